"""Control: from the desired motion to torques."""

from __future__ import annotations

from dataclasses import replace

from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import FloatArray
from drake_oa.common.wires import Wires
from drake_oa.control.cartesian_inverse_dynamics import CartesianInverseDynamics
from drake_oa.control.integral_action import IntegralAction
from drake_oa.diagrams.station import Cell
from drake_oa.regulation.config import Verified
from drake_oa.robot.plant import make_robot_plant
from drake_oa.scenario.faults import ModelError
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.scenario.tool_orientation import end_rotations


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
