"""Tests of the nominal posture: interpolation, continuous changes of the plan, restarts."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator

from drake_oa.common.messages import PlannedMotion, PolicyState
from drake_oa.posture.nominal_posture_source import NominalPostureSource
from drake_oa.posture.posture_trajectory import trajectory_of

ALPHA_K = 4.0
REST = np.zeros(2)


def motion(*q: float, p_WS: tuple[float, ...] = ()) -> PlannedMotion:
    """Returns a plan of joint positions (q, -q), along which the tool rises by 1 m."""
    s, rows = np.linspace(0.0, 1.0, len(q)), np.column_stack([q, -np.array(q)])
    return PlannedMotion(s, np.outer(s, [0.0, 0.0, 1.0]), rows, np.array(p_WS))


def policy(s: float, speed: float, stamp: float = 0.0, p: float = 0.0) -> PolicyState:
    """Returns the state of a policy at normalized time s and height p [m]."""
    p_WE = np.array([0.0, 0.0, p])
    return PolicyState(phase=math.exp(-ALPHA_K * s), speed=speed, stamp=stamp, p_WE=p_WE)


@given(st.lists(st.floats(-2.0, 2.0), min_size=2, max_size=8))
def test_the_trajectory_does_not_overshoot_and_its_velocity_is_its_derivative(
    values: list[float],
) -> None:
    trajectory, last = trajectory_of(motion(*values), REST), len(values) - 1
    for i in range(last):
        low, high = sorted(values[i : i + 2])
        for x in np.linspace(0.05, 0.95, 7):
            before, q, after = (
                trajectory.at((i + x + h) / last, 0.2, 0.0) for h in (-1e-5, 0, 1e-5)
            )
            assert low - 1e-9 <= q[0] <= high + 1e-9
            assert q[1] == pytest.approx(-q[0])
            slope = (after - before)[:2] / (2e-5 / last) * 0.2
            np.testing.assert_allclose(q[2:], slope, atol=1e-4)


def test_the_posture_follows_new_plans_without_a_jump() -> None:
    system = NominalPostureSource(REST, ALPHA_K, period=0.01)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    plan = system.GetInputPort("motion").FixValue(context, Value(PlannedMotion()))
    state = system.GetInputPort("policy_state").FixValue(context, Value(policy(0.0, 0.2)))
    np.testing.assert_array_equal(system.get_output_port().Eval(context), 0.0)
    plan.GetMutableData().set_value(motion(0.0, 0.4, 0.8))
    last = np.zeros(4)
    for step in range(1, 1001):
        time = 0.01 * step
        # The motion is held at s = 0.5.
        s = min(0.2 * time, 0.5)
        simulator.AdvanceTo(time)
        state.GetMutableData().set_value(policy(s, 0.2 * (s < 0.5), time))
        now = system.get_output_port().Eval(context)
        assert np.abs(now[:2] - last[:2]).max() < 0.02
        last = now
        if step == 300:
            np.testing.assert_allclose(now, [0.4, -0.4, 0.0, 0.0], atol=1e-3)
            plan.GetMutableData().set_value(motion(1.0, -0.5, 0.0))
        if step == 600:
            np.testing.assert_allclose(now, [-0.5, 0.5, 0.0, 0.0], atol=1e-3)
            plan.GetMutableData().set_value(PlannedMotion())
    np.testing.assert_allclose(last[:2], REST, atol=1e-4)


def test_after_a_restart_the_posture_rests_until_there_is_a_new_plan() -> None:
    system = NominalPostureSource(REST, ALPHA_K, period=0.01)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    plan = motion(0.0, 0.4, 0.8, p_WS=(0.0, 0.0, 0.0))
    plans = system.GetInputPort("motion").FixValue(context, Value(plan))
    state = system.GetInputPort("policy_state")
    port = state.FixValue(context, Value(policy(0.5, 0.0, p=0.5)))
    simulator.AdvanceTo(5.0)
    p_WE = np.array([0.0, 0.0, 0.5])
    port.GetMutableData().set_value(PolicyState(p_WS=p_WE, p_WE=p_WE, stamp=5.0))
    simulator.AdvanceTo(5.03)
    posture = system.get_output_port().Eval(context)
    np.testing.assert_allclose(posture, [0.4, -0.4, 0.0, 0.0], atol=1e-6)
    plans.GetMutableData().set_value(motion(0.6, 0.6, p_WS=tuple(p_WE)))
    simulator.AdvanceTo(10.0)
    posture = system.get_output_port().Eval(context)
    np.testing.assert_allclose(posture[:2], [0.6, -0.6], atol=1e-6)
