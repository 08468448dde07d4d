"""Figures of logged runs and of demonstrations, and the style of all figures.

`plot_run` draws clearance, phase, torques, tracking error and the path of a logged run;
`plot_demonstrations` draws demonstrations and the motion that the movement primitive learned.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from textwrap import shorten
from typing import Any, NamedTuple

import numpy as np
from cycler import cycler
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.spatial import KDTree

from drake_oa.common.files import save_figure
from drake_oa.common.messages import FloatArray, HoldCause
from drake_oa.policy.dmp import local_frame, trajectory
from drake_oa.policy.orientation_dmp import orientation_along, vectors_from
from drake_oa.runs.metrics import MotionMetrics
from drake_oa.runs.motion_log import MotionLog
from drake_oa.scenario.demonstration import (
    demonstrated_orientation,
    demonstrated_path,
    read_demonstrations,
)
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.task import goal_steps

_PALETTE = ("#0072b2", "#d55e00", "#cc79a7", "#56b4e9", "#e69f00", "#000000", "#009e73")
"""Colors of Okabe and Ito that color-blind readers can distinguish."""
_STYLE: dict[Any, Any] = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.prop_cycle": cycler(color=_PALETTE),
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "figure.titlesize": 11,
    "grid.color": "0.92",
    "legend.borderaxespad": 0.1,
    "legend.columnspacing": 1.2,
    "legend.fontsize": 7,
    "legend.frameon": False,
}
"""Matplotlib settings of all figures."""
_COLORS = {"modulated": "#00798c", "preplanned": "#111111"}
_OBSTACLE, _DESIRED, _ENDS, _LEARNED = "#d1495b", "#edae49", "#0072b2", "#009e73"
"""Colors of obstacles, of the desired path, of start and goal, and of a learned motion."""
_PAUSE_COLORS = {"slow": "#f7e8b5", "hold": "#edae49", "held": "#edae49", "stop": "#d1495b"}
_MIN_ERROR = 1e-3
"""Lower bound of drawn tracking errors [mm]; zero has no logarithm."""
_SAME_HOLD_TOLERANCE = 0.1
"""Greatest difference between the times of a hold by supervisor and policy [s]."""
_MAX_LISTED = 6
"""Maximum number of pauses that are listed with their reasons."""
_MIN_SEEN_SHARE = 0.05
"""Share of the observations from which on an obstacle is drawn."""
_MOVED = 0.02
"""Distance from which on an obstacle is drawn at several times [m]."""
_CLEAR, _FAINT = 0.35, 0.06
"""Opacity of obstacles that were present at the end, and of others."""


@contextmanager
def saved_figure(path: Path, width: float, height: float, title: str = "") -> Iterator[Figure]:
    """Provides an empty figure in the common style and saves it after the block.

    Args:
        path: the file; its suffix gives the format.
        width: of the figure [inch].
        height: of the figure [inch].
        title: of the figure.

    Raises:
        OutputError: if the file cannot be written.
    """
    with rc_context(_STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        figure.suptitle(title)
        yield figure
        save_figure(path, figure, dpi=140)


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
    """Returns the pauses of a motion in order of their beginning.

    A hold of the policy within a hold of the supervisor is omitted.
    """

    def intervals(starts: FloatArray) -> Iterable[tuple[float, float]]:
        return pairwise([*starts.tolist(), log.simulated_time])

    supervision = zip(
        intervals(log.supervision_time),
        log.supervision_action,
        log.supervision_reason,
        strict=True,
    )
    found = [
        Pause(*span, action, reason) for span, action, reason in supervision if action != "run"
    ]
    supervised = [pause for pause in found if pause.kind != "slow"]
    events = zip(intervals(log.event_time), log.event_hold, log.event, strict=True)
    for (start, end), hold, note in events:
        if hold not in (HoldCause.NONE, HoldCause.SUPERVISOR) and not any(
            pause.start - _SAME_HOLD_TOLERANCE <= start and end <= pause.end + _SAME_HOLD_TOLERANCE
            for pause in supervised
        ):
            found.append(Pause(start, end, "held", note))
    return sorted(found)


def outline(p_WO: FloatArray, R_WO: FloatArray, semi_axes: FloatArray, P: FloatArray) -> FloatArray:
    """Returns the outline of an ellipsoid in parallel projection.

    The points P (c + R diag(a) u), |u| = 1, fill the ellipse with the shape matrix
    Q = P R diag(a^2) R^T P^T; its boundary is P c + Q^(1/2) (cos, sin).

    Args:
        p_WO: (3,) center [m].
        R_WO: (3, 3) orientation.
        semi_axes: (3,) semi-axes [m].
        P: (2, 3) orthonormal directions of the axes of the picture.

    Returns:
        (73, 2) points of the closed boundary [m].
    """
    scaled = P @ (R_WO * semi_axes)
    value, vector = np.linalg.eigh(scaled @ scaled.T)
    turn = np.linspace(0.0, 2.0 * np.pi, 73)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    return np.asarray((P @ p_WO)[:, None] + (vector * np.sqrt(value)) @ circle).T


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
    primitive = demonstrated_orientation(scenario)
    start, goal = np.asarray(task.start, dtype=float), np.asarray(task.goal, dtype=float)
    R_WL = float(np.linalg.norm(goal - start)) * local_frame(start, goal)
    path = KDTree(way.p)

    def with_turn(p: FloatArray, R: FloatArray | None) -> FloatArray:
        return p if R is None else np.hstack([p, np.degrees(vectors_from(R, 0))])

    found = Demonstrations([], [], [], way.s, way.p, [])
    for one in read_demonstrations(task):
        first, last = one.path[0], one.path[-1]
        local = (one.path - last) @ local_frame(first, last) / np.linalg.norm(last - first)
        placed = goal + local @ R_WL.T
        elapsed = one.t - one.t[0]
        found.durations.append(float(elapsed[-1]))
        found.s.append(elapsed / elapsed[-1])
        found.samples.append(with_turn(placed, one.orientations))
        found.errors.append(float(np.sqrt((path.query(placed)[0] ** 2).mean())))
    if primitive is not None:
        R = orientation_along(primitive, primitive.first, primitive.last, way.s)
        found = found._replace(motion=with_turn(way.p, R))
    return found


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
        panels = _add_panels(
            figure,
            shown.motion.shape[1],
            scenario,
            lambda ax, P: _draw_demonstrations(ax, shown, P),
        )
        labels = [f"{axis} [m]" for axis in "xyz"] + [f"turn about {axis} [deg]" for axis in "xyz"]
        for column, (ax, label) in enumerate(zip(panels, labels, strict=False)):
            for s, samples in zip(shown.s, shown.samples, strict=True):
                ax.plot(s, samples[:, column], marker=".", markersize=2.0, linewidth=0.5)
            motion = shown.motion[:, column]
            ax.plot(shown.motion_s, motion, color=_LEARNED, label="learned")
            ax.set_ylabel(label)
        _finish(panels[0], "placed between start and goal of the task")
        panels[-1].set_xlabel("normalized time [1]")


def plot_run(
    path: Path,
    title: str,
    scenario: Scenario,
    logs: Mapping[str, MotionLog],
    metrics: Mapping[str, MotionMetrics],
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
        metrics: metrics of the motions.
        shown: demonstrations that are drawn beside the path; None: none.

    Raises:
        OutputError: if the file cannot be written.
    """
    main = "modulated" if "modulated" in logs else next(iter(logs))
    stopped = pauses(logs[main])
    ends = [
        f"{name}: {log.duration:.2f} s, ended by {log.stop_reason}" for name, log in logs.items()
    ]

    def draw_view(ax: Axes, P: FloatArray) -> None:
        if shown is not None:
            _draw_demonstrations(ax, shown, P)
        _draw_path(ax, scenario, logs, P)

    with saved_figure(path, 14.0, 10.0, "\n".join([title, *ends])) as figure:
        panels = _add_panels(figure, 2 if scenario.robot is None else 4, scenario, draw_view)
        _draw_clearance(panels[0], scenario, logs, metrics)
        _draw_phase(panels[1], logs, main, stopped)
        if scenario.robot is not None:
            _draw_torque(panels[2], logs, main)
            _draw_error(panels[3], logs)
        for ax in panels:
            for pause in stopped:
                color = _PAUSE_COLORS[pause.kind]
                ax.axvspan(*pause[:2], color=color, alpha=0.45, linewidth=0.0, zorder=0)
        panels[-1].set_xlabel("time [s]")
        panels[0].set_xlim(0.0, max(log.simulated_time for log in logs.values()) or 1.0)


