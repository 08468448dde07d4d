"""Which turn of the tool is chosen, and when it is turned."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drake_oa.common.messages import FloatArray, ObstacleClouds, PolicyState
from drake_oa.geometry.annulus import Annulus
from drake_oa.geometry.rotation import turned_about, unit_axis
from drake_oa.policy.dmp import imitate, local_frame, minimum_jerk
from drake_oa.regulation.config import SearchParameters
from drake_oa.regulation.regressor import load_chain
from drake_oa.regulation.regulator import Regulator
from drake_oa.regulation.tool_turn import ToolTurner, TurnChoice, TurningTool, TurnParameters
from drake_oa.scenario.loading import package_file

UP = np.array([0.0, 0.0, 1.0])
START, GOAL = np.array([0.0, 0.0, 0.3]), np.array([1.0, 0.0, 0.3])
QUICK = SearchParameters(candidates=32, rounds=6, polish=0, steps=250)
angles = st.floats(-np.pi, np.pi)
numbers = st.integers(0, 2**32 - 1)


def box(size: tuple[float, ...], center: tuple[float, ...] = (0.0, 0.0, 0.0)) -> FloatArray:
    """(8, 3) corners."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return np.array(center) + 0.5 * signs * np.array(size)


# A bar across the motion, below a small hand.
PARTS = (box((0.02, 0.5, 0.02)), box((0.05, 0.05, 0.1), (0.0, 0.0, 0.06)))


def tool(R_WE: FloatArray | None = None) -> TurningTool:
    return TurningTool.of(list(PARTS), UP, np.eye(3) if R_WE is None else R_WE)


def post(x: float, y: float, height: float = 1.5, width: float = 0.04) -> FloatArray:
    """(N, 3) points on the edges of a square post that stands on the ground."""
    z = np.linspace(0.0, height, 75)
    corners = [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1) if (a, b) != (0, 0)]
    return np.concatenate(
        [
            np.column_stack([np.full(75, x + 0.5 * width * a), np.full(75, y + 0.5 * width * b), z])
            for a, b in corners
        ]
    )


def seen(*clouds: FloatArray, stamp: float = 0.0) -> ObstacleClouds:
    return ObstacleClouds(stamp=stamp, clouds_W=clouds, ids=np.arange(len(clouds)))


# Two posts with a gap of 0.3 m, and others beside them that leave no way round.
GAP = seen(*(post(0.5, y) for y in (-0.17, 0.17, -0.5, 0.5, -0.85, 0.85)))


def policy(x: float = 0.0, stamp: float = 0.0, speed: float = 0.0) -> PolicyState:
    """At rest at x, or under way."""
    return PolicyState(
        p_WE=START + [x, 0.0, 0.0],
        z_W=np.array([speed, 0.0, 0.0]),
        p_WS=START,
        p_WG=GOAL,
        R_WL=local_frame(START, GOAL),
        stamp=stamp,
        phase=1.0,
        speed=0.2,
    )


@cache
def turner(**changes: float) -> ToolTurner:
    weights = load_chain(package_file("package://drake_oa/weights/regressor_chain.safetensors"))
    dmp = imitate(*minimum_jerk(START, GOAL, duration=5.0))
    # Not above 0.5 m: there is no way over the posts.
    annulus = Annulus(np.array([[0.1, 0.5], [0.0, 0.0], [5.0, 5.0]]))
    regulator = Regulator(weights, dmp, 0.03, parameters=QUICK, annulus=annulus)
    parameters = TurnParameters(step=np.pi / 4.0, **changes)
    return ToolTurner(tool(), regulator, dmp.duration, parameters, free_W=START[None])


@given(numbers, angles, angles)
def test_turns_add_up_and_keep_lengths_and_the_axis(seed: int, one: float, other: float) -> None:
    rng = np.random.default_rng(seed)
    axis, points = unit_axis(rng.normal(size=3)), rng.normal(size=(5, 3))
    twice = turned_about(turned_about(points, axis, one), axis, other)
    np.testing.assert_allclose(twice, turned_about(points, axis, one + other), atol=1e-12)
    np.testing.assert_allclose(
        np.linalg.norm(twice, axis=1), np.linalg.norm(points, axis=1), rtol=1e-12
    )
    np.testing.assert_allclose(twice @ axis, points @ axis, atol=1e-12)
    assert np.array_equal(turned_about(points, axis, 0.0), points)


@given(numbers, angles)
def test_the_distance_of_a_turned_tool_is_that_of_its_turned_boxes(seed: int, turn: float) -> None:
    rng = np.random.default_rng(seed)
    points, place = rng.uniform(-0.6, 0.6, (40, 3)), rng.uniform(-0.2, 0.2, 3)
    found = tool().clearance(points, place[None], np.array([turn]), 10.0)[0, 0]
    here = turned_about(points - place, UP, -turn)
    least = np.inf
    for part in PARTS:
        low, high = part.min(axis=0), part.max(axis=0)
        outside = np.maximum(np.maximum(low - here, here - high), 0.0)
        least = min(least, np.linalg.norm(outside, axis=1).min())
    assert found == pytest.approx(least, abs=1e-12)


