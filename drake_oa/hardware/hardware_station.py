"""Scenarios and diagrams for runs on hardware, in which messages of the arm and the cameras replace
the simulated world.
"""

from __future__ import annotations

from dataclasses import fields, replace

from pydrake.multibody.parsing import ModelDirective

from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import FloatArray
from drake_oa.common.signal_builder import SignalBuilder
from drake_oa.diagrams.station import StationModel, add_station
from drake_oa.hardware.command_streamer import ARM_JOINTS
from drake_oa.hardware.robot_link import CommandStream, MeasuredState, RobotLink
from drake_oa.perception.config import (
    DepthCamera,
    GroundTruth,
    LcmCamera,
    RecordedBag,
    RecordedClouds,
)
from drake_oa.robot.arm import joints_to
from drake_oa.robot.plant import RobotLimits, make_robot_plant
from drake_oa.scenario.obstacles import OBSTACLE_PREFIX
from drake_oa.scenario.perception import GivenEllipsoids
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.scenario.sources import perception_period, table_plane
from drake_oa.world.live_camera import ExternalInputs
from drake_oa.world.world_model import flat_directives


def arm_of(scenario: Scenario) -> tuple[list[int], RobotLimits]:
    """Returns the indices of the arm's joints in the positions of a scenario's robot, and the
    limits of these joints.

    Raises:
        ScenarioError: for a scenario without a robot, or an arm that does not have seven joints.
    """
    robot_plant = make_robot_plant(robot_of(scenario))
    joints = joints_to(robot_plant.plant, robot_plant.tool_frame)
    arm = [joint.position_start() for joint in joints]
    if len(arm) != ARM_JOINTS:
        raise ScenarioError(
            f"robot.model: the arm has {len(arm)} joints; a Panda's messages have {ARM_JOINTS}"
        )
    limits = robot_plant.limits
    return arm, RobotLimits(
        position_name=tuple(limits.position_name[i] for i in arm),
        position_lower=limits.position_lower[arm],
        position_upper=limits.position_upper[arm],
        velocity_limit=limits.velocity_limit[arm],
    )


def hardware_scenario(scenario: Scenario, lcm_url: str, image_delay: float = 0.0) -> Scenario:
    """Returns a copy of a scenario for a run on hardware: without simulated obstacles, and with
    images received by LCM (`!LcmCamera`).

    Args:
        scenario: scenario with `!DepthCamera` or `!LcmCamera`.
        lcm_url: URL of the LCM bus.
        image_delay: delay of the images, in simulated time, that must not slow the arm [s]. The
            motion guard slows the arm if an observation is older than `guard.stale_frames` camera
            periods. The delay, converted to camera periods, is added to this field.

    Raises:
        ScenarioError: naming a field that requires a simulated world, or if the scenario has no
            robot.
    """
    robot_of(scenario)
    if scenario.faults:
        raise ScenarioError("faults: require a simulated world; remove them (--set 'faults=[]')")
    source = scenario.perception
    if isinstance(source, GroundTruth | RecordedClouds | RecordedBag | GivenEllipsoids):
        raise ScenarioError(
            f"perception: !{type(source).__name__} does not perceive the real world; valid: "
            "!LcmCamera, !DepthCamera"
        )
    if type(source) is DepthCamera:
        shared = {item.name: getattr(source, item.name) for item in fields(DepthCamera)}
        source = LcmCamera(**shared | {"noise": None, "lcm_url": lcm_url})
    frames = scenario.guard.stale_frames + image_delay / perception_period(scenario)
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
    """Adds the LCM messages of the arm and the live cameras to a diagram, in place of a simulated
    world, for a run on hardware.

    Only a model of the robot is simulated: the plant integrates the controller's torques, and the
    positions of the plant are sent to the arm as commands.

    Args:
        signals: builder of the diagram; the added signals are the same as those of the simulated
            station (`drake_oa.diagrams.station.add_station`).
        scenario: scenario from `hardware_scenario`.
        avoid_obstacles: whether the diagram avoids obstacles, and therefore has cameras.
        link: link to the arm.
        q_measured: (n,) configuration of the robot, with measured joints of the arm [rad, m].

    Returns:
        Plant and scene graph of the robot model, and cameras, as for a simulated station.

    Raises:
        ScenarioError: naming the invalid field of the scenario.
    """
    arm, _ = arm_of(scenario)
    measured = signals.builder.AddNamedSystem("arm", MeasuredState(link, arm, q_measured))
    output, wait = measured.get_output_port(), link.wait_for_message
    external = ExternalInputs(output, link.to_simulated, link.clock, wait)
    station = add_station(signals, scenario, avoid_obstacles=avoid_obstacles, external=external)
    if station is None:
        raise ScenarioError("robot: must be set for a run on hardware; the scenario has null")
    station.plant.SetDefaultPositions(station.robot, q_measured)
    stream = CommandStream(link, arm, 2 * len(q_measured), table_plane(scenario))
    signals.add("command_stream", stream)
    return station


def _without_obstacles(directives: list[ModelDirective]) -> list[ModelDirective]:
    """Returns Drake model directives without those that add or weld obstacles, because real
    obstacles replace them on hardware.

    Each included file is replaced by its directives. Obstacles are recognized by the prefix
    "obstacle" of their names.
    """
    models = []
    for directive in flat_directives(directives):
        model, weld = directive.add_model, directive.add_weld
        names = [model.name] if model else [weld.parent, weld.child] if weld else []
        if not any(str(name).startswith(OBSTACLE_PREFIX) for name in names):
            models.append(directive)
    return models
