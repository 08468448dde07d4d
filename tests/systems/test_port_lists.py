"""The port list in each system's docstring is the list of its declared ports."""

import importlib
import inspect
import pkgutil
import re
import textwrap
from typing import Any

import pytest
import yaml
from pydrake.systems.framework import LeafSystem

import drake_oa.systems
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.scenario import load_scenario


def system_classes() -> dict[str, type[LeafSystem]]:
    found = {}
    for module in pkgutil.iter_modules(drake_oa.systems.__path__):
        members = vars(importlib.import_module(f"drake_oa.systems.{module.name}"))
        for name, member in members.items():
            if (
                inspect.isclass(member)
                and issubclass(member, LeafSystem)
                and member.__module__.startswith("drake_oa.systems")
            ):
                found[name] = member
    return found


def documented_ports(kind: type[LeafSystem]) -> dict[str, Any]:
    text = textwrap.dedent(inspect.getdoc(kind) or "")
    block = re.search(r"\.\. pydrake_system::\n\n((?: +.*\n|\n)+)", text)
    if block is None:
        raise LookupError(f"{kind.__name__} has no pydrake_system block")
    return yaml.safe_load(textwrap.dedent(block.group(1)))


def test_every_system_documents_its_ports() -> None:
    for name, kind in system_classes().items():
        assert documented_ports(kind)["name"] == name


@pytest.mark.parametrize(
    "override",
    [
        "perception=!DepthCamera {}",
        "perception=!DepthCamera {noise: {}}",
        "perception=!GroundTruth {}",
        "recorded",
        "regulation=!Regressor {}",
    ],
)
def test_documented_ports_are_the_declared_ones(override: str, recording_folder: Any) -> None:
    if override == "recorded":
        override = f"perception=!RecordedClouds {{folder: {recording_folder}}}"
    diagram = build_avoidance(load_scenario("tabletop_box", [override]))
    checked = 0
    for system in diagram.GetSystems():
        if type(system).__module__.startswith("drake_oa."):
            listed = documented_ports(type(system))
            inputs = [system.get_input_port(i).get_name() for i in range(system.num_input_ports())]
            outputs = [
                system.get_output_port(i).get_name() for i in range(system.num_output_ports())
            ]
            assert [str(p).split(" ")[0] for p in listed.get("input_ports") or []] == inputs
            assert [str(p).split(" ")[0] for p in listed["output_ports"]] == outputs
            checked += 1
    rings, depth = "Regressor" in override, "RecordedClouds" not in override
    depth = depth and "GroundTruth" not in override
    assert checked == 7 + depth + (depth and "DepthCamera {}" not in override) + rings