@given(numbers, angles, angles)
def test_distances_turn_with_the_world(seed: int, turn: float, by: float) -> None:
    rng = np.random.default_rng(seed)
    points, place = rng.uniform(-0.6, 0.6, (40, 3)), rng.uniform(-0.2, 0.2, (1, 3))
    found = tool().clearance(points, place, np.array([turn]), 10.0)
    about = tool().clearance(
        turned_about(points, UP, by), turned_about(place, UP, by), np.array([turn + by]), 10.0
    )
    np.testing.assert_allclose(found, about, atol=1e-12)
    # The tool is its own mirror image.
    mirror = np.array([1.0, -1.0, 1.0])
    mirrored = tool().clearance(points * mirror, place * mirror, np.array([-turn]), 10.0)
    np.testing.assert_allclose(found, mirrored, atol=1e-12)


def test_distances_are_cut_off_where_nothing_near_is_asked_for() -> None:
    found = tool().clearance(np.array([[0.0, 0.0, -1.0]]), np.zeros((1, 3)), np.zeros(1), 0.05)
    assert found == [[0.05]]
    inside = tool().clearance(np.array([[0.0, 0.2, 0.0]]), np.zeros((1, 3)), np.zeros(1), 0.05)
    assert inside == [[0.0]]


def test_boxes_are_along_the_tool() -> None:
    R = np.array([[np.cos(0.7), -np.sin(0.7), 0.0], [np.sin(0.7), np.cos(0.7), 0.0], [0, 0, 1.0]])
    turned = TurningTool.of([part @ R.T for part in PARTS], UP, R)
    np.testing.assert_allclose(turned.half, tool().half, atol=1e-12)
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (30, 3))
    np.testing.assert_allclose(
        turned.clearance(points, np.zeros((1, 3)), np.zeros(1), 9.0),
        tool().clearance(points, np.zeros((1, 3)), np.array([0.7]), 9.0),
        atol=1e-12,
    )


def test_turns_are_tried_from_the_smallest_on_either_way() -> None:
    turns = TurnParameters(largest=1.0, step=0.4).turns
    assert turns == pytest.approx([0.0, 0.4, -0.4, 0.8, -0.8, 1.0, -1.0])
    assert TurnParameters(largest=np.pi / 2.0, step=np.pi / 12.0).turns[-1] == pytest.approx(
        -np.pi / 2.0
    )


