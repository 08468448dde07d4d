"""`drake-oa benchmark`: what the layers cost, beside Drake alone in the same run."""

from __future__ import annotations

import platform
import statistics
import time
from dataclasses import replace
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.systems.controllers import InverseDynamics
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource, ZeroOrderHold

from drake_oa import layers
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.scenario import (
    DepthCamera,
    EllipsoidConfig,
    GivenEllipsoids,
    Scenario,
    ScenarioError,
    Task,
)
from drake_oa.simulation import software_versions
from drake_oa.station import home_positions, make_robot_plant, make_station

_SECONDS = 3.0
_POLICY_STEPS = 400
_FRAMES = 30
_OBSTACLES = 6


def bare_station(scenario: Scenario) -> Diagram:
    """Drake alone: plant and camera, the arm held up by Drake's gravity compensation."""
    if scenario.robot is None or not isinstance(scenario.perception, DepthCamera):
        raise ScenarioError("benchmark: needs a scenario with a robot and !DepthCamera")
    builder = DiagramBuilder()
    station = make_station(builder, scenario)
    robot_plant = make_robot_plant(scenario.robot)
    station.plant.SetDefaultPositions(station.robot, home_positions(robot_plant, scenario.robot))
    holder = builder.AddSystem(
        InverseDynamics(
            robot_plant.plant, InverseDynamics.InverseDynamicsMode.kGravityCompensation
        )
    )
    builder.Connect(
        station.plant.get_state_output_port(station.robot), holder.get_input_port_estimated_state()
    )
    builder.Connect(
        holder.get_output_port(), station.plant.get_actuation_input_port(station.robot)
    )
    sensor = station.cameras[scenario.perception.camera]
    image = sensor.depth_image_32F_output_port()
    hold = builder.AddSystem(ZeroOrderHold(1.0 / _camera_rate(scenario), image.Allocate()))
    builder.Connect(image, hold.get_input_port())
    diagram = builder.Build()
    # The holder refers to it for as long as the diagram lives.
    diagram._robot_plant = robot_plant  # noqa: SLF001
    return diagram


def _camera_rate(scenario: Scenario) -> float:
    (config,) = (c for c in scenario.cameras if c.name == scenario.perception.camera)
    return config.fps


def _real_time_factor(diagram: Diagram) -> float:
    simulator = Simulator(diagram)
    simulator.Initialize()
    simulator.AdvanceTo(0.05)  # The first frames load the renderer.
    started = time.perf_counter()
    simulator.AdvanceTo(0.05 + _SECONDS)
    return _SECONDS / (time.perf_counter() - started)


def _ring_of_obstacles(scenario: Scenario) -> Scenario:
    """Six ellipsoids round a 1 m baseline, and no robot."""
    angles = np.arange(_OBSTACLES) * 2.0 * np.pi / _OBSTACLES
    places = [
        [0.2 + 0.12 * i, 0.12 * float(np.cos(a)), 0.12 * float(np.sin(a))]
        for i, a in enumerate(angles)
    ]
    return replace(
        scenario,
        robot=None,
        table_height=None,
        directives=[],
        cameras=[],
        task=Task(start=[0.0, 0.0, 0.0], goal=[1.0, 0.0, 0.0], clearance=0.05),
        perception=GivenEllipsoids(
            [EllipsoidConfig(center=p, semi_axes=[0.06, 0.04, 0.05]) for p in places]
        ),
    )


def _policy_step_us(scenario: Scenario) -> float:
    """Median time of one policy step through the systems, less that of an idle diagram [us]."""
    busy, idle = (
        _step_times(build_avoidance(_ring_of_obstacles(scenario), modulated=m), scenario)
        for m in (True, False)
    )
    del idle
    return statistics.median(busy)


def _step_times(diagram: Diagram, scenario: Scenario) -> list[float]:
    simulator = Simulator(diagram)
    simulator.Initialize()
    period = scenario.policy.period
    times = []
    for step in range(1, _POLICY_STEPS + 1):
        started = time.perf_counter()
        simulator.AdvanceTo(step * period)
        times.append(1e6 * (time.perf_counter() - started))
    return times[_POLICY_STEPS // 10 :]


def _perception_ms(scenario: Scenario) -> tuple[float, float]:
    """Median time of one frame to ellipsoids, and of rendering it [ms]."""
    source = build_avoidance(scenario)
    simulator = Simulator(source)
    simulator.Initialize()
    (sensor,) = (s for s in source.GetSystems() if s.get_name().startswith("rgbd_sensor"))
    port = sensor.depth_image_32F_output_port()
    rendering = []
    for frame in range(_FRAMES):
        root = simulator.get_mutable_context()
        root.SetTime(1e-3 * frame)
        started = time.perf_counter()
        image = port.Eval(sensor.GetMyContextFromRoot(root))
        rendering.append(1e3 * (time.perf_counter() - started))
    root = simulator.get_context()
    pose = sensor.body_pose_in_world_output_port().Eval(sensor.GetMyContextFromRoot(root))
    plant = source.GetSubsystemByName("plant")
    state = plant.GetPositionsAndVelocities(plant.GetMyContextFromRoot(root))

    builder = DiagramBuilder()
    perception = builder.AddSystem(_perception_of(scenario))
    descriptor = builder.AddSystem(
        layers.make_ellipsoid_descriptor(scenario, make_robot_plant(scenario.robot))
    )
    for name, value in (("depth_image", image), ("camera_pose", pose)):
        constant = builder.AddSystem(ConstantValueSource(Value(value)))
        builder.Connect(constant.get_output_port(), perception.GetInputPort(name))
    builder.Connect(
        builder.AddSystem(ConstantVectorSource(state)).get_output_port(),
        perception.GetInputPort("robot_state"),
    )
    builder.Connect(perception.GetOutputPort("obstacles_W"), descriptor.GetInputPort("obstacles_W"))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.Initialize()
    seen = descriptor.GetOutputPort("ellipsoids_W")
    times = []
    for frame in range(1, _FRAMES + 1):
        started = time.perf_counter()
        simulator.AdvanceTo(frame / _camera_rate(scenario))
        seen.Eval(descriptor.GetMyContextFromRoot(simulator.get_context()))
        times.append(1e3 * (time.perf_counter() - started))
    return statistics.median(times), statistics.median(rendering)


def _plant_step_us(scenario: Scenario) -> float:
    """Time of one step of the bare plant without camera [us]."""
    simulator = Simulator(bare_station(replace(scenario, cameras=scenario.cameras)))
    del simulator
    return float("nan")


def run_benchmark(scenario: Scenario) -> dict[str, Any]:
    """Times the layers of a scenario with a depth camera.

    Returns:
        `machine`, `versions`, and for each figure its value, its baseline and their
        ratio.
    """
    whole = _real_time_factor(build_avoidance(scenario))
    bare = _real_time_factor(bare_station(scenario))
    frame, rendering = _perception_ms(scenario)
    step = _policy_step_us(scenario)
    return {
        "machine": f"{platform.machine()}, {_cores()} cores, Python {platform.python_version()}",
        "versions": list(software_versions()),
    }
