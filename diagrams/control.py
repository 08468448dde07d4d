"""Wiring of the motion guard, the posture and the controller."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.primitives import ConstantValueSource

from drake_oa.common.messages import FloatArray, PlannedMotion
from drake_oa.common.wires import Wires
from drake_oa.control.cartesian_inverse_dynamics import CartesianInverseDynamics
from drake_oa.control.joint_inverse_dynamics import JointInverseDynamics
from drake_oa.diagrams.motion import make_dmp
from drake_oa.diagrams.station import Cell, make_posture_guide
from drake_oa.perception.config import GroundTruth
from drake_oa.posture.posture_follower import PostureFollower
from drake_oa.robot.plant import RobotPlant, make_robot_plant
from drake_oa.safety.motion_guard import MotionGuard
from drake_oa.scenario.end_poses import end_rotations
from drake_oa.scenario.faults import ModelError
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.scenario.sources import padding, perception_period


def add_control(wires: Wires, scenario: Scenario, cell: Cell | None) -> None:
    """Adds controller: desired motion, robot_state -> actuation."""
    if cell is None:
        return
    if "desired_joint_state" in wires:
        wires.add("controller", make_joint_controller(scenario))
    else:
        wires.add("controller", make_controller(scenario, cell.q_start))
    wires.take("actuation", cell.plant.get_actuation_input_port(cell.robot))
    wires.log("robot_state", "actuation", "torque_saturation", "tracking_error")


def make_controller(scenario: Scenario, q_start: FloatArray) -> CartesianInverseDynamics:
    """The control law; posture and tool orientation are those of the start.

    Args:
        scenario: with a robot.
        q_start: (nq,) its positions at the start, see `start_positions`.

    Raises:
        ScenarioError: if the scenario has no robot, or its model error is of another one.
    """
    robot = robot_of(scenario)
    robot_plant = _controlled_plant(scenario)
    return CartesianInverseDynamics(
        robot_plant.plant,
        R_WE_desired=end_rotations(scenario)[0],
        q_posture=q_start,
        tool_frame=robot_plant.tool_frame.name(),
        gains=robot.gains,
        finger_opening=robot.finger_opening,
        period=scenario.policy.period,
    )


def _controlled_plant(scenario: Scenario) -> RobotPlant:
    """The robot as the controller knows it, with the model error of the scenario's faults."""
    errors = [fault.inertias for fault in scenario.faults if isinstance(fault, ModelError)]
    return make_robot_plant(robot_of(scenario), inertias=errors[-1] if errors else "")


def make_joint_controller(scenario: Scenario) -> JointInverseDynamics:
    """The controller of the joints that MotionGuard commands.

    Raises:
        ScenarioError: if the scenario has no robot, or its model error is of another one.
    """
    robot, robot_plant = robot_of(scenario), _controlled_plant(scenario)
    return JointInverseDynamics(
        robot_plant.plant,
        tool_frame=robot_plant.tool_frame.name(),
        gains=robot.gains,
        finger_opening=robot.finger_opening,
        period=scenario.policy.period,
    )


_GUIDE_SAMPLES = 41
"""Of a posture that is not planned, along the motion."""


def add_posture(wires: Wires, scenario: Scenario, cell: Cell | None) -> None:
    """Adds posture_follower, or posture_guide and guide_follower where no motion is planned.

    They output desired_posture, the controller's.
    """
    if cell is None:
        return
    if "motion" in wires:
        # Without a planned posture the null space is drawn to that of the start.
        q_rest, policy = cell.q_start[cell.chain.q_index], scenario.policy
        follower = PostureFollower(q_rest, policy.alpha_k, period=policy.period)
        wires.add("posture_follower", follower)
    else:
        add_guide_follower(wires, scenario, cell.q_start)
    wires.log("desired_posture")


def add_guide_follower(wires: Wires, scenario: Scenario, q_start: FloatArray) -> bool:
    """Adds posture_guide and guide_follower: a posture from the joints at the start to the goal's.

    Args:
        wires: offers desired_posture then.
        scenario: with a robot.
        q_start: (nq,) positions of the robot at the start.

    Returns:
        Whether the task gives the joints at the goal; if not, nothing is added.
    """
    guide = make_posture_guide(scenario, q_start[: len(robot_of(scenario).q_seed)])
    if guide is None:
        return False
    s, policy = np.linspace(0.0, 1.0, _GUIDE_SAMPLES), scenario.policy
    motion = PlannedMotion(s, np.zeros((len(s), 3)), guide(s))
    source = ConstantValueSource(Value(motion))
    follower = PostureFollower(motion.q[0], policy.alpha_k, period=policy.period)
    wires.add("posture_guide", source, offers={"y0": "guided_posture"})
    wires.add("guide_follower", follower, reads={"motion": "guided_posture"})
    return True


def add_safety(wires: Wires, scenario: Scenario, cell: Cell | None) -> None:
    """Adds motion_guard where the motion is verified: the desired motion of the tool, motion,
    solids_W, robot_state -> desired_joint_state, desired_joint_acceleration and speed_scale.
    """
    if cell is None or "motion" not in wires:
        return
    policy, period = scenario.policy, perception_period(scenario)
    exact = isinstance(scenario.perception, GroundTruth)
    # The requested clearance of the tool is a margin of the whole arm beside moving obstacles.
    margin = max(scenario.guard.margin_moving, scenario.task.clearance)
    guard = MotionGuard(
        cell.guarded_arm,
        make_dmp(scenario).duration,
        cell.q_start[cell.chain.q_index],
        alpha_k=policy.alpha_k,
        period=period,
        step=policy.period,
        hold_time=policy.hold_time,
        padding=0.0 if exact else padding(scenario.perception),
        max_age=policy.max_observation_age,
        turn_limit=scenario.task.turn_limit,
        parameters=replace(scenario.guard, margin_moving=margin),
        thinking=scenario.thinking,
    )
    wires.add("motion_guard", guard, offers={"decision": "decision_guard"})
    wires.log("speed_scale", "decision_guard", "guard_action", "guard_contact", "guard_claim")
