"""Functions that add the layers posture, safety and control to the diagram of a scenario."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.primitives import ConstantValueSource

from drake_oa.common.messages import PlannedMotion
from drake_oa.common.signal_builder import SignalBuilder
from drake_oa.control.cartesian_inverse_dynamics import CartesianInverseDynamics
from drake_oa.control.joint_inverse_dynamics import JointInverseDynamics
from drake_oa.diagrams.motion import make_dmp
from drake_oa.diagrams.station import StationModel
from drake_oa.perception.config import GroundTruth
from drake_oa.posture.nominal_posture_source import NominalPostureSource
from drake_oa.robot.plant import make_robot_plant
from drake_oa.safety.motion_guard import MotionGuard
from drake_oa.scenario.end_poses import end_rotations, posture_guide
from drake_oa.scenario.faults import ModelError
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.scenario.sources import padding, perception_period


def add_control(signals: SignalBuilder, scenario: Scenario, station: StationModel | None) -> None:
    """Adds the system `controller`, which computes the robot's actuation for its desired motion.

    With the system MotionGuard of the safety layer, the controller is a JointInverseDynamics, which
    tracks the joint motion that MotionGuard outputs. Without MotionGuard it is a
    CartesianInverseDynamics, which tracks the motion of the tool; if the signals desired_posture
    and desired_orientation do not exist, it holds the posture and orientation at the start. Either
    controller uses the model of the robot. If the scenario has faults `!ModelError`, the inertial
    parameters of the last one replace those of the model.

    Raises:
        ScenarioError: if the file of these parameters cannot be read, or names a link that the
            robot does not have.
    """
    if station is None:
        return
    robot = robot_of(scenario)
    errors = [fault.inertias for fault in scenario.faults if isinstance(fault, ModelError)]
    robot_plant = make_robot_plant(robot, inertias=errors[-1] if errors else "")
    common: dict[str, Any] = {
        "tool_frame": robot_plant.tool_frame.name(),
        "gains": robot.gains,
        "finger_opening": robot.finger_opening,
        "period": scenario.policy.period,
    }
    if "desired_joint_state" in signals:
        signals.add("controller", JointInverseDynamics(robot_plant.plant, **common))
    else:
        R_WE = end_rotations(scenario)[0]
        controller = CartesianInverseDynamics(
            robot_plant.plant, R_WE_desired=R_WE, q_posture=station.q_start, **common
        )
        signals.add("controller", controller)
    signals.add_sink("actuation", station.plant.get_actuation_input_port(station.robot))
    signals.log("robot_state", "actuation", "torque_saturation", "tracking_error")


_GUIDE_SAMPLES = 41
"""Number of samples of the nominal posture from the start of the task to its goal.

The nominal posture is the configuration to which the null space of the arm is attracted. The
samples are evenly spaced in normalized time."""


def add_posture(signals: SignalBuilder, scenario: Scenario, station: StationModel | None) -> None:
    """Adds systems that output desired_posture, the nominal posture that the null space tracks.

    With the signal motion (planned motion of the verification layer), this is the system
    nominal_posture_source, which outputs the planned joint positions at the present phase.

    Without this signal, and if the task specifies a configuration `task.q_goal` at the goal, two
    systems are added. posture_guide outputs a joint motion from the configuration at the start to
    `task.q_goal` with a minimum-jerk profile; guide_follower outputs the joint positions of this
    motion at the present phase. Otherwise, or without a robot, no system is added.
    """
    if station is None:
        return
    policy = scenario.policy
    if "motion" in signals:
        # Before the first planned motion the null space tracks the configuration at the start.
        q_rest = station.q_start[station.chain.q_index]
        follower = NominalPostureSource(q_rest, policy.alpha_k, period=policy.period)
        signals.add("nominal_posture_source", follower)
    elif scenario.task.q_goal is not None:
        s = np.linspace(0.0, 1.0, _GUIDE_SAMPLES)
        q_goal = np.asarray(scenario.task.q_goal)
        q = posture_guide(s, station.q_start[: len(q_goal)], q_goal)
        motion = PlannedMotion(s, np.zeros((len(s), 3)), q)
        follower = NominalPostureSource(q[0], policy.alpha_k, period=policy.period)
        source = ConstantValueSource(Value(motion))
        signals.add("posture_guide", source, outputs={"y0": "guided_posture"})
        signals.add("guide_follower", follower, inputs={"motion": "guided_posture"})
    signals.log("desired_posture")


def add_safety(signals: SignalBuilder, scenario: Scenario, station: StationModel | None) -> None:
    """Adds the system motion_guard, which computes joint commands and reacts to moving obstacles.

    It is added only if motions are verified by roll-outs (simulations). Main inputs are the desired
    motion of the tool, the signal motion (verified motion of the arm), collision_scene_W and
    robot_state. Main outputs are desired_joint_state, desired_joint_acceleration, path_state (state
    of the robot on the verified motion at the present phase), speed_scale (fraction of full speed)
    and evasion_velocity (velocity that moves the desired position to the tool if a maneuver has
    made no progress toward the verified motion for 1 s).
    """
    if station is None or "motion" not in signals:
        return
    policy, period = scenario.policy, perception_period(scenario)
    gains = robot_of(scenario).gains
    exact = isinstance(scenario.perception, GroundTruth)
    # Moving obstacles: the whole arm keeps the clearance that is requested of the tool.
    margin = max(scenario.guard.margin_moving, scenario.task.clearance)
    guard = MotionGuard(
        station.robot_plant,
        station.chain,
        station.spheres,
        make_dmp(scenario).duration,
        station.q_start[station.chain.q_index],
        config=policy,
        period=period,
        damping=gains.kd_position / max(gains.kp_position, 1e-9),
        padding=0.0 if exact else padding(scenario.perception),
        turn_limit=scenario.task.turn_limit,
        parameters=replace(scenario.guard, margin_moving=margin),
        compute_latency=scenario.compute_latency,
    )
    signals.add("motion_guard", guard, outputs={"decision": "decision_guard"})
    signals.log("speed_scale", "decision_guard", "guard_action", "guard_contact", "guard_claim")
