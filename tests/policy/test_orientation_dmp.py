"""The movement primitive of the orientation: imitation, generalization and angular rates."""

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
    evaluate,
    goal_vector,
    imitate_orientation,
    minimum_jerk_orientation,
    minimum_jerk_share,
    orientation_along,
    roll_orientation,
    rotation_matrix,
)

LEAST_JERK = minimum_jerk_orientation()
S = np.linspace(0.0, 1.0, 61)
SHARE = minimum_jerk_share(S)
ZEROS = np.zeros(3)

vectors = st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3).map(np.array)


def turned(r: ArrayLike) -> FloatArray:
    return np.asarray(Rotation.from_rotvec(r).as_matrix())


def angles(A: FloatArray, B: FloatArray) -> FloatArray:
    """Angle between orientations, row by row [rad]."""
    return np.asarray((Rotation.from_matrix(A).inv() * Rotation.from_matrix(B)).magnitude())


START = turned([np.pi, 0.0, 0.0])
GOAL = START @ turned([0.3, -0.2, 0.7])
WIGGLE = START @ turned(
    np.column_stack([0.9 * SHARE, 0.4 * np.sin(np.pi * S) ** 2, 0.3 * SHARE + 0.2 * SHARE**2])
)
WIGGLING = imitate_orientation(WIGGLE)


def test_the_default_is_a_turn_of_least_jerk_about_a_fixed_axis() -> None:
    R = orientation_along(LEAST_JERK, START, GOAL, S)
    g = goal_vector(START, GOAL)
    np.testing.assert_allclose(angles(R, START @ turned(np.outer(SHARE, g))), 0.0, atol=1e-5)
    with pytest.raises(ValueError, match="half a turn apart"):
        orientation_along(LEAST_JERK, START, START @ np.diag([-1.0, -1.0, 1.0]), S)


@settings(max_examples=25)
@given(vectors, vectors, vectors)
def test_the_frames_of_world_and_tool_make_no_difference(
    world: FloatArray, tool: FloatArray, goal: FloatArray
) -> None:
    R_VW, R_EF, R_WG = turned(3.0 * world), turned(3.0 * tool), START @ turned(1.5 * goal)
    ours = orientation_along(LEAST_JERK, START, R_WG, S)
    theirs = orientation_along(LEAST_JERK, R_VW @ START @ R_EF, R_VW @ R_WG @ R_EF, S)
    np.testing.assert_allclose(theirs, R_VW @ ours @ R_EF, atol=1e-9)


@pytest.mark.parametrize(
    "demonstration",
    [
        WIGGLE,
        # There and back, more than half a turn, and farther than rotation vectors reach.
        START @ turned(np.outer(np.sin(np.pi * S) ** 2, [0.5, 0.0, 0.0])),
        START @ turned(np.outer(SHARE, [0.0, 0.0, 4.0])),
        START @ turned(np.outer(SHARE, [0.0, 0.0, 7.0])),
    ],
)
def test_it_reproduces_the_demonstration(demonstration: FloatArray) -> None:
    scale = np.random.default_rng(1).choice([-2.5, -1.0, 1.0, 1e-3], len(S))
    quaternions = Rotation.from_matrix(demonstration).as_quat(scalar_first=True)
    for shown in (demonstration, quaternions * scale[:, None]):
        primitive = imitate_orientation(shown, 4.0 * S + 7.0)
        assert primitive.dmp.duration == pytest.approx(4.0)
        R = orientation_along(primitive, primitive.first, primitive.last, S)
        assert angles(R, demonstration).max() < 5e-3


def test_a_goal_half_a_turn_away_is_approached_as_demonstrated() -> None:
    primitive = imitate_orientation(START @ turned(np.outer(SHARE, [0.0, 0.0, 4.0])))
    target = demonstrated_goal(primitive, START, START @ turned([0.0, 0.0, np.pi]))
    np.testing.assert_allclose(target, [0.0, 0.0, np.pi], atol=1e-6)


@settings(max_examples=25)
@given(vectors)
def test_the_demonstrated_wiggle_is_added_on_the_way_to_another_goal(goal: FloatArray) -> None:
    r, own = (
        roll_orientation(WIGGLING, end, S, ZEROS, ZEROS).p
        for end in (WIGGLING.total + 0.5 * goal, WIGGLING.total)
    )
    np.testing.assert_allclose(r, own + np.outer(SHARE, 0.5 * goal), atol=1e-4)


@settings(max_examples=25)
@given(st.lists(st.floats(0.0, 0.05), min_size=20, max_size=40))
def test_the_motion_does_not_depend_on_the_steps(steps: list[float]) -> None:
    s = np.append(0.0, np.cumsum(steps))
    motion = roll_orientation(WIGGLING, WIGGLING.total, s, ZEROS, ZEROS)
    np.testing.assert_allclose(motion.k, WIGGLING.dmp.phase(s), rtol=1e-9)
    middle = len(s) // 2
    state = motion.p[middle], motion.z[middle], motion.k[middle]
    for begin, after in ((0, (ZEROS, ZEROS)), (middle, state)):
        end = roll_orientation(WIGGLING, WIGGLING.total, s[[begin, -1]], *after)
        np.testing.assert_allclose(end.p[1], motion.p[-1], atol=1e-4)


@settings(max_examples=50)
@given(vectors, vectors, vectors, st.floats(0.0, 5.0), st.floats(0.1, 0.9))
def test_angular_rates_are_those_of_finite_differences(
    axis: FloatArray, rate: FloatArray, other: FloatArray, angle: float, time: float
) -> None:
    r = angle * axis / max(float(np.linalg.norm(axis)), 1e-2)
    ends = np.array([[r, rate], [r + other, 2.0 * other - rate]])
    origin = Rotation.from_rotvec(axis).as_quat(scalar_first=True)
    for array in (ends, origin):
        array.flags.writeable = False
    h = 1e-4
    before, now, after = (evaluate(ends, 1.0, origin, time + dt) for dt in (-h, 0.0, h))
    R = [Rotation.from_quat(one[:4], scalar_first=True) for one in (before, now, after)]
    back, ahead = ((one * R[1].inv()).as_rotvec() for one in (R[0], R[2]))
    np.testing.assert_allclose((ahead - back) / (2.0 * h), now[4:7], atol=1e-5)
    np.testing.assert_allclose((ahead + back) / h**2, now[7:], atol=1e-2)


@given(vectors, st.integers(-1, 1))
def test_the_nearest_vector_is_taken(r: FloatArray, turns: int) -> None:
    length = np.linalg.norm(r)
    near = r + 2.0 * np.pi * turns * r / length if length > 0.1 else r
    np.testing.assert_allclose(goal_vector(np.eye(3), turned(near), near=near), near, atol=1e-6)


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
            np.array([turned([0.0, 0.0, x]) for x in np.linspace(0.0, 12.0, 40)]),
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


@pytest.mark.parametrize("quaternion", [[0.0] * 4, [np.inf, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
def test_a_quaternion_must_be_one(quaternion: list[float]) -> None:
    with pytest.raises(ValueError, match="a quaternion must be"):
        rotation_matrix(quaternion)