@pytest.mark.parametrize(
    ("name", "value"), [("largest", 0.0), ("step", np.nan), ("speed", -1.0), ("margin", np.inf)]
)
def test_refuses_parameters_out_of_range(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        TurnParameters(**{name: value})


@pytest.mark.parametrize("axis", [np.zeros(3), np.ones(2), [np.nan, 0.0, 1.0]])
def test_refuses_an_axis_without_direction(axis: object) -> None:
    with pytest.raises(ValueError, match="axis"):
        TurningTool.of(list(PARTS), axis, np.eye(3))
    with pytest.raises(ValueError, match="part"):
        TurningTool.of([], UP, np.eye(3))


@pytest.mark.parametrize(
    "obstacles",
    [
        ObstacleClouds(),
        ObstacleClouds(stamp=0.0),
        seen(post(0.5, 0.8)),
        seen(post(0.5, -0.8), post(0.2, 0.9)),
    ],
)
def test_nothing_is_turned_where_there_is_room(obstacles: ObstacleClouds) -> None:
    choice = turner().update(TurnChoice(), policy(), GOAL, obstacles, 0.0)
    assert (choice.planned, choice.turn, choice.speed_scale) == (0.0, 0.0, 1.0)
    assert not choice.blocked


@pytest.fixture(scope="module")
def chosen() -> TurnChoice:
    """At the start, before the gap."""
    return turner().update(TurnChoice(), policy(), GOAL, GAP, 0.0)


def test_turns_to_pass_a_gap_that_is_too_narrow(chosen: TurnChoice) -> None:
    assert abs(chosen.planned) == pytest.approx(np.pi / 2.0)
    assert chosen.turn == chosen.planned
    assert not chosen.blocked
    assert chosen.speed_scale == 1.0
    # The way is the straight one.
    assert chosen.regulation.remaining == pytest.approx(1.0, abs=1e-3)


def test_the_mirrored_and_the_turned_world_are_passed_alike(chosen: TurnChoice) -> None:
    mirrored = seen(*(cloud * [1.0, -1.0, 1.0] for cloud in GAP.clouds_W))
    other = turner().update(TurnChoice(), policy(), GOAL, mirrored, 0.0)
    assert abs(other.planned) == abs(chosen.planned)
    here = policy()
    about = turned_about(np.array([START, GOAL]), UP, 1.0)
    turned = seen(*(turned_about(cloud, UP, 1.0) for cloud in GAP.clouds_W))
    there = replace(here, p_WE=about[0], p_WS=about[0], p_WG=about[1], R_WL=local_frame(*about))
    weights = load_chain(package_file("package://drake_oa/weights/regressor_chain.safetensors"))
    dmp = imitate(*minimum_jerk(START, GOAL, duration=5.0))
    annulus = Annulus(np.array([[0.1, 0.5], [0.0, 0.0], [5.0, 5.0]]))
    R = turned_about(np.eye(3), UP, 1.0).T
    turning = ToolTurner(
        TurningTool.of([turned_about(part, UP, 1.0) for part in PARTS], UP, R),
        Regulator(weights, dmp, 0.03, parameters=QUICK, annulus=annulus),
        dmp.duration,
        TurnParameters(step=np.pi / 4.0),
        free_W=about[:1],
    )
    found = turning.update(TurnChoice(), there, about[1], turned, 0.0)
    assert abs(found.planned) == abs(chosen.planned)
    assert found.regulation.remaining == pytest.approx(chosen.regulation.remaining, abs=1e-6)


def test_a_choice_stands_and_costs_nothing_while_nothing_changes(chosen: TurnChoice) -> None:
    again = turner().update(chosen, policy(0.01, 0.1), GOAL, replace(GAP, stamp=0.1), chosen.turn)
    assert again.planned == chosen.planned
    assert again.regulation is chosen.regulation
    assert again.points is chosen.points


def test_noise_does_not_change_it(chosen: TurnChoice) -> None:
    rng = np.random.default_rng(2)
    noisy = seen(*(c + 1e-3 * rng.normal(size=c.shape) for c in GAP.clouds_W), stamp=0.3)
    again = turner().update(chosen, policy(0.02, 0.3, 0.3), GOAL, noisy, chosen.turn)
    assert again.planned == chosen.planned


def test_the_motion_waits_for_the_turn_near_the_gap(chosen: TurnChoice) -> None:
    scales = [
        turner()
        .update(chosen, policy(x, 0.1, 1.5), GOAL, GAP, 0.2 * np.sign(chosen.planned))
        .speed_scale
        for x in (0.0, 0.2, 0.36, 0.42)
    ]
    assert scales == sorted(scales, reverse=True)
    assert scales[0] > 0.2
    assert scales[-1] == 0.0
    # Turned already, nothing is waited for.
    ready = turner().update(chosen, policy(0.42, 0.1, 1.5), GOAL, GAP, chosen.planned)
    assert ready.speed_scale == 1.0


def test_it_does_not_turn_where_it_would_touch_on_the_way(chosen: TurnChoice) -> None:
    # Beside the gap, tip to tip with a post: it may turn one way until it is near.
    blocked = seen(*GAP.clouds_W, post(0.2, 0.2))
    start = replace(chosen, planned=-np.pi / 2.0, obstacles=blocked)
    found = turner().update(
        replace(start, searched=-1.0, obstacles=ObstacleClouds()),
        replace(policy(0.03), stamp=-0.99),
        GOAL,
        blocked,
        0.0,
    )
    place = policy(0.03).p_WE[None]
    swept = np.linspace(0.0, found.turn, 50)
    points = np.concatenate(blocked.clouds_W)
    assert tool().clearance(points, place, swept, 1.0).min() > 0.0
    all_of_it = np.linspace(0.0, -np.pi / 2.0, 90)
    assert tool().clearance(points, place, all_of_it, 1.0).min() < 0.01
    assert abs(found.turn) < np.pi / 2.0


def test_turns_back_only_behind_the_gap(chosen: TurnChoice) -> None:
    planned = {}
    for x in (0.4, 0.5, 0.6, 0.9):
        here = turner().update(chosen, policy(x, 3.0, 1.0), GOAL, GAP, chosen.planned)
        planned[x] = here.planned
        if here.planned == 0.0:
            assert here.turn == 0.0
            points = np.concatenate(GAP.clouds_W)
            swept = np.linspace(0.0, chosen.planned, 90)
            place = policy(x).p_WE[None]
            assert tool().clearance(points, place, swept, 1.0).min() >= 0.03 - 2e-3
    assert planned[0.4] == planned[0.5] == planned[0.6] == chosen.planned
    assert planned[0.9] == 0.0


def test_says_so_where_no_turn_will_do() -> None:
    wall = seen(*(post(0.5, y, width=0.1) for y in np.arange(-1.0, 1.01, 0.1)))
    # One obstacle each, none of which can be passed.
    found = turner(largest=np.pi / 4.0).update(TurnChoice(), policy(), GOAL, wall, 0.0)
    assert found.planned == 0.0
    assert found.blocked
