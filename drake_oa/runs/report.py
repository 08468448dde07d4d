"""Report of a run as JSON data and table: clearances, contacts and decisions of its motions."""

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

TOLERANCE = 1e-3
"""Difference between two clearances above which the report table mentions it in a line of text [m].

A note mentions that the achievable clearance is less than the requested one, or that the requested
clearance was reduced further during the motion. A warning mentions that the minimum clearance is
less than the achievable one."""
_CONTACTS = ("contacts", "initial_contacts", "new_contacts", "self_contacts")
"""Keys of the lists of contacts in the report, which are also the names of the attributes of
`MotionMetrics` with these contacts."""


def motion_metrics(scenario: Scenario, log: MotionLog) -> MotionMetrics:
    """Computes contacts and clearances of a logged motion on the true geometry of its scenario.

    SceneGraph computes them for a robot. Without a robot, the obstacles are the ellipsoids that the
    scenario gives.

    Args:
        scenario: configuration of the run.
        log: log of the motion.
    """
    if scenario.robot is not None:
        return robot_metrics(scenario, log.q, log.q_world)
    return free_point_metrics(log.desired_position, _given(scenario))


def achievable_clearance_of(scenario: Scenario) -> float:
    """Computes the achievable clearance of a task [m]: the requested one, or less if start or goal
    is nearer to an obstacle.

    The achievable clearance is min(Delta, d_start, d_goal), with the requested clearance Delta and
    the true distances d of the tool to resting obstacles; 0 if start or goal is in contact. A
    moving goal counts at its last position.

    Raises:
        ScenarioError: if start or goal is out of reach.
    """
    task = scenario.task
    if scenario.robot is None:
        ends = np.array([task.start, goal_at(task, math.inf)], dtype=float)
        clearances = free_point_metrics(ends, _given(scenario)).resting_clearance
    else:
        ends = np.stack(end_positions(scenario))
        clearances = robot_metrics(scenario, ends).resting_clearance
    return float(max(np.min([task.clearance, *clearances]), 0.0))


