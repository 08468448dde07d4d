"""Tests of clearance margins of a configuration, against distances of all pairs."""

import numpy as np
import pydrake.geometry as drake
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from drake_oa.geometry.collision_scene import geometry_distance, geometry_of, hull
from drake_oa.planning.collision_model import (
    FAR,
    SPHERE_STRIDE,
    ArmCollisionModel,
    free_fraction,
    group_distances,
    is_collision_free,
    lower_clearance_margins,
    min_clearance_margin,
    self_distance,
)
from tests.planning.arms import ArmAlone, random_boxes

SEEDS = st.integers(0, 2**32 - 1)


def random_model(arm: ArmAlone, random: np.random.Generator) -> ArmCollisionModel:
    shard = hull(random.uniform(-0.1, 0.1, (12, 3)) + [0.4, 0.2, 0.5])
    objects = random_boxes(random, 4, moving=2)
    world = arm.model(
        [*objects, shard, geometry_of(drake.HalfSpace())], self_clearance=random.uniform(0.0, 0.05)
    )
    table = random.uniform(-0.05, 0.2, world.required.of_geometries.shape)
    table[random.random(table.shape) < 0.2] = -np.inf
    return world._replace(required=world.required._replace(of_geometries=table))


@settings(max_examples=15)
@given(seed=SEEDS)
def test_margins_are_the_minima_over_all_pairs(panda_arm: ArmAlone, seed: int) -> None:
    random = np.random.default_rng(seed)
    q, t = panda_arm.random_q(random), random.uniform(0.0, 2.0)
    world = random_model(panda_arm, random)
    spheres, required, p = world.spheres, world.required, panda_arm.centers(q)
    rows = range(len(world.geometries.ball))
    d = np.array([[geometry_distance(world.geometries, k, *c, t) for k in rows] for c in p])
    d = np.minimum.reduceat(d - spheres.radius[:, None], spheres.first[:-1])
    found = group_distances(world.chain, spheres, world.geometries, q[None], t, np.inf)
    np.testing.assert_allclose(found, d, atol=1e-12)
    own = np.inf
    groups = [slice(*ends) for ends in zip(spheres.first, spheres.first[1:], strict=False)]
    for (a, b), allowance in zip(spheres.pairs, spheres.allowance, strict=True):
        one, other = groups[a], groups[b]
        gap = cdist(p[one], p[other]) - spheres.radius[one][:, None] - spheres.radius[other]
        own = min(own, gap.min() + allowance)
    assert self_distance(world.chain, spheres, q) == pytest.approx(min(own, FAR), abs=1e-12)
    least = np.full(3, FAR)
    room = np.empty((len(d), 3))
    lower_clearance_margins(
        panda_arm.poses(q), t, spheres, world.geometries, required, room, least, -np.inf
    )
    clearance_margin = [
        (d - required.of_geometries)[of].min() for of in (required.is_tool, ~required.is_tool)
    ]
    np.testing.assert_allclose(
        least, np.minimum([*clearance_margin, own - required.of_self], FAR), atol=1e-12
    )


@given(seed=SEEDS)
def test_a_configuration_beyond_a_joint_limit_is_not_free(panda_arm: ArmAlone, seed: int) -> None:
    random = np.random.default_rng(seed)
    world = panda_arm.model([], self_clearance=-5.0)
    q, joint = panda_arm.random_q(random), random.integers(7)
    for limit, sign in ((panda_arm.chain.lower, -1.0), (panda_arm.chain.upper, 1.0)):
        q[joint] = limit[joint]
        assert is_collision_free(world, q)
        q[joint] += sign * 1e-6
        assert not is_collision_free(world, q)


@settings(max_examples=40)
@given(seed=SEEDS)
def test_a_free_edge_is_free_between_checked_configurations(panda_arm: ArmAlone, seed: int) -> None:
    random = np.random.default_rng(seed)
    world = panda_arm.model(random_boxes(random, 5))
    one = panda_arm.random_q(random)
    assume(is_collision_free(world, one))
    other = one + random.normal(size=7) * random.uniform(0.05, 0.6)
    share, checked = free_fraction(world, one, other)
    assert 0.0 <= share <= 1.0
    assert checked >= 1
    along = one + np.linspace(0.0, share, 200)[:, None] * (other - one)
    assert min_clearance_margin(world, along) >= -0.5 * SPHERE_STRIDE - 1e-9
    # The reach of the joints bounds the displacement of every sphere.
    moved = np.linalg.norm(panda_arm.centers(other) - panda_arm.centers(one), axis=1)
    assert moved.max() <= panda_arm.chain.reach @ np.abs(other - one) + 1e-12