def _add_panels(
    figure: Figure,
    count: int,
    scenario: Scenario,
    draw_view: Callable[[Axes, FloatArray], None],
) -> list[Axes]:
    """Adds panels over time on the left, and two views of the path on the right.

    Args:
        figure: an empty figure.
        count: number of the panels.
        scenario: scenario of the path.
        draw_view: draws the path, given the axes and their (2, 3) directions in the world.

    Returns:
        The panels.
    """
    parts: Any = figure.subfigures(1, 2, width_ratios=[1.35, 1.0])
    start, goal = np.asarray(scenario.task.start), goal_steps(scenario.task)[:, 1:]
    along = local_frame(scenario.task.start, scenario.task.goal)[:, 0] * [1.0, 1.0, 0.0]
    length = float(np.linalg.norm(along))
    along = along / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
    above, side = parts[1].subplots(2, 1)
    views = (
        (above, np.eye(3)[:2], "x [m]", "y [m]", "path from above"),
        (side, np.stack([along, np.eye(3)[2]]), "along the baseline [m]", "z [m]", ""),
    )
    for ax, P, xlabel, ylabel, title in views:
        draw_view(ax, P)
        marks = {"color": _ENDS, "linestyle": "none", "markersize": 9}
        ax.plot(*(goal[:-1] @ P.T).T, marker="*", alpha=_CLEAR, **marks)
        ax.plot(*(P @ start), marker="o", label="start", **marks)
        ax.plot(*(P @ goal[-1]), marker="*", label="goal", **marks)
        ax.set(xlabel=xlabel, ylabel=ylabel)
        ax.set_aspect("equal", adjustable="datalim")
        if title:
            _finish(ax, title)
    return list(parts[0].subplots(count, 1, sharex=True))


