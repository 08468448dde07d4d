"""The report of a run: what the pre-planned and the avoiding motion kept and touched."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from drake_oa.common.console import Column, TextTable
from drake_oa.common.messages import EllipsoidSet, FloatArray
from drake_oa.perception.config import LcmCamera
from drake_oa.planning.search import SOURCES
from drake_oa.runs.metrics import MotionMetrics, free_point_metrics, path_length, robot_metrics
from drake_oa.runs.motion_log import MotionLog
from drake_oa.safety.maneuvers import ACTIONS
from drake_oa.safety.passive_safety import CLAIMS
from drake_oa.scenario.end_poses import end_positions, end_rotations
from drake_oa.scenario.perception import GivenEllipsoids
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.sources import given_ellipsoids, perception_period
from drake_oa.scenario.task import goal_at

TOLD = 1e-3
"""Clearance that is missing by more than this is told, and counts as missing [m]."""
_CONTACTS = ("contacts", "initial_contacts", "made_contacts", "self_contacts")
_COST_KEYS = {"verification": "decision_latency", "guard": "guard_latency"}
"""Layer -> key of the costs of its decisions in the report."""


def motion_metrics(scenario: Scenario, log: MotionLog) -> MotionMetrics:
    """Judges a logged motion: by SceneGraph, or by the given ellipsoids without a robot.

    Args:
        scenario: what was run.
        log: of the motion.
    """
    if scenario.robot is not None:
        return robot_metrics(scenario, log.q, log.q_world)
    return free_point_metrics(log.desired_position, _given(scenario))


def achievable_clearance_of(scenario: Scenario) -> float:
    """min(Delta, true clearance of the tool at the start, at the goal) to what rests [m].

    Nobody can keep more; 0 where start or goal touches. Of a goal that moves, the last counts.

    Raises:
        ScenarioError: if start or goal is out of reach.
    """
    task = scenario.task
    if scenario.robot is None:
        ends = np.array([task.start, goal_at(task, math.inf)], dtype=float)
        left = free_point_metrics(ends, _given(scenario)).resting_clearance
    else:
        ends = np.stack(end_positions(scenario))
        left = robot_metrics(scenario, ends).resting_clearance
    return float(max(np.min([task.clearance, *left]), 0.0))


def motion_report(
    scenario: Scenario,
    log: MotionLog,
    achievable_clearance: float | None = None,
) -> dict[str, Any]:
    """The figures of one motion; distances in meters, times in seconds.

    Contacts and clearances are judged until all was at rest; what is of the motion
    itself, to its end. On hardware no obstacle is known: `collisions` without a contact with
    anything else, `achievable_clearance` and `clearance_shortfall` are None.

    Keys: `collisions` (pairs of a robot link and a thing that touched),
    `contacts` (their names), `initial_contacts` (those the motion started in),
    `made_contacts` (those it made), `self_contacts` (links of the robot that touched each
    other), `contact_depth` (pair -> greatest penetration), `tool_clearance_min`,
    `robot_clearance_min` (to obstacles; None where there is
    none), `requested_clearance`, `achievable_clearance`, `resting_clearance_min` (of the tool to what
    never moves; None where there is none), `clearance_shortfall` (what that lacks of the feasible
    one), `goal_error` (at the motion's end or when all is at rest, the greater one),
    `orientation_error` (angle to that of the goal when all is at rest [rad]; only where the
    tool turns), `torque_saturation` (fraction of logged steps), `duration`, `path_length`,
    `out_of_range` (fraction of observations with an obstacle beyond what the regressor
    chain was trained for), `inference` ("Verified", "Paper", or None without
    modulation), `believed_shortfall` (most that the verified motion lacked of what inference
    believed feasible; None unless it was verified), `clearance_reduction` (by how much inference
    lowered the requested clearance at most; None unless verified), `sources` (source of the motion ->
    fraction of the moving time; None unless verified), `guard_actions` and `guard_claims` (action
    of the motion guard, and claim of passive motion safety that limits the speed -> fraction of the
    moving time), `decision_latency` and `guard_latency` (`latency_statistics` of the decisions of the
    inference and of the guard; None without decisions that cost time), `stop_reason`,
    `ended` (one of `MotionEnd`), `settled` (whether all came to rest), `events` (what held
    the policy, and its notes), `supervision` (actions of the motion guard, with reasons).

    Args:
        scenario: what was run.
        log: of the motion.
        achievable_clearance: `achievable_clearance_of` the scenario; None: it is asked for.
    """
    metrics, period = motion_metrics(scenario, log), perception_period(scenario)
    if achievable_clearance is None:
        achievable_clearance = achievable_clearance_of(scenario)
    resting, nearest = (
        min_clearance(metrics.resting_clearance),
        min_clearance(metrics.robot_clearance),
    )
    short = 0.0 if resting is None else max(achievable_clearance - resting, 0.0)
    verified = log.inference == "Verified"
    measured = nearest is not None or not isinstance(scenario.perception, LcmCamera)
    return {
        "collisions": len(metrics.contacts) if measured or metrics.contacts else None,
        **{name: list(getattr(metrics, name)) for name in _CONTACTS},
        "contact_depth": metrics.contact_depth,
        "tool_clearance_min": min_clearance(metrics.tool_clearance),
        "robot_clearance_min": nearest,
        "requested_clearance": scenario.task.clearance,
        "achievable_clearance": achievable_clearance if measured else None,
        "resting_clearance_min": resting,
        "clearance_shortfall": short if measured else None,
        "goal_error": _goal_error(scenario, log, metrics.p_WE),
        **_orientation(scenario, log),
        "torque_saturation": float(log.saturated[log.moving].mean()) if len(log.t) else 0.0,
        "duration": log.duration,
        "path_length": path_length(metrics.p_WE[log.moving]),
        "out_of_range": float((log.out_of_range > 0).mean()) if len(log.out_of_range) else 0.0,
        "inference": log.inference or None,
        "believed_shortfall": float(log.shortfall.max(initial=0.0)) if verified else None,
        "clearance_reduction": float(log.clearance_reduction.max(initial=0.0))
        if verified
        else None,
        "sources": shares(log, log.motion_source, SOURCES) if verified else None,
        "guard_actions": shares(log, log.guard_action, ACTIONS),
        "guard_claims": shares(log, log.guard_claim, CLAIMS),
        **{
            key: latency_statistics(layer_costs(log, layer), period)
            for layer, key in _COST_KEYS.items()
        },
        "stop_reason": log.stop_reason,
        "ended": log.ended,
        "settled": log.settled,
        "events": _rows(time=log.event_time.tolist(), hold=log.event_hold, note=log.event),
        "supervision": _rows(
            time=log.supervision_time.tolist(),
            action=log.supervision_action,
            reason=log.supervision_reason,
        ),
    }


def _rows(**columns: Sequence[object]) -> list[dict[str, object]]:
    """Returns rows by the names of their columns."""
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def latency_statistics(costs: ArrayLike, period: float) -> dict[str, float] | None:
    """Returns {median, p99, max [s], share_over_period, count} of decisions; None without any.

    Args:
        costs: of decisions [s].
        period: of the perception [s].
    """
    costs = np.asarray(costs, dtype=float)
    if not len(costs):
        return None
    return {
        "median": float(np.median(costs)),
        "p99": float(np.percentile(costs, 99.0)),
        "max": float(costs.max()),
        "share_over_period": float((costs > period).mean()),
        "count": len(costs),
    }


def layer_costs(log: MotionLog, layer: str = "verification") -> FloatArray:
    """Returns the costs of a layer's decisions that began in the motion [s]."""
    of_layer = np.array(log.decision_layer, dtype=str) == layer
    return log.decision_latency[of_layer & (log.decision_time <= log.duration)]


def _orientation(scenario: Scenario, log: MotionLog) -> dict[str, Any]:
    if not len(log.desired_orientation):
        return {}
    desired = Rotation.from_quat(log.desired_orientation[-1], scalar_first=True)
    # The logged error leads from the actual to the desired orientation.
    to_desired = Rotation.from_rotvec(log.orientation_error[-1])
    goal = Rotation.from_matrix(end_rotations(scenario)[1].matrix())
    return {"orientation_error": float((goal * desired.inv() * to_desired).magnitude())}


def _goal_error(scenario: Scenario, log: MotionLog, p_WE: FloatArray) -> float:
    reached = p_WE[[log.moving.stop - 1, -1]] if len(p_WE) else np.array([scenario.task.start])
    times = (log.duration, log.simulated_time)[: len(reached)]
    goals = np.array([goal_at(scenario.task, time) for time in times])
    return float(np.linalg.norm(reached - goals, axis=1).max())


def _given(scenario: Scenario) -> EllipsoidSet:
    source = scenario.perception
    return given_ellipsoids(source) if isinstance(source, GivenEllipsoids) else EllipsoidSet()


def min_clearance(clearance: FloatArray) -> float | None:
    """Returns the minimum clearance [m]; None if there is none."""
    minimum = float(clearance.min(initial=math.inf))
    return minimum if math.isfinite(minimum) else None


def shares(log: MotionLog, codes: FloatArray, names: Sequence[str]) -> dict[str, float]:
    """Returns the fractions of the moving time in which a logged code had each of its names."""
    codes = codes[log.moving] if len(codes) else codes
    found = {name: float(np.mean(codes == code)) for code, name in enumerate(names) if len(codes)}
    return {name: share for name, share in found.items() if share > 0.0 and name}


def run_report(name: str, scenario: Scenario, logs: dict[str, MotionLog]) -> dict[str, Any]:
    """The report of `drake-oa run --json`; see `motion_report` for each motion.

    Args:
        name: the scenario's name.
        scenario: the scenario.
        logs: "nominal" and "avoiding" -> their logs.
    """
    report: dict[str, Any] = {"scenario": name, "seed": scenario.seed}
    achievable_clearance = achievable_clearance_of(scenario)
    report |= {
        motion: motion_report(scenario, log, achievable_clearance) for motion, log in logs.items()
    }
    last = logs.get("avoiding") or next(iter(logs.values()))
    report["real_time_factor"] = (
        last.simulated_time / last.wall_time if last.wall_time > 0.0 else None
    )
    report["versions"] = dict(item.split(" ", 1) for item in last.versions)
    return report


_COLUMNS = (
    Column("motion", ""),
    Column("collisions"),
    Column("tool_clearance_min", "tool clearance [m]", "{:.3f}"),
    Column("robot_clearance_min", "robot clearance [m]", "{:.3f}"),
    Column("requested_clearance", "requested clearance [m]", "{:.3f}"),
    Column("achievable_clearance", "achievable clearance [m]", "{:.3f}"),
    Column("clearance_shortfall", "clearance shortfall [mm]", "{:.1f}", 1e3),
    Column("goal_error", "goal error [mm]", "{:.2f}", 1e3),
    Column("orientation_error", "orientation error [deg]", "{:.2f}", math.degrees(1.0)),
    Column("torque_saturation", "saturated [%]", "{:.1f}", 1e2),
    Column("duration", "duration [s]", "{:.2f}"),
    Column("source", "motion source"),
    Column("stop_reason", "termination"),
)


def report_table(report: dict[str, Any]) -> TextTable:
    """Returns the report as a table with one column for each motion.

    The notes below it name clearance that was not feasible or not kept, and contacts.
    """
    rows = []
    for motion in ("nominal", "avoiding"):
        if found := report.get(motion):
            sources = [f"{name} {share:.0%}" for name, share in (found["sources"] or {}).items()]
            rows.append({"motion": motion, "source": ", ".join(sources) or None, **found})
    notes = dict.fromkeys(note for row in rows for note in _notes(row["motion"], row))
    return TextTable(_COLUMNS, rows, list(notes), transposed=True)


def contact_error(report: dict[str, Any]) -> str:
    """Returns one line that names the contacts of the avoiding motion; "" without any."""
    depths = report.get("avoiding", {}).get("contact_depth", {})
    pairs = ", ".join(f"{pair} ({-1e3 * depth:.1f} mm)" for pair, depth in depths.items())
    return pairs and f"contact during the avoiding motion: {pairs}"


def _notes(motion: str, found: dict[str, Any]) -> list[str]:
    """What is to be said of one motion's clearance; less than `TOLD` is not."""
    notes = []
    requested = found["requested_clearance"]
    achievable_clearance = (
        requested if found["achievable_clearance"] is None else found["achievable_clearance"]
    )
    if requested - achievable_clearance > TOLD:
        notes.append(
            f"note: start and goal leave {achievable_clearance:.3f} m of the asked {requested:g} m"
        )
    if found["self_contacts"]:
        notes.append(f"warning: {motion}: the robot touched itself: {found['self_contacts']}")
    if not found["inference"]:
        return notes
    if found["inference"] == "Paper" and found["out_of_range"]:
        notes.append(
            f"note: {motion}: obstacles outside the regressor chain's trained range in "
            f"{found['out_of_range']:.0%} of the observations"
        )
    if (found["clearance_shortfall"] or 0.0) > TOLD:
        notes.append(
            f"warning: {motion}: kept {found['resting_clearance_min']:.3f} m to what rests, "
            f"{1e3 * found['clearance_shortfall']:.1f} mm less than start and goal leave"
        )
    if (found["clearance_reduction"] or 0.0) > max(TOLD, requested - achievable_clearance + TOLD):
        notes.append(
            f"note: {motion}: inference reduced the requested clearance by up to "
            f"{1e3 * found['clearance_reduction']:.1f} mm: it took an obstacle to be that near"
        )
    return notes
