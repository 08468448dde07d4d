"""The port list in each system's docstring is the list of its declared ports."""

import importlib
import inspect
import pkgutil
import re
import textwrap
from typing import Any

import pytest
import yaml
from pydrake.systems.framework import Diagram, LeafSystem

import drake_oa
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.scenario.loading import load_scenario


def system_classes() -> dict[str, type[LeafSystem]]:
    found = {}
    for module in pkgutil.walk_packages(drake_oa.__path__, "drake_oa."):
        if module.name == "drake_oa.studies.scenes.peers":
            continue  # Needs a package that is not ours.
        for name, member in vars(importlib.import_module(module.name)).items():
            if (
                inspect.isclass(member)
                and issubclass(member, LeafSystem)
                and member.__module__ == module.name
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


def checked_systems(diagram: Diagram) -> set[str]:
    """Names of our systems in a diagram, whose ports were compared."""
    checked = set()
    for system in diagram.GetSystems():
        if type(system).__module__.startswith("drake_oa."):
            listed = documented_ports(type(system))
            inputs = [system.get_input_port(i).get_name() for i in range(system.num_input_ports())]
            outputs = [
                system.get_output_port(i).get_name() for i in range(system.num_output_ports())
            ]
            written = [str(p).partition(" ") for p in listed.get("input_ports") or []]
            # A port "(with x)" is there when the system was given an x.
            given = [name for name, _, kind in written if not kind.startswith("(with")]
            assert inputs in (given, [name for name, _, _ in written])
            assert [str(p).split(" ")[0] for p in listed.get("output_ports") or []] == outputs
            checked.add(type(system).__name__)
    return checked


ALWAYS = {"CartesianInverseDynamics", "DmpIntegrator", "EllipsoidDescriptor", "Supervisor"}
ALWAYS |= {"ObstacleEvasion"}


@pytest.mark.parametrize(
    ("override", "others"),
    [
        ("perception=!DepthCamera {}", {"DepthPerception", "MotionSelector", "CloudSolids"}),
        ("perception=!DepthCamera {noise: {}}", {"LateCamera"}),
        ("perception=!LcmCamera {lcm_url: 'memq://'}", {"LiveCamera", "DepthPerception"}),
        ("perception=!GroundTruth {}", {"GroundTruthPerception", "TrueSolids"}),
        ("recorded", {"RecordedPerception"}),
        ("regulation=!Paper {}", {"RegressorChain", "CostRingSelector"}),
        ("task.rpy_goal=[3.0, 0.0, 1.0]", {"OrientationIntegrator"}),
        ("faults=[!Push {}]", {"ExternalPush"}),
    ],
)
def test_documented_ports_are_the_declared_ones(
    override: str, others: set[str], recording_folder: Any
) -> None:
    if override == "recorded":
        override = f"perception=!RecordedClouds {{folder: {recording_folder}}}"
    checked = checked_systems(build_avoidance(load_scenario("tabletop_box", [override])))
    assert checked >= ALWAYS | others


def test_several_cameras_have_the_ports_of_one_with_their_names() -> None:
    diagram = build_avoidance(load_scenario("two_cameras"))
    for name, more in (("perception", ["views"]), ("solids", ["views"])):
        system = diagram.GetSubsystemByName(name)
        listed = documented_ports(type(system))
        inputs = [system.get_input_port(i).get_name() for i in range(system.num_input_ports())]
        written = [str(p).partition(" ")[0] for p in listed["input_ports"]]
        for side in ("left", "right"):
            own = [port.removesuffix(f"_{side}") for port in inputs if port.endswith(f"_{side}")]
            assert own == [port for port in written if port != "obstacles_W"]
        ports = inputs + [
            system.get_output_port(i).get_name() for i in range(system.num_output_ports())
        ]
        assert [port for port in ports if port in more] == more
