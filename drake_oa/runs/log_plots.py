"""The figure of a logged run: clearance, phase, torques, tracking error and the path."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, takewhile
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from drake_oa.common.messages import FloatArray, HoldCause
from drake_oa.policy.dmp import local_frame
from drake_oa.runs.demonstration_plots import Taught, draw_shown
from drake_oa.runs.metrics import MotionMetrics
from drake_oa.runs.motion_log import MotionLog
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.task import goal_steps

_COLORS = {"modulated": "#00798c", "preplanned": "#111111"}
_JOINT_COLORS = ("#000000", "#e69f00", "#56b4e9", "#009e73", "#cc79a7", "#0072b2", "#d55e00")
"""Okabe and Ito's palette, which colour-blind readers can tell apart."""
_OBSTACLE = "#d1495b"
_PAUSE_COLORS = {"slow": "#f7e8b5", "hold": "#edae49", "held": "#edae49", "stop": "#d1495b"}
_LEAST_ERROR = 1e-3
"""Tracking errors below this are drawn as this [mm]: zero has no logarithm."""
_TOGETHER = 0.1
"""Holds of supervisor and policy that begin, or end, this near to each other are one [s]."""
_LISTED = 6
"""So many reasons of pauses are told at most."""
_SEEN_AT_LEAST = 0.05
"""An obstacle is drawn that was in this share of the observations."""
_MOVED = 0.02
"""One that went further than this [m] is drawn at several times."""
_CLEAR, _FAINT = 0.35, 0.06
"""Opacity of obstacles that were there at the end, and of those that were not."""
_NUMBER_SPACE = 0.02
"""Numbers of pauses nearer to each other than this share of the time are left out."""


@dataclass(frozen=True)
class Pause:
    """A time in which a motion was slowed, held or stopped.

    Attributes:
        start: when it began [s].
        end: when it ended, or the log did [s].
        kind: "slow", "hold" or "stop" by the supervisor; "held" by the policy itself.
        reason: why.
    """

    start: float
    end: float
    kind: str
    reason: str


def pauses(log: MotionLog) -> list[Pause]:
    """The pauses of a motion, in order of their beginning.

    A hold of the policy that lies within one of the supervisor's is the same pause: it is told
    once.
    """
    said = zip(log.supervision_action, log.supervision_reason, strict=True)
    found = [
        Pause(start, end, action, reason)
        for (start, end), (action, reason) in zip(
            _spans(log.supervision_time, log.simulated_time), said, strict=True
        )
        if action != "run"
    ]
    supervised = [(pause.start, pause.end) for pause in found if pause.kind != "slow"]
    for (start, end), hold, note in zip(
        _spans(log.event_time, log.simulated_time), log.event_hold, log.event, strict=True
    ):
        known = hold == HoldCause.SUPERVISOR or any(
            low - _TOGETHER <= start and end <= high + _TOGETHER for low, high in supervised
        )
        if hold != HoldCause.NONE and not known:
            found.append(Pause(start, end, "held", note))
    return sorted(found, key=lambda pause: pause.start)


def _spans(starts: FloatArray, end: float) -> list[tuple[float, float]]:
    """From each start to the next one, the last to the end."""
    times = [*starts.tolist(), end]
    return list(pairwise(times))


def outline(p_WO: FloatArray, R_WO: FloatArray, semi_axes: FloatArray, P: FloatArray) -> FloatArray:
    """The outline of an ellipsoid seen along a direction: its parallel projection.

    The points P (c + R diag(a) u), |u| = 1, fill the ellipse with the shape matrix
    Q = P R diag(a^2) R^T P^T; its rim is P c + Q^(1/2) (cos, sin).

    Args:
        p_WO: (3,) centre [m].
        R_WO: (3, 3) orientation.
        semi_axes: (3,) semi-axes [m].
        P: (2, 3) orthonormal directions of the picture's axes.

    Returns:
        (73, 2) points of the closed rim [m].
    """
    scaled = P @ (R_WO * semi_axes)
    value, vector = np.linalg.eigh(scaled @ scaled.T)
    turn = np.linspace(0.0, 2.0 * np.pi, 73)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    return np.asarray((P @ p_WO)[:, None] + (vector * np.sqrt(value)) @ circle).T


