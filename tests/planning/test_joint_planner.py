"""A path in the joints from one side of a wall to the other."""

from itertools import pairwise

import numpy as np
import pytest

from drake_oa.common.latency import counted
from drake_oa.common.messages import FloatArray
from drake_oa.planning.collision_model import ArmCollisionModel, is_collision_free, free_fraction
from drake_oa.planning.joint_planner import plan_path
from tests.planning.arms import ArmAlone, box_at, wall_with_gap

MOST = 60_000


def mirrored(q: FloatArray) -> FloatArray:
    return q * [-1.0, 1.0, -1.0, 1.0, -1.0, 1.0, 1.0]


def inside(q: FloatArray) -> FloatArray:
    """In the wall."""
    return q * [0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]


@pytest.fixture(scope="module")
def walled(panda_arm: ArmAlone) -> ArmCollisionModel:
    return panda_arm.among(wall_with_gap(), 0.03, 0.03)


def is_clear(world: ArmCollisionModel, path: FloatArray) -> bool:
    return all(free_fraction(world, *ends)[0] == 1.0 for ends in pairwise(path))


def test_a_path_leads_through_the_gap_to_a_free_goal(
    walled: ArmCollisionModel, panda_arm: ArmAlone
) -> None:
    one, other = panda_arm.q, mirrored(panda_arm.q)
    assert free_fraction(walled, one, other)[0] < 1.0
    goals = np.stack([inside(one), other])
    with counted() as work:
        found = plan_path(walled, one, goals, max_configurations=MOST, seed=1)
    assert 0 < work["configurations"] <= 2 * MOST
    np.testing.assert_allclose(found[[0, -1]], [one, other], atol=1e-12)
    assert is_clear(walled, found)
    # Whatever else is planned by another seed.
    other_path = plan_path(walled, one, goals, max_configurations=MOST, seed=7)
    np.testing.assert_array_equal(
        plan_path(walled, one, goals, max_configurations=MOST, seed=1), found
    )
    assert found.shape != other_path.shape or not np.array_equal(found, other_path)


def test_where_nothing_is_in_the_way_the_path_is_straight(panda_arm: ArmAlone) -> None:
    one, other = panda_arm.q, mirrored(panda_arm.q)
    found = plan_path(panda_arm.among(), one, other[None], max_configurations=MOST, seed=1)
    length = np.linalg.norm(np.diff(found, axis=0), axis=1).sum()
    assert length == pytest.approx(np.linalg.norm(other - one), rel=1e-6)


def test_it_is_empty_where_there_is_none(walled: ArmCollisionModel, panda_arm: ArmAlone) -> None:
    one, other = panda_arm.q, mirrored(panda_arm.q)
    assert not is_collision_free(walled, inside(one))
    beyond = one.copy()
    beyond[3] = 0.5
    for begin, ends in ((inside(one), other[None]), (one, beyond[None]), (one, np.zeros((0, 7)))):
        assert plan_path(walled, begin, ends, max_configurations=MOST).shape == (0, 7)
    with counted() as work:
        assert not len(plan_path(walled, one, other[None], max_configurations=100))
    assert 100 <= work["configurations"] < 1000
    # A wall without a gap.
    world = panda_arm.among([box_at([3.0, 0.02, 3.0], [1.7, 0.0, 0.0])], 0.0, 0.0)
    found = plan_path(world, one, other[None], max_configurations=5000, seed=1)
    assert is_clear(world, found)
