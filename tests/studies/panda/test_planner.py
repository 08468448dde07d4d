"""The sampling-based planner: what it solves keeps the clearance; what it cannot, it says."""

import numpy as np
import pytest

from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario
from drake_oa.studies.panda.evaluation import run_and_judge
from drake_oa.studies.panda.planner import CLEARANCE, plan_motion, run_planner

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
    plan = plan_motion(scenario, states=2000)
    assert plan.reason == ""
    assert 1.5 < plan.t[-1] < 3.5


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
