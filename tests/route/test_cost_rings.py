"""Tests of the cost rings and of the selection of sides."""

from dataclasses import replace
from functools import partial
from itertools import pairwise, permutations, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import EllipsoidSet, TablePlane
from drake_oa.route.cost_rings import (
    RingScene,
    length_ring,
    obstruction,
    overlap_groups,
    path_length,
    remaining_clearance,
    ring_scene,
    select_directions,
    table_ring,
)
from tests.builders import balls

START, GOAL = np.array([0.0, 0.0, 0.3]), np.array([1.0, 0.0, 0.3])
TABLE = TablePlane()
LENGTH = {"length": length_ring}
RINGS = {"table": partial(table_ring, height=0.05), **LENGTH}
seeds = st.integers(0, 2**31)


def scene_of(
    ellipsoids: EllipsoidSet, table: TablePlane | None = TABLE, delta: float = 0.15, width: int = 36
) -> RingScene:
    return ring_scene(
        START, GOAL, np.eye(3), ellipsoids, table, requested_clearance=delta, n_directions=width
    )


def posed(seed: int, count: int) -> EllipsoidSet:
    """Draws ellipsoids in a row along the baseline, displaced from it by up to 0.08 m."""
    rng = np.random.default_rng(seed)
    p = np.column_stack([0.2 + 0.3 * np.arange(count), *rng.uniform(-0.08, 0.08, (2, count))])
    return replace(
        balls(*(p + [0.0, 0.0, 0.3])),
        R_WO=Rotation.random(count, random_state=rng).as_matrix().reshape(count, 3, 3),
        semi_axes=rng.uniform(0.015, 0.06, (count, 3)),
    )


def chosen(scene: RingScene, row: int = 0, **rings: object) -> np.ndarray:
    return scene.directions_W[select_directions(scene, RINGS | rings)[0][row]]


def total_cost(scene: RingScene, sides: tuple[int, ...]) -> tuple[float, float]:
    """Computes path length and other costs of a sequence of sides, by the module's formula."""
    some = scene.ellipsoids
    rows = np.argsort(some.p_WO[:, 0], kind="stable")
    points = [START, *(scene.p_WP[row, sides[row]] for row in rows), GOAL]
    cost = sum(float(RINGS["table"](scene)[row, side]) for row, side in enumerate(sides))
    for leg, (a, b) in enumerate(pairwise(points)):
        counts = np.ones(len(some), dtype=bool)
        counts[[rows[0]] * (leg == 0) + [rows[-1]] * (leg == len(some))] = False
        leg_cost = obstruction(a[None], b[None], some, counts, scene.requested_clearance)
        cost += 2.0 * float(leg_cost[0, 0])
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum()), cost


@settings(max_examples=30)
@given(seed=seeds, count=st.integers(1, 3), width=st.integers(4, 6))
def test_the_sides_have_the_minimum_cost_of_all_combinations(
    seed: int, count: int, width: int
) -> None:
    scene = scene_of(posed(seed, count), delta=0.05, width=width)
    if len(np.unique(overlap_groups(scene.ellipsoids, 0.05))) < count:
        return
    costs = {sides: total_cost(scene, sides) for sides in product(range(width), repeat=count)}
    lengths = [length for length, _ in costs.values()]
    scale = count / max(max(lengths) - min(lengths), count * 0.1)
    forbidden = RINGS["table"](scene) >= 1.0
    if forbidden.all(axis=1).any():
        return
    allowed = {
        sides: scale * (length - min(lengths)) + cost
        for sides, (length, cost) in costs.items()
        if not any(forbidden[row, side] for row, side in enumerate(sides))
    }
    index = tuple(select_directions(scene, RINGS)[0].tolist())
    assert allowed[index] == pytest.approx(min(allowed.values()))