def _finish(ax: Axes, title: str) -> None:
    """Sets the title above axes on the left, and the legend on the right."""
    ax.set_title(title)
    add_legend(ax, ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0))


def _draw_demonstrations(ax: Axes, shown: Demonstrations, P: FloatArray) -> None:
    """Draws the samples and the learned motion along the directions P (2, 3)."""
    style: Any = {"color": "0.55", "marker": ".", "markersize": 1.5, "linewidth": 0.5}
    for samples in shown.samples:
        ax.plot(*(P @ samples[:, :3].T), label="demonstrated", **style)
    motion = P @ shown.motion[:, :3].T
    ax.plot(*motion, color=_LEARNED, linestyle="--", linewidth=1.2, label="learned", zorder=3)


def _color(name: str) -> str:
    return _COLORS.get(name, "#2e4057")


def _draw_clearance(
    ax: Axes,
    scenario: Scenario,
    logs: Mapping[str, MotionLog],
    metrics: Mapping[str, MotionMetrics],
) -> None:
    lowest = 0.0
    for name, log in logs.items():
        found, color = metrics[name], _color(name)
        ax.plot(log.t, found.tool_clearance, color=color, label=f"{name}, tool")
        if scenario.robot is not None:
            ax.plot(log.t, found.robot_clearance, ":", color=color, label=f"{name}, any link")
        lowest = min(lowest, float(found.robot_clearance.min(initial=0.0)))
    asked = scenario.task.clearance
    ax.axhline(asked, color="0.4", linewidth=1.0, linestyle="--", label=f"asked, Δ = {asked:g} m")
    ax.axhline(0.0, color="black", linewidth=0.8)
    ax.axhspan(1.1 * lowest, 0.0, color=_OBSTACLE, alpha=0.15, linewidth=0.0)
    ax.set(ylabel="clearance [m]")
    _finish(ax, "distance to the nearest obstacle")


