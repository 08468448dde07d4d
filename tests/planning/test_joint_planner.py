"""Tests of joint-space paths from one side of a wall to the other."""

from itertools import pairwise

import numpy as np
import pytest

from drake_oa.common.latency import counted
from drake_oa.common.messages import FloatArray
from drake_oa.planning.collision_model import ArmCollisionModel, free_fraction, is_collision_free
from drake_oa.planning.joint_planner import plan_path
from tests.planning.arms import ArmAlone, box_at, wall_with_gap

LIMIT = 60_000


def mirrored(q: FloatArray) -> FloatArray:
    return q * [-1.0, 1.0, -1.0, 1.0, -1.0, 1.0, 1.0]


def colliding(q: FloatArray) -> FloatArray:
    """Returns a configuration in collision with the wall."""
    return q * [0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]


@pytest.fixture(scope="module")
def walled(panda_arm: ArmAlone) -> ArmCollisionModel:
    return panda_arm.model(wall_with_gap(), 0.03, 0.03)


def is_path_free(world: ArmCollisionModel, path: FloatArray) -> bool:
    return all(free_fraction(world, *ends)[0] == 1.0 for ends in pairwise(path))


def test_a_path_through_the_gap_ends_at_a_free_goal(
    walled: ArmCollisionModel, panda_arm: ArmAlone
) -> None:
    start, goal = panda_arm.q, mirrored(panda_arm.q)
    assert free_fraction(walled, start, goal)[0] < 1.0
    goals = np.stack([colliding(start), goal])
    with counted() as work:
        path = plan_path(walled, start, goals, max_configurations=LIMIT, seed=1)
    assert 0 < work["configurations"] <= 2 * LIMIT
    np.testing.assert_allclose(path[[0, -1]], [start, goal], atol=1e-12)
    assert is_path_free(walled, path)
    # Another seed gives another path; the same seed the same path.
    other_path = plan_path(walled, start, goals, max_configurations=LIMIT, seed=7)
    same_path = plan_path(walled, start, goals, max_configurations=LIMIT, seed=1)
    np.testing.assert_array_equal(same_path, path)
    assert path.shape != other_path.shape or not np.array_equal(path, other_path)


def test_without_obstacles_the_path_is_straight(panda_arm: ArmAlone) -> None:
    start, goal = panda_arm.q, mirrored(panda_arm.q)
    path = plan_path(panda_arm.model(), start, goal[None], max_configurations=LIMIT, seed=1)
    length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    assert length == pytest.approx(np.linalg.norm(goal - start), rel=1e-6)


def test_no_path_without_a_solution(walled: ArmCollisionModel, panda_arm: ArmAlone) -> None:
    start, goal = panda_arm.q, mirrored(panda_arm.q)
    assert not is_collision_free(walled, colliding(start))
    beyond = start.copy()
    beyond[3] = 0.5
    for begin, ends in (
        (colliding(start), goal[None]),
        (start, beyond[None]),
        (start, np.zeros((0, 7))),
    ):
        assert plan_path(walled, begin, ends, max_configurations=LIMIT).shape == (0, 7)
    with counted() as work:
        assert not len(plan_path(walled, start, goal[None], max_configurations=100))
    assert 100 <= work["configurations"] < 1000
    # A wall without a gap.
    world = panda_arm.model([box_at([3.0, 0.02, 3.0], [1.7, 0.0, 0.0])], 0.0, 0.0)
    assert not len(plan_path(world, start, goal[None], max_configurations=5000, seed=1))
