"""Wall times of the layers, and of Drake alone, for `drake_oa.benchmark`."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.controllers import InverseDynamics
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import ZeroOrderHold
from pydrake.systems.sensors import ImageDepth32F

from drake_oa import layers
from drake_oa.action import Segment
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.scenario import (
    DepthCamera,
    EllipsoidConfig,
    GivenEllipsoids,
    Regressor,
    Robot,
    Scenario,
    ScenarioError,
    Task,
)
from drake_oa.simulation import simulate
from drake_oa.station import home_positions, make_robot_plant, make_station
from drake_oa.surroundings import Surroundings
from drake_oa.values import FloatArray

OBSTACLES = 6
"""How many the policy is timed among."""

_WARM_UP = 10
_JUST_AFTER = 1e-6
_DESIRED = ("desired_position", "desired_velocity", "desired_acceleration")
_Answer = TypeVar("_Answer")


@dataclass(frozen=True, eq=False)
class Frame:
    """What perception and controller read at one instant of a run."""

    depth: NDArray[np.float32]
    X_WC: RigidTransform
    robot_state: FloatArray
    desired: dict[str, FloatArray]


def _timed(call: Callable[..., _Answer], *arguments: object) -> tuple[float, _Answer]:
    """Wall time [s] of a call, and its answer."""
    started = time.perf_counter()
    answer = call(*arguments)
    return time.perf_counter() - started, answer


# --- real-time factor ---------------------------------------------------------------


def camera_rate(scenario: Scenario) -> float:
    """Frames a second of the camera that perception looks through."""
    perception = scenario.perception
    if scenario.robot is None or not isinstance(perception, DepthCamera):
        raise ScenarioError(
            "benchmark: needs a scenario with a robot and 'perception: !DepthCamera'"
        )
    return float(next(c.fps for c in scenario.cameras if c.name == perception.camera))


def _robot(scenario: Scenario) -> Robot:
    if scenario.robot is None:
        raise ScenarioError("robot: the benchmark needs a robot; this scenario has null")
    return scenario.robot


def bare_station(scenario: Scenario, *, render: bool = True) -> Diagram:
    """Drake alone: the scenario's plant and camera without our systems.

    The arm is held at its seed by Drake's gravity compensation, and the image is pulled
    at the camera's rate.

    Args:
        scenario: with a robot and a depth camera.
        render: whether there is a camera at all.

    Raises:
        ScenarioError: if it has no robot or no depth camera.
    """
    rate, robot = camera_rate(scenario), _robot(scenario)
    builder = DiagramBuilder()
    station = make_station(builder, scenario, render=render)
    robot_plant = make_robot_plant(robot)
    station.plant.SetDefaultPositions(station.robot, home_positions(robot_plant, robot))
    holder = builder.AddNamedSystem(
        "gravity_compensation",
        InverseDynamics(
            robot_plant.plant, InverseDynamics.InverseDynamicsMode.kGravityCompensation
        ),
    )
    builder.Connect(
        station.plant.get_state_output_port(station.robot), holder.get_input_port_estimated_state()
    )
    builder.Connect(holder.get_output_port(), station.plant.get_actuation_input_port(station.robot))
    if render and isinstance(scenario.perception, DepthCamera):
        image = station.cameras[scenario.perception.camera].depth_image_32F_output_port()
        puller = builder.AddNamedSystem("puller", ZeroOrderHold(1.0 / rate, image.Allocate()))
        builder.Connect(image, puller.get_input_port())
    return builder.Build()


def real_time_factor(diagram: Diagram, seconds: float) -> float:
    """Simulated over wall time of a diagram alone, over some simulated seconds."""
    simulator = Simulator(diagram)
    simulator.Initialize()
    # The first image loads the renderer.
    simulator.AdvanceTo(0.02)
    elapsed, _ = _timed(simulator.AdvanceTo, 0.02 + seconds)
    return seconds / elapsed


def whole_real_time_factor(scenario: Scenario, seconds: float) -> float:
    """As `drake-oa run` reports it: logs and supervision included, no viewer."""
    log = simulate(scenario, duration=seconds)
    return log.duration / log.wall_time


def time_plant(scenario: Scenario, steps: int) -> list[float]:
    """Wall time of each step of the plant alone [us]."""
    simulator = Simulator(bare_station(scenario, render=False))
    simulator.Initialize()
    step = scenario.plant_step
    simulator.AdvanceTo((_WARM_UP - 0.5) * step)
    return [
        1e6 * _timed(simulator.AdvanceTo, (i + 0.5) * step)[0]
        for i in range(_WARM_UP, _WARM_UP + steps)
    ]


# --- policy -------------------------------------------------------------------------


def six_obstacles(scenario: Scenario) -> Scenario:
    """The scenario's policy among six ellipsoids on a baseline of 1 m, no robot.

    The baseline runs into all of them, and the coupling is the paper's: each takes part in
    regressor chain, route and coupling. (Of verified motions at most one term acts.)
    """
    angles = np.arange(OBSTACLES) * (2.0 * np.pi / OBSTACLES)
    ellipsoids = [
        EllipsoidConfig(
            center=[0.2 + 0.1 * i, 0.02 * float(np.cos(a)), 0.02 * float(np.sin(a))],
            semi_axes=[0.03, 0.05, 0.04],
            rpy=[0.1 * i, 0.0, float(a)],
        )
        for i, a in enumerate(angles)
    ]
    return replace(
        scenario,
        robot=None,
        table_height=None,
        directives=[],
        cameras=[],
        task=Task(start=[0.0, 0.0, 0.0], goal=[1.0, 0.0, 0.0], clearance=0.1),
        perception=GivenEllipsoids(ellipsoids),
        regulation=Regressor(),
    )


class _PolicyRun:
    """The policy among six obstacles, stepped by hand.

    Drake updates when it leaves a time and publishes when it arrives: from an instant of
    the policy to just after it there is one step of the policy and no log.
    """

    def __init__(self, scenario: Scenario) -> None:
        among = six_obstacles(scenario)
        self.simulator = Simulator(build_avoidance(among))
        self.simulator.Initialize()
        self._layers = [
            self.context(name)
            for name in ("cost_ring_selector", "regressor_chain", "dmp_integrator")
        ]
        self._period = scenario.policy.period
        self._step = _WARM_UP
        self.simulator.AdvanceTo(self._step * self._period)

    def system(self, name: str) -> Any:
        """A subsystem."""
        diagram: Any = self.simulator.get_system()
        return diagram.GetSubsystemByName(name)

    def context(self, name: str) -> Any:
        """The context of a subsystem."""
        return self.system(name).GetMyContextFromRoot(self.simulator.get_context())

    def forget(self) -> None:
        """Makes every layer answer anew: while the obstacles stay they need not."""
        for context in self._layers:
            context.SetAllCacheEntriesOutOfDate()

    def time_step(self) -> float:
        """Wall time of a policy step [us]; the run stands just after it."""
        end = self._step * self._period + _JUST_AFTER
        return 1e6 * _timed(self.simulator.AdvanceTo, end)[0]

    def time_rest(self) -> float:
        """Wall time from just after a step to just before the next one [us]."""
        end = (self._step + 1) * self._period - _JUST_AFTER
        return 1e6 * _timed(self.simulator.AdvanceTo, end)[0]

    def go_on(self) -> None:
        """Advances to the next step."""
        self._step += 1
        self.simulator.AdvanceTo(self._step * self._period)

    def timer(self, system: str, *ports: str) -> Callable[[], float]:
        """What times the evaluation of output ports [us]."""
        return _port_timer(self.simulator, system, *ports)

    def check(self) -> None:
        """Raises ScenarioError if what was timed was no motion."""
        diagram: Any = self.simulator.get_system()
        state = diagram.GetOutputPort("policy_state").Eval(self.simulator.get_context())
        if state.note:
            raise ScenarioError(f"policy: it is held among the benchmark's obstacles: {state.note}")


def _port_timer(simulator: Simulator, name: str, *ports: str) -> Callable[[], float]:
    diagram: Any = simulator.get_system()
    system = diagram.GetSubsystemByName(name)
    context = system.GetMyContextFromRoot(simulator.get_context())
    outputs = [system.GetOutputPort(port) for port in ports]
    return lambda: 1e6 * sum(_timed(port.Eval, context)[0] for port in outputs)


def time_policy(scenario: Scenario, steps: int) -> tuple[list[float], list[float]]:
    """Wall times of policy steps, Simulator included, logs not [us].

    Returns:
        Of steps in which every layer answers anew, as after each observation; and of
        steps as they come in a run. In most of those the policy alone has something to
        do; those just after a route decision cost as much as the first kind, so that
        the mean is well above the median.
    """
    complete: list[float] = []
    running: list[float] = []
    run = _PolicyRun(scenario)
    # One kind after the other, as most steps of a run follow one in which the policy alone
    # had something to do: just after one in which every layer had, it is slower.
    for times in (running, complete):
        for _ in range(steps):
            if times is complete:
                run.forget()
            times.append(run.time_step())
            run.go_on()
        run.check()
    return complete, running


def time_kernel(scenario: Scenario, samples: int, steps: int = 100) -> list[float]:
    """Wall times of the compiled policy step among six obstacles [us].

    Each is the mean over as many steps as one call of the kernel takes, so that nothing of
    Python is left in it.

    Args:
        scenario: whose policy it is.
        samples: how many times.
        steps: how many steps each is the mean of.

    Raises:
        ScenarioError: if the motion is held, so that there is less to do.
    """
    run = _PolicyRun(scenario)
    policy, context = run.system("dmp_integrator"), run.context("dmp_integrator")
    read = {
        name: policy.GetInputPort(name).Eval(context)
        for name in ("goal", "ellipsoids_W", "coupling_parameters", "route")
    }
    around = Surroundings.of(read["ellipsoids_W"], read["coupling_parameters"], read["route"])
    before = Segment.resting(policy.GetOutputPort("policy_state").Eval(context))

    def sample() -> float:
        elapsed, after = _timed(
            policy.level.step,
            before,
            read["goal"],
            around,
            before.end.stamp,
            scenario.policy.period,
            steps,
        )
        if after.note:
            raise ScenarioError(f"policy: it is held among the obstacles: {after.note}")
        return 1e6 * elapsed / steps

    sample()
    return [sample() for _ in range(samples)]


def time_layers(scenario: Scenario, steps: int) -> dict[str, float]:
    """Median wall times [us] of the layers of a policy step, and of what surrounds it.

    Keys: "route" and "regressor chain", when they answer anew; "coupling and DMP" (with
    the Simulator) of each policy step; "desired motion", interpolated for each step of the
    controller; "route decision", at its own period, absent where it always coincides with
    a policy step.
    """
    run = _PolicyRun(scenario)
    route = run.timer("cost_ring_selector", "decision")
    chain = run.timer("regressor_chain", "coupling_parameters")
    desired = run.timer("dmp_integrator", *_DESIRED)
    selector = run.context("cost_ring_selector")
    times: dict[str, list[float]] = {}

    def keep(name: str, elapsed: float) -> None:
        times.setdefault(name, []).append(elapsed)

    for i in range(
        max(2 * steps, int(2.0 * scenario.policy.route_period / scenario.policy.period))
    ):
        if i % 2 == 0:
            run.forget()
            keep("route", route())
            keep("regressor chain", chain())
            run.time_step()
        else:
            # The other two's answers are in the cache: the rest of the step remains.
            keep("coupling and DMP", run.time_step())
        keep("desired motion", desired())
        # Its only state is the decision: another object once it has been taken anew.
        before = selector.get_abstract_state(0).get_value()
        rest = run.time_rest()
        if selector.get_abstract_state(0).get_value() is not before:
            keep("route decision", rest)
        run.go_on()
    run.check()
    return {name: statistics.median(values) for name, values in times.items()}


# --- perception and control ---------------------------------------------------------


def record(scenario: Scenario, frames: int) -> tuple[list[Frame], list[float]]:
    """What the camera sees in a run, one frame more than asked, and rendering times [ms]."""
    rate = camera_rate(scenario)
    simulator = Simulator(build_avoidance(scenario))
    simulator.Initialize()
    root = simulator.get_context()
    diagram: Any = simulator.get_system()

    def reader(system: str, port: str) -> Callable[[], Any]:
        found = diagram.GetSubsystemByName(system)
        context = found.GetMyContextFromRoot(root)
        return lambda: found.GetOutputPort(port).Eval(context)

    perception = diagram.GetSubsystemByName("perception")
    seen = perception.GetMyContextFromRoot(root)
    recorded, rendering = [], []
    for i in range(frames + 1):
        # Just before the frame is due, so that nothing has rendered this instant yet.
        simulator.AdvanceTo((i + 1) / rate - _JUST_AFTER)
        elapsed, image = _timed(perception.GetInputPort("depth_image").Eval, seen)
        rendering.append(1e3 * elapsed)
        recorded.append(
            Frame(
                np.array(image.data[:, :, 0]),
                RigidTransform(perception.GetInputPort("camera_pose").Eval(seen)),
                np.array(perception.GetInputPort("robot_state").Eval(seen)),
                {name: np.array(reader("dmp_integrator", name)()) for name in _DESIRED},
            )
        )
    return recorded, rendering


def time_frames(scenario: Scenario, recorded: list[Frame]) -> tuple[list[float], list[float]]:
    """Wall times of perception and of the descriptor, a frame each [ms]."""
    cell = DiagramBuilder()
    station = make_station(cell, scenario)
    robot_plant = make_robot_plant(_robot(scenario))
    builder = DiagramBuilder()
    perception = builder.AddNamedSystem(
        "perception", layers.make_perception(scenario, station, robot_plant)
    )
    descriptor = builder.AddNamedSystem(
        "descriptor", layers.make_ellipsoid_descriptor(scenario, robot_plant)
    )
    builder.Connect(perception.GetOutputPort("obstacles_W"), descriptor.GetInputPort("obstacles_W"))
    for name in ("depth_image", "camera_pose", "robot_state"):
        builder.ExportInput(perception.GetInputPort(name), name)
    simulator = Simulator(builder.Build())
    describe = _port_timer(simulator, "descriptor", "ellipsoids_W")
    _show(simulator, recorded[0])
    simulator.Initialize()
    describe()
    seeing, describing = [], []
    for i, frame in enumerate(recorded[1:], start=1):
        _show(simulator, frame)
        due = i / camera_rate(scenario) + _JUST_AFTER
        seeing.append(1e3 * _timed(simulator.AdvanceTo, due)[0])
        describing.append(1e-3 * describe())
    return seeing, describing


def _show(simulator: Simulator, frame: Frame) -> None:
    diagram: Any = simulator.get_system()
    context = simulator.get_mutable_context()
    image = ImageDepth32F(frame.depth.shape[1], frame.depth.shape[0])
    image.mutable_data[:, :, 0] = frame.depth
    diagram.GetInputPort("depth_image").FixValue(context, image)
    diagram.GetInputPort("camera_pose").FixValue(context, frame.X_WC)
    diagram.GetInputPort("robot_state").FixValue(context, frame.robot_state)


def time_controller(scenario: Scenario, recorded: list[Frame], steps: int) -> float:
    """Median wall time of the control law, for states of the run [us]."""
    robot_plant = make_robot_plant(_robot(scenario))
    controller = layers.make_controller(
        scenario, robot_plant, layers.start_positions(robot_plant, scenario)
    )
    context = controller.CreateDefaultContext()
    actuation = controller.GetOutputPort("actuation")
    times = []
    for i in range(_WARM_UP + steps):
        frame = recorded[i % len(recorded)]
        controller.GetInputPort("robot_state").FixValue(context, frame.robot_state)
        for name, value in frame.desired.items():
            controller.GetInputPort(name).FixValue(context, value)
        times.append(1e6 * _timed(actuation.Eval, context)[0])
    return statistics.median(times[_WARM_UP:])