def motion_report(
    scenario: Scenario, log: MotionLog, achievable_clearance: float | None = None
) -> dict[str, Any]:
    """Computes the metrics of one logged motion, in SI units, for the report of a run.

    The verified motion is the selected motion, which was checked by simulation. Contacts and
    clearances count until the world is at rest; duration, path and decisions until the end of the
    motion. On hardware the true obstacles are unknown. Therefore `achievable_clearance` and
    `clearance_shortfall` are None, and `collisions` is None instead of 0.

    Args:
        scenario: configuration of the run.
        log: log of the motion.
        achievable_clearance: achievable clearance of the scenario [m]; None: it is computed.

    Returns:
        Metrics by key:

        - collisions: number of pairs of a robot link and an object in contact.
        - contacts: names of these pairs.
        - initial_contacts, new_contacts: names of the pairs that are in contact at the first
          instant, and of the pairs whose contact begins later.
        - self_contacts: names of the pairs of robot links in contact.
        - contact_depth: maximum penetration of each pair.
        - tool_clearance_min, robot_clearance_min: minimum clearance of the tool and of the whole
          robot to obstacles; None: no obstacle.
        - requested_clearance: clearance that the task requests.
        - achievable_clearance: requested clearance, or less if start or goal is nearer to an
          obstacle.
        - resting_clearance_min: minimum clearance of the tool to resting obstacles; None: no such
          obstacle.
        - clearance_shortfall: achievable clearance minus `resting_clearance_min`, at least 0.
        - goal_error: distance to the goal at the end of the motion or at rest, whichever is larger.
        - orientation_error: angle to the goal's orientation at rest; only if the tool turns.
        - torque_saturation: fraction of the motion's instants with a joint at its effort limit.
        - duration: time from start to termination of the motion.
        - path_length: length of the path of the tool point.
        - out_of_range: fraction of observations with an obstacle beyond the training range of the
          regressor chain.
        - inference: "Verified" or "Paper"; None for the nominal motion.
        - predicted_shortfall: maximum predicted amount by which the verified motion falls below the
          required clearance; None unless `inference` is "Verified".
        - clearance_reduction: maximum reduction of the requested clearance because start or goal is
          nearer to an obstacle; None unless `inference` is "Verified".
        - sources: fraction of the duration for each source of the motion: nominal, chain (the
          regressor chain), search or joint_path (a path in joint space); None unless `inference` is
          "Verified".
        - guard_actions: fraction of the duration for each action of the motion guard: follow, slow
          or wait on the verified motion, evade, or brake.
        - guard_claims: fraction of the duration in which the guard limits the speed because of each
          claim of passive motion safety: A toward moving obstacles, B toward unobserved space.
        - decision_latency, guard_latency: statistics of the compute latencies of decisions on the
          motion and on maneuvers of the guard, see `latency_statistics`; None: no decision with
          latency.
        - stop_reason, ended, settled: reason of the termination in words, its kind, and whether the
          world came to rest afterwards.
        - events: times at which the policy began or ended a hold, with reasons and notes.
        - supervision: times at which the action of the motion guard changed, with reasons.
    """
    metrics, period = motion_metrics(scenario, log), perception_period(scenario)
    if achievable_clearance is None:
        achievable_clearance = achievable_clearance_of(scenario)
    resting = min_clearance(metrics.resting_clearance)
    nearest = min_clearance(metrics.robot_clearance)
    shortfall = 0.0 if resting is None else max(achievable_clearance - resting, 0.0)
    is_verified = log.inference == "Verified"
    reduction = float(log.clearance_reduction.max(initial=0.0))
    is_measured = nearest is not None or not isinstance(scenario.perception, LcmCamera)
    return {
        "collisions": len(metrics.contacts) if is_measured or metrics.contacts else None,
        **{name: list(getattr(metrics, name)) for name in _CONTACTS},
        "contact_depth": metrics.contact_depth,
        "tool_clearance_min": min_clearance(metrics.tool_clearance),
        "robot_clearance_min": nearest,
        "requested_clearance": scenario.task.clearance,
        "achievable_clearance": achievable_clearance if is_measured else None,
        "resting_clearance_min": resting,
        "clearance_shortfall": shortfall if is_measured else None,
        "goal_error": _goal_error(scenario, log, metrics.p_WE),
        **_orientation(scenario, log),
        "torque_saturation": float(log.saturated[log.moving].mean()) if len(log.t) else 0.0,
        "duration": log.duration,
        "path_length": path_length(metrics.p_WE[log.moving]),
        "out_of_range": float((log.out_of_range > 0).mean()) if len(log.out_of_range) else 0.0,
        "inference": log.inference or None,
        "predicted_shortfall": float(log.shortfall.max(initial=0.0)) if is_verified else None,
        "clearance_reduction": reduction if is_verified else None,
        "sources": time_fractions(log, log.motion_source, SOURCES) if is_verified else None,
        "guard_actions": time_fractions(log, log.guard_action, ACTIONS),
        "guard_claims": time_fractions(log, log.guard_claim, CLAIMS),
        "decision_latency": latency_statistics(layer_latencies(log), period),
        "guard_latency": latency_statistics(layer_latencies(log, "guard"), period),
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
    """Converts the columns of a table to its rows: dictionaries with the names of the columns as
    keys.
    """
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def latency_statistics(
    latencies: ArrayLike, period: float | None = None
) -> dict[str, float] | None:
    """Computes statistics of the compute latencies of decisions.

    Args:
        latencies: (N,) latencies of decisions [s].
        period: time between two observations of the obstacles [s], or None.

    Returns:
        Dictionary of "median", "p99" and "max" [s]; "count"; and, with a period,
        "fraction_over_period", the fraction of latencies above it. None without decisions.
    """
    latencies = np.asarray(latencies, dtype=float)
    if not len(latencies):
        return None
    statistics = {
        "median": float(np.median(latencies)),
        "p99": float(np.percentile(latencies, 99.0)),
        "max": float(latencies.max()),
        "count": len(latencies),
    }
    if period is not None:
        statistics["fraction_over_period"] = float((latencies > period).mean())
    return statistics


def layer_latencies(log: MotionLog, layer: str = "verification") -> FloatArray:
    """Returns the compute latencies (N,) of the decisions that a layer started during a motion [s].

    Args:
        log: log of the motion.
        layer: layer that decides: "verification" (on the motion) or "guard" (on its maneuvers).
    """
    is_of_layer = np.array(log.decision_layer, dtype=str) == layer
    return log.decision_latency[is_of_layer & (log.decision_time <= log.duration)]


def _orientation(scenario: Scenario, log: MotionLog) -> dict[str, Any]:
    """Computes the angle between the tool's orientation at the last logged instant and that of the
    goal [rad].

    Returns:
        The angle under the key "orientation_error" of the report; {} for a motion with constant
        orientation.
    """
    if not len(log.desired_orientation):
        return {}
    desired = Rotation.from_quat(log.desired_orientation[-1], scalar_first=True)
    # The logged error is the rotation from the actual to the desired orientation.
    to_desired = Rotation.from_rotvec(log.orientation_error[-1])
    goal = Rotation.from_matrix(end_rotations(scenario)[1].matrix())
    return {"orientation_error": float((goal * desired.inv() * to_desired).magnitude())}


def _goal_error(scenario: Scenario, log: MotionLog, p_WE: FloatArray) -> float:
    """Computes the larger of two distances of the tool point to the goal [m]: at the termination of
    the motion, and at the last instant.

    Args:
        scenario: scenario of the log.
        log: log of the motion.
        p_WE: (T, 3) positions of the tool point at the instants of the log [m].
    """
    ends = p_WE[[log.moving.stop - 1, -1]] if len(p_WE) else np.array([scenario.task.start])
    times = (log.duration, log.simulated_time)[: len(ends)]
    goals = np.array([goal_at(scenario.task, time) for time in times])
    return float(np.linalg.norm(ends - goals, axis=1).max())


def _given(scenario: Scenario) -> EllipsoidSet:
    """Returns the ellipsoids that a scenario with `!GivenEllipsoids` specifies as its obstacles;
    for other perception, an empty set.
    """
    source = scenario.perception
    return given_ellipsoids(source) if isinstance(source, GivenEllipsoids) else EllipsoidSet()


def min_clearance(clearance: FloatArray) -> float | None:
    """Returns the minimum of clearances (T,) over time [m]; None if all are infinite, without
    obstacle.
    """
    minimum = float(clearance.min(initial=math.inf))
    return minimum if math.isfinite(minimum) else None


def time_fractions(log: MotionLog, codes: FloatArray, names: Sequence[str]) -> dict[str, float]:
    """Computes the fraction of a motion's instants in which each value of a logged code, such as
    the guard's action, occurs.

    Args:
        log: log of the motion.
        codes: (T,) logged codes, which are indices of `names`; (0,): not logged.
        names: names of the codes; a code with an empty name does not count.

    Returns:
        Fractions greater than 0, by the names of the codes.
    """
    codes = codes[log.moving] if len(codes) else codes
    shares = {name: float(np.mean(codes == code)) for code, name in enumerate(names) if len(codes)}
    return {name: share for name, share in shares.items() if share > 0.0 and name}


def run_report(name: str, scenario: Scenario, logs: dict[str, MotionLog]) -> dict[str, Any]:
    """Creates the report of a run, which `drake-oa run --json` writes.

    It contains scenario, seed, real-time factor (simulated time over wall time) and software
    versions, and under the name of each motion its metrics (`motion_report`).

    Args:
        name: name of the scenario.
        scenario: configuration of the run.
        logs: logs of the motions "nominal" and "avoiding", at least one of them.
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
"""Metrics in the rows of the printed report of a run: key, label, format, and factor to the printed
unit; `drake-oa run --help` explains the metrics."""


def report_table(report: dict[str, Any]) -> TextTable:
    """Returns the report of a run as a table with one row for each metric and one column for each
    motion.

    Notes below the table state clearance shortfalls, reductions of the requested clearance,
    self-contacts and, for the method "Paper", observations beyond the training range.

    Args:
        report: result of `run_report`.
    """
    rows = []
    for motion in ("nominal", "avoiding"):
        if metrics := report.get(motion):
            sources = [f"{name} {share:.0%}" for name, share in (metrics["sources"] or {}).items()]
            rows.append({"motion": motion, "source": ", ".join(sources) or None, **metrics})
    notes = dict.fromkeys(note for row in rows for note in _notes(row["motion"], row))
    return TextTable(_COLUMNS, rows, list(notes), transposed=True)


def contact_error(report: dict[str, Any]) -> str:
    """Returns one line with the contacts of the avoiding motion and their depths as negative
    distances [mm]; "" without a contact.

    Args:
        report: result of `run_report`.
    """
    depths = report.get("avoiding", {}).get("contact_depth", {})
    pairs = ", ".join(f"{pair} ({-1e3 * depth:.1f} mm)" for pair, depth in depths.items())
    return pairs and f"contact during the avoiding motion: {pairs}"


def _notes(motion: str, metrics: dict[str, Any]) -> list[str]:
    """Returns notes and warnings on clearances and self-contacts of one motion, as lines for the
    report table.

    Args:
        motion: name of the motion.
        metrics: result of `motion_report` for this motion.
    """
    notes = []
    requested, achievable = metrics["requested_clearance"], metrics["achievable_clearance"]
    reduction = 0.0 if achievable is None else requested - achievable
    if reduction > TOLERANCE:
        notes.append(
            f"note: at start or goal {achievable:.3f} m of the requested "
            f"{requested:g} m are achievable"
        )
    if metrics["self_contacts"]:
        notes.append(f"warning: {motion}: self-contact of the robot: {metrics['self_contacts']}")
    if not metrics["inference"]:
        return notes
    if metrics["inference"] == "Paper" and metrics["out_of_range"]:
        notes.append(
            f"note: {motion}: {metrics['out_of_range']:.0%} of the observations are beyond the "
            "training range of the regressor chain"
        )
    if (metrics["clearance_shortfall"] or 0.0) > TOLERANCE:
        notes.append(
            f"warning: {motion}: minimum clearance {metrics['resting_clearance_min']:.3f} m to "
            f"resting obstacles, shortfall {1e3 * metrics['clearance_shortfall']:.1f} mm"
        )
    if (metrics["clearance_reduction"] or 0.0) > TOLERANCE + max(reduction, 0.0):
        notes.append(
            f"note: {motion}: requested clearance reduced by up to "
            f"{1e3 * metrics['clearance_reduction']:.1f} mm: an obstacle was perceived nearer to "
            "start or goal"
        )
    return notes
