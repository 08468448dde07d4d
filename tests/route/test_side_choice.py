"""The sides of several obstacles, chosen together."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import permutations, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import EllipsoidSet, FloatArray, TablePlane
from drake_oa.route.cost_rings import (
    Chain,
    RingScene,
    legs_between,
    length_ring,
    obstruction,
    overlap_groups,
    path_length,
    ring_scene,
    select_directions,
    sequence_costs,
    table_ring,
)
from tests.builders import balls

START, GOAL = np.array([0.0, 0.0, 0.4]), np.array([2.0, 0.0, 0.4])
RINGS = {"table": partial(table_ring, height=0.05), "length": length_ring}
DELTA = 0.1


def posed(seed: int, count: int) -> EllipsoidSet:
    """Ellipsoids in a row along the baseline, off it by up to 0.15 m."""
    rng = np.random.default_rng(seed)
    p = np.column_stack(
        [
            0.4 + 1.2 * np.arange(count) / max(count - 1, 1) + rng.uniform(-0.05, 0.05, count),
            rng.uniform(-0.15, 0.15, count),
            0.4 + rng.uniform(-0.15, 0.15, count),
        ]
    )
    return replace(
        balls(*p),
        R_WO=Rotation.random(count, random_state=rng).as_matrix().reshape(count, 3, 3),
        semi_axes=rng.uniform(0.03, 0.12, (count, 3)),
    )


def scene_of(some: EllipsoidSet, directions: int = 8, table: bool = True) -> RingScene:
    plane = TablePlane() if table else None
    return ring_scene(
        START, GOAL, np.eye(3), some, plane, asked_clearance=DELTA, n_directions=directions
    )


def rows_of(some: EllipsoidSet, rows: list[int]) -> EllipsoidSet:
    names = ("p_WO", "R_WO", "semi_axes", "v_WO", "ids")
    return replace(some, **{name: getattr(some, name)[rows] for name in names})


def total_of(chain: Chain, index: FloatArray) -> float:
    rows = np.arange(len(index))
    return chain.choice[rows, index].sum() + chain.pair[rows[:-1], index[:-1], index[1:]].sum()


@given(seed=st.integers(0, 2**31), count=st.integers(1, 4), width=st.integers(1, 5))
def test_a_chain_finds_the_least_of_all_combinations(seed: int, count: int, width: int) -> None:
    rng = np.random.default_rng(seed)
    chain = Chain(rng.normal(size=(count, width)), rng.normal(size=(count - 1, width, width)))
    index, least = chain.least()
    totals = [total_of(chain, np.array(c)) for c in product(range(width), repeat=count)]
    assert least == pytest.approx(min(totals))
    assert total_of(chain, index) == pytest.approx(min(totals))


@settings(max_examples=40)
@given(seed=st.integers(0, 2**31), count=st.integers(1, 3), width=st.integers(4, 6))
def test_the_sides_are_the_least_of_all_combinations(seed: int, count: int, width: int) -> None:
    """The total is written out here, leg by leg, as the module's text has it."""
    scene = scene_of(posed(seed, count), width)
    some = scene.ellipsoids
    groups = overlap_groups(some, DELTA)
    if len(np.unique(groups)) < count:
        return
    chosen = select_directions(scene, RINGS).index
    rows = np.argsort(some.p_WO[:, 0], kind="stable")
    table = RINGS["table"](scene)

    def length(sides: tuple[int, ...]) -> float:
        points = [START, *(scene.p_WP[row, side] for row, side in zip(rows, sides, strict=True))]
        return float(np.linalg.norm(np.diff([*points, GOAL], axis=0), axis=1).sum())

    def obstruction(sides: tuple[int, ...]) -> float:
        points = [START, *(scene.p_WP[row, side] for row, side in zip(rows, sides, strict=True))]
        points.append(GOAL)
        total = 0.0
        for leg in range(count + 1):
            counts = np.ones(count, dtype=bool)
            if leg in (0, count):
                counts[rows[min(leg, count - 1)]] = False
            total += in_way(points[leg][None], points[leg + 1][None], some, counts)[0, 0]
        return total

    every = list(product(range(width), repeat=count))
    lengths = {sides: length(sides) for sides in every}
    low, high = min(lengths.values()), max(lengths.values())
    scale = count / max(high - low, count * 0.1 * 2.0)
    total = {
        sides: scale * (lengths[sides] - low)
        + 2.0 * obstruction(sides)
        + (1.0 + 1e3) * table[rows, sides].sum()
        for sides in every
    }
    assert total[tuple(chosen[rows].tolist())] == pytest.approx(min(total.values()), abs=1e-9)


