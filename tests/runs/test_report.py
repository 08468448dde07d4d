"""Report of a run."""

import json
from collections.abc import Callable

import numpy as np
import pytest

from drake_oa.common.messages import FloatArray
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.report import TOLERANCE, motion_report, report_table, run_report
from drake_oa.scenario.loading import load_scenario, parse_scenario, scenario_text

LogOf = Callable[..., MotionLog]

FREE = load_scenario("free_space")
AROUND = np.array([[0.0, 0.0, 0.0], [0.5, -0.5, 0.0], [1.0, 0.0, 0.0]])
THROUGH = np.linspace([0.0, 0.0, 0.0], [0.999, 0.0, 0.0], 50)


@pytest.fixture(scope="module")
def log_of(straight_log: Callable[..., MotionLog]) -> LogOf:
    """Function that creates the log of a path (N, 3) [m] in 5 s; keywords replace attributes."""

    def make(path: FloatArray, **changes: object) -> MotionLog:
        origin = {"wall_time": 2.5, "versions": ("drake 1.51.1", "source_digest abc")}
        times = np.linspace(0.0, 5.0, len(path))
        return straight_log(
            len(path), t=times, p_WE=path, desired_position=path, **origin, **changes
        )

    return make


def test_the_report_has_the_documented_keys_and_is_json(log_of: LogOf) -> None:
    events = {"event_time": np.array([1.0, 2.0]), "event": ("obstacles not seen", "")}
    events["event_hold"] = ("obstacles", "none")
    logs = {"nominal": log_of(THROUGH), "avoiding": log_of(AROUND, **events)}
    report = json.loads(json.dumps(run_report("free_space", FREE, logs), allow_nan=False))
    nominal, avoiding = report["nominal"], report["avoiding"]
    assert {"scenario", "seed", "real_time_factor", "versions"} <= set(report)
    assert report["real_time_factor"] == 2.0
    assert report["versions"] == {"drake": "1.51.1", "source_digest": "abc"}
    assert avoiding["events"][0] == {"time": 1.0, "hold": "obstacles", "note": "obstacles not seen"}
    assert nominal["contacts"] == ["tool point - ellipsoid 0"]
    assert nominal["tool_clearance_min"] < 0.0
    assert nominal["goal_error"] == pytest.approx(1e-3)
    assert avoiding["tool_clearance_min"] > 0.15
    assert avoiding["path_length"] == pytest.approx(2.0 * np.sqrt(0.5))
    heading, collisions, *_ = str(report_table(report)).splitlines()
    assert heading.split() == ["nominal", "avoiding"]
    assert collisions.split() == ["collisions", "1", "0"]


def test_predicted_and_true_shortfalls_are_reported_separately(log_of: LogOf) -> None:
    predicted = {
        "shortfall": np.array([0.0, 0.0123, 0.002]),
        "clearance_reduction": np.array([0.0, 0.02, 0.0]),
    }
    logs = {"nominal": log_of(THROUGH, inference=""), "avoiding": log_of(AROUND, **predicted)}
    report = run_report("free_space", FREE, logs)
    keys = ("inference", "predicted_shortfall", "clearance_reduction", "clearance_shortfall")
    # The true clearance exceeds the requested one, so the true shortfall is 0.
    assert [report["avoiding"][key] for key in keys] == ["Verified", 0.0123, 0.02, 0.0]
    assert [report["nominal"][key] for key in keys[:3]] == [None, None, None]
    assert report["nominal"]["clearance_shortfall"] > report["nominal"]["achievable_clearance"]
    *_, clearance_reduction = str(report_table(report)).splitlines()
    assert clearance_reduction.startswith("note: avoiding: requested clearance reduced by")


def test_clearance_reduction_and_shortfall_are_noted(log_of: LogOf) -> None:
    far = parse_scenario(scenario_text(FREE), ["task.clearance=1.0"])
    report = run_report("far", far, {"avoiding": log_of(AROUND)})
    found = report["avoiding"]
    assert found["requested_clearance"] == 1.0
    assert found["achievable_clearance"] < 0.5
    assert found["clearance_shortfall"] > TOLERANCE
    requested, shortfall = str(report_table(report)).splitlines()[-2:]
    assert requested.startswith(f"note: at start or goal {found['achievable_clearance']:.3f} m")
    assert shortfall.startswith(
        f"warning: avoiding: minimum clearance {found['resting_clearance_min']:.3f} m"
    )


def test_latency_statistics_exclude_decisions_after_the_motion(log_of: LogOf) -> None:
    latencies = np.array([0.002, 0.3, 0.002, 0.1, 0.004, 9.0])
    log = log_of(
        AROUND,
        decision_time=np.array([0.0, 0.1, 0.1, 0.4, 1.0, 5.5]),
        decision_latency=latencies,
        decision_layer=tuple(("verification", "guard")[k] for k in (0, 0, 1, 0, 1, 0)),
    )
    found = motion_report(FREE, log)
    assert found["decision_latency"] == {
        "median": 0.1,
        "p99": pytest.approx(0.296),
        "max": 0.3,
        # The period of this scenario is 1 / 15 s; the decision after the motion does not count.
        "fraction_over_period": pytest.approx(2.0 / 3.0),
        "count": 3,
    }
    assert found["guard_latency"]["max"] == 0.004
    assert motion_report(FREE, log_of(AROUND))["decision_latency"] is None
