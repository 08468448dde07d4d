"""Start and goal of a task given as configurations."""

from __future__ import annotations

import numpy as np
import pytest

from drake_oa.common.config import ScenarioError
from drake_oa.robot.plant import make_robot_plant
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.end_poses import start_positions
from drake_oa.scenario.loading import parse_scenario, scenario_text

Q_START = [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]
Q_GOAL = [0.4, -0.5, 0.3, -2.1, 0.2, 1.8, 0.6]
JOINTS = f"task: {{q_start: {Q_START}, q_goal: {Q_GOAL}"


def test_start_goal_and_orientations_follow_from_configurations() -> None:
    scenario = parse_scenario(JOINTS + "}")
    robot = make_robot_plant(scenario.robot)
    q = start_positions(scenario)
    np.testing.assert_array_equal(q[:7], Q_START)
    np.testing.assert_allclose(robot.tool_path(q[None])[0], scenario.task.start)
    q[:7] = Q_GOAL
    (X_WG,) = robot.tool_poses(q[None])
    np.testing.assert_allclose(X_WG.translation(), scenario.task.goal)
    np.testing.assert_allclose(X_WG.rotation().ToRollPitchYaw().vector(), scenario.task.rpy_goal)
    again = parse_scenario(scenario_text(scenario))
    assert again == scenario
    start_positions(again)


def test_poses_that_contradict_the_configurations_are_rejected() -> None:
    with pytest.raises(ScenarioError, match=r"task\.goal, .*: task\.q_goal has the tool at"):
        start_positions(parse_scenario(JOINTS + ", goal: [0.5, 0.1, 0.4]}"))
    with pytest.raises(ScenarioError, match=r"task\.rpy_start: task\.q_start has the tool at"):
        start_positions(parse_scenario(JOINTS + ", rpy_start: [3.1, 0.0, 0.5]}"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("task: {q_start: [0.0, 0.1]}", r"task\.q_start: expected 7 numbers.* not 2"),
        (f"task: {{q_goal: {[*Q_GOAL[:6], 3.0]}}}", r"task\.q_goal\[6\]: 3 is outside \[-2\.8973"),
        ("robot: {q_seed: [0, 0]}", r"robot\.q_seed: .* of panda_joint1, .* not \[0\.0, 0\.0\]"),
    ],
)
def test_error_of_invalid_joints_names_the_field(text: str, message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        start_positions(parse_scenario(text))


def test_configurations_require_a_robot() -> None:
    text = "robot: null\nperception: !GivenEllipsoids {}\ntask: {q_goal: [0.0]}"
    with pytest.raises(ScenarioError, match="requires a robot"):
        parse_scenario(text)


def test_arm_moves_from_the_start_configuration_to_the_goal_configuration() -> None:
    scenario = parse_scenario(JOINTS + ", duration: 2.0}\nperception: !GroundTruth {}")
    scenario.table_height = None
    log = simulate(scenario)
    assert log.stop_reason == "goal"
    np.testing.assert_array_equal(log.q[0, :7], Q_START)
    # With the start configuration as nominal posture the arm ends more than 0.13 rad away.
    assert np.abs(log.q[-1, :7] - Q_GOAL).max() < 0.02