def in_way(
    a: FloatArray, b: FloatArray, some: EllipsoidSet, counts: FloatArray | None = None
) -> FloatArray:
    counts = np.ones(len(some), dtype=bool) if counts is None else counts
    return obstruction(a, b, some, counts, DELTA)


@given(seed=st.integers(0, 2**31))
def test_obstruction_is_the_depth_of_the_leg_in_the_grown_obstacles(seed: int) -> None:
    some = posed(seed, 2)
    rng = np.random.default_rng(seed)
    a = rng.uniform([0, -0.4, 0], [2, 0.4, 0.8], (3, 3))
    b = rng.uniform([0, -0.4, 0], [2, 0.4, 0.8], (4, 3))
    found = in_way(a, b, some)
    share = np.linspace(0.0, 1.0, 2001)[:, None, None, None, None]
    p = a[:, None, None] + share * (b[None, :, None] - a[:, None, None]) - some.p_WO
    at = np.einsum("sabmi,mij->sabmj", p, some.R_WO)
    inside = np.linalg.norm(at / some.semi_axes, axis=-1).min(axis=0)
    grown = np.linalg.norm(at / (some.semi_axes + DELTA), axis=-1).min(axis=0)
    expected = np.where(inside < 1.0, 1.0, np.maximum(1.0 - grown, 0.0)).max(axis=2)
    near = np.abs(inside - 1.0).min(axis=2) < 1e-3
    assert_allclose(found[~near], expected[~near], atol=2e-3)


def test_one_obstacle_is_passed_as_the_paper_prints_it() -> None:
    for seed in range(20):
        scene = scene_of(posed(seed, 1), 36)
        total = RINGS["table"](scene)[0] + length_ring(scene)[0]
        chosen = select_directions(scene, RINGS).index[0]
        assert total[chosen] == total.min()


def test_it_does_not_zigzag_between_obstacles_on_either_side() -> None:
    # Each by itself is passed on the side that it leaves; together over both is as short.
    some = balls((0.8, 0.04, 0.4), (1.2, -0.04, 0.4), radius=0.12)
    scene = scene_of(some, 36, table=False)
    assert len(np.unique(overlap_groups(some, 0.05))) == 2
    scene = replace(scene, asked_clearance=0.05)
    each = length_ring(scene).argmin(axis=1)
    both = select_directions(scene, {"length": length_ring}).index
    sides = scene.directions_W[each][:, 1]
    assert sides[0] < -0.9
    assert sides[1] > 0.9
    kept = scene.directions_W[both]
    assert kept[0] @ kept[1] > 0.8
    assert path_length(scene, both) < path_length(scene, each)


@settings(max_examples=20)
@given(seed=st.integers(0, 2**31), turn=st.tuples(*[st.floats(-3.0, 3.0)] * 3))
def test_the_choice_does_not_depend_on_the_frame(seed: int, turn: tuple[float, ...]) -> None:
    some = posed(seed, 3)
    R, p = Rotation.from_euler("xyz", turn).as_matrix(), np.array([0.4, -1.0, 2.0])
    moved = replace(some, p_WO=some.p_WO @ R.T + p, R_WO=R @ some.R_WO)
    table = TablePlane()
    moved_table = TablePlane(normal_W=R @ table.normal_W, offset=float(R[:, 2] @ p))
    there = ring_scene(R @ START + p, R @ GOAL + p, R, moved, moved_table, asked_clearance=DELTA)
    here = ring_scene(START, GOAL, np.eye(3), some, table, asked_clearance=DELTA)
    assert_sides_alike(here, select_directions(here, RINGS).index, there)


