"""The report of a run: what the pre-planned and the modulated motion kept and touched."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from drake_oa.cartesian_kernels import rotation_vector
from drake_oa.goal_course import goal_at
from drake_oa.layers import given_ellipsoids
from drake_oa.metrics import MotionMetrics, free_point_metrics, path_length, robot_metrics
from drake_oa.motion_log import MotionLog
from drake_oa.orientation_dmp import rotation_matrix
from drake_oa.orientation_kernels import exponential
from drake_oa.scenario import GivenEllipsoids, Scenario
from drake_oa.text_tables import aligned
from drake_oa.tool_orientation import end_rotations
from drake_oa.values import EllipsoidSet


def motion_metrics(scenario: Scenario, log: MotionLog) -> MotionMetrics:
    """Judges a logged motion: by SceneGraph, or by the given ellipsoids without a robot."""
    if scenario.robot is not None:
        return robot_metrics(scenario, log.q, log.q_world)
    source = scenario.perception
    given = given_ellipsoids(source) if isinstance(source, GivenEllipsoids) else EllipsoidSet()
    return free_point_metrics(log.desired_position, given)


def motion_report(scenario: Scenario, log: MotionLog) -> dict[str, Any]:
    """The figures of one motion; distances in metres, times in seconds.

    Keys: `collisions` (pairs of a robot link and a thing that touched),
    `contacts` (their names), `initial_contacts` (those the motion started in),
    `made_contacts` (those it made), `tool_clearance_min`, `robot_clearance_min` (to
    obstacles; None where there is none), `goal_error` (at the last instant, to where
    the goal is then), `orientation_error` (angle to that of the goal then [rad]; only where
    the tool turns),
    `torque_saturation` (fraction of logged steps), `duration`, `path_length`,
    `out_of_range` (fraction of observations with an obstacle beyond what the regressor
    chain was trained for), `regulation` ("Verified", "Regressor", or None without
    modulation), `shortfall_max` (most that the verified motion lacked of the feasible
    clearance; None unless it was verified), `short_of` (name of the obstacle it lacked it
    to, or None), `stop_reason`, `events` (notes of the policy), `supervision` (what the
    supervisor did, and why).
    """
    metrics = motion_metrics(scenario, log)
    goal = goal_at(scenario.task, log.duration)
    reached = metrics.p_WE[-1] if len(metrics.p_WE) else np.asarray(scenario.task.start)
    return {
        "collisions": len(metrics.contacts),
        "contacts": list(metrics.contacts),
        "initial_contacts": list(metrics.initial_contacts),
        "made_contacts": list(metrics.made_contacts),
        "tool_clearance_min": _finite(metrics.tool_clearance.min(initial=math.inf)),
        "robot_clearance_min": _finite(metrics.robot_clearance.min(initial=math.inf)),
        "goal_error": float(np.linalg.norm(reached - goal)),
        **_orientation(scenario, log),
        "torque_saturation": float(log.saturated.mean()) if len(log.saturated) else 0.0,
        "duration": log.duration,
        "path_length": path_length(metrics.p_WE),
        "out_of_range": float((log.out_of_range > 0).mean()) if len(log.out_of_range) else 0.0,
        **_shortfall(log),
        "stop_reason": log.stop_reason,
        "events": [
            {"time": float(when), "note": note}
            for when, note in zip(log.event_time, log.event, strict=True)
        ],
        "supervision": [
            {"time": float(when), "action": action, "reason": reason}
            for when, action, reason in zip(
                log.supervision_time, log.supervision_action, log.supervision_reason, strict=True
            )
        ],
    }


def _orientation(scenario: Scenario, log: MotionLog) -> dict[str, Any]:
    if not len(log.desired_orientation):
        return {}
    desired = rotation_matrix(log.desired_orientation[-1])
    # The logged error leads from the actual to the desired orientation.
    off = exponential(np.ascontiguousarray(log.orientation_error[-1]))
    actual = rotation_matrix(off).T @ desired
    goal = end_rotations(scenario)[1].matrix()
    left = rotation_vector(np.ascontiguousarray(goal @ actual.T))
    return {"orientation_error": float(np.linalg.norm(left))}


def _shortfall(log: MotionLog) -> dict[str, Any]:
    most = float(log.shortfall.max(initial=0.0))
    return {
        "regulation": log.regulation or None,
        "shortfall_max": most if log.regulation == "Verified" else None,
        "short_of": int(log.short_of[log.shortfall.argmax()]) if most > 0.0 else None,
    }


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def run_report(name: str, scenario: Scenario, logs: dict[str, MotionLog]) -> dict[str, Any]:
    """The report of `drake-oa run --json`; see `motion_report` for each motion.

    Args:
        name: the scenario's name.
        scenario: the scenario.
        logs: "preplanned" and "modulated" -> their logs.
    """
    report: dict[str, Any] = {"scenario": name, "seed": scenario.seed}
    report |= {motion: motion_report(scenario, log) for motion, log in logs.items()}
    last = logs.get("modulated") or next(iter(logs.values()))
    report["real_time_factor"] = last.duration / last.wall_time if last.wall_time > 0.0 else None
    versions = dict(item.split(" ", 1) for item in last.versions)
    report["commit"] = versions.pop("commit", None)
    report["versions"] = versions
    return report


_COLUMNS = (
    ("collisions", "collisions", "{:d}"),
    ("tool_clearance_min", "tool clearance [m]", "{:.3f}"),
    ("robot_clearance_min", "robot clearance [m]", "{:.3f}"),
    ("shortfall_max", "shortfall [mm]", "{:.1f}"),
    ("goal_error", "goal error [mm]", "{:.2f}"),
    ("orientation_error", "turn error [deg]", "{:.2f}"),
    ("torque_saturation", "saturated [%]", "{:.1f}"),
    ("duration", "duration [s]", "{:.2f}"),
)
_SCALE = {
    "shortfall_max": 1e3,
    "goal_error": 1e3,
    "orientation_error": math.degrees(1.0),
    "torque_saturation": 1e2,
}


def report_table(report: dict[str, Any]) -> str:
    """The report as a text table, one row a motion, like the paper's Table III.

    Below it a line for each motion that could not keep the clearance.
    """
    shown = [motion for motion in ("preplanned", "modulated") if motion in report]
    columns = [c for c in _COLUMNS if any(c[0] in report[motion] for motion in shown)]
    rows = [["", *(title for _, title, _ in columns), "ended by"]]
    for motion in ("preplanned", "modulated"):
        if motion not in report:
            continue
        row: list[str] = [motion]
        for key, _, form in columns:
            value = report[motion].get(key)
            row.append("-" if value is None else form.format(value * _SCALE.get(key, 1)))
        rows.append([*row, report[motion]["stop_reason"]])
    warnings = [
        f"warning: {motion}: {1e3 * found['shortfall_max']:.1f} mm of the clearance to obstacle "
        f"{found['short_of']} could not be kept"
        for motion in ("preplanned", "modulated")
        if (found := report.get(motion)) and found["shortfall_max"]
    ]
    return "\n".join([aligned(rows, "r" * len(rows[0])), *warnings])
