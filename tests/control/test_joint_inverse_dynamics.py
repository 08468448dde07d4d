"""Tests of `JointInverseDynamics` and of the torque limits."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.systems.analysis import Simulator
from pydrake.systems.controllers import InverseDynamicsController

from drake_oa.control.joint_inverse_dynamics import JointInverseDynamics, limit_torque
from drake_oa.robot.config import Gains, Robot
from drake_oa.robot.plant import RobotPlant, home_positions
from tests.builders import fix, read

GAINS = Gains(kp_position=100.0, kd_position=20.0, ki_position=0.0)


def test_torques_equal_those_of_drakes_controller(panda: RobotPlant) -> None:
    rng, q = np.random.default_rng(1), home_positions(Robot())
    x = np.concatenate([q + 0.1 * rng.normal(size=9), 0.2 * rng.normal(size=9)])
    desired = np.append(x[:7] + 0.01 * rng.normal(size=7), x[9:16] + 0.01 * rng.normal(size=7))
    a, tool = rng.normal(size=7), panda.tool_frame.name()
    system = JointInverseDynamics(panda.plant, tool_frame=tool, gains=GAINS, finger_opening=0.02)
    own = system.CreateDefaultContext()
    fix(system, own, robot_state=x, desired_joint_state=desired, desired_joint_acceleration=a)
    gains = (np.full(9, GAINS.kp_position), np.zeros(9), np.full(9, GAINS.kd_position))
    drake = InverseDynamicsController(panda.plant, *gains, True)
    context = drake.CreateDefaultContext()
    # No acceleration of the fingers.
    q_d, v_d = np.append(desired[:7], x[7:9]), np.append(desired[7:], x[16:])
    drake.get_input_port_estimated_state().FixValue(context, x)
    drake.get_input_port_desired_state().FixValue(context, np.append(q_d, v_d))
    drake.get_input_port_desired_acceleration().FixValue(context, np.append(a, np.zeros(2)))
    expected = drake.get_output_port_control().Eval(context)
    np.testing.assert_allclose(read(system, own, "actuation")[:7], expected[:7], atol=1e-9)
    assert read(system, own, "torque_saturation") == read(system, own, "stopping") == 0.0


def test_the_integral_ignores_a_joint_with_a_large_error(panda: RobotPlant) -> None:
    system = JointInverseDynamics(panda.plant, tool_frame=panda.tool_frame.name(), period=0.01)
    x = np.append(home_positions(Robot()), np.zeros(9))
    desired = np.append(x[:7] + [0.01, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0], np.zeros(7))
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    fix(system, context, robot_state=x, desired_joint_state=desired)
    fix(system, context, desired_joint_acceleration=np.zeros(7))
    before = read(system, context, "actuation")
    simulator.AdvanceTo(0.055)
    integral = context.get_discrete_state_vector().value()
    assert integral[0] == pytest.approx(Gains().ki_position * 0.05 * 0.01)
    np.testing.assert_array_equal(integral[1:], 0.0)
    assert np.abs(read(system, context, "actuation") - before).max() > 0.1


@given(st.integers(0, 2**31 - 1))
def test_torque_limits_preserve_the_bias_and_the_direction_of_the_drive(seed: int) -> None:
    random = np.random.default_rng(seed)
    effort = random.uniform(5.0, 20.0, 7)
    bias, drive = random.uniform(-0.9, 0.9, 7) * effort, 30.0 * random.normal(size=7)
    tau, saturated = limit_torque(bias, drive, effort)
    assert np.all(np.abs(tau) <= effort)
    assert saturated == np.any(np.abs(bias + drive) > effort)
    factor = (tau - bias) @ drive / (drive @ drive)
    assert 0.0 <= factor <= 1.0 + 1e-12
    np.testing.assert_allclose(tau, bias + factor * drive, atol=1e-9)
    assert saturated == np.any(np.isclose(np.abs(tau), effort))


def test_a_bias_beyond_its_limit_is_clipped_and_a_drive_may_reduce_it() -> None:
    bias, effort = np.array([12.0, 1.0]), np.array([10.0, np.inf])
    tau, saturated = limit_torque(bias, np.array([-1.0, 2.0]), effort)
    np.testing.assert_allclose(tau, [10.0, 3.0])
    assert saturated
    tau, _ = limit_torque(bias, np.array([1.0, 2.0]), effort)
    np.testing.assert_allclose(tau, [10.0, 1.0])