@settings(max_examples=20)
@given(seed=st.integers(0, 2**31), order=st.sampled_from(list(permutations(range(3)))))
def test_the_choice_does_not_depend_on_the_order(seed: int, order: tuple[int, ...]) -> None:
    some = posed(seed, 3)
    here, there = scene_of(some, 36), scene_of(rows_of(some, list(order)), 36)
    index = select_directions(here, RINGS).index[list(order)]
    assert_sides_alike(there, index, there)


def assert_sides_alike(scene: RingScene, index: np.ndarray, other: RingScene) -> None:
    """The other scene's choice is the same, or by rounding one that costs as much."""
    found = select_directions(other, RINGS).index
    if np.array_equal(found, index):
        return
    groups = overlap_groups(scene.ellipsoids, DELTA)
    assert len(np.unique(groups)) > 1 or path_length(scene, found) == pytest.approx(
        path_length(scene, index), abs=1e-6
    )
    legs = legs_between(
        START, GOAL, scene.p_WP, scene.detour, scene.ellipsoids, groups, DELTA, None
    )
    table = RINGS["table"](scene)
    rows = [np.flatnonzero(groups == group) for group in legs.order]
    chain = sequence_costs(
        legs,
        np.array([table[r].mean(axis=0) for r in rows]),
        np.array([(table[r] >= 1.0).any(axis=0) for r in rows], dtype=float),
        0.2,
    )
    first = [r[0] for r in rows]
    assert total_of(chain, found[first]) == pytest.approx(total_of(chain, index[first]), abs=1e-9)


def test_sides_once_chosen_are_kept_until_others_are_clearly_better() -> None:
    some = balls((0.5, 0.01, 0.4), (1.5, 0.01, 0.4), radius=0.06)
    scene = scene_of(some, 36, table=False)
    rings = {"length": length_ring}
    other = np.array([0, 0])
    assert (select_directions(scene, rings).index != other).all()
    assert_array_equal(select_directions(scene, rings, previous=other).index, other)
    assert (select_directions(scene, rings, previous=other, hysteresis=0.0).index != other).all()


def along_legs(p: Callable[[FloatArray], FloatArray], ways: FloatArray) -> FloatArray:
    """(N, P) margins of a condition of points (..., 3): 1 where it holds on a leg, else -inf."""
    share = np.linspace(0.0, 1.0, 12)[:, None]
    margins = np.ones(ways.shape[:2])
    for corner in range(1, ways.shape[1]):
        begin, end = ways[:, corner - 1, None], ways[:, corner, None]
        margins[:, corner] = np.where(p(begin + share * (end - begin)).all(axis=1), 1.0, -np.inf)
    return np.minimum.accumulate(margins, axis=1)


def test_legs_do_not_lead_out_of_reach() -> None:
    some = balls((0.5, 0.03, 0.4), (1.5, 0.03, 0.4), radius=0.1)
    scene = scene_of(some, 36, table=False)
    rings = {"length": length_ring}
    # A hole between the two, on the side that is shorter.
    hole = partial(along_legs, lambda p: np.linalg.norm(p - [1.0, -0.2, 0.4], axis=-1) > 0.3)
    free = select_directions(scene, rings)
    held = select_directions(scene, rings, joint_margins=hole)
    assert (scene.directions_W[free.index, 1] < -0.9).all()
    assert not held.blocked.any()
    assert np.isfinite(hole(np.array([[START, *scene.p_WP[[0, 1], held.index], GOAL]]))).all()
    nowhere = partial(along_legs, lambda p: p[..., 0] > np.inf)
    assert select_directions(scene, rings, joint_margins=nowhere).blocked.any()


def test_a_forbidden_side_is_taken_by_no_sequence() -> None:
    some = balls((0.6, 0.03, 0.4), (1.4, -0.03, 0.4), radius=0.1)
    scene = scene_of(some, 36, table=False)

    def left_only(scene: RingScene) -> FloatArray:
        return np.where(scene.p_WP[..., 1] < -1e-6, 1.0, 0.0)

    found = select_directions(scene, {"length": length_ring, "left": left_only})
    assert (scene.directions_W[found.index, 1] >= -1e-6).all()
    assert not found.blocked.any()
    none = {"length": length_ring, "none": lambda scene: np.ones(scene.detour.shape)}
    assert select_directions(scene, none).blocked.all()
