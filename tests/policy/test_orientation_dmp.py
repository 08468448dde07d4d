"""Tests of the movement primitive of the orientation: imitation and generalization."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import FloatArray
from drake_oa.policy.dmp import (
    demonstrated_goal,
    imitate_orientation,
    minimum_jerk_orientation,
    minimum_jerk_profile,
    orientation_along,
    roll_orientation,
    rotation_matrix,
)

LEAST_JERK = minimum_jerk_orientation()
S = np.linspace(0.0, 1.0, 61)
SHARE = minimum_jerk_profile(S)
vectors = st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3).map(np.array)


def turned(r: ArrayLike) -> FloatArray:
    """Returns rotation matrices of rotation vectors [rad]."""
    return np.asarray(Rotation.from_rotvec(r).as_matrix())


def angles(A: FloatArray, B: FloatArray) -> FloatArray:
    """Computes the angles between two sequences of orientations [rad]."""
    return np.asarray((Rotation.from_matrix(A).inv() * Rotation.from_matrix(B)).magnitude())


START = turned([np.pi, 0.0, 0.0])
WIGGLE = START @ turned(
    np.column_stack([0.9 * SHARE, 0.4 * np.sin(np.pi * S) ** 2, 0.3 * SHARE + 0.2 * SHARE**2])
)


@settings(max_examples=25)
@given(vectors, vectors, vectors)
def test_the_default_is_a_minimum_jerk_rotation_in_any_world_and_tool_frame(
    world: FloatArray, tool: FloatArray, goal: FloatArray
) -> None:
    R_VW, R_EF, R_WG = turned(3.0 * world), turned(3.0 * tool), START @ turned(1.5 * goal)
    ours = orientation_along(LEAST_JERK, START, R_WG, S)
    np.testing.assert_allclose(
        angles(ours, START @ turned(np.outer(SHARE, 1.5 * goal))), 0.0, atol=1e-4
    )
    theirs = orientation_along(LEAST_JERK, R_VW @ START @ R_EF, R_VW @ R_WG @ R_EF, S)
    np.testing.assert_allclose(theirs, R_VW @ ours @ R_EF, atol=1e-9)


@pytest.mark.parametrize(
    "demonstration",
    [
        WIGGLE,
        # There and back, by more than 180 degrees, and by more than 360 degrees.
        START @ turned(np.outer(np.sin(np.pi * S) ** 2, [0.5, 0.0, 0.0])),
        START @ turned(np.outer(SHARE, [0.0, 0.0, 4.0])),
        START @ turned(np.outer(SHARE, [0.0, 0.0, 7.0])),
    ],
)
def test_it_reproduces_the_demonstration(demonstration: FloatArray) -> None:
    scale = np.random.default_rng(1).choice([-2.5, -1.0, 1.0, 1e-3], len(S))
    quaternions = Rotation.from_matrix(demonstration).as_quat(scalar_first=True)
    for orientations in (demonstration, quaternions * scale[:, None]):
        primitive = imitate_orientation(orientations, 4.0 * S + 7.0)
        assert primitive.dmp.duration == pytest.approx(4.0)
        R = orientation_along(primitive, primitive.first, primitive.last, S)
        assert angles(R, demonstration).max() < 5e-3


@settings(max_examples=25)
@given(vectors, st.floats(0.05, 0.9))
def test_a_motion_to_another_goal_adds_the_demonstrated_deviation_in_any_steps(
    change: FloatArray, middle: float
) -> None:
    wiggling, rest = imitate_orientation(WIGGLE), np.zeros(3)
    begin, end = wiggling.offset, wiggling.offset + wiggling.total
    first, other = (
        roll_orientation(wiggling, goal, begin, rest, end=1.0) for goal in (end, end + 0.5 * change)
    )
    final, share = first.p[-1], minimum_jerk_profile(first.s)
    np.testing.assert_allclose(other.p, first.p + np.outer(share, 0.5 * change), atol=1e-4)
    first = roll_orientation(wiggling, end, begin, rest, end=middle)
    state = first.p[-1], first.z[-1], wiggling.dmp.phase(middle)
    second = roll_orientation(wiggling, end, *state, end=1.0 - middle)
    np.testing.assert_allclose(second.p[-1], final, atol=1e-4)


def test_a_goal_at_180_degrees_is_approached_in_the_demonstrated_direction() -> None:
    primitive = imitate_orientation(START @ turned(np.outer(SHARE, [0.0, 0.0, 4.0])))
    goal = START @ turned([0.0, 0.0, np.pi])
    r = demonstrated_goal(primitive, START, goal) - primitive.offset
    np.testing.assert_allclose(r, [0.0, 0.0, np.pi], atol=1e-6)
    with pytest.raises(ValueError, match="differ by 180 degrees"):
        orientation_along(LEAST_JERK, START, goal, S)


@pytest.mark.parametrize(
    ("orientations", "message"),
    [
        (np.zeros((5, 3)), r"\(T, 4\) quaternions, w first, or \(T, 3, 3\)"),
        (np.array([[1.0, 0.0, 0.0, 0.0]]), "at least 2 samples"),
        ([[1.0, 0, 0, 0], [0, 0, 0, 0]], "quaternion of sample 1 is 0"),
        ([[1.0, 0, 0, 0], [np.nan, 0, 0, 0]], "sample 1 is not"),
        ([np.eye(3), 2.0 * np.eye(3)], "sample 1 is no rotation matrix"),
        ([np.eye(3), np.diag([1.0, -1.0, -1.0])], "sample 0 and the next differ by 180 degrees"),
        (turned(np.outer(SHARE, [0.0, 0.0, 12.0])), "rotated by more than 300 degrees"),
    ],
)
def test_errors_name_the_sample_of_an_invalid_demonstration(
    orientations: FloatArray, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        imitate_orientation(orientations)


def test_invalid_quaternions_are_refused() -> None:
    for quaternion in ([0.0] * 4, [np.inf, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0]):
        with pytest.raises(ValueError, match="a quaternion must be"):
            rotation_matrix(quaternion)
