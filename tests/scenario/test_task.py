"""Where a goal that is moved is, and which moves are refused."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drake_oa.common.config import ScenarioError
from drake_oa.scenario.loading import load_scenario, parse_scenario, scenario_text
from drake_oa.scenario.task import Task, goal_at, goal_steps, goal_trajectory, last_move

numbers = st.floats(-1.0, 1.0)
tasks = st.lists(
    st.tuples(st.integers(1, 1000).map(lambda t: 0.01 * t), numbers, numbers, numbers),
    max_size=4,
    unique_by=lambda m: m[0],
).map(lambda moves: Task(goal_moves=[list(move) for move in sorted(moves)]))


def test_a_goal_stays_until_it_is_moved() -> None:
    task = Task(goal=[0.1, 0.2, 0.3], goal_moves=[[1.0, 0.4, 0.2, 0.3], [2.0, 0.4, 0.2, 0.5]])
    for time, goal in (
        (0.0, [0.1, 0.2, 0.3]),
        (0.999, [0.1, 0.2, 0.3]),
        (1.0, [0.4, 0.2, 0.3]),
        (2.0, [0.4, 0.2, 0.5]),
        (99.0, [0.4, 0.2, 0.5]),
    ):
        np.testing.assert_array_equal(goal_at(task, time), goal)
    assert last_move(task) == 2.0
    assert last_move(replace(task, goal_moves=[])) == 0.0


@given(tasks, st.floats(0.0, 20.0))
def test_the_trajectory_is_where_the_goal_is(task: Task, time: float) -> None:
    np.testing.assert_array_equal(goal_trajectory(task).value(time).ravel(), goal_at(task, time))


@given(tasks)
def test_each_step_holds_from_its_own_time_on(task: Task) -> None:
    steps = goal_steps(task)
    for row in steps:
        np.testing.assert_array_equal(goal_at(task, row[0]), row[1:])
        np.testing.assert_array_equal(goal_trajectory(task).value(row[0]).ravel(), row[1:])
    np.testing.assert_array_equal(goal_at(task, last_move(task) + 1e3), steps[-1, 1:])


@pytest.mark.parametrize(
    ("moves", "message"),
    [
        ("[[1, 0, 0]]", r"task\.goal_moves\[0\]: expected 4 numbers"),
        ("[[0, 0, 0, 1]]", r"goal_moves\[0\]: its time 0 s must be later than 0"),
        ("[[2, 0, 0, 1], [2, 0, 0, 1]]", r"goal_moves\[1\]: its time 2 s must be later than that"),
        ("[[2, 0, 0, 1], [2.0000000000000004, 0, 0, 1]]", r"must be later .* by 1 us"),
        ("[[2, 0, 0, 1], [3, 0.45, -0.45, 0.3]]", r"goal_moves\[1\]: .* is the start"),
        ("[[2, 0, .inf, 1]]", r"goal_moves\[0\]\[2\]: must be a finite number"),
        ("[7]", r"goal_moves\[0\]: expected a list, not 7"),
    ],
)
def test_bad_moves_are_refused(moves: str, message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        load_scenario("tabletop_box", [f"task.goal_moves={moves}"])


def test_moves_are_written_with_the_scenario() -> None:
    scenario = load_scenario("free_space", ["task.goal_moves=[[1, 1, 0.2, 0]]"])
    assert parse_scenario(scenario_text(scenario)).task == scenario.task
