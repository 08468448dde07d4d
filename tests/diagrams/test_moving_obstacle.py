"""Things that cross the way of the robot, from what is seen to what is touched."""

import numpy as np
import pytest

from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.geometry.shapes import Sphere
from drake_oa.perception.config import GroundTruth
from drake_oa.runs.metrics import robot_metrics
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.report import motion_report
from drake_oa.runs.simulation import AT_GOAL, REST_TIME, simulate
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.obstacles import Obstacle
from drake_oa.scenario.scenario import Scenario
from drake_oa.studies.panda.run import run_and_judge
from drake_oa.studies.panda.scenes import draw_panda_scene


def judged(scenario: Scenario, log: MotionLog) -> tuple[tuple[str, ...], float]:
    found = robot_metrics(scenario, log.q, log.q_world)
    return found.contacts, float(found.robot_clearance.min())


def with_truth() -> Scenario:
    scenario = load_scenario("moving_obstacle")
    scenario.perception = GroundTruth()
    return scenario


def test_the_planned_motion_is_hit_by_both() -> None:
    scenario = with_truth()
    contacts, _ = judged(scenario, simulate(scenario, modulated=False))
    hit = {contact.split(" - ")[1] for contact in contacts}
    assert hit == {"obstacle_box", "obstacle_ball"}


@pytest.mark.slow
@pytest.mark.parametrize("truth", [True, False])
def test_both_are_passed(truth: bool) -> None:
    scenario = with_truth() if truth else load_scenario("moving_obstacle")
    log = simulate(scenario)
    assert log.stop_reason == "goal"
    contacts, clearance = judged(scenario, log)
    assert contacts == ()
    assert clearance > 0.05
    assert np.linalg.norm(log.p_WE[-1] - scenario.task.goal) < 5e-3


@pytest.mark.slow
def test_what_is_faster_than_the_arm_is_told_and_its_contacts_count(
    caplog: pytest.LogCaptureFixture,
) -> None:
    scenario = with_truth()
    # At the shoulder, which cannot leave.
    ahead = np.array([1.2, 0.3, 0.45])
    way = np.array([0.0, 0.0, 0.45]) - ahead
    time = float(np.linalg.norm(way)) / 2.5
    scenario.obstacles = [
        Obstacle(
            name="fast",
            shapes=[Sphere(radius=0.05)],
            translation=ahead.tolist(),
            waypoints=[[1.0, 0.0, 0.0, 0.0], [1.0 + time, *way.tolist()]],
        )
    ]
    log = simulate(scenario)
    assert "supervisor holds: obstacle 0 cannot be evaded by this arm" in caplog.text
    # The run goes on past the prediction, until the ball has arrived and all is at rest.
    assert log.simulated_time > 1.0 + time + REST_TIME
    contacts, clearance = judged(scenario, log)
    assert {contact.split(" - ")[0] for contact in contacts} >= {"panda_link2"}
    assert clearance < -0.03


@pytest.mark.slow
def test_what_comes_to_the_goal_after_the_arm_counts() -> None:
    scenario = load_scenario("tabletop_box")
    scenario.perception = GroundTruth()
    scenario.obstacles = [
        Obstacle(
            name="late",
            shapes=[Sphere(radius=0.08)],
            translation=[0.45, 1.2, 0.3],
            waypoints=[[8.0, 0.0, 0.0, 0.0], [8.8, 0.0, -0.75, 0.0]],
        )
    ]
    log = simulate(scenario)
    assert log.motion_end < 8.0
    assert log.simulated_time >= 8.8 + REST_TIME
    # It has to leave, and the ball stays.
    assert log.stop_reason.startswith("goal left by")
    assert motion_report(scenario, log)["goal_error"] > AT_GOAL


@pytest.mark.slow
def test_what_is_held_when_all_is_at_rest_is_given_time_to_go_on() -> None:
    block = (
        "{name: block, shapes: [!Box {size: [0.12, 0.12, 0.5]}], translation: [0.45, 0.45, 0.25]"
    )
    scenario = load_scenario("tabletop_box", [f"obstacles=[{block}, present: [0.0, 11.5]}}]"])
    log = simulate(scenario)
    assert log.stop_reason == "goal"
    assert log.motion_end > 11.5


@pytest.mark.slow
def test_stuck_beside_what_came_to_rest_it_gets_past_and_arrives() -> None:
    # Link 5 is held beside it, and no motion from there lets the arm by.
    result = run_and_judge(draw_panda_scene(0, 67, kind="moving"), "verified", "depth").result
    assert result["outcome"] == "success"
    assert result["contacts"] == []


def test_what_evades_turns_the_arm_too() -> None:
    diagram = build_avoidance(with_truth())
    follower = diagram.GetSubsystemByName("posture_follower")
    context = follower.GetMyContextFromRoot(diagram.CreateDefaultContext())
    assert follower.GetInputPort("evading").HasValue(context)


@pytest.mark.slow
def test_a_ball_that_comes_at_the_elbow_is_let_past() -> None:
    # No displacement of the tool alone keeps link 4 off it.
    result = run_and_judge(draw_panda_scene(0, 38, kind="moving"), "verified", "depth").result
    assert result["outcome"] == "success"
    assert result["contacts"] == []
