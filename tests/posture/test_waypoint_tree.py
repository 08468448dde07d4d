"""A tree of legs, on a point that moves among walls in the place of an arm."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_oa.common.messages import BoolArray, FloatArray, PlannedMotion
from drake_oa.posture.posture_plan import PosturePlan
from drake_oa.posture.waypoint_tree import (
    Aside,
    Legs,
    LegTree,
    grown,
    shortened_way,
    straight_motion,
)

START, GOAL, STOP = np.zeros(3), np.array([0.6, 0.0, 0.0]), 0.03


def wall(p: FloatArray) -> FloatArray:
    """(N,) distance to a wall across the way, 0.3 m high and open above [m]."""
    off = np.abs(p - [0.3, 0.0, 0.0]) - [0.02, 1.0, 0.3]
    out = np.linalg.norm(np.maximum(off, 0.0), axis=-1)
    return np.asarray(out + np.minimum(off.max(axis=-1), 0.0))


def plan(q: FloatArray, motion: PlannedMotion) -> PosturePlan:
    """The posture of a point is where it is."""
    np.testing.assert_allclose(q, motion.p_WE[0])
    distance = wall(motion.p_WE)
    return PosturePlan(
        s=motion.s,
        q=motion.p_WE,
        distance=distance,
        short=max(0.0, STOP - float(distance.min())),
        free=len(motion) if (distance >= STOP).all() else int((distance < STOP).argmax()),
    )


def anywhere(points: FloatArray) -> BoolArray:
    return points[:, 2] >= -0.2


def start() -> LegTree:
    return LegTree.at(START, START, GOAL, [0.3, 0.0, 0.0])


LEGS = Legs(plan, anywhere)


def test_it_finds_the_way_over_a_wall() -> None:
    tree, row = grown(start(), LEGS, 300)
    assert row > 0
    way = np.concatenate([START[None], tree.way(row), GOAL[None]])
    for one, other in itertools.pairwise(way):
        assert LEGS.gone(one, one, other)[2]
    assert way[:, 2].max() > 0.3
    assert anywhere(tree.p_WV).all()


def test_what_is_no_need_is_left_out() -> None:
    tree, row = grown(start(), LEGS, 300)
    points, q = shortened_way(tree, row, LEGS)
    assert 1 <= len(points) <= len(tree.way(row))
    np.testing.assert_array_equal(points[-1], q)
    way = np.concatenate([START[None], points, GOAL[None]])
    for one, other in itertools.pairwise(way):
        assert LEGS.gone(one, one, other)[2]


def test_a_way_that_can_not_be_gone_any_more_is_none() -> None:
    tree, row = grown(start(), LEGS, 300)
    higher = Legs(plan, lambda points: points[:, 2] <= 0.2)
    assert len(shortened_way(tree, row, higher)[0]) == 0


def test_it_grows_on_and_each_time_in_the_same_way() -> None:
    whole, row = grown(start(), LEGS, 300)
    tree, found = start(), -1
    while found < 0:
        tried = tree.tried
        tree, found = grown(tree, LEGS, 10)
        assert tree.tried > tried
    assert found == row
    np.testing.assert_array_equal(tree.p_WV, whole.p_WV)


def test_where_nothing_leads_on_there_is_none() -> None:
    nowhere = Legs(plan, lambda points: np.zeros(len(points), dtype=bool))
    tree, row = grown(start(), nowhere, 300)
    assert (row, len(tree), tree.tried) == (-1, 1, len(tree.aims()))


def test_a_blocked_leg_counts_as_far_as_it_leads() -> None:
    reached, q, whole = LEGS.gone(START, START, GOAL)
    assert not whole
    # The wall begins at 0.28 m; samples are up to 25 mm apart.
    assert 0.22 < reached[0] <= 0.25
    np.testing.assert_array_equal(reached, q)
    # The first node leads away; from it and from the others the goal is tried.
    tree, _ = grown(start(), LEGS, 3)
    assert len(tree) >= 3
    assert wall(tree.p_WV).min() >= STOP


def test_no_leg_leads_through_where_the_tool_may_not_be() -> None:
    hole = Legs(plan, lambda points: np.linalg.norm(points - [0.0, 0.3, 0.0], axis=1) > 0.1)
    reached, _, whole = hole.gone(START, START, np.array([0.0, 0.6, 0.0]))
    assert not whole
    assert 0.15 < reached[1] <= 0.2
    # Who is in it may come out.
    inside, out = np.array([0.0, 0.3, 0.0]), np.array([0.0, 0.5, 0.0])
    assert hole.gone(inside, inside, out)[2]


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_the_first_aims_lead_away_from_what_is_near_and_up(seed: int) -> None:
    p_WE, p_WO, p_WG = np.random.default_rng(seed).uniform(-1.0, 1.0, (3, 3))
    first = LegTree.at(p_WE, np.zeros(7), p_WG, p_WO).aims()[:8] - p_WE
    np.testing.assert_allclose(np.linalg.norm(first, axis=1), 0.2)
    away = (p_WE - p_WO) / np.linalg.norm(p_WE - p_WO) + [0.0, 0.0, 0.5]
    assert (first @ away > 0.0).all()


@pytest.mark.parametrize("length", [0.0, 0.01, 0.2, 0.21])
def test_the_way_is_straight_and_closely_sampled(length: float) -> None:
    p_WE = np.array([0.4, 0.1, 0.3])
    motion = straight_motion(p_WE, p_WE + [0.0, length, 0.0])
    np.testing.assert_array_equal(motion.p_WE[0], p_WE)
    np.testing.assert_allclose(motion.p_WE[-1], p_WE + [0.0, length, 0.0])
    assert (motion.s[0], motion.s[-1]) == (0.0, 1.0)
    assert np.linalg.norm(np.diff(motion.p_WE, axis=0), axis=1).max() <= 0.025


def test_it_leads_from_point_to_point_and_ends() -> None:
    points = np.arange(9.0).reshape(3, 3)
    aside = Aside().by(points, [1.0, 2.0, 3.0])
    for row in range(3):
        np.testing.assert_array_equal(aside.p_WV, points[row])
        np.testing.assert_array_equal(aside.further, points[row + 1 :])
        np.testing.assert_array_equal(aside.p_WG, [1.0, 2.0, 3.0])
        aside = aside.reached()
    assert (len(aside.p_WV), len(aside.p_WG)) == (0, 0)


def test_given_up_what_has_been_tried_is_kept() -> None:
    tree = LegTree.at(np.zeros(3), np.zeros(7), np.ones(3), np.ones(3))
    aside = Aside(tree=tree).by(np.ones((2, 3)), np.ones(3)).given_up()
    assert (len(aside.p_WV), len(aside.further), len(aside.p_WG)) == (0, 0, 0)
    assert aside.tree is tree
