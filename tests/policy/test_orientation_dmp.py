"""The movement primitive of the orientation: what it is taught, and what it keeps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.math import RollPitchYaw, RotationMatrix

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.rotation import rotation_of
from drake_oa.policy.dmp import minimum_jerk_share
from drake_oa.policy.orientation_dmp import (
    angular_motion,
    demonstrated_goal,
    exponential,
    goal_vector,
    imitate_orientation,
    minimum_jerk_orientation,
    orientation_along,
    rotation_matrix,
    step,
)

LEAST_JERK = minimum_jerk_orientation()
S = np.linspace(0.0, 1.0, 21)


def rpy(roll: float, pitch: float, yaw: float) -> FloatArray:
    return np.array(RollPitchYaw(roll, pitch, yaw).ToRotationMatrix().matrix())


def turned(r: FloatArray) -> FloatArray:
    return np.asarray(rotation_of(exponential(np.asarray(r, dtype=float))))


def quaternions(R: FloatArray) -> FloatArray:
    return np.array([RotationMatrix(m).ToQuaternion().wxyz() for m in R])


def angles(A: FloatArray, B: FloatArray) -> FloatArray:
    """Angle between orientations, row by row [rad]."""
    return np.array(
        [np.linalg.norm(goal_vector(a, b, near=np.zeros(3))) for a, b in zip(A, B, strict=True)]
    )


START = rpy(np.pi, 0.0, 0.0)
GOAL = rpy(np.pi - 0.35, 0.0, 0.7)

vectors = st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3).map(np.array)


def demonstration(wiggle: float = 0.4, count: int = 61) -> FloatArray:
    """(T, 3, 3) from START to elsewhere, by no straight way."""
    s = np.linspace(0.0, 1.0, count)
    share = minimum_jerk_share(s)
    r = np.column_stack(
        [0.9 * share, wiggle * np.sin(np.pi * s) ** 2, 0.3 * share + 0.5 * wiggle * share**2]
    )
    return np.array([START @ turned(row) for row in r])


WIGGLE = imitate_orientation(demonstration())

# The default: least jerk about a fixed axis.


def test_the_default_is_a_turn_of_least_jerk_about_a_fixed_axis() -> None:
    R = orientation_along(LEAST_JERK, START, GOAL, S)
    g = goal_vector(START, GOAL)
    share = minimum_jerk_share(S)
    np.testing.assert_allclose([goal_vector(START, m) for m in R], share[:, None] * g, atol=1e-5)
    np.testing.assert_array_equal(R[0], START)


@settings(max_examples=25)
@given(vectors, vectors, st.floats(0.0, 3.1))
def test_it_arrives_from_everywhere_to_everywhere(
    start: FloatArray, axis: FloatArray, angle: float
) -> None:
    length = np.linalg.norm(axis)
    r = angle * axis / length if length > 1e-3 else np.zeros(3)
    R_WS = turned(3.0 * start)
    R_WG = R_WS @ turned(r)
    R = orientation_along(LEAST_JERK, R_WS, R_WG, [0.0, 1.0, 1.5])
    np.testing.assert_allclose(angles(R[1:], np.array([R_WG, R_WG])), 0.0, atol=1e-3)


@settings(max_examples=25)
@given(vectors, vectors, vectors)
def test_the_frames_of_world_and_tool_make_no_difference(
    world: FloatArray, tool: FloatArray, goal: FloatArray
) -> None:
    R_VW, R_EF, R_WG = turned(3.0 * world), turned(3.0 * tool), START @ turned(goal)
    ours = orientation_along(LEAST_JERK, START, R_WG, S)
    theirs = orientation_along(LEAST_JERK, R_VW @ START @ R_EF, R_VW @ R_WG @ R_EF, S)
    np.testing.assert_allclose(theirs, R_VW @ ours @ R_EF, atol=1e-9)


# Taught from a demonstration.


def test_it_reproduces_the_demonstration() -> None:
    shown = demonstration()
    primitive = imitate_orientation(shown)
    R = orientation_along(primitive, shown[0], shown[-1], np.linspace(0.0, 1.0, len(shown)))
    assert angles(R, shown).max() < 2e-3
    np.testing.assert_allclose(primitive.first, shown[0], atol=1e-12)
    np.testing.assert_allclose(primitive.last, shown[-1], atol=1e-12)


@settings(max_examples=10)
@given(st.lists(st.sampled_from([-1.0, 1.0, -2.5, 1e-3]), min_size=61, max_size=61))
def test_signs_and_lengths_of_quaternions_make_no_difference(factors: list[float]) -> None:
    q = quaternions(demonstration())
    plain = WIGGLE
    other = imitate_orientation(q * np.array(factors)[:, None])
    np.testing.assert_allclose(other.dmp.weights, plain.dmp.weights, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(other.total, plain.total, atol=1e-12)


def test_uneven_stamps_are_followed_in_their_own_time() -> None:
    t = np.linspace(0.0, 1.0, 61) ** 1.5 * 4.0 + 7.0
    g = goal_vector(START, GOAL)
    shown = np.array([START @ turned(x * g) for x in np.sin(0.5 * np.pi * (t - 7.0) / 4.0) ** 2])
    primitive = imitate_orientation(shown, t)
    assert primitive.dmp.duration == pytest.approx(4.0)
    assert angles(orientation_along(primitive, START, GOAL, (t - 7.0) / 4.0), shown).max() < 5e-3


@settings(max_examples=25)
@given(vectors)
def test_what_was_shown_besides_is_added_on_the_way_to_another_goal(goal: FloatArray) -> None:
    shown, primitive = demonstration(), WIGGLE
    R_WG = START @ turned(primitive.total + 0.5 * goal)
    R = orientation_along(primitive, START, R_WG, S)
    share = minimum_jerk_share(S)
    own = np.array(
        [goal_vector(START, m) for m in orientation_along(primitive, START, shown[-1], S)]
    )
    expected = own + share[:, None] * 0.5 * goal
    np.testing.assert_allclose(angles(R, [START @ turned(r) for r in expected]), 0.0, atol=1e-4)


def test_a_motion_there_and_back_can_be_taught() -> None:
    s = np.linspace(0.0, 1.0, 61)
    shown = np.array(
        [START @ turned(np.array([0.5, 0.0, 0.0]) * np.sin(np.pi * x) ** 2) for x in s]
    )
    primitive = imitate_orientation(shown)
    R = orientation_along(primitive, START, START, s)
    assert angles(R, shown).max() < 5e-3
    assert angles(R[30:31], shown[30:31]).max() < 5e-3


def test_more_than_half_a_turn_goes_the_way_that_was_shown() -> None:
    s = np.linspace(0.0, 1.0, 41)
    share = minimum_jerk_share(s)
    shown = np.array([START @ turned(np.array([0.0, 0.0, 4.0 * x])) for x in share])
    primitive = imitate_orientation(shown)
    np.testing.assert_allclose(primitive.total, [0.0, 0.0, 4.0], atol=1e-9)
    R = orientation_along(primitive, shown[0], shown[-1], s)
    assert angles(R, shown).max() < 5e-3
    # And at half a turn exactly, where nothing else tells the way.
    half = START @ turned(np.array([0.0, 0.0, np.pi]))
    np.testing.assert_allclose(
        demonstrated_goal(primitive, START, half), [0.0, 0.0, np.pi], atol=1e-6
    )


# The step.


@settings(max_examples=25)
@given(st.lists(st.floats(0.002, 0.05), min_size=40, max_size=80), st.floats(0.3, 5.0))
def test_the_way_does_not_depend_on_tau_or_the_steps(steps: list[float], tau: float) -> None:
    goal, duration = WIGGLE.total, 3.0
    r, z, k = np.zeros(3), np.zeros(3), 1.0
    for dt in steps:
        r, z, k = step(WIGGLE, r, z, k, dt / (tau * duration), goal)
    s = float(np.sum(steps)) / (tau * duration)
    assert k == pytest.approx(np.exp(-WIGGLE.dmp.alpha_k * s), rel=1e-9)
    R = orientation_along(WIGGLE, START, START @ turned(goal), [s])[0]
    assert np.linalg.norm(goal_vector(START @ turned(r), R)) < 1e-4


# Rates.


@given(vectors, vectors, vectors, st.floats(0.0, 5.0))
def test_angular_rates_are_those_of_finite_differences(
    axis: FloatArray, rate: FloatArray, acceleration: FloatArray, angle: float
) -> None:
    length = np.linalg.norm(axis)
    r = angle * axis / length if length > 1e-2 else 1e-2 * axis

    def at(t: float) -> FloatArray:
        return turned(r + t * rate + 0.5 * t * t * acceleration)

    h = 1e-4
    w, alpha = angular_motion(r, rate, acceleration)
    # Of R(-h) to R(h), in the frame of the start; and the second difference.
    ahead, behind = (goal_vector(at(0.0).T, at(t).T, near=np.zeros(3)) for t in (h, -h))
    np.testing.assert_allclose(-(ahead - behind) / (2.0 * h), w, atol=1e-6)
    np.testing.assert_allclose(-(ahead + behind) / h**2, alpha, atol=2e-4)


def test_rates_are_smooth_where_the_series_takes_over() -> None:
    rate, acceleration = np.array([0.3, -0.5, 0.8]), np.array([-0.2, 0.4, 0.1])
    direction = np.array([2.0, -1.0, 2.0]) / 3.0
    edge = np.sqrt(1e-3)
    inside = angular_motion((edge - 1e-12) * direction, rate, acceleration)
    outside = angular_motion((edge + 1e-12) * direction, rate, acceleration)
    np.testing.assert_allclose(inside, outside, atol=1e-9)


@given(vectors, st.integers(-1, 1))
def test_the_nearest_vector_is_taken(r: FloatArray, turns: int) -> None:
    length = np.linalg.norm(r)
    near = r + 2.0 * np.pi * turns * r / length if length > 0.1 else r
    found = goal_vector(np.eye(3), turned(near), near=near)
    np.testing.assert_allclose(found, near, atol=1e-6)


# What is refused.


@pytest.mark.parametrize(
    ("orientations", "t", "message"),
    [
        (np.zeros((5, 3)), None, r"\(T, 4\) quaternions, w first, or \(T, 3, 3\)"),
        (np.array([[1.0, 0.0, 0.0, 0.0]]), None, "at least 2 samples, not 1"),
        ([[1.0, 0, 0, 0], [0, 0, 0, 0]], None, "quaternion of sample 1 is 0"),
        ([[1.0, 0, 0, 0], [np.nan, 0, 0, 0]], None, "sample 1 is not"),
        (np.array([np.eye(3), 2.0 * np.eye(3)]), None, "sample 1 is no rotation matrix"),
        (
            np.array([np.eye(3), np.diag([1.0, -1.0, -1.0])]),
            None,
            "samples 0 and 1 are half a turn apart",
        ),
        (
            np.array([turned(np.array([0.0, 0.0, x])) for x in np.linspace(0.0, 12.0, 40)]),
            None,
            "from the middle; at most 300 can be imitated",
        ),
        (np.array([START, GOAL, GOAL]), [0.0, 1.0, 1.0], "sample 2 at 1.0 s follows 1.0 s"),
        (np.array([START, GOAL]), [0.0, np.nan], "t must be finite: sample 1 is not"),
    ],
)
def test_a_bad_demonstration_says_what_and_where(
    orientations: FloatArray, t: list[float] | None, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        imitate_orientation(orientations, t)


def test_half_a_turn_without_a_way_round_is_refused() -> None:
    with pytest.raises(ValueError, match="half a turn apart"):
        orientation_along(LEAST_JERK, START, START @ np.diag([-1.0, -1.0, 1.0]), S)


@given(vectors, st.sampled_from([1e-200, 1e-3, -1.0, 1e200]))
def test_any_length_and_sign_names_the_same_rotation(r: FloatArray, factor: float) -> None:
    q = exponential(3.0 * r)
    np.testing.assert_allclose(rotation_matrix(factor * q), rotation_matrix(q), atol=1e-12)
    np.testing.assert_allclose(rotation_matrix(q) @ rotation_matrix(q).T, np.eye(3), atol=1e-12)
