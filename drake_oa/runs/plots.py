"""Figure of a logged run: clearances, phase and torques over time, and the path in two views."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import SubFigure

from drake_oa.common.files import saved_figure
from drake_oa.common.messages import FloatArray
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.report import motion_metrics
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.task import goal_steps

_COLORS = {"avoiding": "#00798c", "nominal": "#111111"}
"""Colors of the curves in the figure of a run, by the name of the motion."""
_OBSTACLE, _DESIRED, _ENDS = "#d1495b", "#edae49", "#0072b2"
"""Colors of the observed obstacles, of the desired path, and of start and goal in the figure of a
run."""
_PANELS = ("clearance [m]", "phase, speed scale [-]", "torque / limit [-]")
"""Labels of the vertical axes of the three plots over time, from top to bottom."""
_OBSERVATIONS = 6
"""Number of observations, evenly spaced in the log, whose obstacles are drawn in the path views."""


def plot_run(path: Path, title: str, scenario: Scenario, logs: Mapping[str, MotionLog]) -> None:
    """Plots a logged run to a file: signals over time on the left, the path from above and from the
    side on the right.

    Args:
        path: file of the figure; its suffix determines the format.
        title: title of the figure.
        scenario: scenario of the logs.
        logs: logs of motions with at least one instant, by the names of the motions.

    Raises:
        OutputError: if the file cannot be written.
        ScenarioError: if the scenario's world cannot be built.
    """
    task = scenario.task
    start, goals = np.asarray(task.start), goal_steps(task)[:, 1:]
    along = int(np.argmax(np.abs(goals[0] - start)[:2]))
    for name, log in logs.items():
        title += f"\n{name}: {log.duration:.2f} s, terminated by {log.stop_reason}"
    with saved_figure(path, 14.0, 10.0, title) as figure:
        left, right = cast("list[SubFigure]", figure.subfigures(1, 2, width_ratios=[1.35, 1.0]))
        panels, views = left.subplots(3, 1, sharex=True), right.subplots(2, 1)
        clearance, phase, torque = panels
        clearance.axhline(task.clearance, color="0.4", label=f"requested, {task.clearance:g} m")
        for name, log in logs.items():
            metrics, style = motion_metrics(scenario, log), {"color": _COLORS.get(name)}
            clearance.plot(log.t, metrics.tool_clearance, label=f"{name}, tool", **style)
            clearance.plot(log.t, metrics.robot_clearance, ":", label=f"{name}, robot", **style)
            phase.plot(log.t, log.phase, label=f"{name}, phase k", **style)
            phase.plot(log.t, log.speed_scale, "--", label=f"{name}, speed scale", **style)
            share = np.abs(log.torque / log.effort_limit).max(axis=1, initial=0.0)
            torque.plot(log.t, share, label=f"{name}, maximum of all joints", **style)
        torque.set_xlabel("time [s]")
        for ax, label in zip(panels, _PANELS, strict=True):
            ax.set_ylabel(label)
        for ax, axes in zip(views, ([0, 1], [along, 2]), strict=True):
            ax.plot(*start[axes], "o", color=_ENDS, label="start")
            ax.plot(*goals.T[axes], "*", color=_ENDS, label="goal")
            ax.set(xlabel=f"{'xyz'[axes[0]]} [m]", ylabel=f"{'xyz'[axes[1]]} [m]")
            ax.set_aspect("equal", adjustable="datalim")
            for name, log in logs.items():
                _draw_path(ax, name, log, axes)
        for ax in (*panels, *views):
            # Several curves share a label: the legend has each label once.
            handles, labels = ax.get_legend_handles_labels()
            entries = dict(zip(labels, handles, strict=True))
            ax.legend(
                entries.values(), entries, ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0)
            )


def _draw_path(ax: Axes, name: str, log: MotionLog, axes: list[int]) -> None:
    """Draws the desired and actual path of a motion, and the obstacles observed at several times,
    in one view.

    Args:
        ax: Matplotlib axes of the view.
        name: name of the motion.
        log: log of the motion.
        axes: indices of the two world coordinates of the view, horizontal one first.
    """
    count = len(log.observation_time)
    turn = np.linspace(0.0, 2.0 * np.pi, 73)
    for row in np.linspace(0, count - 1, _OBSERVATIONS if count else 0).astype(int):
        obstacles = log.observation(row)
        shapes = (obstacles.p_WO, obstacles.R_WO, obstacles.semi_axes)
        for p_WO, R_WO, semi_axes in zip(*shapes, strict=True):
            # With R diag(a) = U S V^T, projected, the outline is U S (cos, sin).
            U, S, _ = np.linalg.svd((R_WO * semi_axes)[axes])
            rim: FloatArray = p_WO[axes] + np.stack([np.cos(turn), np.sin(turn)], axis=1) * S @ U.T
            label = "obstacle as observed, dilated"
            ax.fill(*rim.T, facecolor=_OBSTACLE, edgecolor="none", alpha=0.08, label=label)
    ax.plot(*log.desired_position.T[axes], color=_DESIRED, linewidth=3.5, label="desired")
    ax.plot(*log.p_WE.T[axes], color=_COLORS.get(name), label=f"{name}, actual")
