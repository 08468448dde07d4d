"""What one configuration keeps of the world, against Drake and against all pairs."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pydrake.math import RigidTransform

from drake_oa.geometry.distance_field import field_of
from drake_oa.geometry.solids import Solid, cloud_solid, half_space, hull, solid_distance
from drake_oa.planning.arm_world import (
    FAR,
    LINKS,
    SELF,
    STRIDE,
    TOOL,
    ArmWorld,
    exceeds,
    excess,
    excess_along,
    group_distances,
    lower_excess,
    self_distance,
    share_clear,
)
from drake_oa.robot.arm import axis_frame, joints_to, tool_poses
from tests.planning.arms import ArmAlone, box_at, brute_excess, random_things

SEEDS = st.integers(0, 2**32 - 1)


def lowered(
    world: ArmWorld, arm: ArmAlone, q: np.ndarray, t: float, least: float, enough: float
) -> np.ndarray:
    found = np.full(3, least)
    room = np.empty((len(world.asked.is_tool), 3))
    lower_excess(arm.poses(q), t, world.spheres, world.solids, world.asked, room, found, enough)
    return found


def kept(world: ArmWorld, q: np.ndarray, t: float = 0.0) -> float:
    room = np.empty((len(q) + 2, 12)), np.empty((len(world.asked.is_tool), 3))
    return float(excess(world, np.array(q), t, FAR, *room))


def random_world(
    arm: ArmAlone, random: np.random.Generator, more: Sequence[Solid] = ()
) -> ArmWorld:
    things = random_things(random, 4, moving=2)
    solids = [thing.solid() for thing in things] + list(more)
    world = arm.among(solids, own=random.uniform(0.0, 0.05))
    table = random.uniform(-0.05, 0.2, world.asked.of_solids.shape)
    table[random.random(table.shape) < 0.2] = -np.inf
    return world._replace(asked=world.asked._replace(of_solids=table))


@settings(max_examples=15)
@given(seed=SEEDS)
def test_the_joints_are_where_drake_has_them(
    panda_arm: ArmAlone, six_arm: ArmAlone, seed: int
) -> None:
    for arm in (panda_arm, six_arm):
        plant, q = arm.robot.plant, arm.random_q(np.random.default_rng(seed))
        context = plant.CreateDefaultContext()
        full = arm.q_full.copy()
        full[arm.chain.q_index] = q
        plant.SetPositions(context, full)
        frames = [
            joint.child_body().EvalPoseInWorld(context) @ axis_frame(joint)
            for joint in joints_to(plant, arm.robot.tool_frame)
        ]
        frames = [RigidTransform(), *frames, arm.robot.tool_frame.CalcPoseInWorld(context)]
        X = arm.poses(q)
        for row, frame in zip(X, frames, strict=True):
            expected = np.append(frame.rotation().matrix().ravel(), frame.translation())
            np.testing.assert_allclose(row, expected, atol=1e-12)
        np.testing.assert_array_equal(tool_poses(arm.chain, q[None])[0], X[-1])


@settings(max_examples=15)
@given(seed=SEEDS)
def test_what_is_kept_is_the_least_of_all_pairs(
    panda_arm: ArmAlone, six_arm: ArmAlone, seed: int
) -> None:
    random = np.random.default_rng(seed)
    for arm in (panda_arm, six_arm):
        q, t = arm.random_q(random), random.uniform(0.0, 2.0)
        shard = hull(random.uniform(-0.1, 0.1, (12, 3)) + [0.4, 0.2, 0.5])
        world = random_world(arm, random, [shard, half_space()])
        expected = brute_excess(world, arm, q, t)
        own = expected[SELF] + world.asked.of_self
        assert self_distance(arm.chain, world.spheres, q) == pytest.approx(min(own, FAR), abs=1e-12)
        for least in (FAR, 0.02, -0.01, 10.0):
            found = lowered(world, arm, q, t, least, -np.inf)
            np.testing.assert_allclose(found, np.minimum(expected, least), atol=1e-12)
        if expected.min() < 0.0:
            assert kept(world, q, t) < 0.0
        else:
            assert kept(world, q, t) == pytest.approx(min(expected.min(), FAR), abs=1e-12)
        # Where it is enough, it is below what is enough; where it never is, all is known.
        for enough in (expected.min() + 0.01, expected.min() - 0.01, 0.0):
            found = lowered(world, arm, q, t, FAR, enough)
            if expected.min() < min(enough, FAR):
                assert found.min() < enough
                assert (found >= np.minimum(expected, FAR) - 1e-12).all()
            elif enough <= expected.min():
                np.testing.assert_allclose(found, np.minimum(expected, FAR), atol=1e-12)


@settings(max_examples=10)
@given(seed=SEEDS)
def test_a_fields_distances_are_culled_to_a_voxel(panda_arm: ArmAlone, seed: int) -> None:
    random = np.random.default_rng(seed)
    box = random.uniform(-1.0, 1.0, (2000, 3))
    box[np.arange(2000), random.integers(3, size=2000)] = random.choice([-1.0, 1.0], 2000)
    at = random.uniform([0.2, -0.5, 0.0], [0.7, 0.5, 0.7])
    grid = field_of(box * random.uniform(0.03, 0.15, 3) + at)
    world = panda_arm.among([cloud_solid(grid)])
    for _ in range(4):
        q = panda_arm.random_q(random)
        expected = brute_excess(world, panda_arm, q, 0.0)
        found = lowered(world, panda_arm, q, 0.0, FAR, -np.inf)
        np.testing.assert_allclose(found, np.minimum(expected, FAR), atol=grid.voxel)


def test_what_may_touch_is_not_looked_at(panda_arm: ArmAlone) -> None:
    # All over the arm: only what is asked of it counts.
    wrapped = box_at([2.0, 2.0, 2.0], [0.3, 0.0, 0.5])
    world = panda_arm.among([wrapped], own=-0.5)
    assert kept(world, panda_arm.q) < -0.3
    free = np.full_like(world.asked.of_solids, -np.inf)
    world = world._replace(asked=world.asked._replace(of_solids=free))
    np.testing.assert_array_equal(
        lowered(world, panda_arm, panda_arm.q, 0.0, 5.0, -np.inf)[[TOOL, LINKS]], 5.0
    )
    assert lowered(world, panda_arm, panda_arm.q, 0.0, 5.0, -np.inf)[SELF] < 5.0


def test_limits_count(arm: ArmAlone) -> None:
    world = arm.among([], own=-5.0)
    for joint in range(len(arm.q)):
        for limit, sign in ((arm.chain.lower, -1.0), (arm.chain.upper, 1.0)):
            q = arm.q.copy()
            q[joint] = limit[joint]
            assert exceeds(world, q)
            q[joint] += sign * 1e-6
            assert not exceeds(world, q)


@settings(max_examples=10)
@given(seed=SEEDS)
def test_the_distances_of_groups_are_the_least_of_their_spheres(
    panda_arm: ArmAlone, seed: int
) -> None:
    random = np.random.default_rng(seed)
    world, q = random_world(panda_arm, random), panda_arm.random_q(random)
    t, spheres, p = random.uniform(0.0, 2.0), world.spheres, panda_arm.centers(q)
    found = group_distances(world.chain, spheres, world.solids, q[None], t, np.inf)
    for k in range(found.shape[1]):
        each = [
            solid_distance(world.solids, k, *center, t) - radius
            for center, radius in zip(p, spheres.radius, strict=True)
        ]
        least = np.minimum.reduceat(each, spheres.first[:-1])
        np.testing.assert_allclose(found[:, k], least, atol=1e-12)


@settings(max_examples=25)
@given(seed=SEEDS)
def test_no_sphere_moves_farther_than_it_reaches(
    panda_arm: ArmAlone, six_arm: ArmAlone, seed: int
) -> None:
    random = np.random.default_rng(seed)
    for arm in (panda_arm, six_arm):
        q, dq = arm.random_q(random), random.normal(size=len(arm.q)) * 10 ** random.uniform(-4, 0)
        dq *= random.random(len(dq)) < 0.6
        moved = np.linalg.norm(arm.centers(q + dq) - arm.centers(q), axis=1)
        assert moved.max() <= arm.chain.reach @ np.abs(dq) + 1e-12


def a_way(arm: ArmAlone, random: np.random.Generator) -> tuple[ArmWorld, np.ndarray, np.ndarray]:
    """From a configuration that keeps what is asked to another one."""
    world = arm.among([thing.solid() for thing in random_things(random, 5)])
    for _ in range(20):
        one = arm.random_q(random)
        if exceeds(world, one):
            other = np.clip(
                one + random.normal(size=len(one)) * random.uniform(0.05, 0.6),
                arm.chain.lower,
                arm.chain.upper,
            )
            return world, one, other
    assume(False)
    raise AssertionError


@settings(max_examples=40)
@given(seed=SEEDS)
def test_a_clear_way_is_clear_between_its_samples(panda_arm: ArmAlone, seed: int) -> None:
    world, one, other = a_way(panda_arm, np.random.default_rng(seed))
    share, looked_at = share_clear(world, one, other, STRIDE, FAR)
    assert 0.0 <= share <= 1.0
    assert looked_at >= 1
    along = one + np.linspace(0.0, share, 200)[:, None] * (other - one)
    assert excess_along(world, along) >= -0.5 * STRIDE - 1e-9
    if share < 1.0:
        # The next configuration that was looked at.
        bound = float(world.chain.reach @ np.abs(other - one))
        at = kept(world, one + share * (other - one)) if share > 0.0 else 0.0
        beyond = min(share + max(STRIDE, at) / bound, 1.0)
        assert kept(world, one + beyond * (other - one)) < 0.0
