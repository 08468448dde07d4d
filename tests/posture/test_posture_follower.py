"""The null space's course: smooth, at the plan's place, and without jumps."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator

from drake_oa.common.messages import PlannedMotion, PolicyState
from drake_oa.posture.posture_course import PostureCourse, monotone_slopes
from drake_oa.posture.posture_follower import PostureFollower

ALPHA_K = 4.0
REST = np.zeros(2)


def motion(*q: float) -> PlannedMotion:
    rows = np.column_stack([q, -np.array(q)])
    return PlannedMotion(np.linspace(0.0, 1.0, len(q)), np.zeros((len(q), 3)), rows)


def taken_over(
    course: PostureCourse, plan: PlannedMotion, s: float, speed: float, time: float
) -> PostureCourse:
    return course.with_motion(plan, s, speed, time, course.at(s, speed, time))


def policy(s: float, speed: float = 0.2, stamp: float = 0.0) -> PolicyState:
    return PolicyState(phase=math.exp(-ALPHA_K * s), speed=speed, stamp=stamp)


@given(st.lists(st.floats(-2.0, 2.0), min_size=2, max_size=8))
def test_course_passes_the_samples_and_stays_between_them(values: list[float]) -> None:
    course = taken_over(PostureCourse(REST), motion(*values), 0.0, 0.0, 0.0)
    course = PostureCourse(REST, course.motion)
    for i in range(len(values) - 1):
        low, high = sorted(values[i : i + 2])
        for x in np.linspace(0.0, 1.0, 7):
            q = course.at((i + x) / (len(values) - 1), 0.2, 0.0)
            assert low - 1e-9 <= q[0] <= high + 1e-9
            assert q[1] == pytest.approx(-q[0])


def test_velocity_is_the_derivative() -> None:
    course = taken_over(PostureCourse(REST), motion(0.0, 0.5, 0.6, -0.2), 0.0, 0.2, 0.0)
    for time in np.linspace(0.01, 4.0, 30):
        at = [course.at(0.2 * t, 0.2, t)[:2] for t in (time - 1e-5, time + 1e-5)]
        v = course.at(0.2 * time, 0.2, time)[2:]
        np.testing.assert_allclose((at[1] - at[0]) / 2e-5, v, atol=1e-3)


def test_a_new_plan_does_not_jump_and_is_reached() -> None:
    one = taken_over(PostureCourse(REST), motion(0.0, 0.5, 0.9), 0.0, 0.2, 0.0)
    two = taken_over(one, motion(1.0, -0.5, 0.0), 0.5, 0.2, 2.5)
    np.testing.assert_allclose(one.at(0.5, 0.2, 2.5), two.at(0.5, 0.2, 2.5), atol=1e-12)
    np.testing.assert_allclose(two.at(1.0, 0.2, 6.0)[:2], [0.0, 0.0], atol=1e-4)
    gone = taken_over(two, PlannedMotion(), 0.7, 0.2, 3.0)
    np.testing.assert_allclose(gone.at(0.7, 0.2, 3.0), two.at(0.7, 0.2, 3.0), atol=1e-12)
    np.testing.assert_allclose(gone.at(0.7, 0.2, 9.0)[:2], REST, atol=1e-6)


def test_slopes_do_not_overshoot_a_step() -> None:
    slopes = monotone_slopes(np.array([0.0, 0.5, 0.6, 1.0]), np.array([[0.0], [0.0], [1.0], [1.0]]))
    np.testing.assert_array_equal(slopes, 0.0)


def test_without_a_plan_it_is_the_posture_at_rest() -> None:
    follower = PostureFollower([0.3, -0.1], ALPHA_K)
    context = follower.CreateDefaultContext()
    follower.GetInputPort("motion").FixValue(context, Value(PlannedMotion()))
    follower.GetInputPort("policy_state").FixValue(context, Value(policy(0.3)))
    posture = follower.get_output_port().Eval(context)
    np.testing.assert_array_equal(posture, [0.3, -0.1, 0.0, 0.0])


def test_the_system_follows_and_rests_with_a_held_motion() -> None:
    follower = PostureFollower(REST, ALPHA_K, period=0.01)
    simulator = Simulator(follower)
    context = simulator.get_mutable_context()
    follower.GetInputPort("motion").FixValue(context, Value(motion(0.0, 0.4, 0.8)))
    port = follower.GetInputPort("policy_state").FixValue(context, Value(policy(0.0)))
    last = None
    for step in range(1, 301):
        time = 0.01 * step
        s = min(0.2 * time, 0.5)
        held = PolicyState(phase=math.exp(-ALPHA_K * s), speed=0.2 if s < 0.5 else 0.0, stamp=time)
        simulator.AdvanceTo(time)
        port.GetMutableData().set_value(held)
        now = follower.get_output_port().Eval(context)
        if last is not None:
            assert np.abs(now[:2] - last[:2]).max() < 0.02
        last = now
    np.testing.assert_allclose(last, [0.4, -0.4, 0.0, 0.0], atol=1e-3)


def test_where_the_motion_begins_anew_it_stays_until_there_is_a_plan_for_that() -> None:
    start, here = np.zeros(3), np.array([0.0, 0.0, 0.5])
    plan = PlannedMotion(
        np.linspace(0.0, 1.0, 3),
        np.linspace([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 3),
        np.array([[0.0, 0.0], [0.4, -0.4], [0.8, -0.8]]),
        start,
    )
    follower = PostureFollower(REST, ALPHA_K, period=0.01)
    simulator = Simulator(follower)
    context = simulator.get_mutable_context()
    motion_port = follower.GetInputPort("motion").FixValue(context, Value(plan))
    under_way = replace(policy(0.5, speed=0.0), p_WS=start, p_WE=here)
    port = follower.GetInputPort("policy_state").FixValue(context, Value(under_way))
    simulator.AdvanceTo(5.0)
    before = np.array(follower.get_output_port().Eval(context))
    np.testing.assert_allclose(before[:2], [0.4, -0.4], atol=1e-6)
    port.GetMutableData().set_value(PolicyState(phase=1.0, p_WS=here, p_WE=here, stamp=5.0))
    simulator.AdvanceTo(5.03)
    held = follower.get_output_port().Eval(context)
    np.testing.assert_allclose(held, [0.4, -0.4, 0.0, 0.0], atol=1e-6)
    other = PlannedMotion(plan.s, plan.p_WE, np.tile([0.6, 0.0], (3, 1)), here)
    motion_port.GetMutableData().set_value(other)
    simulator.AdvanceTo(5.05)
    np.testing.assert_allclose(follower.get_output_port().Eval(context)[:2], held[:2], atol=0.01)
    simulator.AdvanceTo(10.0)
    np.testing.assert_allclose(follower.get_output_port().Eval(context)[:2], [0.6, 0.0], atol=1e-6)
