"""The planners: a plan keeps the clearance and touches nothing; the lack of one has a reason."""

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
from drake_oa.evaluation.panda.scenes import draw_panda_scene
from drake_oa.evaluation.panda.true_world import STEP, make_true_world
from drake_oa.runs.metrics import clearance_evaluator
from drake_oa.scenario.end_poses import end_positions
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario

needs_ompl = pytest.mark.skipif(find_spec("ompl") is None, reason="ompl is not installed")

_LINE = ["task.start=[0.45,-0.3,0.3]", "task.goal=[0.45,0.3,0.3]"]


def _scene(size: list[float], at: list[float]) -> Scenario:
    listed = f"obstacles=[{{name: box, shapes: [!Box {{size: {size}}}], translation: {at}}}]"
    bare = ["directives=[]", "cameras=[]", "perception=!GroundTruth {}"]
    return load_scenario("tabletop_box", [*bare, *_LINE, listed])


@needs_ompl
def test_goes_round_a_post_with_the_clearance_and_the_same_twice():
    scenario = _scene([0.1, 0.1, 0.5], [0.45, 0.0, 0.25])
    found, again = run_planner(scenario), run_planner(scenario)
    assert found["stop_reason"] == "goal"
    assert found["contacts"] == []
    assert found["robot_clearance_min"] > 0.8 * CLEARANCE
    assert found["goal_error"] < 1e-3
    assert found | {"wall_time": None} == again | {"wall_time": None}


@needs_ompl
def test_a_goal_inside_a_box_has_no_plan():
    scenario = _scene([0.3, 0.3, 0.3], [0.45, 0.3, 0.3])
    result = run_and_evaluate(scenario, "planner", "truth")
    assert (result["outcome"], result["failed"]) == ("stopped", False)
    assert result["reason"] == "no configuration at the goal is free"


@needs_ompl
def test_states_are_limited():
    found = run_planner(_scene([2.0, 0.02, 4.0], [1.3, 0.0, 0.0]), states=300)
    assert found["stop_reason"] == "no path found in 300 states"
    assert found["states"] < 600


def _scenario(at, waypoints):
    ball = f"shapes: [!Sphere {{radius: 0.1}}], translation: {at}, waypoints: {waypoints}"
    bare = ["cameras=[]", "perception=!GroundTruth {}"]
    return load_scenario("tabletop_box", [*bare, f"obstacles=[{{name: ball, {ball}}}]"])


def _found(scenario, seed=0):
    world, (q_start, q_goal) = make_true_world(scenario, MOVING_CLEARANCE), end_positions(scenario)
    index = world.arm.chain.q_index
    goals = np.array(goal_positions(scenario, q_goal))[:, index]
    return find_motion(world, q_start[index], goals, seed), index, goals


def _check(scenario, motion, index, goals):
    evaluator, (q_start, _) = clearance_evaluator(scenario), end_positions(scenario)
    corners = [np.linspace(*ends, 50) for ends in pairwise(motion.path)]
    q = np.vstack([motion.q, *corners])
    path = np.tile(q_start, (len(q), 1))
    path[:, index] = q
    found = evaluator.metrics(
        path, np.array([evaluator.positions_at(STEP * k) for k in range(len(q))])
    )
    assert found.contacts == found.self_contacts == ()
    assert found.robot_clearance.min() >= MOVING_CLEARANCE
    assert np.abs(goals - q[-1]).max(axis=1).min() < 1e-9


def test_motions_in_random_scenes_touch_nothing():
    scenario = draw_panda_scene(0, 3, kind="moving_hard", perception="truth")
    (motion, states), index, goals = _found(scenario)
    assert states < 100_000
    _check(scenario, motion, index, goals)


def test_an_arm_that_cannot_stay_at_the_start_leaves_it():
    p_WE = load_scenario("tabletop_box").task.start
    way = [[0, 0, 0, 0], [1.5, 0, 1.2, 0], [2.0, 0, 1.2, 0], [3.5, 0, 0, 0]]
    scenario = _scenario([p_WE[0], p_WE[1] - 1.2, p_WE[2]], way)
    (motion, states), index, goals = _found(scenario, 1)
    assert np.abs(motion.q - motion.q[0]).max() > 0.1
    _check(scenario, motion, index, goals)
    (again, same), *_ = _found(scenario, 1)
    assert same == states
    assert np.array_equal(again.q, motion.q)


def test_a_goal_that_an_obstacle_takes_has_no_motion():
    goal = load_scenario("tabletop_box").task.goal
    way = [[0, 0, 0, 0], [1, 0, 1, 0]]
    scenario = _scenario([goal[0], goal[1] - 1.0, goal[2]], way)
    result = run_and_evaluate(scenario, "planner", "truth")
    assert (result["outcome"], result["reason"]) == ("stopped", "no motion found")
