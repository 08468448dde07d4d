"""Ports, outputs and contexts of each system alone, and its response to NaN inputs.

The systems and their inputs come from diagrams of shipped scenarios.
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
    "MotionVerifier.decision",
}
"""Outputs that may be NaN or inf: copies of inputs that no torque depends on, and the times of a
contact that is not predicted and of a decision that has not started."""


Parts = list[tuple[LeafSystem, Context]]
"""Systems of a diagram with their contexts."""


def system_classes() -> dict[str, type[LeafSystem]]:
    """Returns the classes of all systems of the package by name."""
    classes = {}
    for info in pkgutil.walk_packages(drake_oa.__path__, "drake_oa."):
        module = importlib.import_module(info.name)
        for name, member in inspect.getmembers(module, inspect.isclass):
            if issubclass(member, LeafSystem) and member.__module__ == info.name:
                classes[name] = member
    return classes


def own_systems(diagram: Diagram) -> Iterator[LeafSystem]:
    """Yields the systems of a diagram that the package defines."""
    for system in diagram.GetSystems():
        if type(system).__module__.startswith("drake_oa."):
            yield system


def inputs_of(system: LeafSystem) -> list[Any]:
    """Returns the input ports of a system."""
    return [system.get_input_port(i) for i in range(system.num_input_ports())]


def outputs_of(system: LeafSystem) -> list[Any]:
    """Returns the output ports of a system."""
    return [system.get_output_port(i) for i in range(system.num_output_ports())]


def full_name(port: Any) -> str:
    """Returns "Class.port" of a port."""
    return f"{type(port.get_system()).__name__}.{port.get_name()}"


# Ports.


def documented_ports(kind: type[LeafSystem]) -> dict[str, Any]:
    """Returns the port lists in the docstring of a system's class."""
    text = textwrap.dedent(inspect.getdoc(kind) or "")
    block = re.search(r"\.\. pydrake_system::\n\n((?: +.*\n|\n)+)", text)
    if block is None:
        raise LookupError(f"{kind.__name__} has no pydrake_system block")
    return yaml.safe_load(textwrap.dedent(block.group(1)))


def checked_systems(diagram: Diagram) -> set[str]:
    """Compares ports of a diagram's systems with their docstrings; returns the classes."""
    checked = set()
    for system in own_systems(diagram):
        listed = documented_ports(type(system))
        inputs = [port.get_name() for port in inputs_of(system)]
        written = [str(p).partition(" ") for p in listed.get("input_ports") or []]
        # A port "(with x)" exists if the system was constructed with an x.
        required = [name for name, _, kind in written if not kind.startswith("(with")]
        assert inputs in (required, [name for name, _, _ in written])
        outputs = [str(p).split(" ")[0] for p in listed.get("output_ports") or []]
        assert [port.get_name() for port in outputs_of(system)] == outputs
        checked.add(type(system).__name__)
    return checked


def test_every_system_documents_its_ports() -> None:
    for name, kind in system_classes().items():
        assert documented_ports(kind)["name"] == name


# Each system alone.


@pytest.fixture(scope="module")
def diagrams(recording_folder: Path, straight_log: Any) -> dict[str, Diagram]:
    """Diagrams that together have every system except those of hardware and of baselines."""
    recorded = f"perception=!RecordedClouds {{folder: {recording_folder}}}"
    meshcat = Meshcat()
    built = {}
    for name, (shipped, *overrides) in OVERRIDES.items():
        scenario = load_scenario(shipped, overrides + [recorded] * (name == "recorded"))
        built[name] = build_avoidance(scenario, meshcat=meshcat if name == "point" else None)
    built["replay"] = build_replay(load_scenario("free_space"), straight_log(), meshcat)
    return built


def alone(system: LeafSystem, inner: Context) -> Simulator:
    """Creates the simulator of one system, with the inputs fixed to their values in a context."""
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
    """Pickler of messages that stores images, clouds and forces as arrays."""

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, ImageDepth32F):
            return np.array, (value.data,)
        if isinstance(value, PointCloud):
            return np.array, (value.xyzs(),)
        if isinstance(value, ExternallyAppliedSpatialForce):
            return np.array, (value.F_Bq_W.get_coeffs(),)
        return NotImplemented


def outputs_at(simulator: Simulator, time: float) -> dict[str, bytes]:
    """Advances to a time [s], and returns the pickled outputs of the system by name."""
    simulator.AdvanceTo(time)
    outputs = {}
    for port in outputs_of(simulator.get_system()):
        Bits(file := io.BytesIO()).dump(port.Eval(simulator.get_context()))
        outputs[port.get_name()] = file.getvalue()
    return outputs


def test_the_diagrams_have_every_system(diagrams: dict[str, Diagram]) -> None:
    live = load_scenario("tabletop_box", ["perception=!LcmCamera {lcm_url: 'memq://'}"])
    every = [*diagrams.values(), build_avoidance(live)]
    checked = set().union(*map(checked_systems, every))
    # Tests of hardware and evaluation check the first ones; the next two are base classes.
    others = {"CommandStream", "CommandedJoints", "MeasuredState", "ProgramInputs"}
    others |= {"TimedCamera", "InverseDynamics"}
    # Their package is optional; tests of bags check them.
    others |= {"BagCamera", "ImageRecorder"}
    assert checked == set(system_classes()) - others
    assert set(drake_oa.__all__) <= checked & set(dir(drake_oa))
    assert all(getattr(drake_oa, name) is system_classes()[name] for name in drake_oa.__all__)


@pytest.fixture(params=[*OVERRIDES, "replay"])
def parts(diagrams: dict[str, Diagram], request: pytest.FixtureRequest) -> Parts:
    """Systems of one of the diagrams, with their contexts at 0.05 s."""
    whole = Simulator(diagrams[request.param])
    whole.AdvanceTo(0.05)
    root = whole.get_context()
    return [(one, one.GetMyContextFromRoot(root)) for one in own_systems(diagrams[request.param])]


def test_clone_of_a_context_has_identical_outputs(parts: Parts) -> None:
    for system, inner in parts:
        one = alone(system, inner)
        begin = one.get_context().Clone()
        first = outputs_at(one, 0.1)
        other = Simulator(system, one.get_context().Clone())
        other.Initialize(InitializeParams(suppress_initialization_events=True))
        assert outputs_at(one, 0.21) == outputs_at(other, 0.21)
        # The state is in the context alone.
        assert outputs_at(Simulator(system, begin), 0.1) == first


def test_nan_input_yields_finite_commands(parts: Parts) -> None:
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
                continue  # The system refuses the input.
            for output in outputs_of(system):
                name = full_name(output)
                if output.get_data_type() == PortDataType.kVectorValued and name not in ECHOES:
                    assert np.isfinite(output.Eval(one.get_context())).all(), name
