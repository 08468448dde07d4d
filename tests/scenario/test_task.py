"""Position of a goal that moves during the motion."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from drake_oa.scenario.task import Task, goal_at, goal_steps, goal_trajectory, last_move_time

numbers = st.floats(-1.0, 1.0)
tasks = st.lists(
    st.tuples(st.integers(1, 1000).map(lambda t: 0.01 * t), numbers, numbers, numbers),
    max_size=4,
    unique_by=lambda m: m[0],
).map(lambda moves: Task(goal_moves=[list(move) for move in sorted(moves)]))


@given(tasks, st.floats(0.0, 20.0))
def test_goal_trajectory_agrees_with_goal_at(task: Task, time: float) -> None:
    np.testing.assert_array_equal(goal_trajectory(task).value(time).ravel(), goal_at(task, time))


@given(tasks)
def test_goal_jumps_at_the_time_of_each_move(task: Task) -> None:
    steps = goal_steps(task)
    for row in steps:
        np.testing.assert_array_equal(goal_at(task, row[0]), row[1:])
        np.testing.assert_array_equal(goal_trajectory(task).value(row[0]).ravel(), row[1:])
    np.testing.assert_array_equal(goal_at(task, last_move_time(task) + 1e3), steps[-1, 1:])
