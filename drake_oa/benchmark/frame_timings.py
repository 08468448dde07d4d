"""Wall times of perception and controller on what a run gave them, for
`drake_oa.benchmark.benchmark`."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import ImageDepth32F

from drake_oa.benchmark.run_timings import camera_rate, robot_of, with_present_images
from drake_oa.benchmark.timings import DESIRED, JUST_AFTER, WARM_UP, port_timer, timed
from drake_oa.common.messages import FloatArray
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.diagrams.control import make_controller
from drake_oa.diagrams.descriptor import make_ellipsoid_descriptor
from drake_oa.diagrams.perception import PIXEL_CENTER, robot_shapes
from drake_oa.perception.config import DepthCamera
from drake_oa.perception.depth_perception import DepthPerception
from drake_oa.robot.plant import make_robot_plant
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.sources import perception_period
from drake_oa.scenario.task_joints import start_positions
from drake_oa.world.station import make_station


@dataclass(frozen=True, eq=False)
class Frame:
    """What perception and controller read at one instant of a run.

    Attributes:
        depth: (H, W) as measured [m].
        X_WC: pose of the camera in the world.
        robot_state: [q, v] of the robot [rad, m and per s].
        desired: port of the policy, of `timings.DESIRED` -> its value.
    """

    depth: NDArray[np.float32]
    X_WC: RigidTransform
    robot_state: FloatArray
    desired: dict[str, FloatArray]


def record(scenario: Scenario, frames: int) -> tuple[list[Frame], list[float], list[float]]:
    """What perception reads in a run: one frame more than asked.

    Args:
        scenario: with a robot and a depth camera.
        frames: how many.

    Returns:
        The frames, and of each the times that rendering and noise took [ms]; of noise none
        where the camera is ideal.

    Raises:
        ScenarioError: if the scenario has no robot or no depth camera.
    """
    rate = camera_rate(scenario)
    simulator = Simulator(build_avoidance(with_present_images(scenario)))
    simulator.Initialize()
    root = simulator.get_context()
    diagram: Any = simulator.get_system()

    def reader(system: str, port: str) -> Callable[[], Any]:
        found = diagram.GetSubsystemByName(system)
        context = found.GetMyContextFromRoot(root)
        return lambda: found.GetOutputPort(port).Eval(context)

    perception = diagram.GetSubsystemByName("perception")
    seen = perception.GetMyContextFromRoot(root)
    noise: Any = None
    if diagram.HasSubsystemNamed("depth_noise"):
        noise = diagram.GetSubsystemByName("depth_noise")
    camera = noise or perception
    rendered = camera.GetMyContextFromRoot(root)
    recorded, rendering, adding = [], [], []
    for i in range(frames + 1):
        # Just before the frame is due, so that nothing has rendered this instant yet.
        simulator.AdvanceTo((i + 1) / rate - JUST_AFTER)
        rendering.append(1e3 * timed(camera.GetInputPort("depth_image").Eval, rendered)[0])
        if noise is not None:
            adding.append(1e3 * timed(noise.GetOutputPort("depth_image").Eval, rendered)[0])
        image = perception.GetInputPort("depth_image").Eval(seen)
        recorded.append(
            Frame(
                np.array(image.data[:, :, 0]),
                RigidTransform(perception.GetInputPort("camera_pose").Eval(seen)),
                np.array(perception.GetInputPort("robot_state").Eval(seen)),
                {name: np.array(reader("dmp_integrator", name)()) for name in DESIRED},
            )
        )
    return recorded, rendering, adding


def time_frames(scenario: Scenario, recorded: list[Frame]) -> tuple[list[float], list[float]]:
    """Wall times of perception and of the descriptor, a frame each [ms].

    Args:
        scenario: from which the frames are.
        recorded: from `record`; the first one is not timed.
    """
    cell = DiagramBuilder()
    station = make_station(cell, scenario)
    robot_plant = make_robot_plant(robot_of(scenario))
    builder = DiagramBuilder()
    source = scenario.perception
    if not isinstance(source, DepthCamera):
        raise TypeError("frames are of a scenario with a depth camera")
    camera = station.cameras[source.camera]
    perception = builder.AddNamedSystem(
        "perception",
        DepthPerception(
            camera.intrinsics,
            config=source.segmentation,
            robot=robot_shapes(robot_plant),
            pixel_center=PIXEL_CENTER,
            period=perception_period(scenario),
            delay=camera.delay,
        ),
    )
    descriptor = builder.AddNamedSystem(
        "descriptor", make_ellipsoid_descriptor(scenario, robot_plant)
    )
    builder.Connect(perception.GetOutputPort("obstacles_W"), descriptor.GetInputPort("obstacles_W"))
    for name in ("depth_image", "camera_pose", "robot_state"):
        builder.ExportInput(perception.GetInputPort(name), name)
    simulator = Simulator(builder.Build())
    describe = port_timer(simulator, "descriptor", "ellipsoids_W")
    _show(simulator, recorded[0])
    simulator.Initialize()
    describe()
    seeing, describing = [], []
    for i, frame in enumerate(recorded[1:], start=1):
        _show(simulator, frame)
        due = i / camera_rate(scenario) + JUST_AFTER
        seeing.append(1e3 * timed(simulator.AdvanceTo, due)[0])
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
    """Median wall time of the control law over so many steps, for states of the run [us]."""
    robot_plant = make_robot_plant(robot_of(scenario))
    controller = make_controller(scenario, robot_plant, start_positions(robot_plant, scenario))
    context = controller.CreateDefaultContext()
    actuation = controller.GetOutputPort("actuation")
    times = []
    for i in range(WARM_UP + steps):
        frame = recorded[i % len(recorded)]
        controller.GetInputPort("robot_state").FixValue(context, frame.robot_state)
        for name, value in frame.desired.items():
            controller.GetInputPort(name).FixValue(context, value)
        times.append(1e6 * timed(actuation.Eval, context)[0])
    return statistics.median(times[WARM_UP:])
