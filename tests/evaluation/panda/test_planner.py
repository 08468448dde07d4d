"""Tests of the planners: clearance and contacts of plans, and reasons for missing plans."""

from importlib.util import find_spec
from itertools import pairwise

import numpy as np
import pytest

from drake_oa.evaluation.panda.evaluation import run_and_evaluate
from drake_oa.evaluation.panda.planner import (
    CLEARANCE,
    MOVING_CLEARANCE,
    find_motion,
    goal_positions,
    run_planner,
)
from drake_oa.evaluation.panda.scenes import draw_panda_scene, with_perception
from drake_oa.evaluation.panda.true_world import STEP, make_true_world
from drake_oa.runs.metrics import clearance_evaluator
from drake_oa.scenario.end_poses import end_positions
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario
from tests.builders import ball_scene

needs_ompl = pytest.mark.skipif(find_spec("ompl") is None, reason="ompl is not installed")

_LINE = ["task.start=[0.45,-0.3,0.3]", "task.goal=[0.45,0.3,0.3]"]


def _scene(size: list[float], at: list[float]) -> Scenario:
    """Returns a scenario with one resting box."""
    listed = f"obstacles=[{{name: box, shapes: [!Box {{size: {size}}}], translation: {at}}}]"
    bare = ["directives=[]", "cameras=[]", "perception=!GroundTruth {}"]
    return load_scenario("tabletop_box", [*bare, *_LINE, listed])


@needs_ompl
def test_plan_around_a_post_has_the_clearance_and_repeats_exactly():
    scenario = _scene([0.1, 0.1, 0.5], [0.45, 0.0, 0.25])
    result, repeated = run_planner(scenario), run_planner(scenario)
    assert result["stop_reason"] == "goal"
    assert result["contacts"] == []
    assert result["robot_clearance_min"] > 0.8 * CLEARANCE
    assert result["goal_error"] < 1e-3
    assert result | {"wall_time": None} == repeated | {"wall_time": None}


@needs_ompl
def test_goal_inside_a_box_has_no_plan():
    scenario = _scene([0.3, 0.3, 0.3], [0.45, 0.3, 0.3])
    result = run_and_evaluate(scenario, "planner", "truth")
    assert (result["outcome"], result["failed"]) == ("stopped", False)
    assert result["reason"] == "all goal configurations in collision"


@needs_ompl
def test_number_of_states_is_limited():
    result = run_planner(_scene([2.0, 0.02, 4.0], [1.3, 0.0, 0.0]), states=300)
    assert result["stop_reason"] == "no path found in 300 states"
    assert result["states"] < 600


def _search(scenario, seed=0):
    """Returns the result of `find_motion`, joint indices, and goal configurations."""
    world, (q_start, q_goal) = make_true_world(scenario, MOVING_CLEARANCE), end_positions(scenario)
    index = world.arm.chain.q_index
    goals = np.array(goal_positions(scenario, q_goal))[:, index]
    return find_motion(world, q_start[index], goals, seed), index, goals


def _check(scenario, motion, index, goals):
    """Checks that a motion is collision-free and ends at a goal configuration."""
    evaluator, (q_start, _) = clearance_evaluator(scenario), end_positions(scenario)
    corners = [np.linspace(*ends, 50) for ends in pairwise(motion.path)]
    q = np.vstack([motion.q, *corners])
    path = np.tile(q_start, (len(q), 1))
    path[:, index] = q
    result = evaluator.metrics(
        path, np.array([evaluator.positions_at(STEP * k) for k in range(len(q))])
    )
    assert result.contacts == result.self_contacts == ()
    assert result.robot_clearance.min() >= MOVING_CLEARANCE
    assert np.abs(goals - q[-1]).max(axis=1).min() < 1e-9


def test_motion_in_a_random_scene_is_collision_free():
    scenario = with_perception(draw_panda_scene(0, 3, kind="moving_hard"), "truth")
    (motion, states), index, goals = _search(scenario)
    assert states < 100_000
    _check(scenario, motion, index, goals)


def test_arm_leaves_a_start_that_an_obstacle_will_occupy():
    p_WE = load_scenario("tabletop_box").task.start
    waypoints = [[0, 0, 0, 0], [1.5, 0, 1.2, 0], [2.0, 0, 1.2, 0], [3.5, 0, 0, 0]]
    scenario = ball_scene(np.subtract(p_WE, [0.0, 1.2, 0.0]), waypoints=waypoints)
    (motion, states), index, goals = _search(scenario, 1)
    assert np.abs(motion.q - motion.q[0]).max() > 0.1
    _check(scenario, motion, index, goals)
    (repeated, same), *_ = _search(scenario, 1)
    assert same == states
    assert np.array_equal(repeated.q, motion.q)


def test_goal_occupied_by_an_obstacle_has_no_motion():
    goal = load_scenario("tabletop_box").task.goal
    waypoints = [[0, 0, 0, 0], [1, 0, 1, 0]]
    scenario = ball_scene(np.subtract(goal, [0.0, 1.0, 0.0]), waypoints=waypoints)
    result = run_and_evaluate(scenario, "planner", "truth")
    assert (result["outcome"], result["reason"]) == ("stopped", "no motion found")
