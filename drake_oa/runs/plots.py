"""Figure of a logged run: clearance, phase, torques and the path."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import SubFigure

from drake_oa.common.files import saved_figure
from drake_oa.common.messages import FloatArray
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.report import motion_metrics
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.task import goal_steps

_COLORS = {"modulated": "#00798c", "preplanned": "#111111"}
_OBSTACLE, _DESIRED, _ENDS = "#d1495b", "#edae49", "#0072b2"
"""Colors of obstacles, of the desired path, and of start and goal."""
_PANELS = (
    ("distance to the nearest obstacle", "clearance [m]"),
    ("phase and speed", "phase, speed scale [1]"),
    ("joint torques against their limits", "torque / limit [1]"),
)
"""Titles and labels of the panels of a run; without a robot there are only the first two."""
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


def plot_run(path: Path, title: str, scenario: Scenario, logs: Mapping[str, MotionLog]) -> None:
    """Draws a run: panels over time on the left, the path from two sides on the right.

    Without a robot there are no torques.

    Args:
        path: the file of the figure.
        title: of the figure.
        scenario: scenario of the logs.
        logs: the motions of at least one instant, by name.

    Raises:
        OutputError: if the file cannot be written.
        ScenarioError: if the station of the scenario cannot be built.
    """
    start, goals = np.asarray(scenario.task.start), goal_steps(scenario.task)[:, 1:]
    along = int(np.argmax(np.abs(goals[0] - start)[:2]))
    for name, log in logs.items():
        title += f"\n{name}: {log.duration:.2f} s, ended by {log.stop_reason}"
    with saved_figure(path, 14.0, 10.0, title) as figure:
        left, right = cast("list[SubFigure]", figure.subfigures(1, 2, width_ratios=[1.35, 1.0]))
        panels = list(left.subplots(2 if scenario.robot is None else 3, 1, sharex=True))
        for name, log in logs.items():
            _draw_motion(panels, name, scenario, log)
        for ax, axes in zip(right.subplots(2, 1), ([0, 1], [along, 2]), strict=True):
            ax.plot(*start[axes], "o", color=_ENDS, markersize=9, zorder=3, label="start")
            ax.plot(*goals.T[axes], "*", color=_ENDS, markersize=9, zorder=3, label="goal")
            ax.set(xlabel=f"{'xyz'[axes[0]]} [m]", ylabel=f"{'xyz'[axes[1]]} [m]")
            ax.set_aspect("equal", adjustable="datalim")
            for name, log in logs.items():
                _draw_path(ax, name, log, axes)
            add_legend(ax, ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0))
        clearance = scenario.task.clearance
        label = f"requested, Δ = {clearance:g} m"
        panels[0].axhline(clearance, color="0.4", linestyle="--", label=label)
        panels[0].axhline(0.0, color=_OBSTACLE)
        for ax, (heading, label) in zip(panels, _PANELS, strict=False):
            ax.set(title=heading, ylabel=label)
            add_legend(ax, ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0))
        panels[-1].set_xlabel("time [s]")


def _draw_motion(panels: Sequence[Axes], name: str, scenario: Scenario, log: MotionLog) -> None:
    """Draws clearance, phase and speed of a motion; of a robot torques, too."""
    metrics, color = motion_metrics(scenario, log), _COLORS.get(name)
    clearance, phase, *of_robot = panels
    clearance.plot(log.t, metrics.tool_clearance, color=color, label=f"{name}, tool")
    phase.plot(log.t, log.phase, color=color, label=f"{name}, phase k")
    phase.plot(log.t, log.speed_scale, "--", color=color, label=f"{name}, speed scale")
    if not of_robot:
        return
    (torque,) = of_robot
    clearance.plot(log.t, metrics.robot_clearance, ":", color=color, label=f"{name}, any link")
    share = np.abs(log.torque / log.effort_limit).max(axis=1, initial=0.0)
    torque.plot(log.t, share, color=color, label=f"{name}, largest of all joints")


def _draw_path(ax: Axes, name: str, log: MotionLog, axes: list[int]) -> None:
    """Draws the path of a motion, and over one another the obstacles as seen at several times."""
    count = len(log.observation_time)
    turn = np.linspace(0.0, 2.0 * np.pi, 73)
    for row in np.linspace(0, count - 1, _OBSERVATIONS if count else 0).astype(int):
        seen = log.observation(row)
        for p_WO, R_WO, semi_axes in zip(seen.p_WO, seen.R_WO, seen.semi_axes, strict=True):
            # With R diag(a) = U S V^T, projected, the outline is U S (cos, sin).
            U, S, _ = np.linalg.svd((R_WO * semi_axes)[axes])
            rim: FloatArray = p_WO[axes] + np.stack([np.cos(turn), np.sin(turn)], axis=1) * S @ U.T
            label = "obstacle as seen, dilated"
            ax.fill(*rim.T, facecolor=_OBSTACLE, edgecolor="none", alpha=0.08, label=label)
    ax.plot(*log.desired_position.T[axes], color=_DESIRED, linewidth=3.5, label="desired")
    ax.plot(*log.p_WE.T[axes], color=_COLORS.get(name), label=f"{name}, actual")
