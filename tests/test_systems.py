"""Every system alone: its ports, its outputs, its context, and inputs that are not a number.

The systems and their inputs are those of diagrams of shipped scenarios.
"""

import importlib
import inspect
import io
import pickle
import pkgutil
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from pydrake.geometry import Meshcat
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from pydrake.perception import PointCloud
from pydrake.systems.analysis import InitializeParams, Simulator
from pydrake.systems.framework import Context, Diagram, LeafSystem, PortDataType
from pydrake.systems.sensors import ImageDepth32F

import drake_oa
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.runs.replay import build_replay
from drake_oa.scenario.loading import load_scenario

OVERRIDES = {
    "depth": ["tabletop_box"],
    "truth": ["tabletop_box", "perception=!GroundTruth {}"],
    "recorded": ["tabletop_box"],
    "point": ["free_space"],
    "given": [
        "tabletop_box",
        "inference=!Paper {}",
        "perception=!GivenEllipsoids {ellipsoids: [{center: [0.5, 0.0, 0.2]}]}",
    ],
    "paper": ["tabletop_box", "inference=!Paper {}"],
    "turned": ["tabletop_box", "task.rpy_goal=[3.0, 0.0, 1.0]"],
    "moving": ["moving_obstacle", "perception=!GroundTruth {}"],
    "faults": ["tabletop_box", "faults=[!Push {}, !TorqueSaturation {}, !CameraDropout {}]"],
}
ECHOES = {
    "CartesianInverseDynamics.tracking_error",
    "CartesianInverseDynamics.orientation_error",
    "MotionGuard.guard_contact",
    "MotionGuard.path_state",
    "MotionGuard.tracking_error",
    "MotionGuard.orientation_error",
}
"""Outputs that hand on an input that is not a number, and the time of a contact that never comes;
the controller commands no torque of them."""


Parts = list[tuple[LeafSystem, Context]]


def system_classes() -> dict[str, type[LeafSystem]]:
    """All systems of the package by name."""
    found = {}
    for module in pkgutil.walk_packages(drake_oa.__path__, "drake_oa."):
        for name, member in vars(importlib.import_module(module.name)).items():
            if (
                inspect.isclass(member)
                and issubclass(member, LeafSystem)
                and member.__module__ == module.name
            ):
                found[name] = member
    return found


def own_systems(diagram: Diagram) -> Iterator[LeafSystem]:
    """The package's systems in a diagram."""
    for system in diagram.GetSystems():
        if type(system).__module__.startswith("drake_oa."):
            yield system


def inputs_of(system: LeafSystem) -> list[Any]:
    return [system.get_input_port(i) for i in range(system.num_input_ports())]


def outputs_of(system: LeafSystem) -> list[Any]:
    return [system.get_output_port(i) for i in range(system.num_output_ports())]


def full_name(port: Any) -> str:
    return f"{type(port.get_system()).__name__}.{port.get_name()}"


# Ports.


def documented_ports(kind: type[LeafSystem]) -> dict[str, Any]:
    """The port list of a system's docstring."""
    text = textwrap.dedent(inspect.getdoc(kind) or "")
    block = re.search(r"\.\. pydrake_system::\n\n((?: +.*\n|\n)+)", text)
    if block is None:
        raise LookupError(f"{kind.__name__} has no pydrake_system block")
    return yaml.safe_load(textwrap.dedent(block.group(1)))


def checked_systems(diagram: Diagram) -> set[str]:
    """Names of the package's systems in a diagram, whose ports were compared."""
    checked = set()
    for system in own_systems(diagram):
        listed = documented_ports(type(system))
        inputs = [port.get_name() for port in inputs_of(system)]
        written = [str(p).partition(" ") for p in listed.get("input_ports") or []]
        # A port "(with x)" is there when the system was given an x.
        given = [name for name, _, kind in written if not kind.startswith("(with")]
        assert inputs in (given, [name for name, _, _ in written])
        outputs = [str(p).split(" ")[0] for p in listed.get("output_ports") or []]
        assert [port.get_name() for port in outputs_of(system)] == outputs
        checked.add(type(system).__name__)
    return checked


def test_every_system_documents_its_ports() -> None:
    for name, kind in system_classes().items():
        assert documented_ports(kind)["name"] == name


# Each alone.


