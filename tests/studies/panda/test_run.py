"""One run of the Panda, judged."""

import pytest

from drake_oa.perception.config import GroundTruth
from drake_oa.regulation.config import Paper, Verified
from drake_oa.scenario.loading import load_scenario, parse_scenario, scenario_text
from drake_oa.studies.panda.evaluation import METHODS, plain_reason, run_and_judge, with_method
from drake_oa.studies.panda.scenes import seen_by

_TOUCHING = """
directives:
- add_directives: {file: package://drake_oa/scenes/table.dmd.yaml}
task: {start: [0.5, -0.3, 0.3], goal: [0.5, 0.3, 0.3], duration: 0.3}
obstacles:
- name: post
  shapes: [!Cylinder {radius: 0.05, length: 0.3, translation: [0, 0, 0.15]}]
  translation: [0.5, -0.22, 0]
"""


@pytest.mark.parametrize(
    ("reason", "plain"),
    [
        ("goal missed by 12.5 mm at s = 2.2", "goal missed by # mm at s = #"),
        ("held for 5 s: tool inside obstacle 3", "held for # s: tool inside obstacle #"),
        ("panda_link7 at -1.5e-3 rad", "panda_link7 at # rad"),
        ("time limit of 30 s", "time limit of # s"),
        ("", ""),
    ],
)
def test_reasons_are_counted_without_their_numbers(reason, plain):
    assert plain_reason(reason) == plain


def test_methods_and_perception_change_their_blocks_alone():
    scenario = load_scenario("tabletop_box")
    paper = with_method(scenario, "paper")
    assert isinstance(paper.regulation, Paper)
    assert paper.policy.fade == 0.0
    assert isinstance(with_method(paper, "verified").regulation, Verified)
    assert isinstance(seen_by(scenario, "truth").perception, GroundTruth)
    assert scenario_text(seen_by(scenario, "depth")) == scenario_text(scenario)
    assert isinstance(scenario.regulation, Verified)


@pytest.mark.parametrize(
    ("method", "perception", "message"),
    [("mine", "truth", "panda has: preplanned"), ("paper", "sonar", "one of depth, depth2, truth")],
)
def test_unknown_names_are_refused(method, perception, message):
    with pytest.raises(ValueError, match=message):
        run_and_judge(parse_scenario(_TOUCHING), method, perception)
    assert "preplanned" in METHODS


def test_a_run_that_touches_is_a_contact_and_runs_the_same_again():
    scenario = parse_scenario(_TOUCHING)
    result = run_and_judge(scenario, "preplanned", "truth", duration=0.3).result
    assert result["outcome"] == "contact"
    assert result["reason"] == "time limit of # s"
    assert any("obstacle_post" in contact for contact in result["contacts"])
    assert result["robot_clearance_min"] < 1e-3
    assert result["real_time_factor"] > 0.0
    again = run_and_judge(scenario, "preplanned", "truth", duration=0.3).result
    clock = {"wall_time", "real_time_factor"}
    assert {k: v for k, v in result.items() if k not in clock} == {
        k: v for k, v in again.items() if k not in clock
    }


def test_a_run_short_of_the_goal_is_stopped_with_its_reason():
    run = run_and_judge(parse_scenario(_TOUCHING), "preplanned", "truth", duration=0.02)
    assert run.result["outcome"] == "stopped"
    assert run.result["stop_reason"] == "time limit of 0.02 s"
    assert run.result["contacts"] == []
    assert not run.result["failed"]
    assert run.log is not None


def test_a_scene_that_cannot_be_run_is_a_result():
    scenario = parse_scenario(_TOUCHING, ["task.goal=[2.0, 0.0, 0.3]"])
    run = run_and_judge(scenario, "preplanned", "truth")
    assert run.log is None
    assert run.result["outcome"] == "stopped"
    assert run.result["failed"]
    assert run.result["reason"].startswith("ScenarioError: task.goal: out of reach")
    assert run.result["goal_error"] == pytest.approx(1.5297, abs=1e-3)