@settings(max_examples=20)
@given(seed=seeds, order=st.sampled_from(list(permutations(range(3)))))
def test_the_selection_is_invariant_to_frame_and_order(seed: int, order: tuple[int, ...]) -> None:
    some, rows = posed(seed, 3), list(order)
    R, p = Rotation.random(random_state=seed).as_matrix(), np.array([0.4, -1.0, 2.0])
    names = ("p_WO", "R_WO", "semi_axes", "v_WO", "ids")
    moved = replace(some, p_WO=some.p_WO @ R.T + p, R_WO=R @ some.R_WO)
    moved = replace(moved, **{name: getattr(moved, name)[rows] for name in names})
    table = TablePlane(normal_W=R @ TABLE.normal_W, offset=float(R[:, 2] @ p))
    first = scene_of(some, delta=0.05)
    second = ring_scene(R @ START + p, R @ GOAL + p, R, moved, table, requested_clearance=0.05)
    index, other = (select_directions(scene, RINGS)[0] for scene in (first, second))
    # Rounding may select another sequence of equal cost.
    back = tuple(other[np.argsort(rows)].tolist())
    ours, theirs = (sum(total_cost(first, sides)) for sides in (tuple(index.tolist()), back))
    assert np.array_equal(index[rows], other) or ours == pytest.approx(theirs, abs=1e-6)


def test_obstacles_on_both_sides_are_passed_without_a_zigzag() -> None:
    # Each alone is passed on its free side; both together on one side, which is shorter.
    scene = scene_of(balls((0.4, 0.02, 0.3), (0.6, -0.02, 0.3), radius=0.06), None, 0.025)
    each = length_ring(scene).argmin(axis=1)
    both = select_directions(scene, LENGTH)[0]
    sides = scene.directions_W[each][:, 1]
    assert sides[0] < -0.9
    assert sides[1] > 0.9
    directions = scene.directions_W[both]
    assert directions[0] @ directions[1] > 0.8
    assert path_length(scene, both) < path_length(scene, each)


@given(y=st.floats(-0.006, 0.006), z=st.floats(-0.006, 0.006), side=st.integers(0, 35))
def test_noise_does_not_change_the_side_of_an_obstacle_on_the_baseline(
    y: float, z: float, side: int
) -> None:
    scene = scene_of(balls((0.5, y, 0.3 + z)), table=None)
    assert select_directions(scene, RINGS, previous=np.array([side]))[0][0] == side


def test_guidance_has_a_clearance_if_the_baseline_is_too_close() -> None:
    # Close to the baseline, far from it, close to the start, which limits it, and behind the start.
    centers = [(0.5, 0.2, 0.3), (0.5, 0.3, 0.3), (0.1, 0.0, 0.5), (-0.2, 0.0, 0.3)]
    clearance = remaining_clearance(scene_of(balls(*centers)))
    np.testing.assert_allclose(clearance, [0.15, 0.0, np.hypot(0.1, 0.2) - 0.1, 0.0])


def test_obstacles_without_a_passage_between_them_are_passed_on_one_side() -> None:
    near = balls((0.45, 0.06, 0.3), (0.55, -0.05, 0.3))
    assert len(set(overlap_groups(near, 0.15))) == 1
    index = select_directions(scene_of(near), RINGS)[0]
    assert index[0] == index[1]
    far = balls((0.2, 0.0, 0.3), (0.8, 0.0, 0.3), radius=0.05)
    assert len(set(overlap_groups(far, 0.15))) == 2


@given(
    center=st.tuples(st.floats(0.2, 0.8), st.floats(-0.3, 0.3), st.floats(0.0, 0.6)),
    radius=st.floats(0.02, 0.3),
)
def test_passing_points_have_the_clearance_and_costs_are_in_range(
    center: tuple[float, float, float], radius: float
) -> None:
    scene = scene_of(balls(center, radius=radius))
    distance = np.linalg.norm(scene.p_WP[0] - np.array(center), axis=1) - radius
    assert distance.min() >= 0.15 - 1e-9
    for ring in RINGS.values():
        cost = ring(scene)
        assert ((cost >= 0.0) & (cost <= 1.0)).all()
    assert path_length(scene, select_directions(scene, RINGS)[0]) >= 1.0 - 1e-12