def draw_run(
    figure: Figure,
    title: str,
    scenario: Scenario,
    logs: Mapping[str, MotionLog],
    metrics: Mapping[str, MotionMetrics],
    shown: Taught | None = None,
) -> None:
    """Draws a run: panels over time on the left, the path from two sides on the right.

    Without a robot there are neither torques nor a tracking error.

    Args:
        figure: an empty figure with a constrained layout, some 14 x 10 inches.
        title: its title.
        scenario: the scenario of the logs.
        logs: the motions that have an instant, by name; pauses and joints are those of the
            modulated one, or of the only one there is.
        metrics: their metrics.
        shown: what was demonstrated, to be drawn beside the path; None: nothing.
    """
    parts: Any = figure.subfigures(1, 2, width_ratios=[1.35, 1.0])
    left, right = parts
    has_robot = scenario.robot is not None
    panels = left.subplots(4 if has_robot else 2, 1, sharex=True).tolist()
    above, side = right.subplots(2, 1)
    main = "modulated" if "modulated" in logs else next(iter(logs))
    ends = [
        f"{name}: {log.duration:.2f} s, ended by {log.stop_reason}" for name, log in logs.items()
    ]
    figure.suptitle("\n".join([title, *ends]), fontsize=11)

    _clearance(panels[0], scenario, logs, metrics)
    _phase(panels[1], logs, main)
    if has_robot:
        _torque(panels[2], logs, main)
        _error(panels[3], logs)
    for number, ax in enumerate(panels):
        # The panel of the phase has the key.
        _shade(ax, pauses(logs[main]), labelled=number == 1)
    _head(panels[1], "phase and speed", columns=3)
    panels[-1].set_xlabel("time [s]")
    panels[0].set_xlim(0.0, max(log.simulated_time for log in logs.values()) or 1.0)

    horizontal = local_frame(scenario.task.start, scenario.task.goal)[:, 0] * [1.0, 1.0, 0.0]
    length = float(np.linalg.norm(horizontal))
    along = horizontal / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
    views = (
        (above, np.eye(3)[:2], "x [m]", "y [m]", "path from above"),
        (
            side,
            np.stack([along, [0.0, 0.0, 1.0]]),
            "along the baseline [m]",
            "z [m]",
            "path from the side",
        ),
    )
    for ax, P, xlabel, ylabel, name in views:
        if shown is not None:
            draw_shown(ax, shown, P)
        _path(ax, scenario, logs, P)
        ax.set(xlabel=xlabel, ylabel=ylabel)
        _head(ax, name, columns=3)
        ax.set_aspect("equal", adjustable="datalim")
        ax.grid(color="0.92")
        ax.set_axisbelow(True)
    side.get_legend().remove()


def _color(name: str) -> str:
    return _COLORS.get(name, "#2e4057")


def _head(ax: Axes, title: str, *, columns: int = 1) -> None:
    """The title above a panel on the left, the legend above it on the right: off the data."""
    ax.set_title(title, loc="left", fontsize=10)
    if ax.get_legend_handles_labels()[1]:
        ax.legend(
            fontsize=7,
            ncols=columns,
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
            frameon=False,
            borderaxespad=0.1,
            columnspacing=1.2,
        )


def _clearance(
    ax: Axes,
    scenario: Scenario,
    logs: Mapping[str, MotionLog],
    metrics: Mapping[str, MotionMetrics],
) -> None:
    lowest = 0.0
    for name, log in logs.items():
        found = metrics[name]
        ax.plot(log.t, found.tool_clearance, color=_color(name), label=f"{name}, tool")
        if scenario.robot is not None:
            ax.plot(
                log.t,
                found.robot_clearance,
                color=_color(name),
                linestyle=":",
                label=f"{name}, any link",
            )
        lowest = min(lowest, float(found.robot_clearance.min(initial=0.0)))
    asked = scenario.task.clearance
    ax.axhline(asked, color="0.4", linewidth=1.0, linestyle="--", label=f"asked, Δ = {asked:g} m")
    ax.axhline(0.0, color="black", linewidth=0.8)
    if lowest < 0.0:
        ax.axhspan(1.1 * lowest, 0.0, color=_OBSTACLE, alpha=0.15, linewidth=0.0)
    finite = any(np.isfinite(metrics[name].tool_clearance).any() for name in logs)
    title = "distance to the nearest obstacle"
    ax.set(ylabel="clearance [m]")
    _head(ax, title if finite else f"{title}: there is none", columns=3)


def _phase(ax: Axes, logs: Mapping[str, MotionLog], main: str) -> None:
    for name, log in logs.items():
        ax.plot(log.t, log.phase, color=_color(name), label=f"{name}, phase k")
    log = logs[main]
    if (log.speed_scale < 1.0).any():
        ax.plot(
            log.t,
            log.speed_scale,
            color=_color(main),
            linestyle="--",
            label=f"{main}, share of full speed",
        )
    ax.set(ylabel="phase, share [1]", ylim=(-0.03, 1.12))
    stopped = pauses(log)
    lines = [
        f"{number}  {pause.start:.2f} s, {pause.kind}: {pause.reason}"
        for number, pause in enumerate(stopped[:_LISTED], start=1)
    ]
    if len(stopped) > _LISTED:
        lines.append(f"and {len(stopped) - _LISTED} more")
    last = -np.inf
    for number, pause in enumerate(stopped[:_LISTED], start=1):
        middle = 0.5 * (pause.start + pause.end)
        if middle - last > _NUMBER_SPACE * log.simulated_time:
            ax.text(middle, 1.01, str(number), ha="center", va="bottom", fontsize=7)
            last = middle
    if lines:
        ax.text(
            0.99,
            0.84,
            "\n".join(line if len(line) < 90 else f"{line[:87]}..." for line in lines),
            transform=ax.transAxes,
            fontsize=7,
            ha="right",
            va="top",
            multialignment="left",
            bbox={"facecolor": "white", "alpha": 0.75, "edgecolor": "none"},
        )


