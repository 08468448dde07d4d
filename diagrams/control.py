"""Wiring of the controller, the posture in its null space, the supervisor and the evasion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.primitives import ConstantValueSource

from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import FloatArray, PlannedMotion
from drake_oa.common.wires import Wires
from drake_oa.control.cartesian_inverse_dynamics import CartesianInverseDynamics, IntegralAction
from drake_oa.diagrams.motion import make_dmp
from drake_oa.diagrams.station import Cell, make_posture_guide
from drake_oa.perception.config import GroundTruth
from drake_oa.posture.posture_follower import PostureFollower
from drake_oa.regulation.config import Verified
from drake_oa.robot.plant import make_robot_plant
from drake_oa.safety.obstacle_evasion import ObstacleEvasion
from drake_oa.safety.supervisor import Supervisor
from drake_oa.scenario.end_poses import end_rotations
from drake_oa.scenario.faults import ModelError
from drake_oa.scenario.perception import GivenEllipsoids
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.scenario.sources import padding, perception_period


def add_control(wires: Wires, scenario: Scenario, cell: Cell | None) -> None:
    """Adds controller and integral_action: desired motion, robot_state -> actuation."""
    if cell is None:
        return
    controller = make_controller(scenario, cell.q_start)
    wires.add("controller", controller, reads={"desired_acceleration": "asked_acceleration"})
    wires.otherwise("asked_acceleration", "desired_acceleration")
    integral = make_integral_action(scenario)
    if integral is not None:
        asked = {"desired_acceleration": "asked_acceleration"}
        wires.add("integral_action", integral, offers=asked)
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
    errors = [fault.inertias for fault in scenario.faults if isinstance(fault, ModelError)]
    robot_plant = make_robot_plant(robot, inertias=errors[-1] if errors else "")
    gains = robot.gains
    if isinstance(scenario.regulation, Verified):
        # The links go as near to things as the tool does: they are held as stiffly.
        gains = replace(
            gains,
            kp_posture=max(gains.kp_posture, gains.kp_position),
            kd_posture=max(gains.kd_posture, gains.kd_position),
        )
    return CartesianInverseDynamics(
        robot_plant.plant,
        R_WE_desired=end_rotations(scenario)[0],
        q_posture=q_start,
        tool_frame=robot_plant.tool_frame.name(),
        gains=gains,
        finger_opening=robot.finger_opening,
    )


def make_integral_action(scenario: Scenario) -> IntegralAction | None:
    """What takes away the error that a wrong model leaves; None: not asked for.

    Raises:
        ScenarioError: for a gain with which the law is not stable.
    """
    robot = scenario.robot
    if robot is None or robot.gains.ki_position == 0.0:
        return None
    gains = robot.gains
    if gains.ki_position >= gains.kp_position * gains.kd_position:
        raise ScenarioError(
            f"robot.gains.ki_position: {gains.ki_position:g} must be below kp_position times "
            f"kd_position, {gains.kp_position * gains.kd_position:g} [1/s^3]"
        )
    return IntegralAction(gains.ki_position, period=scenario.policy.period)


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
        evasion = scenario.evasion
        turn = {} if evasion is None else {"turn_acceleration": evasion.turn_acceleration}
        follower = PostureFollower(q_rest, policy.alpha_k, period=policy.period, **turn)
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
    wires.add("guide_follower", follower, reads={"motion": "guided_posture", "evading": None})
    return True


def add_safety(wires: Wires, scenario: Scenario, cell: Cell | None) -> None:
    """Adds supervisor and evasion.

    They read solids_W, robot_state, policy_state, motion and what the controller says of
    itself; they offer speed_scale, evasion and evading.
    """
    if cell is None or scenario.supervisor is None:
        return
    policy, period = scenario.policy, perception_period(scenario)
    exact = isinstance(scenario.perception, (GroundTruth, GivenEllipsoids))
    dmp, outside = make_dmp(scenario), 0.0 if exact else padding(scenario.perception)
    supervisor = Supervisor(
        cell.guarded_arm,
        dmp.duration,
        period=policy.period,
        parameters=scenario.supervisor,
        padding=outside,
        hold_time=policy.hold_time,
        frame_period=period,
        max_age=policy.max_observation_age,
    )
    wires.add("supervisor", supervisor)
    if "obstacles_W" in wires and scenario.evasion is not None:
        evasion = ObstacleEvasion(
            cell.guarded_arm,
            dmp,
            period=period,
            step=policy.period,
            max_age=policy.max_observation_age,
            parameters=scenario.evasion,
            padding=outside,
            hold_time=policy.hold_time,
            # A motion's posture follower turns the arm as well.
            turns="motion" in wires and "desired_posture" in wires,
            table_height=policy.table_height,
            thinking=scenario.thinking,
        )
        wires.add("evasion", evasion, offers={"decision": "decision_evasion"})
    wires.log("speed_scale", "evasion", "decision_evasion")
