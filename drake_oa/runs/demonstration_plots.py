"""Demonstrations drawn: every sample of them, and the motion that the primitive learnt."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.spatial import KDTree

from drake_oa.common.messages import FloatArray
from drake_oa.policy.dmp import local_frame, trajectory
from drake_oa.policy.orientation_dmp import orientation_along, vectors_from
from drake_oa.scenario.demonstration import (
    demonstrated_orientation,
    demonstrated_path,
    read_demonstrations,
)
from drake_oa.scenario.scenario import Scenario

_SAMPLES, _LEARNT = "0.55", "#009e73"
_COLORS = ("#0072b2", "#d55e00", "#cc79a7", "#56b4e9", "#e69f00")
"""Of Okabe and Ito's palette: of the recordings, in turn."""


@dataclass(frozen=True, eq=False)
class Turn:
    """Rotation vectors r (T, 3) from the first orientation [rad] at shares s (T,) of the time."""

    s: FloatArray
    r: FloatArray


@dataclass(frozen=True, eq=False)
class Taught:
    """What demonstrations of a task are where the task is, and what is learnt of them.

    Attributes:
        s: of each recording (T_d,) shares of its time.
        p: of each (T_d, 3) positions [m], turned and scaled with the way from its own start and
            goal to the task's.
        durations: of each [s].
        turns: of each its orientations; empty: they have none.
        motion_s, motion_p: (N,) and (N, 3): the primitive's motion [m].
        motion_turn: its orientations; None: none were shown.
        off: of each recording how far its samples are from that motion's path, whatever the time,
            root mean square [m].
    """

    s: list[FloatArray]
    p: list[FloatArray]
    durations: list[float]
    turns: list[Turn]
    motion_s: FloatArray
    motion_p: FloatArray
    motion_turn: Turn | None
    off: list[float]


def taught(scenario: Scenario) -> Taught | None:
    """What is taught by the demonstrations of a scenario; None: it has none.

    Raises:
        ScenarioError: naming the file that cannot be read or imitated.
    """
    task = scenario.task
    if not task.demonstration:
        return None
    shown = read_demonstrations(task)
    way = trajectory(demonstrated_path(scenario), task.start, task.goal)
    start, goal = np.asarray(task.start, dtype=float), np.asarray(task.goal, dtype=float)
    scale, R_WL = float(np.linalg.norm(goal - start)), local_frame(start, goal)
    path = KDTree(way.p)
    shares, placed, turns, off = [], [], [], []
    for one in shown:
        first, last = one.path[0], one.path[-1]
        local = (one.path - last) @ local_frame(first, last) / np.linalg.norm(last - first)
        shares.append((one.t - one.t[0]) / (one.t[-1] - one.t[0]))
        placed.append(goal + scale * local @ R_WL.T)
        off.append(float(np.sqrt((path.query(placed[-1])[0] ** 2).mean())))
        if one.orientations is not None:
            turns.append(Turn(shares[-1], vectors_from(one.orientations, 0)))
    primitive = demonstrated_orientation(scenario)
    turn = None
    if primitive is not None:
        s = np.linspace(0.0, 1.0, 101)
        R = orientation_along(primitive, primitive.first, primitive.last, s)
        turn = Turn(s, vectors_from(R, 0))
    durations = [float(one.t[-1] - one.t[0]) for one in shown]
    return Taught(shares, placed, durations, turns, way.s, way.p, turn, off)


def draw_shown(ax: Axes, shown: Taught, P: FloatArray) -> None:
    """Draws the samples and what is learnt of them into a picture of a path.

    Args:
        ax: the picture.
        shown: what is drawn.
        P: (2, 3) orthonormal directions of the picture's axes.
    """
    label: str | None = "demonstrated"
    for p in shown.p:
        ax.plot(*(P @ p.T), color=_SAMPLES, marker=".", markersize=1.5, linewidth=0.5, label=label)
        label = None
    ax.plot(
        *(P @ shown.motion_p.T),
        color=_LEARNT,
        linewidth=1.2,
        linestyle="--",
        label="learnt",
        zorder=3,
    )


def draw_taught(figure: Figure, title: str, scenario: Scenario, shown: Taught) -> None:
    """Draws what a scenario is taught: position and orientation over time, and the path.

    Args:
        figure: an empty figure with a constrained layout, some 14 x 10 inches.
        title: its title.
        scenario: whose task it is.
        shown: of the same.
    """
    count, turns = len(shown.p), shown.motion_turn is not None
    spans = f"{min(shown.durations):.2f} to {max(shown.durations):.2f} s"
    off = ", ".join(f"{1e3 * value:.1f}" for value in shown.off)
    said = (
        f"{count} demonstration{'s' if count > 1 else ''} of "
        f"{spans if count > 1 else f'{shown.durations[0]:.2f} s'}, imitated by "
        f"{scenario.policy.n_basis} basis functions; the samples are {off} mm (rms) from that path"
    )
    figure.suptitle(f"{title}\n{said}", fontsize=11)
    parts: Any = figure.subfigures(1, 2, width_ratios=[1.35, 1.0])
    left, right = parts
    panels = left.subplots(6 if turns else 3, 1, sharex=True).tolist()
    for axis, name in enumerate("xyz"):
        for s, p, color in zip(shown.s, shown.p, _cycle(count), strict=True):
            panels[axis].plot(s, p[:, axis], color=color, marker=".", markersize=2.0, linewidth=0.5)
        panels[axis].plot(shown.motion_s, shown.motion_p[:, axis], color=_LEARNT, label="learnt")
        panels[axis].set_ylabel(f"{name} [m]")
    if shown.motion_turn is not None:
        for axis, name in enumerate("xyz"):
            for turn, color in zip(shown.turns, _cycle(count), strict=True):
                r = np.degrees(turn.r[:, axis])
                panels[3 + axis].plot(
                    turn.s, r, color=color, marker=".", markersize=2.0, linewidth=0.5
                )
            r = np.degrees(shown.motion_turn.r[:, axis])
            panels[3 + axis].plot(shown.motion_turn.s, r, color=_LEARNT)
            panels[3 + axis].set_ylabel(f"turn about {name} [deg]")
    panels[0].set_title("placed on the task's way", loc="left", fontsize=10)
    panels[0].legend(fontsize=7, loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False)
    panels[-1].set_xlabel("share of the time [1]")
    above, side = right.subplots(2, 1)
    way = np.asarray(scenario.task.goal) - np.asarray(scenario.task.start)
    along = way * [1.0, 1.0, 0.0]
    length = float(np.linalg.norm(along))
    along = along / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
    for ax, P, xlabel, ylabel, name in (
        (above, np.eye(3)[:2], "x [m]", "y [m]", "path from above"),
        (side, np.stack([along, [0.0, 0.0, 1.0]]), "along the way [m]", "z [m]", "from the side"),
    ):
        draw_shown(ax, shown, P)
        for label, p_WQ, marker in (
            ("start", scenario.task.start, "o"),
            ("goal", scenario.task.goal, "*"),
        ):
            at = P @ np.asarray(p_WQ)
            ax.plot(
                *at, color="#0072b2", marker=marker, markersize=9, linestyle="none", label=label
            )
        ax.set(xlabel=xlabel, ylabel=ylabel)
        ax.set_title(name, loc="left", fontsize=10)
        ax.set_aspect("equal", adjustable="datalim")
    above.legend(fontsize=7, ncols=4, loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False)
    for ax in (*panels, above, side):
        ax.grid(color="0.92")
        ax.set_axisbelow(True)


def _cycle(count: int) -> list[str]:
    return [_COLORS[row % len(_COLORS)] for row in range(count)]
