"""Tests of evaluations on the Panda: outcomes, metrics, parallel runs, stored results."""

import pytest

from drake_oa.evaluation.panda.evaluation import (
    PandaResults,
    evaluate_panda,
    panda_suite,
    run_and_evaluate,
)
from drake_oa.evaluation.panda.tables import panda_metrics, panda_table, run_metrics
from drake_oa.scenario.loading import load_scenario

_SUITE = panda_suite("tabletop", 2, 0, ("nominal", "verified"), "truth", 0.05)


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """Results of an evaluation in this process, and their folder."""
    folder = tmp_path_factory.mktemp("results")
    return evaluate_panda(_SUITE, folder=folder), folder


def _assert_equal(one, other):
    """Checks that results are equal except for wall times."""
    assert one.scenarios == other.scenarios
    for method in _SUITE.methods:
        assert list(one.runs[method]) == list(other.runs[method]) == [0, 1]
        for scene in (0, 1):
            clock = dict.fromkeys(("wall_time", "real_time_factor"))
            assert one.runs[method][scene] | clock == other.runs[method][scene] | clock


def test_evaluation_resumes_and_repeats_unreadable_results(stored, caplog):
    results, folder = stored
    damaged = folder / f"{_SUITE.run_name(1, 'nominal')}.json"
    damaged.write_text(damaged.read_text()[:40])
    resumed = evaluate_panda(_SUITE, folder=folder)
    assert resumed.resumed == 3
    assert "is unreadable" in caplog.text
    _assert_equal(results, resumed)


@pytest.mark.slow
def test_worker_processes_give_equal_results(stored):
    _assert_equal(stored[0], evaluate_panda(_SUITE, workers=2))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "maze"}, "unknown kind of scenes 'maze'"),
        ({"methods": ("mine",)}, "unknown method 'mine'"),
    ],
)
def test_invalid_settings_are_rejected(changes, message):
    settings = {"kind": "tabletop", "scenes": 1, "seed": 0, "methods": ("verified",), **changes}
    with pytest.raises(ValueError, match=message):
        panda_suite(**settings)


def _run(outcome, reason="", contacts=(), clearance=0.1, **more):
    """Returns the result of a run, as of `run_and_evaluate`."""
    return {
        "outcome": outcome,
        "reason": reason,
        "failed": False,
        "contacts": list(contacts),
        "tool_clearance_min": clearance,
        "robot_clearance_min": clearance,
        "goal_error": 1e-4,
        "real_time_factor": 1.0,
        "self_contacts": [],
        "clearance_shortfall": 0.0,
        "decision_latency": None,
        "duration": 5.0,
        "ended": "goal",
        "contact_events": None,
        "claim_violations": None,
        "sources": None,
        **more,
    }


@pytest.mark.parametrize("solved", [("verified", "planner"), ("verified",), ("planner",)])
def test_success_rate_is_relative_to_solved_scenes(solved):
    suite = panda_suite("tabletop", 3, 0, ("verified", "planner"), "truth")
    yes, no = _run("success"), _run("stopped", "held")
    runs = {method: {0: yes if method in solved else no, 1: no, 2: no} for method in suite.methods}
    results = PandaResults(suite, {}, runs)
    metrics = panda_metrics(results)
    assert metrics["solved"] == 1
    for method, found in metrics["methods"].items():
        assert found["success_rate_solved"] == (method in solved)
    assert "scenes solved by at least one method: 1" in str(panda_table([metrics]))
    # Unknown without the planner.
    del results.runs["planner"]
    metrics = panda_metrics(results)
    assert metrics["solved"] is metrics["methods"]["verified"]["success_rate_solved"] is None


def test_metrics_count_outcomes_reasons_pairs_and_claims():
    contacts = ["hand - obstacle_box1", "hand - obstacle_box12", "link6 - table"]
    events = [{"avoidable_by_physics": True, "avoidable_by_view": view} for view in (True, False)]
    claims = {"instants": 100, "A": 3, "B": 7}
    touched = {"contact_events": events, "claim_violations": claims, "goal_error": 2e-3}
    metrics = run_metrics(
        [
            _run("success", clearance_shortfall=0.02, claim_violations=claims | {"A": 0}),
            _run("stopped", "held", goal_error=0.5, clearance=None, real_time_factor=None),
            _run("stopped", "held", goal_error=0.4, ended="time limit", sources={"search": 1.0}),
            _run("contact", "goal", contacts=contacts, clearance=-0.01, **touched),
        ]
    )
    expected = {
        "scenes": 4,
        "success": 1,
        "success_rate": 0.25,
        "contacts": 1,
        "stopped": 2,
        "stop_reasons": {"held": 2},
        "contact_pairs": {"hand - obstacle_box": 1, "link6 - table": 1},
        "avoidable_by_physics": 2,
        "avoidable_by_view": 1,
        "claim_A": 3,
        "claim_B": 14,
        "time_limits": 1,
        "shortfall_count": 1,
        "sources": {"search": 1},
        "goal_error_max": 2e-3,
        "robot_clearance_min": -0.01,
        "real_time_factor": 1.0,
    }
    assert {key: metrics[key] for key in expected} == expected
    assert run_metrics([_run("success")])["claim_A"] is None


def test_exception_of_a_run_is_stored_as_a_result():
    scenario = load_scenario("tabletop_box", ["task.goal=[2.0, 0.0, 0.3]"])
    result = run_and_evaluate(scenario, "nominal", "truth")
    assert result["failed"]
    assert result["reason"].startswith("ScenarioError: task.goal: out of reach")
