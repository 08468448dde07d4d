"""A path in the joints from one side of a wall to the other."""

import subprocess
import sys

import numpy as np
import pytest

from drake_oa.common.messages import FloatArray
from drake_oa.common.thinking import counted
from drake_oa.planning.arm_world import (
    FAR,
    STRIDE,
    ArmWorld,
    exceeds,
    excess_along,
    share_clear,
)
from drake_oa.planning.joint_planner import plan_path
from tests.planning.arms import ArmAlone, box_at, wall_with_gap

MOST = 60_000


@pytest.fixture(scope="module")
def walled(panda_arm: ArmAlone) -> tuple[ArmWorld, FloatArray, FloatArray]:
    """The world, and configurations on both sides of the wall."""
    return panda_arm.among(wall_with_gap(), 0.03, 0.03), panda_arm.q, mirrored(panda_arm.q)


def mirrored(q: FloatArray) -> FloatArray:
    return q * [-1.0, 1.0, -1.0, 1.0, -1.0, 1.0, 1.0]


def densely(corners: FloatArray, count: int = 60) -> FloatArray:
    at = np.linspace(0.0, len(corners) - 1.0, count * (len(corners) - 1) + 1)
    return np.stack([np.interp(at, np.arange(len(corners)), q) for q in corners.T], axis=1)


def test_a_path_leads_through_the_gap(walled: tuple[ArmWorld, FloatArray, FloatArray]) -> None:
    world, one, other = walled
    assert share_clear(world, one, other, STRIDE, FAR)[0] < 1.0
    with counted() as work:
        found = plan_path(world, one, other[None], most=MOST, seed=1)
    assert len(found)
    assert 0 < work.configurations <= 2 * MOST
    np.testing.assert_allclose(found[[0, -1]], [one, other], atol=1e-12)
    assert all(exceeds(world, q) for q in found)
    assert excess_along(world, densely(found)) >= -0.5 * STRIDE


def test_the_same_seed_gives_the_same_path(
    walled: tuple[ArmWorld, FloatArray, FloatArray], panda_arm: ArmAlone
) -> None:
    world, one, other = walled
    first = plan_path(world, one, other[None], most=MOST, seed=1)
    # Whatever else was planned since, and by whatever seed.
    plan_path(world, other, one[None], most=MOST, seed=7)
    plan_path(panda_arm.among(), one, other[None], most=MOST, seed=1)
    again = plan_path(world, one, other[None], most=MOST, seed=1)
    np.testing.assert_array_equal(first, again)
    differs = plan_path(world, one, other[None], most=MOST, seed=7)
    assert first.shape != differs.shape or not np.array_equal(first, differs)


def test_it_ends_at_a_goal_that_keeps_what_is_asked(
    walled: tuple[ArmWorld, FloatArray, FloatArray],
) -> None:
    world, one, other = walled
    inside = one * [0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]
    assert not exceeds(world, inside)
    found = plan_path(world, one, np.stack([inside, other]), most=MOST, seed=1)
    np.testing.assert_allclose(found[-1], other, atol=1e-12)


def test_where_nothing_is_in_the_way_the_path_is_straight(panda_arm: ArmAlone) -> None:
    one, other = panda_arm.q, mirrored(panda_arm.q)
    found = plan_path(panda_arm.among(), one, other[None], most=MOST, seed=1)
    length = np.linalg.norm(np.diff(found, axis=0), axis=1).sum()
    assert length == pytest.approx(np.linalg.norm(other - one), rel=1e-6)


def test_it_is_empty_where_there_is_none(
    walled: tuple[ArmWorld, FloatArray, FloatArray], panda_arm: ArmAlone
) -> None:
    world, one, other = walled
    inside = one * [0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]
    for begin, ends in ((inside, other[None]), (one, inside[None]), (one, np.zeros((0, 7)))):
        assert plan_path(world, begin, ends, most=MOST).shape == (0, 7)
    with counted() as work:
        assert not len(plan_path(world, one, other[None], most=100))
    assert 100 <= work.configurations < 1000
    # Nor beyond the limits.
    beyond = one.copy()
    beyond[3] = 0.5
    assert not len(plan_path(panda_arm.among(), one, beyond[None], most=MOST))


def test_a_wall_without_a_gap_is_not_passed(panda_arm: ArmAlone) -> None:
    world = panda_arm.among([box_at([3.0, 0.02, 3.0], [1.7, 0.0, 0.0])], 0.0, 0.0)
    q = panda_arm.q
    found = plan_path(world, q, mirrored(q)[None], most=5000, seed=1)
    assert found.shape == (0, 7) or excess_along(world, densely(found)) >= -0.5 * STRIDE


def test_the_planner_leaves_nothing_behind() -> None:
    """Bindings that are destroyed at the interpreter's exit complain of what is left."""
    code = """
import numpy as np
from drake_oa.planning.arm_world import (
    ArmWorld,
    Asked,
)
from drake_oa.planning.joint_planner import plan_path
from drake_oa.geometry.solids import solids_of
from drake_oa.robot.arm import Chain, Spheres

X = np.tile(np.eye(4), (3, 1, 1))
wide = np.full(2, 3.0)
chain = Chain(X, -wide, wide, wide, wide)
none = np.zeros(0, dtype=np.int64)
spheres = Spheres(
    none, np.zeros((0, 3)), np.zeros(0), np.zeros(0, dtype=bool), np.zeros(1, dtype=np.int64),
    none, np.zeros((0, 4)), np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.int64),
    np.zeros((0, 4)), np.zeros((0, 2), dtype=np.int64), np.zeros(0),
)
world = ArmWorld(
    chain, spheres, solids_of([]), Asked(np.zeros((0, 0)), 0.0, np.zeros(0, dtype=bool)), 0.0
)
for goal in (0.5, 1.0):
    found = plan_path(world, np.zeros(2), np.full((1, 2), goal), most=1000, seed=1)
    print(len(found) > 1)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "True"]
    assert not done.stderr
