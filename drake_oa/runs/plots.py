"""Figures of logged runs and of demonstrations.

`plot_run` draws clearance, phase, torques, tracking error and the path of a logged run;
`plot_demonstrations` draws demonstrations and the motion that the movement primitive learned.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from textwrap import shorten
from typing import Any, NamedTuple, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.offsetbox import AnchoredText
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from drake_oa.common.files import saved_figure
from drake_oa.common.messages import FloatArray, HoldCause
from drake_oa.policy.dmp import local_frame, orientation_along, trajectory, vectors_from
from drake_oa.runs.metrics import MotionMetrics
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.report import motion_metrics
from drake_oa.scenario.demonstration import (
    demonstrated_orientation,
    demonstrated_path,
    read_demonstrations,
)
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.task import goal_steps

_COLORS = {"modulated": "#00798c", "preplanned": "#111111"}
_OBSTACLE, _DESIRED, _ENDS, _LEARNED = "#d1495b", "#edae49", "#0072b2", "#009e73"
"""Colors of obstacles, of the desired path, of start and goal, and of a learned motion."""
_PAUSE_COLORS = {"slow": "#f7e8b5", "hold": "#edae49", "held": "#edae49", "stop": "#d1495b"}
_PANELS = (
    ("distance to the nearest obstacle", "clearance [m]"),
    ("phase and speed", "phase, share [1]"),
    ("joint torques against their limits", "torque / limit [1]"),
    ("distance of the tool point from its desired position", "error [mm]"),
)
"""Titles and labels of the panels of a run; without a robot there are only the first two."""
_MIN_ERROR = 1e-3
"""Lower bound of drawn tracking errors [mm]; zero has no logarithm."""
_MAX_LISTED = 6
"""Maximum number of pauses that are listed with their reasons."""
_OBSERVATIONS = 6
"""Number of observations of which obstacles are drawn, one over the other."""


def add_legend(ax: Axes, **options: Any) -> None:
    """Adds a legend with one entry per label, if anything has a label.

    Args:
        ax: axes.
        options: arguments of `Axes.legend`.
    """
    handles, labels = ax.get_legend_handles_labels()
    if entries := dict(zip(labels, handles, strict=True)):
        ax.legend(entries.values(), entries, **options)


class Pause(NamedTuple):
    """Interval in which a motion was slowed, held or stopped.

    Attributes:
        start: beginning [s].
        end: end, at the latest that of the log [s].
        kind: "slow", "hold" or "stop" by the supervisor; "held" by the policy.
        reason: cause.
    """

    start: float
    end: float
    kind: str
    reason: str


def pauses(log: MotionLog) -> list[Pause]:
    """Returns the pauses of a motion in order of their beginning."""
    holds = [
        "run" if hold in (HoldCause.NONE, HoldCause.SUPERVISOR) else "held"
        for hold in log.event_hold
    ]
    found = []
    for times, kinds, reasons in (
        (log.supervision_time, log.supervision_action, log.supervision_reason),
        (log.event_time, holds, log.event),
    ):
        spans = pairwise([*times.tolist(), log.simulated_time])
        found += [
            Pause(*span, kind, reason)
            for span, kind, reason in zip(spans, kinds, reasons, strict=True)
            if kind != "run"
        ]
    return sorted(found)


def outline(p_WO: FloatArray, R_WO: FloatArray, semi_axes: FloatArray, P: FloatArray) -> FloatArray:
    """Returns the outline of an ellipsoid in parallel projection.

    With the singular value decomposition P R diag(a) = U S V^T, the points P (c + R diag(a) u),
    |u| = 1, fill the ellipse with the boundary P c + U S (cos, sin).

    Args:
        p_WO: (3,) center [m].
        R_WO: (3, 3) orientation.
        semi_axes: (3,) semi-axes [m].
        P: (2, 3) orthonormal directions of the axes of the picture.

    Returns:
        (73, 2) points of the closed boundary [m].
    """
    U, S, _ = np.linalg.svd(P @ (R_WO * semi_axes))
    turn = np.linspace(0.0, 2.0 * np.pi, 73)
    return np.asarray(P @ p_WO + np.stack([np.cos(turn), np.sin(turn)], axis=1) * S @ U.T)


class Demonstrations(NamedTuple):
    """Demonstrations of a task, placed between its start and goal, and the learned motion.

    The samples have 3 columns, positions [m], or 6 where orientations are demonstrated: positions
    and rotation vectors from the first orientation [deg].

    Attributes:
        durations: of each recording [s].
        s: (T_d,) normalized times of each recording.
        samples: (T_d, 3 or 6) samples of each recording.
        motion_s: (N,) normalized times of the learned motion.
        motion: (N, 3 or 6) samples of the learned motion.
        errors: of each recording the distance of its samples from the learned path, root mean
            square [m].
    """

    durations: list[float]
    s: list[FloatArray]
    samples: list[FloatArray]
    motion_s: FloatArray
    motion: FloatArray
    errors: list[float]


def place_demonstrations(scenario: Scenario) -> Demonstrations | None:
    """Returns the placed demonstrations of a scenario; None if it has none.

    Raises:
        ScenarioError: naming the file that cannot be read or imitated.
    """
    task = scenario.task
    if not task.demonstration:
        return None
    way = trajectory(demonstrated_path(scenario), task.start, task.goal)
    primitive, path = demonstrated_orientation(scenario), KDTree(way.p)
    to_task = _baseline_frame(task.start, task.goal)
    found = Demonstrations([], [], [], way.s, way.p, [])
    for one in read_demonstrations(task):
        first, last = one.path[0], one.path[-1]
        turn = to_task @ np.linalg.inv(_baseline_frame(first, last))
        placed = task.goal + (one.path - last) @ turn.T
        elapsed = one.t - one.t[0]
        found.durations.append(float(elapsed[-1]))
        found.s.append(elapsed / elapsed[-1])
        found.samples.append(_with_turn(placed, one.orientations))
        found.errors.append(float(np.sqrt(np.mean(path.query(placed)[0] ** 2))))
    if primitive is not None:
        R = orientation_along(primitive, primitive.first, primitive.last, way.s)
        found = found._replace(motion=_with_turn(way.p, R))
    return found


def _baseline_frame(start: ArrayLike, goal: ArrayLike) -> FloatArray:
    """Returns (3, 3) axes of the frame of a motion, as long as its baseline [m]."""
    return local_frame(start, goal) * np.linalg.norm(np.subtract(goal, start))


def _with_turn(p: FloatArray, R: FloatArray | None) -> FloatArray:
    """Returns (T, 3 or 6) positions [m], and rotation vectors of orientations [deg]."""
    return p if R is None else np.hstack([p, np.degrees(vectors_from(R, 0))])


def plot_demonstrations(path: Path, title: str, scenario: Scenario, shown: Demonstrations) -> None:
    """Draws demonstrations and the learned motion: samples over time, and the path.

    Args:
        path: the file of the figure.
        title: of the figure.
        scenario: scenario of the task.
        shown: demonstrations of the scenario.

    Raises:
        OutputError: if the file cannot be written.
    """
    durations = ", ".join(f"{duration:.2f}" for duration in shown.durations)
    errors = ", ".join(f"{1e3 * error:.1f}" for error in shown.errors)
    title += (
        f"\ndemonstrations of {durations} s, {errors} mm (rms) from the path of "
        f"{scenario.policy.n_basis} basis functions"
    )
    with saved_figure(path, 14.0, 10.0, title) as figure:
        panels, views = _add_panels(figure, shown.motion.shape[1], scenario)
        for ax, P in views:
            _draw_demonstrations(ax, shown, P)
        labels = [f"{axis} [m]" for axis in "xyz"] + [f"turn about {axis} [deg]" for axis in "xyz"]
        for column, (ax, label) in enumerate(zip(panels, labels, strict=False)):
            for s, samples in zip(shown.s, shown.samples, strict=True):
                ax.plot(s, samples[:, column], marker=".", markersize=2.0, linewidth=0.5)
            motion = shown.motion[:, column]
            ax.plot(shown.motion_s, motion, color=_LEARNED, label="learned")
            ax.set_ylabel(label)
        _finish(views[0][0], "path")
        _finish(panels[0], "placed between start and goal of the task")
        panels[-1].set_xlabel("normalized time [1]")


def plot_run(
    path: Path,
    title: str,
    scenario: Scenario,
    logs: Mapping[str, MotionLog],
    shown: Demonstrations | None = None,
) -> None:
    """Draws a run: panels over time on the left, the path from two sides on the right.

    Without a robot there are neither torques nor a tracking error. Pauses and joints are those of
    the modulated motion, or of the only motion.

    Args:
        path: the file of the figure.
        title: of the figure.
        scenario: scenario of the logs.
        logs: the motions of at least one instant, by name.
        shown: demonstrations that are drawn beside the path; None: none.

    Raises:
        OutputError: if the file cannot be written.
        ScenarioError: if the station of the scenario cannot be built.
    """
    main = "modulated" if "modulated" in logs else next(iter(logs))
    for name, log in logs.items():
        title += f"\n{name}: {log.duration:.2f} s, ended by {log.stop_reason}"
    with saved_figure(path, 14.0, 10.0, title) as figure:
        panels, views = _add_panels(figure, 2 if scenario.robot is None else 4, scenario)
        for name, log in logs.items():
            _draw_motion(panels, name, log, motion_metrics(scenario, log), each_joint=name == main)
            for ax, P in views:
                _draw_path(ax, name, log, P)
        if shown:
            for ax, P in views:
                _draw_demonstrations(ax, shown, P)
        _finish(views[0][0], "path")
        asked = scenario.task.clearance
        panels[0].axhline(asked, color="0.4", linestyle="--", label=f"asked, Δ = {asked:g} m")
        panels[0].axhline(0.0, color=_OBSTACLE)
        _draw_pauses(panels, pauses(logs[main]))
        for ax, (heading, label) in zip(panels, _PANELS, strict=False):
            ax.set_ylabel(label)
            _finish(ax, heading)
        panels[-1].set_xlabel("time [s]")
        panels[-1].set_xlim(0.0, max(log.simulated_time for log in logs.values()) or 1.0)


def _add_panels(
    figure: Figure, count: int, scenario: Scenario
) -> tuple[list[Axes], list[tuple[Axes, FloatArray]]]:
    """Adds panels over time on the left, and two views of start and goal on the right.

    Args:
        figure: an empty figure.
        count: number of the panels.
        scenario: scenario of the task.

    Returns:
        The panels; and the views from above and from the side, along x or y, each with the (2, 3)
        directions of its axes in the world.
    """
    left, right = cast("list[SubFigure]", figure.subfigures(1, 2, width_ratios=[1.35, 1.0]))
    start, goals = np.asarray(scenario.task.start), goal_steps(scenario.task)[:, 1:]
    along = int(np.argmax(np.abs(goals[0] - start)[:2]))
    views = []
    for ax, axes in zip(right.subplots(2, 1), ((0, 1), (along, 2)), strict=True):
        P = np.eye(3)[list(axes)]
        ax.plot(*(P @ start), "o", color=_ENDS, markersize=9, zorder=3, label="start")
        ax.plot(*(P @ goals.T), "*", color=_ENDS, markersize=9, zorder=3, label="goal")
        ax.set(xlabel=f"{'xyz'[axes[0]]} [m]", ylabel=f"{'xyz'[axes[1]]} [m]")
        ax.set_aspect("equal", adjustable="datalim")
        views.append((ax, P))
    return list(left.subplots(count, 1, sharex=True)), views


def _finish(ax: Axes, title: str) -> None:
    """Sets the title above axes on the left, and the legend on the right."""
    ax.set_title(title)
    add_legend(ax, ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0))


def _draw_demonstrations(ax: Axes, shown: Demonstrations, P: FloatArray) -> None:
    """Draws the samples and the learned motion along the directions P (2, 3)."""
    for samples in shown.samples:
        ax.plot(*(P @ samples[:, :3].T), ".-", color="0.55", markersize=2.0, label="demonstrated")
    motion = P @ shown.motion[:, :3].T
    ax.plot(*motion, "--", color=_LEARNED, label="learned", zorder=3)


def _draw_motion(
    panels: Sequence[Axes], name: str, log: MotionLog, metrics: MotionMetrics, *, each_joint: bool
) -> None:
    """Draws clearance, phase and speed of a motion; of a robot torques and tracking error, too."""
    clearance, phase, *of_robot = panels
    color = _COLORS.get(name)
    clearance.plot(log.t, metrics.tool_clearance, color=color, label=f"{name}, tool")
    phase.plot(log.t, log.phase, color=color, label=f"{name}, phase k")
    if (log.speed_scale < 1.0).any():
        label = f"{name}, share of full speed"
        phase.plot(log.t, log.speed_scale, "--", color=color, label=label)
    if not of_robot:
        return
    torque, error = of_robot
    clearance.plot(log.t, metrics.robot_clearance, ":", color=color, label=f"{name}, any link")
    share = log.torque / log.effort_limit
    if each_joint:
        for joint, values in zip(log.actuator_name, share.T, strict=True):
            torque.plot(log.t, values, label=joint)
    else:
        largest = np.abs(share).max(axis=1, initial=0.0)
        torque.plot(log.t, largest, color="0.65", label=f"{name}, largest share")
    torque.set_ylim(-1.1, 1.1)
    distance = 1e3 * np.linalg.norm(log.p_WE - log.desired_position, axis=1)
    error.semilogy(log.t, np.maximum(distance, _MIN_ERROR), color=color, label=name)


def _draw_pauses(panels: Sequence[Axes], stopped: Sequence[Pause]) -> None:
    """Shades pauses in all panels, and lists them with their reasons in the second."""
    for ax in panels:
        for pause in stopped:
            color = _PAUSE_COLORS[pause.kind]
            ax.axvspan(pause.start, pause.end, color=color, alpha=0.45, zorder=0)
    lines = [
        shorten(f"{pause.start:.2f} s, {pause.kind}: {pause.reason}", 90, placeholder="...")
        for pause in stopped[:_MAX_LISTED]
    ]
    if len(stopped) > _MAX_LISTED:
        lines.append(f"and {len(stopped) - _MAX_LISTED} more")
    note = AnchoredText("\n".join(lines), "upper right", prop={"size": 7}, frameon=False)
    panels[1].add_artist(note)


def _draw_path(ax: Axes, name: str, log: MotionLog, P: FloatArray) -> None:
    """Draws the path of a motion, and over one another the obstacles as seen at several times."""
    count = len(log.observation_time)
    for row in np.linspace(0, count - 1, _OBSERVATIONS if count else 0).astype(int):
        seen = log.observation(row)
        for ellipsoid in zip(seen.p_WO, seen.R_WO, seen.semi_axes, strict=True):
            rim = outline(*ellipsoid, P)
            label = "obstacle as seen, dilated"
            ax.fill(*rim.T, facecolor=_OBSTACLE, edgecolor="none", alpha=0.08, label=label)
    ax.plot(*(P @ log.desired_position.T), color=_DESIRED, linewidth=3.5, label="desired")
    ax.plot(*(P @ log.p_WE.T), color=_COLORS.get(name), label=f"{name}, actual")