@pytest.fixture(scope="module")
def diagrams(recording_folder: Path, straight_log: Any) -> dict[str, Diagram]:
    """Diagrams that have every system but those on the bus of a robot and of a baseline."""
    recorded = f"perception=!RecordedClouds {{folder: {recording_folder}}}"
    meshcat = Meshcat()
    built = {}
    for name, (shipped, *overrides) in OVERRIDES.items():
        scenario = load_scenario(shipped, overrides + [recorded] * (name == "recorded"))
        built[name] = build_avoidance(scenario, meshcat=meshcat if name == "point" else None)
    built["replay"] = build_replay(load_scenario("free_space"), straight_log(), meshcat)
    return built


def alone(system: LeafSystem, inner: Context) -> Simulator:
    """A simulation of one system, its inputs fixed at their values in the diagram's context."""
    context = system.CreateDefaultContext()
    for port in inputs_of(system):
        if port.HasValue(inner):
            value: Any = port.Eval(inner)
            if port.get_data_type() == PortDataType.kAbstractValued:
                value = port.Allocate()
                value.set_value(port.Eval(inner))
            port.FixValue(context, value)
    return Simulator(system, context)


class Bits(pickle.Pickler):
    """Pickles messages, with images and clouds as their arrays."""

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, ImageDepth32F):
            return np.array, (value.data,)
        if isinstance(value, PointCloud):
            return np.array, (value.xyzs(),)
        if isinstance(value, ExternallyAppliedSpatialForce):
            return np.array, (value.F_Bq_W.get_coeffs(),)
        return NotImplemented


def outputs_at(simulator: Simulator, time: float) -> dict[str, bytes]:
    """All outputs by name, once the simulator has gone on to a time [s]."""
    simulator.AdvanceTo(time)
    found = {}
    for port in outputs_of(simulator.get_system()):
        Bits(file := io.BytesIO()).dump(port.Eval(simulator.get_context()))
        found[port.get_name()] = file.getvalue()
    return found


def test_the_diagrams_have_every_system(diagrams: dict[str, Diagram]) -> None:
    live = load_scenario("tabletop_box", ["perception=!LcmCamera {lcm_url: 'memq://'}"])
    every = [*diagrams.values(), build_avoidance(live)]
    checked = set().union(*map(checked_systems, every))
    # Tested in tests/hardware and in tests/evaluation; and base classes.
    others = {"CommandStream", "CommandedJoints", "MeasuredState", "ProgramInputs"}
    others |= {"TimedCamera", "InverseDynamics"}
    assert checked == set(system_classes()) - others
    assert set(drake_oa.__all__) <= checked


@pytest.fixture(params=[*OVERRIDES, "replay"])
def parts(diagrams: dict[str, Diagram], request: pytest.FixtureRequest) -> Parts:
    """The systems of one of the diagrams, and their contexts after a while."""
    whole = Simulator(diagrams[request.param])
    whole.AdvanceTo(0.05)
    root = whole.get_context()
    return [(one, one.GetMyContextFromRoot(root)) for one in own_systems(diagrams[request.param])]


def test_a_clone_goes_on_to_the_same_bits(parts: Parts) -> None:
    for system, inner in parts:
        one = alone(system, inner)
        begin = one.get_context().Clone()
        first = outputs_at(one, 0.1)
        other = Simulator(system, one.get_context().Clone())
        other.Initialize(InitializeParams(suppress_initialization_events=True))
        assert outputs_at(one, 0.21) == outputs_at(other, 0.21)
        # Nothing is kept outside the context.
        assert outputs_at(Simulator(system, begin), 0.1) == first


def test_an_input_that_is_not_a_number_is_no_command(parts: Parts) -> None:
    for system, inner in parts:
        for port in inputs_of(system):
            simulated = type(system).__module__.startswith("drake_oa.world.")
            if simulated or port.get_data_type() != PortDataType.kVectorValued:
                continue
            one = alone(system, inner)
            port.FixValue(one.get_mutable_context(), np.full(port.size(), np.nan))
            try:
                outputs_at(one, 0.02)
            except ValueError:
                continue  # It is refused.
            for output in outputs_of(system):
                name = full_name(output)
                if output.get_data_type() == PortDataType.kVectorValued and name not in ECHOES:
                    assert np.isfinite(output.Eval(one.get_context())).all(), name
