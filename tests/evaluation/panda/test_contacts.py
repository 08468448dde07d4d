"""Tests of contact events: closing speeds, avoidability, and observation times of obstacles."""

import json
from dataclasses import replace

import numpy as np
import pytest

from drake_oa.evaluation.panda.contacts import contact_events, observation_times
from drake_oa.evaluation.panda.evaluation import Criteria, run_and_evaluate
from drake_oa.evaluation.panda.scenes import draw_panda_scene, with_perception
from drake_oa.evaluation.panda.true_world import make_true_world
from drake_oa.runs.metrics import clearance_evaluator
from drake_oa.runs.motion_log import pack_ellipsoids
from drake_oa.scenario.end_poses import end_positions
from drake_oa.scenario.loading import load_scenario
from tests.builders import ball_scene, balls

KEYS = (
    "time link obstacle closing_speed closing_speed_max arm_at_rest receding energy "
    "avoidable_by_physics avoidable_by_view parked_contact"
)
"""Keys of a contact event."""


@pytest.fixture(scope="module")
def struck():
    """Scenario of an arm at rest that a ball touches at 1 m/s and then leaves."""
    p_WE = load_scenario("tabletop_box").task.start
    waypoints = [[0, 0, 0, 0], [0.75, 0, 0.75, 0], [1.5, 0, 0, 0]]
    return ball_scene(np.subtract(p_WE, [0.0, 0.8, 0.0]), waypoints=waypoints)


@pytest.fixture(scope="module")
def log_of(struck, straight_log):
    """Function from observations and speed of joint 1 [rad/s] to a log of the resting arm."""
    evaluator, t = clearance_evaluator(struck), 0.004 * np.arange(500)
    world = np.array([evaluator.positions_at(time) for time in t])
    q = np.tile(end_positions(struck)[0], (500, 1))

    def make(*frames, speed=0.0):
        v = speed * np.tile(np.eye(len(q[0]))[0], (500, 1))
        observed = {"observation_time": np.array([frame.stamp + 0.05 for frame in frames])}
        observed |= pack_ellipsoids(frames)
        return straight_log(500, t=t, q=q, v=v, q_world=world, **observed)

    return make


def test_contact_with_a_resting_arm(struck, log_of):
    events = contact_events(struck, log_of(), make_true_world(struck))
    assert events
    for event in events:
        assert " ".join(event) == KEYS
        assert event["obstacle"] == "obstacle_ball"
        assert event["closing_speed"] == event["closing_speed_max"] == event["energy"] == 0.0
        assert event["arm_at_rest"]
        assert event["receding"]
        assert event["avoidable_by_physics"]
        # The log has no observation.
        assert not event["avoidable_by_view"]
        assert event["parked_contact"] == ["start"]
    assert 0.3 < events[0]["time"] < 0.9
    assert json.loads(json.dumps(events)) == events


def test_closing_speed_is_the_speed_of_the_arm_along_the_normal(struck, log_of):
    world = make_true_world(struck)
    speeds = {v: contact_events(struck, log_of(speed=v), world)[0] for v in (-0.2, 0.2)}
    # The ball pushes the hand along +y, the direction of a positive rate of joint 1.
    assert speeds[0.2]["receding"]
    assert not speeds[-0.2]["receding"]
    assert 0.02 < speeds[-0.2]["closing_speed"] < 0.2
    assert speeds[0.2]["closing_speed"] == pytest.approx(-speeds[-0.2]["closing_speed"])
    assert speeds[0.2]["energy"] > 0.0
    assert not speeds[0.2]["arm_at_rest"]


@pytest.mark.parametrize(
    ("late", "wrong_after", "is_known"), [(0.0, 9.0, True), (0.0, 0.15, False), (9.0, 9.0, False)]
)
def test_contact_is_avoidable_by_view_if_the_velocity_is_correct_at_the_deadline(
    struck, log_of, late, wrong_after, is_known
):
    (ball,) = struck.obstacles
    frames = [
        _observation(ball, stamp, [0.0, 1.0 if stamp < wrong_after else 0.0, 0.0])
        for stamp in (0.0, 0.1, 0.2, 0.3, 0.4)
        if stamp >= late
    ]
    (event, *_) = contact_events(struck, log_of(*frames), make_true_world(struck))
    assert event["avoidable_by_view"] == is_known
    assert event["parked_contact"] == ["start", *["first_sight"] * bool(frames)]


def _observation(obstacle, stamp, velocity):
    """Returns an observation of an obstacle at its true position with a velocity [m/s]."""
    center = np.array(obstacle.translation) + obstacle.offset_at(stamp)
    return balls(center, stamp=stamp, v_WO=velocity)


@pytest.mark.parametrize(
    ("error", "aside", "is_known"), [(0.19, 0.0, True), (-0.21, 0.0, False), (0.0, 0.15, False)]
)
def test_velocity_is_correct_within_20_percent(struck, log_of, error, aside, is_known):
    (ball,) = struck.obstacles
    wrong = _observation(ball, 0.1, [0.0, -1.0, 0.0])
    right = _observation(ball, 0.3, [0.0, 1.0 + error, 0.0])
    right = replace(right, p_WO=right.p_WO + [aside, 0.0, 0.0])
    seen, known = observation_times(log_of(wrong, right), ball)
    assert seen == pytest.approx(0.15)
    assert known == pytest.approx([0.35] if is_known else [])


def test_contacts_of_a_nominal_run_are_evaluated_end_to_end():
    scenario = with_perception(draw_panda_scene(0, 0, kind="moving"), "truth")
    touched = run_and_evaluate(scenario, "nominal", "truth", criteria=Criteria(has_drp_rules=True))
    # Also by the rules of DRPBench.
    assert touched["outcome"] == touched["drp_outcome"] == "contact"
    events = touched["contact_events"]
    assert {f"{each['link']} - {each['obstacle']}" for each in events} == set(touched["contacts"])
    assert [event["time"] for event in events] == sorted(event["time"] for event in events)
    assert events[0]["avoidable_by_physics"]
    assert not events[0]["avoidable_by_view"]
    # No claim is checked without observations.
    assert touched["claim_violations"] is None
