"""Scenes of the Panda evaluated here, in processes and on a cluster; kept and resumed."""

import json
import shutil
from dataclasses import replace

import pytest

from drake_oa.runs.motion_log import load_logs
from drake_oa.studies.panda.evaluation import (
    Keeping,
    PandaResults,
    PandaSuite,
    evaluate_panda,
    run_name,
)
from drake_oa.studies.panda.tables import panda_figures, panda_table, run_figures
from drake_oa.studies.results import ResultFolder

_SUITE = PandaSuite(
    scenes=2, seed=0, methods=("preplanned", "verified"), perception="truth", duration=0.05
)


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """An evaluation in this process, and where it was kept."""
    folder = tmp_path_factory.mktemp("results")
    keeping = Keeping(ResultFolder(folder), logs=folder / "logs")
    return evaluate_panda(_SUITE, keeping=keeping), folder


def _same(one, other, methods=_SUITE.methods):
    assert one.scenarios == other.scenarios
    for method in methods:
        assert list(one.runs[method]) == list(other.runs[method]) == [0, 1]
        for scene in (0, 1):
            clock = dict.fromkeys(("wall_time", "real_time_factor"))
            assert one.runs[method][scene] | clock == other.runs[method][scene] | clock


def test_each_run_is_on_disk_with_its_log(kept):
    results, folder = kept
    assert not results.interrupted
    for scene in (0, 1):
        assert (folder / f"{_SUITE.scene_name(scene)}.json").is_file()
        for method in _SUITE.methods:
            name = run_name(_SUITE, scene, method)
            on_disk = json.loads((folder / f"{name}.json").read_text())
            assert on_disk["content"] == results.runs[method][scene]
            (log,) = load_logs(folder / "logs" / f"{name}.npz").values()
            assert log.modulated == (method == "verified")


def test_an_evaluation_resumes_and_makes_what_is_damaged_anew(kept, caplog):
    results, folder = kept
    damaged = folder / f"{run_name(_SUITE, 1, 'preplanned')}.json"
    damaged.write_text(damaged.read_text()[:40])
    seen = []
    again = evaluate_panda(
        _SUITE,
        keeping=Keeping(ResultFolder(folder)),
        on_progress=lambda what, count: seen.append((what, count)),
    )
    assert again.resumed == 3
    assert "is made anew" in caplog.text
    _same(results, again)
    assert sum(count for _, count in seen) == 2 + 4
    drawn = panda_figures(again, ["drake 1"])["drawn"]
    assert drawn == panda_figures(results, ["drake 1"])["drawn"]
    assert drawn["scenes"]["looked_at"] >= 2


def test_other_settings_take_no_result_of_these(kept):
    _, folder = kept
    other = PandaSuite(1, 0, ("preplanned",), "truth", duration=0.02)
    assert evaluate_panda(other, keeping=Keeping(ResultFolder(folder))).resumed == 0


@pytest.mark.slow
def test_processes_and_a_dask_cluster_give_the_same(kept, tmp_path):
    _same(kept[0], evaluate_panda(_SUITE, jobs=2))
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        spread = evaluate_panda(
            replace(_SUITE, methods=("verified",)),
            scheduler=cluster.scheduler_address,
            keeping=Keeping(ResultFolder(tmp_path)),
        )
    _same(kept[0], spread, ("verified",))
    assert len(list(tmp_path.glob("*.json"))) == 4


def test_an_interrupt_keeps_what_is_done(kept, tmp_path):
    for drawn in kept[1].glob("*-scene????.json"):
        shutil.copy(drawn, tmp_path)

    def interrupt(what, count):
        if what == "preplanned":
            raise KeyboardInterrupt

    keeping = Keeping(ResultFolder(tmp_path))
    cut = evaluate_panda(_SUITE, keeping=keeping, on_progress=interrupt)
    assert cut.interrupted
    assert list(cut.runs["preplanned"]) == [0]
    assert not cut.complete("preplanned")
    figures = panda_figures(cut, ["drake 1"])
    assert figures["methods"]["preplanned"]["scenes"] == 1
    assert not figures["methods"]["preplanned"]["complete"]
    assert figures["methods"]["verified"]["scenes"] == 0
    assert "-" in str(panda_table([figures]))


