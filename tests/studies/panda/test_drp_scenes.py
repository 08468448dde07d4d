"""Scenes by the parameters of DRPBench: their boxes, static worlds and motions, and its rules."""

import math
from dataclasses import replace

import numpy as np
import pytest

from drake_oa.robot.plant import make_robot_plant
from drake_oa.runs.metrics import robot_metrics
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.end_poses import end_positions
from drake_oa.studies.panda.drp_scenes import EPISODE, LEVELS, SPEED_LEVELS
from drake_oa.studies.panda.evaluation import Criteria, drp_outcome, run_and_judge
from drake_oa.studies.panda.scenes import draw_panda_scene, suite_kinds

INDICES = range(2)
STEP = 1.0 / 60.0
# Kind of a level -> last step at which its boxes are there.
LAST_STEP = {"sudden": 900, "floating": 700, "goal_blocked": 800, "moving_goal_blocked": 700}


@pytest.fixture(scope="module")
def scenes():
    return {
        name: [draw_panda_scene(0, index, kind=f"drp_{name}") for index in INDICES]
        for name in LEVELS | SPEED_LEVELS
    }


def is_moving(item):
    return item.name.startswith("box")


def boxes(scenario):
    return [item for item in scenario.obstacles if is_moving(item)]


def track(item):
    """(T, 3) positions at (T,) times while a box is there."""
    t = np.arange(item.present[0], item.present[1], 0.01)
    return t, np.array([item.translation + item.offset_at(time) for time in t])


def speeds(item):
    rows = np.diff(np.array(item.waypoints), axis=0)
    return np.linalg.norm(rows[:, 1:], axis=1) / rows[:, 0]


@pytest.mark.parametrize("name", LEVELS)
def test_boxes_have_the_sizes_speeds_and_times_of_their_level(scenes, name):
    level = LEVELS[name]
    for scenario in scenes[name]:
        assert len(boxes(scenario)) == level.count
        assert len(scenario.obstacles) == level.count + len(level.world)
        for item in boxes(scenario):
            (box,) = item.shapes
            assert all(level.size[0] <= edge <= level.size[1] for edge in box.size)
            assert item.present[1] == pytest.approx(STEP * LAST_STEP[name.rstrip("0123456789")])
            assert item.last_change <= EPISODE - 100 * STEP + 1e-3
            if item.waypoints:
                assert item.present[0] == 0.0
                assert speeds(item).min() > level.speed[0] - 1e-3
                assert speeds(item).max() < level.speed[1] + 1e-3


@pytest.mark.parametrize("name", LEVELS)
def test_start_and_goal_are_free_of_the_static_world_and_within_limits(scenes, name):
    for scenario in scenes[name]:
        q = np.stack(end_positions(scenario))
        robot_plant = make_robot_plant(scenario.robot)
        limits = robot_plant.limits
        assert (q >= limits.position_lower).all()
        assert (q <= limits.position_upper).all()
        still = [item for item in scenario.obstacles if not is_moving(item)]
        resting = replace(scenario, obstacles=still)
        metrics = robot_metrics(resting, q)
        assert not metrics.contacts
        assert metrics.robot_clearance.min() >= 0.05
        goals = scenario.task.start, scenario.task.goal
        np.testing.assert_allclose(metrics.p_WE, goals, atol=1e-3)
        # Start and goal are inside of the shelf, and outside of all others.
        for item in still:
            yaw = item.rpy[2]
            out = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
            p_WG = np.subtract(scenario.task.goal, item.translation)
            p_OG = np.append(out @ p_WG[:2], p_WG[2])
            corners = [
                np.add(s.translation, np.multiply(k, s.size))
                for s in item.shapes
                for k in (-0.5, 0.5)
            ]
            within = (p_OG > np.min(corners, axis=0)) & (p_OG < np.max(corners, axis=0))
            assert within.all() == LEVELS[name].inside


@pytest.mark.parametrize("name", LEVELS)
def test_a_box_leaves_the_robot_free_when_it_begins(scenes, name):
    least = 0.1 if name.startswith("sudden") else 0.01
    for scenario in scenes[name]:
        q_start = end_positions(scenario)[0][None]
        for item in boxes(scenario):
            placed = replace(item, waypoints=[], present=[])
            metrics = robot_metrics(replace(scenario, obstacles=[placed]), q_start)
            assert metrics.robot_clearance.min() >= least


