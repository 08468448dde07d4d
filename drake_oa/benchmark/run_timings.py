"""Real-time factor of a run, and of Drake alone, for `drake_oa.benchmark.benchmark`."""

from __future__ import annotations

import copy

from pydrake.systems.analysis import Simulator
from pydrake.systems.controllers import InverseDynamics
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import ZeroOrderHold

from drake_oa.benchmark.timings import WARM_UP, timed
from drake_oa.common.schema_check import ScenarioError
from drake_oa.robot.config import Robot
from drake_oa.robot.plant import home_positions, make_robot_plant
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.scenario import DepthCamera, Scenario
from drake_oa.world.station import make_station


def camera_rate(scenario: Scenario) -> float:
    """Frames a second of the camera that perception looks through.

    Raises:
        ScenarioError: if there is no robot or no depth camera.
    """
    perception = scenario.perception
    if scenario.robot is None or not isinstance(perception, DepthCamera):
        raise ScenarioError(
            "benchmark: needs a scenario with a robot and 'perception: !DepthCamera'"
        )
    return float(next(c.fps for c in scenario.cameras if c.name == perception.camera))


def robot_of(scenario: Scenario) -> Robot:
    """The scenario's robot; ScenarioError without one."""
    if scenario.robot is None:
        raise ScenarioError("robot: the benchmark needs a robot; this scenario has null")
    return scenario.robot


def with_present_images(scenario: Scenario) -> Scenario:
    """The scenario with cameras that render when they are asked, and not beside the run."""
    scenario = copy.deepcopy(scenario)
    for camera in scenario.cameras:
        camera.output_delay = 0.0
    return scenario


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
    rate, robot = camera_rate(scenario), robot_of(scenario)
    builder = DiagramBuilder()
    station = make_station(builder, with_present_images(scenario), render=render)
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
        image = station.cameras[scenario.perception.camera].depth_image
        puller = builder.AddNamedSystem("puller", ZeroOrderHold(1.0 / rate, image.Allocate()))
        builder.Connect(image, puller.get_input_port())
    return builder.Build()


def real_time_factor(diagram: Diagram, seconds: float) -> float:
    """Simulated over wall time of a diagram alone, over so many simulated seconds [s]."""
    simulator = Simulator(diagram)
    simulator.Initialize()
    # The first image loads the renderer.
    simulator.AdvanceTo(0.02)
    elapsed, _ = timed(simulator.AdvanceTo, 0.02 + seconds)
    return seconds / elapsed


def whole_real_time_factor(scenario: Scenario, seconds: float) -> float:
    """As `drake-oa run` reports it for so many seconds [s]: logs and supervision, no viewer."""
    log = simulate(scenario, duration=seconds)
    return log.simulated_time / log.wall_time


def time_plant(scenario: Scenario, steps: int) -> list[float]:
    """Wall time of each step of the plant alone [us]."""
    simulator = Simulator(bare_station(scenario, render=False))
    simulator.Initialize()
    step = scenario.plant_step
    simulator.AdvanceTo((WARM_UP - 0.5) * step)
    return [
        1e6 * timed(simulator.AdvanceTo, (i + 0.5) * step)[0]
        for i in range(WARM_UP, WARM_UP + steps)
    ]
