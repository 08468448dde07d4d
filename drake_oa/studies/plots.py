"""Figures of the paper: box plots of familiar scenes, and the dead zone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.patches import Circle

from drake_oa.common.files import saved_figure
from drake_oa.common.messages import FloatArray
from drake_oa.policy.coupling import dead_zone_free_rate, original_rate
from drake_oa.runs.plots import add_legend
from drake_oa.studies.scenes.evaluation import Comparison, Outcome, matched_term
from drake_oa.studies.scenes.paper_method import BETA, GAMMA
from drake_oa.studies.scenes.scenes import Scenes
from drake_oa.studies.scenes.suites import FAMILIAR_CLEARANCES, Case

_MIN_ERROR = 1e-6
"""Lower bound of drawn goal errors [m]; zero has no logarithm."""


def plot_familiar(
    path: Path,
    cases: Sequence[Case],
    outcomes: Mapping[str, Outcome],
) -> None:
    """Draws the paper's boxes of clearance and convergence of every case, one row per method.

    Args:
        path: the file of the figure.
        cases: the cases that were run.
        outcomes: name of a method -> its outcome; a method without judged motions is omitted.

    Raises:
        OutputError: if the file cannot be written.
    """
    outcomes = {name: outcome for name, outcome in outcomes.items() if len(outcome.of())}
    models = list(dict.fromkeys(case.label.partition(", tau")[0] for case in cases))
    at = np.arange(len(models))
    with saved_figure(path, 12.0, 8.0, "familiar") as figure:
        axes = figure.subplots(max(len(outcomes), 1), 2, squeeze=False)
        for (name, outcome), (left, right) in zip(outcomes.items(), axes, strict=False):
            for scaled, shift, color in ((True, -0.18, "black"), (False, 0.18, "C1")):
                judged = [
                    outcome.of(case.label) for case in cases if case.setting.scale_time == scaled
                ]
                for ax, values in (
                    (left, [of.kept_clearance for of in judged]),
                    (right, [np.maximum(of.goal_error, _MIN_ERROR) for of in judged]),
                ):
                    style = {"boxprops": {"color": color}, "medianprops": {"color": color}}
                    ax.boxplot(values, positions=at + shift, widths=0.3, **style)
                    ax.set_xticks(at, models, rotation=20.0)
                left.plot([], color=color, label="tau scaled" if scaled else "tau = 1")
            left.plot(at[1:], FAMILIAR_CLEARANCES, "C0_", markersize=30.0, label="asked")
            left.set(title=f"{name}: clearance", ylabel="least distance to the obstacle [m]")
            right.set(title=f"{name}: convergence", ylabel="distance to the goal [m]", yscale="log")
            add_legend(left, loc="upper left", markerscale=0.5)


def plot_dead_zone(
    path: Path,
    scenes: Scenes,
    outcomes: Mapping[str, Outcome],
    paths: Mapping[str, FloatArray],
    terms: Sequence[Comparison],
) -> None:
    """Draws both terms over the heading, head-on paths, and clearances over the offset.

    Args:
        path: the file of the figure.
        scenes: places of the point obstacle.
        outcomes: name of a method -> its outcome.
        paths: name of a method -> (N, S + 1, 3) paths [m].
        terms: both terms at several gains.

    Raises:
        OutputError: if the file cannot be written.
    """
    theta = np.linspace(-np.pi / 2, np.pi / 2, 1001)
    alpha, psi = matched_term(GAMMA)
    offset = 1e3 * scenes.center[:, 0, 1]
    with saved_figure(path, 12.0, 8.0, "dead zone") as figure:
        (rate, way), (kept, alone) = figure.subplots(2, 2)
        for name, values in (
            ("original", np.abs(original_rate(theta, GAMMA, BETA))),
            ("dead-zone free", dead_zone_free_rate(np.abs(theta), 0.0, alpha, psi, 0.0)),
        ):
            rate.plot(np.degrees(theta), values / alpha, label=name)
        rate.set(xlabel="heading from the obstacle [deg]", ylabel="turning rate / its peak")
        for name, some in paths.items():
            way.plot(*some[0, :, :2].T, label=name)
        center = tuple(scenes.center[0, 0, :2].tolist())
        way.add_patch(Circle(center, float(scenes.semi_axes[0, 0, 0]), color="0.7"))
        way.set(xlabel="x [m]", ylabel="y [m]")
        way.set_aspect("equal", adjustable="datalim")
        for name, outcome in outcomes.items():
            clearance = 1e3 * outcome.of().kept_clearance
            kept.plot(offset[: len(clearance)], clearance, marker=".", label=name)
        kept.axhline(1e3 * float(scenes.clearance[0]), color="0.5", linestyle="--", label="asked")
        for item, style in zip(terms[:3], ("-", "--", ":"), strict=False):
            label = f"original, gamma = {item.gamma:g}"
            alone.plot(offset, 1e3 * item.original, f"C0{style}", label=label)
            alone.plot(offset, 1e3 * item.dead_zone_free, f"C1{style}")
        for ax in (kept, alone):
            ax.set_xscale("symlog", linthresh=0.01)
            ax.set(xlabel="obstacle off the line by [mm]", ylabel="clearance [mm]")
            ax.set_xlim(-0.001, 110.0)
        titles = ("terms of the same peak and area", "head-on", "methods", "these terms alone")
        for ax, title in zip(figure.axes, titles, strict=True):
            ax.set_title(title)
            add_legend(ax)