def _draw_phase(ax: Axes, logs: Mapping[str, MotionLog], main: str, stopped: list[Pause]) -> None:
    for name, log in logs.items():
        ax.plot(log.t, log.phase, color=_color(name), label=f"{name}, phase k")
    log = logs[main]
    if (log.speed_scale < 1.0).any():
        label = f"{main}, share of full speed"
        ax.plot(log.t, log.speed_scale, "--", color=_color(main), label=label)
    ax.set(ylabel="phase, share [1]", ylim=(-0.03, 1.12))
    lines = [
        shorten(f"{pause.start:.2f} s, {pause.kind}: {pause.reason}", 90, placeholder="...")
        for pause in stopped[:_MAX_LISTED]
    ]
    if len(stopped) > _MAX_LISTED:
        lines.append(f"and {len(stopped) - _MAX_LISTED} more")
    ax.text(
        0.99,
        0.84,
        "\n".join(lines),
        transform=ax.transAxes,
        fontsize=7,
        ha="right",
        va="top",
        multialignment="left",
        bbox={"facecolor": "white", "alpha": 0.75, "edgecolor": "none"},
    )
    _finish(ax, "phase and speed")


def _draw_torque(ax: Axes, logs: Mapping[str, MotionLog], main: str) -> None:
    """Draws each joint of the main motion, and the largest share of the others."""
    for name, log in logs.items():
        share = log.torque / log.effort_limit
        if name == main:
            for joint, values in zip(log.actuator_name, share.T, strict=True):
                ax.plot(log.t, values, linewidth=1.2, label=joint)
        else:
            largest = np.abs(share).max(axis=1, initial=0.0)
            label = f"{name}, largest share"
            ax.plot(log.t, largest, color="0.65", linewidth=1.0, zorder=1, label=label)
    for limit in (-1.0, 1.0):
        ax.axhline(limit, color="black", linewidth=0.8, linestyle="--")
    ax.set(ylabel="torque / limit [1]", ylim=(-1.1, 1.1))
    _finish(ax, "joint torques against their limits")


def _draw_error(ax: Axes, logs: Mapping[str, MotionLog]) -> None:
    for name, log in logs.items():
        error = 1e3 * np.linalg.norm(log.p_WE - log.desired_position, axis=1)
        ax.plot(log.t, np.maximum(error, _MIN_ERROR), color=_color(name), label=name)
    ax.set(ylabel="error [mm]", yscale="log")
    _finish(ax, "distance of the tool point from its desired position")


def _draw_path(ax: Axes, scenario: Scenario, logs: Mapping[str, MotionLog], P: FloatArray) -> None:
    for name, log in logs.items():
        for row, place, opacity in _shown_obstacles(log):
            ellipsoid = (log.p_WO[row, place], log.R_WO[row, place], log.semi_axes[row, place])
            ax.fill(
                *outline(*ellipsoid, P).T,
                facecolor=_OBSTACLE,
                edgecolor="none",
                alpha=opacity,
                label="obstacle as seen, dilated",
            )
        desired = P @ log.desired_position.T
        ax.plot(*desired, color=_DESIRED, linewidth=3.5, label="desired")
        ax.plot(*(P @ log.p_WE.T), color=_color(name), linewidth=1.3, label=f"{name}, actual")


def _shown_obstacles(log: MotionLog) -> Iterator[tuple[int, int, float]]:
    """Yields (row, place, opacity) of the ellipsoids to draw: each obstacle as seen last.

    Obstacles that were gone at the end, and earlier places of those that moved, are fainter.
    """
    for track in np.unique(log.obstacle_id[log.obstacle_id >= 0]):
        seen = np.argwhere(log.obstacle_id == track)
        if len(seen) < _MIN_SEEN_SHARE * len(log.obstacle_id):
            continue
        centers = log.p_WO[*seen.T]
        *earlier, last = seen[np.linspace(0, len(seen) - 1, 5).astype(int)].tolist()
        if float(np.linalg.norm(centers - centers[-1], axis=1).max()) > _MOVED:
            yield from ((*place, _FAINT) for place in earlier)
        yield (*last, _CLEAR if last[0] == len(log.obstacle_id) - 1 else _FAINT)
