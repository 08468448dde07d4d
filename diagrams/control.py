"""Wiring of the motion guard, the posture and the controller."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.primitives import ConstantValueSource

from drake_oa.common.messages import PlannedMotion
from drake_oa.common.wires import Wires
from drake_oa.control.cartesian_inverse_dynamics import CartesianInverseDynamics
from drake_oa.control.joint_inverse_dynamics import JointInverseDynamics
from drake_oa.diagrams.motion import make_dmp
from drake_oa.diagrams.station import Cell
from drake_oa.perception.config import GroundTruth
from drake_oa.posture.posture_follower import PostureFollower
from drake_oa.robot.plant import make_robot_plant
from drake_oa.safety.motion_guard import MotionGuard
from drake_oa.scenario.end_poses import end_rotations, posture_guide
from drake_oa.scenario.faults import ModelError
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.scenario.sources import padding, perception_period


def add_control(wires: Wires, scenario: Scenario, cell: Cell | None) -> None:
    """Adds controller: desired motion, robot_state -> actuation.

    JointInverseDynamics follows the joints that MotionGuard commands, CartesianInverseDynamics the
    tool; its posture and orientation are those of the start. Both know the robot with the model
    error of the scenario's faults.

    Raises:
        ScenarioError: if the model error is of another robot.
    """
    if cell is None:
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
    if "desired_joint_state" in wires:
        wires.add("controller", JointInverseDynamics(robot_plant.plant, **common))
    else:
        R_WE = end_rotations(scenario)[0]
        controller = CartesianInverseDynamics(
            robot_plant.plant, R_WE_desired=R_WE, q_posture=cell.q_start, **common
        )
        wires.add("controller", controller)
    wires.take("actuation", cell.plant.get_actuation_input_port(cell.robot))
    wires.log("robot_state", "actuation", "torque_saturation", "tracking_error")


_GUIDE_SAMPLES = 41
"""Number of samples of a posture that is not planned."""


def add_posture(wires: Wires, scenario: Scenario, cell: Cell | None) -> None:
    """Adds posture_follower, or posture_guide and guide_follower where no motion is planned.

    They output desired_posture, the controller's. The guide leads from the joints at the start to
    those at the goal, if the task gives these.
    """
    if cell is None:
        return
    policy = scenario.policy
    if "motion" in wires:
        # Without a planned posture the null space is drawn to that of the start.
        q_rest = cell.q_start[cell.chain.q_index]
        follower = PostureFollower(q_rest, policy.alpha_k, period=policy.period)
        wires.add("posture_follower", follower)
    elif scenario.task.q_goal is not None:
        s = np.linspace(0.0, 1.0, _GUIDE_SAMPLES)
        q_goal = np.asarray(scenario.task.q_goal)
        q = posture_guide(s, cell.q_start[: len(q_goal)], q_goal)
        motion = PlannedMotion(s, np.zeros((len(s), 3)), q)
        follower = PostureFollower(q[0], policy.alpha_k, period=policy.period)
        source = ConstantValueSource(Value(motion))
        wires.add("posture_guide", source, offers={"y0": "guided_posture"})
        wires.add("guide_follower", follower, reads={"motion": "guided_posture"})
    wires.log("desired_posture")


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
        cell.robot_plant,
        cell.chain,
        cell.spheres,
        make_dmp(scenario).duration,
        cell.q_start[cell.chain.q_index],
        config=policy,
        period=period,
        padding=0.0 if exact else padding(scenario.perception),
        turn_limit=scenario.task.turn_limit,
        parameters=replace(scenario.guard, margin_moving=margin),
        thinking=scenario.thinking,
    )
    wires.add("motion_guard", guard, offers={"decision": "decision_guard"})
    wires.log("speed_scale", "decision_guard", "guard_action", "guard_contact", "guard_claim")