def _shade(ax: Axes, told: list[Pause], *, labelled: bool = False) -> None:
    kinds: set[str] = set()
    for pause in told:
        ax.axvspan(
            pause.start,
            pause.end,
            color=_PAUSE_COLORS[pause.kind],
            alpha=0.45,
            linewidth=0.0,
            zorder=0,
            label=pause.kind if labelled and pause.kind not in kinds else None,
        )
        kinds.add(pause.kind)


def _torque(ax: Axes, logs: Mapping[str, MotionLog], main: str) -> None:
    """Each joint of the main motion, and the largest share of the other ones."""
    log = logs[main]
    ax.set(ylabel="torque / limit [1]")
    title = "joint torques against their limits"
    share = log.torque / log.effort_limit
    for joint, name in enumerate(_short(log.actuator_name)):
        known = joint < len(_JOINT_COLORS)
        ax.plot(
            log.t,
            share[:, joint],
            color=_JOINT_COLORS[joint] if known else "0.6",
            linewidth=1.2,
            linestyle="-" if known else ":",
            label=name,
        )
    for name, other in logs.items():
        if name != main:
            largest = np.abs(other.torque / other.effort_limit).max(axis=1, initial=0.0)
            label = f"{name}, largest share"
            ax.plot(other.t, largest, color="0.65", linewidth=1.0, zorder=1, label=label)
    for limit in (-1.0, 1.0):
        ax.axhline(limit, color="black", linewidth=0.8, linestyle="--")
    ax.set_ylim(-1.1, 1.1)
    _head(ax, title, columns=4)


def _short(names: Sequence[str]) -> list[str]:
    """The names without what all begin with."""
    same = takewhile(lambda letters: len(set(letters)) == 1, zip(*names, strict=False))
    begin = sum(1 for _ in same) if len(names) > 1 else 0
    return [name[begin:] for name in names]


def _error(ax: Axes, logs: Mapping[str, MotionLog]) -> None:
    for name, log in logs.items():
        error = 1e3 * np.linalg.norm(log.p_WE - log.desired_position, axis=1)
        ax.plot(log.t, np.maximum(error, _LEAST_ERROR), color=_color(name), label=name)
    ax.set(ylabel="error [mm]", yscale="log")
    _head(ax, "distance of the tool point to where it was asked to be", columns=2)


def _path(ax: Axes, scenario: Scenario, logs: Mapping[str, MotionLog], P: FloatArray) -> None:
    label: str | None = "obstacle as seen, dilated"
    for log in logs.values():
        for row, place, opacity in _shown_obstacles(log):
            ellipsoid = (log.p_WO[row, place], log.R_WO[row, place], log.semi_axes[row, place])
            rim = outline(*ellipsoid, P)
            shape = Polygon(rim, facecolor=_OBSTACLE, edgecolor="none", alpha=opacity, label=label)
            ax.add_patch(shape)
            label = None
    wanted: str | None = "desired"
    for name, log in logs.items():
        desired, actual = log.desired_position @ P.T, log.p_WE @ P.T
        ax.plot(*desired.T, color="#edae49", linewidth=3.5, label=wanted)
        wanted = None
        ax.plot(*actual.T, color=_color(name), linewidth=1.3, label=f"{name}, actual")
    *before, last = goal_steps(scenario.task)[:, 1:]
    for p_WG in before:
        at = P @ p_WG
        ax.plot(*at, color="#0072b2", marker="*", markersize=9, linestyle="none", alpha=_CLEAR)
    for name, p_WQ, marker in (("start", scenario.task.start, "o"), ("goal", last, "*")):
        at = P @ np.asarray(p_WQ)
        ax.plot(*at, color="#0072b2", marker=marker, markersize=9, linestyle="none", label=name)


def _shown_obstacles(log: MotionLog) -> list[tuple[int, int, float]]:
    """(row, place, opacity) of the ellipsoids to draw: each obstacle as seen last.

    Fainter: one that was gone at the end, and where one was before that moved away.
    """
    names = np.unique(log.obstacle_id[log.obstacle_id >= 0])
    shown = []
    for name in names:
        rows, places = np.nonzero(log.obstacle_id == name)
        if len(rows) < _SEEN_AT_LEAST * len(log.obstacle_id):
            continue
        centre = log.p_WO[rows, places]
        if float(np.linalg.norm(centre - centre[-1], axis=1).max()) > _MOVED:
            for k in np.linspace(0, len(rows) - 1, 5).astype(int)[:-1]:
                shown.append((int(rows[k]), int(places[k]), _FAINT))
        there = rows[-1] == len(log.obstacle_id) - 1
        shown.append((int(rows[-1]), int(places[-1]), _CLEAR if there else _FAINT))
    return shown
