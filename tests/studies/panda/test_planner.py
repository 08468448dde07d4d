"""The sampling-based planner: a plan keeps the clearance, and the lack of one has a reason."""

import pytest

from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario
from drake_oa.studies.panda.evaluation import run_and_judge
from drake_oa.studies.panda.planner import CLEARANCE, run_planner

pytest.importorskip("ompl")

_LINE = ["task.start=[0.45,-0.3,0.3]", "task.goal=[0.45,0.3,0.3]"]


def scene(size: list[float], at: list[float]) -> Scenario:
    listed = f"obstacles=[{{name: box, shapes: [!Box {{size: {size}}}], translation: {at}}}]"
    bare = ["directives=[]", "cameras=[]", "perception=!GroundTruth {}"]
    return load_scenario("tabletop_box", [*bare, *_LINE, listed])


def test_goes_round_a_post_with_the_clearance_and_the_same_twice():
    scenario = scene([0.1, 0.1, 0.5], [0.45, 0.0, 0.25])
    found, again = run_planner(scenario), run_planner(scenario)
    assert found["stop_reason"] == "goal"
    assert found["contacts"] == []
    assert found["robot_clearance_min"] > 0.8 * CLEARANCE
    assert found["goal_error"] < 1e-3
    assert found | {"wall_time": None} == again | {"wall_time": None}


def test_a_goal_inside_a_box_has_no_plan():
    scenario = scene([0.3, 0.3, 0.3], [0.45, 0.3, 0.3])
    result = run_and_judge(scenario, "planner", "truth")
    assert (result["outcome"], result["failed"]) == ("stopped", False)
    assert result["reason"] == "no configuration at the goal is free"


def test_states_are_limited():
    found = run_planner(scene([2.0, 0.02, 4.0], [1.3, 0.0, 0.0]), states=300)
    assert found["stop_reason"] == "no path found in 300 states"
    assert found["states"] < 600