def test_success_is_told_as_a_share_of_what_the_planner_solves():
    suite = PandaSuite(scenes=3, seed=0, methods=("verified", "planner"), perception="truth")
    results = PandaResults(
        suite,
        runs={
            "verified": {
                0: _run("success"),
                1: _run("stopped", "held"),
                2: _run("stopped", "held"),
            },
            "planner": {0: _run("success"), 1: _run("success"), 2: _run("stopped", "no path")},
        },
    )
    figures = panda_figures(results, ["drake 1"])
    assert figures["solved"] == 2
    assert figures["methods"]["verified"]["success_rate_solved"] == 0.5
    assert figures["methods"]["planner"]["success_rate_solved"] == 1.0
    assert "of solved [%]" in str(panda_table([figures]))
    del results.runs["planner"][2]
    figures = panda_figures(results, ["drake 1"])
    assert figures["solved"] is None
    assert figures["methods"]["verified"]["success_rate_solved"] is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "maze"}, "unknown kind of scenes 'maze'"),
        ({"scenes": 0}, "--scenes must be at least 1"),
        ({"seed": -1}, "--seed must be 0 or more"),
        ({"duration": 0.0}, "--duration must be positive"),
        ({"methods": ("mine",)}, "unknown method 'mine'"),
        ({"perception": "sonar"}, "unknown perception 'sonar'"),
    ],
)
def test_bad_settings_are_refused(changes, message):
    settings = {"scenes": 1, "seed": 0, "methods": ("verified",), **changes}
    with pytest.raises(ValueError, match=message):
        PandaSuite(**settings)


def _run(outcome, reason="", goal_error=1e-4, contacts=(), clearance=0.1, speed=1.0, **more):
    return {
        "outcome": outcome,
        "reason": reason,
        "failed": False,
        "contacts": list(contacts),
        "tool_clearance_min": clearance,
        "robot_clearance_min": clearance,
        "goal_error": goal_error,
        "real_time_factor": speed,
        "wall_time": 1.0,
        "self_contacts": [],
        "feasible_clearance": 0.15,
        "short_of_feasible": 0.0,
        "decision_cost": None,
        "moving_after": 0.06,
        "duration": 5.0,
        "stop_reason": reason or "goal",
        "ended": "goal",
        **more,
    }


def test_figures_count_outcomes_reasons_and_pairs():
    figures = run_figures(
        [
            _run("success", speed=3.0, short_of_feasible=0.02),
            _run("stopped", "held", goal_error=0.5, clearance=None, speed=None, moving_after=None),
            _run(
                "stopped",
                "held",
                goal_error=0.4,
                duration=30.0,
                stop_reason="time limit of 30 s",
                ended="time limit",
            ),
            _run(
                "contact",
                "goal",
                goal_error=2e-3,
                contacts=["hand - obstacle_box1", "hand - obstacle_box12", "link6 - table"],
                clearance=-0.01,
                self_contacts=["hand - link5"],
                short_of_feasible=0.5e-3,
            ),
        ]
    )
    assert (figures["scenes"], figures["success"]) == (4, 1)
    assert (figures["contacts"], figures["stopped"]) == (1, 2)
    assert figures["stop_reasons"] == {"held": 2}
    assert figures["contact_pairs"] == {
        "hand - link5": 1,
        "hand - obstacle_box": 1,
        "link6 - table": 1,
    }
    assert figures["self_contacts"] == 1
    assert figures["moving_after_median"] == figures["moving_after_p95"] == 0.06
    assert (figures["time_limits"], figures["duration_max"]) == (1, 30.0)
    assert (figures["short_of_feasible"], figures["short_of_feasible_max"]) == (1, 0.02)
    assert figures["goal_error_max"] == 2e-3
    assert figures["goal_error_max_all"] == 0.5
    assert figures["robot_clearance_min"] == -0.01
    assert figures["real_time_factor"] == 1.0
    assert figures["success_rate"] == 0.25
