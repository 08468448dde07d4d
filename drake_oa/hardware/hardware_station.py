"""Station of a scenario on hardware: robot and cameras are messages, obstacles are unknown."""

from __future__ import annotations

from dataclasses import fields, replace

from pydrake.multibody.parsing import ModelDirective

from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import FloatArray
from drake_oa.common.signal_builder import SignalBuilder
from drake_oa.diagrams.station import StationModel, add_station
from drake_oa.hardware.command_streamer import ARM_JOINTS
from drake_oa.hardware.robot_link import CommandStream, MeasuredState, RobotLink
from drake_oa.perception.config import DepthCamera, GroundTruth, LcmCamera, RecordedClouds
from drake_oa.robot.arm import joints_to
from drake_oa.robot.plant import RobotLimits, make_robot_plant
from drake_oa.scenario.obstacles import OBSTACLE_PREFIX
from drake_oa.scenario.perception import GivenEllipsoids
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.scenario.sources import perception_period, table_plane
from drake_oa.world.live_camera import ExternalInputs
from drake_oa.world.world_model import flat_directives


def arm_of(scenario: Scenario) -> tuple[list[int], RobotLimits]:
    """Returns the places of the arm's joints in the robot's positions, and their limits.

    Raises:
        ScenarioError: for an arm without seven joints, or without a robot.
    """
    robot_plant = make_robot_plant(robot_of(scenario))
    joints = joints_to(robot_plant.plant, robot_plant.tool_frame)
    arm = [joint.position_start() for joint in joints]
    if len(arm) != ARM_JOINTS:
        raise ScenarioError(
            f"robot.model: an arm of {len(arm)} joints; a Panda's messages are of {ARM_JOINTS}"
        )
    limits = robot_plant.limits
    return arm, RobotLimits(
        position_name=tuple(limits.position_name[i] for i in arm),
        position_lower=limits.position_lower[arm],
        position_upper=limits.position_upper[arm],
        velocity_limit=limits.velocity_limit[arm],
    )


def hardware_scenario(scenario: Scenario, lcm_url: str, late: float = 0.0) -> Scenario:
    """Returns a scenario as a run on hardware knows it, without its obstacles.

    Args:
        scenario: whose `!DepthCamera` becomes an `!LcmCamera`.
        lcm_url: of the bus.
        late: known delay of the images, for which the motion does not slow down [s].

    Raises:
        ScenarioError: naming the field that is of the simulated world.
    """
    robot_of(scenario)
    if scenario.faults:
        raise ScenarioError("faults: are simulated; leave them out (--set 'faults=[]')")
    source = scenario.perception
    if isinstance(source, GroundTruth | RecordedClouds | GivenEllipsoids):
        raise ScenarioError(
            f"perception: !{type(source).__name__} does not see the world that the robot is in; "
            "!LcmCamera does"
        )
    if type(source) is DepthCamera:
        own = {item.name: getattr(source, item.name) for item in fields(DepthCamera)}
        source = LcmCamera(**own | {"noise": None, "lcm_url": lcm_url})
    frames = scenario.guard.stale_frames + late / perception_period(scenario)
    return replace(
        scenario,
        guard=replace(scenario.guard, stale_frames=frames),
        directives=_without_obstacles(scenario.directives),
        obstacles=[],
        perception=source,
    )


def add_hardware(
    signals: SignalBuilder,
    scenario: Scenario,
    *,
    avoid_obstacles: bool,
    link: RobotLink,
    q_measured: FloatArray,
) -> StationModel:
    """Adds the robot and cameras of messages, in place of the simulated ones.

    What is simulated is the robot's model alone, which makes positions of torques: where it is,
    the arm is to be.

    Args:
        signals: that are added to; the signals are `add_station`'s.
        scenario: of `hardware_scenario`.
        avoid_obstacles: as for `add_station`.
        link: to the arm.
        q_measured: (n,) where the robot is [rad, m].

    Raises:
        ScenarioError: naming the field that does not fit.
    """
    arm, _ = arm_of(scenario)
    measured = signals.builder.AddNamedSystem("arm", MeasuredState(link, arm, q_measured))
    external = ExternalInputs(measured.get_output_port(), link.to_simulated, link.clock, link.wait)
    station = add_station(signals, scenario, avoid_obstacles=avoid_obstacles, external=external)
    if station is None:
        raise ScenarioError("robot: hardware is a robot; this scenario has null")
    station.plant.SetDefaultPositions(station.robot, q_measured)
    stream = CommandStream(link, arm, 2 * len(q_measured), table_plane(scenario))
    signals.add("command_stream", stream)
    return station


def _without_obstacles(directives: list[ModelDirective]) -> list[ModelDirective]:
    """Returns the models in the world, one by one, except those named as obstacles."""
    kept = []
    for directive in flat_directives(directives):
        model, weld = directive.add_model, directive.add_weld
        names = [model.name] if model else [weld.parent, weld.child] if weld else []
        if not any(str(name).startswith(OBSTACLE_PREFIX) for name in names):
            kept.append(directive)
    return kept
