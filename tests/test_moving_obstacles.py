"""The course of an obstacle, and the force that keeps it there."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drake_oa.moving_obstacles import drive_force, offset_at
from drake_oa.scenario import ScenarioError, load_scenario

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
