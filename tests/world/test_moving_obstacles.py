"""The course of an obstacle, and the force that keeps it there."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drake_oa.common.schema_check import ScenarioError
from drake_oa.scenario.loading import load_scenario, parse_scenario, scenario_text
from drake_oa.scenario.obstacles import ABSENT_HEIGHT, Obstacle, is_present, offset_at
from drake_oa.world.moving_obstacles import drive_force

numbers = st.floats(-5.0, 5.0)
triples = st.tuples(numbers, numbers, numbers).map(np.array)


def test_a_course_is_straight_between_waypoints_and_rests_outside() -> None:
    course = np.array([[1.0, 0.0, 0.0, 1.0], [2.0, 1.0, -2.0, 1.0], [4.0, 1.0, 2.0, 1.0]])
    for time, offset in (
        (0.0, [0.0, 0.0, 1.0]),
        (1.5, [0.5, -1.0, 1.0]),
        (3.0, [1.0, 0.0, 1.0]),
        (9.0, [1.0, 2.0, 1.0]),
    ):
        np.testing.assert_allclose(offset_at(course, time), offset)


@given(triples, triples, triples, st.floats(0.01, 100.0), st.floats(1e-4, 0.01))
def test_the_force_reaches_the_target_in_one_step(
    x: np.ndarray, v: np.ndarray, target: np.ndarray, mass: float, step: float
) -> None:
    v_next = v + step * drive_force(x, v, target, mass, step) / mass
    np.testing.assert_allclose(x + step * v_next, target, atol=1e-9)


@pytest.mark.parametrize(
    ("waypoints", "message"),
    [
        ("[[0, 0, 0]]", r"obstacles\[0\]\.waypoints\[0\]: expected 4 numbers"),
        ("[[1, 0, 0, 0], [1, 1, 0, 0]]", r"waypoints\[1\]: its time 1 s must be at least 0"),
        ("[[-1, 0, 0, 0]]", r"waypoints\[0\]: its time -1 s"),
        ("[[0, 0, 0, 20]]", r"waypoints\[0\]: \[0.0, 0.0, 20.0\] is outside \[-10, 10\] \[m\]"),
        ("[[0, 0, .nan, 0]]", r"waypoints\[0\]\[2\]: must be a finite number"),
        ("[3]", r"waypoints\[0\]: expected a list, not 3"),
    ],
)
def test_bad_waypoints_are_refused(waypoints: str, message: str) -> None:
    obstacle = f"{{name: a, shapes: [!Sphere {{}}], waypoints: {waypoints}}}"
    with pytest.raises(ScenarioError, match=message):
        load_scenario("tabletop_box", [f"obstacles=[{obstacle}]"])


@pytest.mark.parametrize(
    ("present", "there"),
    [([], [0.0, 1.0, 2.0, 9.0]), ([1.0], [1.0, 2.0, 9.0]), ([1.0, 2.0], [1.0]), ([0, 2], [0, 1])],
)
def test_an_obstacle_is_there_from_and_until(present: list[float], there: list[float]) -> None:
    assert [time for time in (0.0, 1.0, 2.0, 9.0) if is_present(present, time)] == there


@given(triples, triples, st.floats(0.0, 5.0), st.floats(0.01, 5.0), st.floats(0.0, 12.0))
def test_presence_does_not_change_the_course(
    one: np.ndarray, other: np.ndarray, begin: float, lasts: float, time: float
) -> None:
    obstacle = Obstacle(
        waypoints=[[1.0, *one.tolist()], [2.0, *other.tolist()]], present=[begin, begin + lasts]
    )
    course = offset_at(np.array(obstacle.waypoints), time)
    away = 0.0 if is_present(obstacle.present, time) else ABSENT_HEIGHT
    np.testing.assert_array_equal(obstacle.offset_at(time), course + [0.0, 0.0, away])
    assert obstacle.driven


def test_what_stays_for_good_is_not_driven() -> None:
    assert not Obstacle().driven
    np.testing.assert_array_equal(Obstacle().offset_at(3.0), np.zeros(3))


@pytest.mark.parametrize(
    ("present", "message"),
    [
        ("[-1]", r"obstacles\[0\]\.present\[0\]: -1 must be at least 0 \[s\]"),
        ("[2, 2]", r"present\[1\]: 2 must be later than 2"),
        ("[1, 2, 3]", r"present: expected \[from\] or \[from, until\] \[s\], not 3 numbers"),
        ("[.nan]", r"present\[0\]: must be a finite number \[s\]"),
        ("3", r"present: expected a list, not 3"),
    ],
)
def test_bad_presence_is_refused(present: str, message: str) -> None:
    obstacle = f"{{name: a, shapes: [!Sphere {{}}], present: {present}}}"
    with pytest.raises(ScenarioError, match=message):
        load_scenario("tabletop_box", [f"obstacles=[{obstacle}]"])


def test_presence_is_written_with_the_scenario() -> None:
    scenario = load_scenario("vanishing_obstacle")
    assert parse_scenario(scenario_text(scenario)).obstacles == scenario.obstacles
