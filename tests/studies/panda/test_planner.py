"""The sampling-based planner: what it solves keeps the clearance; what it cannot, it says."""

import itertools

import numpy as np
import pytest

from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario
from drake_oa.studies.panda.planner import (
    CLEARANCE,
    plan_motion,
    rest_to_rest,
    run_planner,
    world_positions,
)
from drake_oa.studies.panda.run import run_and_judge

pytest.importorskip("ompl")

_LINE = ["task.start=[0.45,-0.3,0.3]", "task.goal=[0.45,0.3,0.3]"]
_POST = "{name: post, shapes: [!Box {size: [0.1, 0.1, 0.5]}], translation: [0.45, 0.0, 0.25]}"


def scene(*obstacles: str) -> Scenario:
    listed = f"obstacles=[{', '.join(obstacles)}]"
    bare = ["directives=[]", "cameras=[]", "perception=!GroundTruth {}"]
    return load_scenario("tabletop_box", [*bare, *_LINE, listed])


def crossing(*waypoints: list[float]) -> str:
    return (
        "{name: ball, shapes: [!Sphere {radius: 0.07}], translation: [0.45, 0.0, 0.3], "
        f"waypoints: {list(waypoints)}}}"
    )


def test_goes_round_a_post_with_the_clearance_and_the_same_twice():
    scenario = scene(_POST)
    found = run_planner(scenario)
    assert found["stop_reason"] == "goal"
    assert found["contacts"] == []
    assert found["robot_clearance_min"] > 0.8 * CLEARANCE
    assert found["goal_error"] < 1e-3
    one, two = plan_motion(scenario), plan_motion(scenario)
    np.testing.assert_array_equal(one.q, two.q)
    assert one.states == two.states
    assert (np.diff(one.t) > 0.0).all()


def test_a_goal_inside_a_box_has_no_plan():
    box = "{name: box, shapes: [!Box {size: [0.3, 0.3, 0.3]}], translation: [0.45, 0.3, 0.3]}"
    result = run_and_judge(scene(box), "planner", "truth").result
    assert (result["outcome"], result["failed"]) == ("stopped", False)
    assert result["reason"] == "no configuration at the goal is free"


def test_states_are_limited():
    wall = "{name: wall, shapes: [!Box {size: [2.0, 0.02, 4.0]}], translation: [1.3, 0.0, 0.0]}"
    plan = plan_motion(scene(wall), states=300)
    assert plan.q.shape == (0, 9)
    assert plan.reason == "no path found in 300 states"
    assert plan.states < 600


def test_waits_for_a_ball_to_leave():
    # The ball is in the way all the time until it goes up.
    scenario = scene(crossing([0.0, 0.0, 0.0, 0.0], [1.5, 0.0, 0.0, 0.0], [2.5, 0.0, 0.0, 1.0]))
    found = run_planner(scenario, states=2000)
    assert found["stop_reason"] == "goal"
    assert found["contacts"] == []
    assert found["robot_clearance_min"] > 0.0


def test_a_ball_that_comes_to_stay_at_the_goal_before_the_robot_can_has_no_plan():
    scenario = scene(crossing([0.0, 0.0, 0.3, 0.0], [0.1, 0.0, 0.301, 0.0]))
    plan = plan_motion(scenario, states=400)
    assert plan.reason
    assert len(plan.t) == 0


def test_does_not_stay_at_the_goal_where_a_ball_passes_later():
    # The straight way takes about a second; the ball is at the goal after two.
    course = ([0.0, 0.0, 1.0, 0.0], [2.0, 0.0, 0.3, 0.0], [3.0, 0.0, 1.0, 0.0])
    plan = plan_motion(scene(crossing(*course)), states=2000)
    assert plan.reason == ""
    assert 2.0 < plan.t[-1] < 4.0


def test_the_world_is_put_where_the_obstacles_are_then():
    scenario = scene(
        _POST.replace("0.0, 0.25", "0.4, 0.25"), crossing([0.0, 0, 0, 0], [1.0, 0, 0, 1])
    )
    q = world_positions(scenario, np.array([0.0, 0.5, 2.0]))
    assert q.shape == (3, 12)
    np.testing.assert_allclose(q.sum(axis=1), [0.0, 0.5, 1.0])
    assert world_positions(scene(_POST), np.array([0.0])) is None


def test_an_executed_path_is_left_nowhere_and_rests_at_its_corners():
    corners = np.array([[0.0, 0.0, 0.5], [0.5, 0.0, 0.5], [0.5, 1.0, 0.5], [0.49, 1.0, 0.5]])
    dense = np.concatenate([np.linspace(a, b, 7) for a, b in itertools.pairwise(corners)])
    speeds = np.array([1.0, 2.0])
    motion = rest_to_rest(dense, speeds)
    t = np.linspace(0.0, motion.end_time(), 2000)
    q, v = motion.vector_values(t).T, motion.MakeDerivative().vector_values(t).T
    np.testing.assert_allclose(q[[0, -1]], corners[[0, -1]], atol=1e-12)
    assert (np.abs(v[:, :2]).max(axis=0) <= 0.501 * speeds).all()
    assert np.abs(v[:, 0]).max() == pytest.approx(0.5, rel=1e-2)
    assert np.abs(np.diff(v, axis=0) / np.diff(t)[:, None]).max() < 1.1 * 0.5 * 2.0 / 0.5
    for corner in corners[1:3]:
        nearest = np.linalg.norm(q - corner, axis=1).argmin()
        assert np.abs(v[nearest]).max() < 0.05
        assert np.linalg.norm(q[nearest] - corner) < 1e-3
    # On one of the three sides.
    off = np.min([np.abs(q[:, 1]), np.abs(q[:, 0] - 0.5), np.abs(q[:, 1] - 1.0)], axis=0)
    assert off.max() < 1e-9


def test_a_plan_is_executed_among_what_rests_alone():
    found = run_and_judge(scene(_POST), "planner_executed", "truth").result
    assert (found["outcome"], found["stop_reason"]) == ("success", "goal")
    assert found["robot_clearance_min"] > 0.8 * CLEARANCE
    found = run_and_judge(scene(crossing([0.0, 0.0, 0.0, 0.0])), "planner_executed", "truth").result
    assert (found["outcome"], found["failed"]) == ("stopped", False)
    assert found["reason"] == "a plan is executed only among obstacles that rest"
