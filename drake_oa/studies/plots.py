"""Figures of the paper: box plots of familiar scenes, and the dead zone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from drake_oa.common.files import saved_figure
from drake_oa.policy.coupling import dead_zone_free_rate, original_rate
from drake_oa.runs.plots import add_legend
from drake_oa.studies.scenes.evaluation import Outcome, matched_term
from drake_oa.studies.scenes.paper_method import BETA, GAMMA
from drake_oa.studies.scenes.scenes import Scenes
from drake_oa.studies.scenes.suites import Case

_MIN_ERROR = 1e-6
"""Lower bound of drawn goal errors [m]; zero has no logarithm."""


def plot_familiar(path: Path, cases: Sequence[Case], outcomes: Mapping[str, Outcome]) -> None:
    """Draws the paper's boxes of clearance and convergence of every case, one row per method.

    Args:
        path: the file of the figure.
        cases: the cases that were run.
        outcomes: name of a method -> its outcome; a method without judged motions is omitted.

    Raises:
        OutputError: if the file cannot be written.
    """
    outcomes = {name: outcome for name, outcome in outcomes.items() if len(outcome.of())}
    labels = [case.label for case in cases]
    with saved_figure(path, 12.0, 8.0, "familiar") as figure:
        axes = figure.subplots(max(len(outcomes), 1), 2, squeeze=False)
        for (name, outcome), (left, right) in zip(outcomes.items(), axes, strict=False):
            judged = [outcome.of(label) for label in labels]
            left.boxplot([of.kept_clearance for of in judged])
            right.boxplot([np.maximum(of.goal_error, _MIN_ERROR) for of in judged])
            for ax in (left, right):
                ax.set_xticks(range(1, len(labels) + 1), labels, rotation=90.0)
            left.set(title=f"{name}: clearance", ylabel="least distance to the obstacle [m]")
            right.set(title=f"{name}: convergence", ylabel="distance to the goal [m]", yscale="log")


def plot_dead_zone(path: Path, scenes: Scenes, outcomes: Mapping[str, Outcome]) -> None:
    """Draws both terms over the heading, and clearances of methods over the offset.

    Args:
        path: the file of the figure.
        scenes: places of the point obstacle.
        outcomes: name of a method -> its outcome.
    """
    theta = np.linspace(-np.pi / 2, np.pi / 2, 1001)
    alpha, psi = matched_term(GAMMA)
    offset = 1e3 * scenes.center[:, 1]
    with saved_figure(path, 12.0, 4.0, "dead zone") as figure:
        rate, clearance = figure.subplots(1, 2)
        for name, values in (
            ("original", np.abs(original_rate(theta, GAMMA, BETA))),
            ("dead-zone free", dead_zone_free_rate(np.abs(theta), 0.0, alpha, psi, 0.0)),
        ):
            rate.plot(np.degrees(theta), values / alpha, label=name)
        rate.set(xlabel="heading from the obstacle [deg]", ylabel="turning rate / its peak")
        for name, outcome in outcomes.items():
            values = 1e3 * outcome.of().kept_clearance
            clearance.plot(offset[: len(values)], values, marker=".", label=name)
        clearance.axhline(1e3 * float(scenes.clearance[0]), linestyle="--", label="requested")
        clearance.set_xscale("symlog", linthresh=0.01)
        clearance.set(xlabel="obstacle off the line by [mm]", ylabel="clearance [mm]")
        for ax in (rate, clearance):
            add_legend(ax)
