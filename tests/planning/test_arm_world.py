"""What one configuration keeps of the world, against Drake and against all pairs."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from drake_oa.geometry.solids import Solid, half_space, hull
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
from tests.planning.arms import ArmAlone, brute_excess, random_things

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
def test_what_is_kept_is_the_least_of_all_pairs(
    panda_arm: ArmAlone, six_arm: ArmAlone, seed: int
) -> None:
    random = np.random.default_rng(seed)
    for arm in (panda_arm, six_arm):
        q, t = arm.random_q(random), random.uniform(0.0, 2.0)
        shard = hull(random.uniform(-0.1, 0.1, (12, 3)) + [0.4, 0.2, 0.5])
        world = random_world(arm, random, [shard, half_space()])
        expected = brute_excess(world, arm, q, t)
        d = group_distances(arm.chain, world.spheres, world.solids, q[None], t, np.inf)
        tool, excess_of = world.asked.is_tool, d - world.asked.of_solids
        least_of = [excess_of[of].min(initial=np.inf) for of in (tool, ~tool)]
        np.testing.assert_allclose(least_of, expected[[TOOL, LINKS]], atol=1e-12)
        own = expected[SELF] + world.asked.of_self
        assert self_distance(arm.chain, world.spheres, q) == pytest.approx(min(own, FAR), abs=1e-12)
        for least in (FAR, 0.02, -0.01, 10.0):
            found = lowered(world, arm, q, t, least, -np.inf)
            np.testing.assert_allclose(found, np.minimum(expected, least), atol=1e-12)
        if expected.min() < 0.0:
            assert kept(world, q, t) < 0.0
        else:
            assert kept(world, q, t) == pytest.approx(min(expected.min(), FAR), abs=1e-12)
        # Where it is enough, it is below what is enough.
        found = lowered(world, arm, q, t, FAR, expected.min() + 0.01)
        assert found.min() < expected.min() + 0.01
        assert (found >= np.minimum(expected, FAR) - 1e-12).all()


@given(seed=SEEDS)
def test_limits_count(panda_arm: ArmAlone, seed: int) -> None:
    random = np.random.default_rng(seed)
    world, q, joint = panda_arm.among([], own=-5.0), panda_arm.random_q(random), random.integers(7)
    for limit, sign in ((panda_arm.chain.lower, -1.0), (panda_arm.chain.upper, 1.0)):
        q[joint] = limit[joint]
        assert exceeds(world, q)
        q[joint] += sign * 1e-6
        assert not exceeds(world, q)


@settings(max_examples=40)
@given(seed=SEEDS)
def test_a_clear_way_is_clear_between_its_samples(panda_arm: ArmAlone, seed: int) -> None:
    random = np.random.default_rng(seed)
    world = panda_arm.among([thing.solid() for thing in random_things(random, 5)])
    one = panda_arm.random_q(random)
    assume(exceeds(world, one))
    other = one + random.normal(size=7) * random.uniform(0.05, 0.6)
    share, checked = share_clear(world, one, other)
    assert 0.0 <= share <= 1.0
    assert checked >= 1
    along = one + np.linspace(0.0, share, 200)[:, None] * (other - one)
    assert excess_along(world, along) >= -0.5 * STRIDE - 1e-9
    # No sphere moves farther than the joints reach.
    moved = np.linalg.norm(panda_arm.centers(other) - panda_arm.centers(one), axis=1)
    assert moved.max() <= panda_arm.chain.reach @ np.abs(other - one) + 1e-12