@pytest.mark.parametrize("name", [name for name in LEVELS | SPEED_LEVELS if "floating" in name])
def test_floating_boxes_fly_at_the_base_and_turn_back(scenes, name):
    for item in (item for scenario in scenes[name] for item in boxes(scenario)):
        _, p = track(item)
        away = np.linalg.norm(p - [0.15, 0.0, 0.5], axis=1)
        assert 0.8 - 1e-3 <= away[0] <= 1.0 + 1e-3
        assert away.max() <= 1.2 + 0.01
        assert np.hypot(p[:, 0], p[:, 1]).min() >= 0.25 - 0.01
        assert p[:, 0].min() >= 0.1 - 0.01


@pytest.mark.parametrize("name", [name for name in LEVELS if name.startswith("moving")])
def test_boxes_fly_at_a_goal_where_the_robot_starts(scenes, name):
    for scenario in scenes[name]:
        goal = np.array(scenario.task.goal)
        assert math.dist(goal, scenario.task.start) == pytest.approx(0.05)
        for item in boxes(scenario):
            _, p = track(item)
            away = np.linalg.norm(p - goal, axis=1)
            assert 0.5 - 1e-3 <= away[0] <= 0.6 + 1e-3
            assert away.max() <= 1.0 + 0.01
            # Slow boxes do not come to the goal in time.
            assert away.min() < 0.05 or speeds(item).min() * item.present[1] < 0.7


@pytest.mark.parametrize("name", [name for name in LEVELS if not name.startswith("moving")])
def test_appearing_boxes_are_on_the_planned_path(scenes, name):
    for scenario in scenes[name]:
        start, goal = np.array(scenario.task.start), np.array(scenario.task.goal)
        for item in boxes(scenario):
            if name.startswith("sudden"):
                assert item.present[0] == pytest.approx(30 * STEP)
                along = np.clip((item.translation - start) @ (goal - start), 0, None)
                nearest = start + along / ((goal - start) @ (goal - start)) * (goal - start)
                assert np.hypot(*(nearest - item.translation)[:2]) < 0.05
            elif name.startswith("goal"):
                assert np.hypot(*(goal - item.translation)[:2]) < 1e-3


def test_speed_levels_are_one_scene_at_several_speeds(scenes):
    for name, level in SPEED_LEVELS.items():
        for one, other in zip(scenes["floating1"], scenes[name], strict=True):
            assert (one.task, one.seed) == (other.task, other.seed)
            for item, faster in zip(boxes(one), boxes(other), strict=True):
                assert (item.shapes, item.translation) == (faster.shapes, faster.translation)
                np.testing.assert_allclose(speeds(faster), level.speed[0], rtol=0.02)


def test_levels_are_kinds_of_scenes():
    assert len(suite_kinds(["drp"], [])) == 11
    assert suite_kinds(["elbow", "drp"], ["sudden1"]) == ["elbow", "drp_sudden1"]
    with pytest.raises(ValueError, match="--level needs --suite drp"):
        suite_kinds(["elbow"], ["sudden1"])


def test_the_rules_of_drpbench_judge_the_end_of_its_episode(scenes):
    scenario = replace(scenes["floating1"][0], obstacles=[])
    log = simulate(scenario, modulated=False, duration=0.02)
    q_start, q_goal = end_positions(scenario)

    def outcome(*turns):
        q = np.stack([q_start, q_goal, q_start])
        q[1, : len(turns)] += turns
        known = replace(log, t=np.array([0.0, EPISODE - 0.01, EPISODE + 0.1]), q=q)
        return drp_outcome(scenario, replace(known, q_world=np.zeros((3, 0))), [])

    assert outcome() == "success"
    # The last joint turns the tool about its axis; the first moves it aside.
    assert outcome(0, 0, 0, 0, 0, 0, math.radians(14.0)) == "success"
    assert outcome(0, 0, 0, 0, 0, 0, math.radians(16.0)) == "stopped"
    assert outcome(0.2) == "stopped"


def test_a_robot_that_stays_at_a_blocked_goal_is_touched_by_both_rules(scenes):
    criteria = Criteria(by_drp=True)
    scenario = scenes["moving_goal_blocked1"][0]
    (item,) = boxes(scenario)
    result = run_and_judge(scenario, "preplanned", "truth", criteria=criteria).result
    assert not result["failed"]
    assert (result["outcome"], result["drp_outcome"]) == ("contact", "contact")
    assert all(f"obstacle_{item.name}" in contact for contact in result["contacts"])
