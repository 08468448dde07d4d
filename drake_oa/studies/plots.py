"""Figures of an evaluation: the paper's box plots, its dead-zone figure, and histograms."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from drake_oa.common.messages import FloatArray
from drake_oa.policy.coupling import dead_zone_free_rate, original_rate
from drake_oa.runs.plots import add_legend, saved_figure
from drake_oa.studies.scenes.evaluation import Comparison, Outcome, matched_term
from drake_oa.studies.scenes.judge import Judgement
from drake_oa.studies.scenes.paper_method import BETA, GAMMA
from drake_oa.studies.scenes.scenes import Scenes
from drake_oa.studies.scenes.suites import FAMILIAR_CLEARANCES, Case

_BLACK, _RED, _BLUE = "#111111", "#d1495b", "#00798c"
_COLORS = {
    "original": _BLACK,
    "paper": _RED,
    "verified": _BLUE,
    "movement_primitives": "#edae49",
}
_OTHERS = ("#66a182", "#2e4057", "#8d96a3")
_MIN_ERROR = 1e-6
"""Lower bound of drawn goal errors [m]; zero has no logarithm."""
_DASHED = {"color": "0.5", "linewidth": 0.8, "linestyle": "--"}


def plot_evaluation(
    path: Path,
    suite: str,
    cases: Sequence[Case],
    outcomes: Mapping[str, Outcome],
) -> None:
    """Draws a suite: the paper's boxes of several cases, histograms of one case.

    Args:
        path: the file of the figure.
        suite: name of the suite.
        cases: the cases that were run.
        outcomes: name of a method -> its outcome; a method without judged motions is omitted.

    Raises:
        OutputError: if the file cannot be written.
    """
    outcomes = {name: outcome for name, outcome in outcomes.items() if len(outcome.of())}
    rows = max(len(outcomes), 1)
    width, height = (12.0, 3.8 * rows) if len(cases) > 1 else (10.0, 7.0)
    with saved_figure(path, width, height, suite) as figure:
        if len(cases) > 1:
            _draw_boxes(figure, cases, outcomes)
        else:
            judged = {name: outcome.of() for name, outcome in outcomes.items()}
            _draw_histograms(figure, judged)


def _styles(names: Iterable[str]) -> dict[str, str]:
    """Returns the color of each method."""
    return {name: _COLORS.get(name, _OTHERS[k % len(_OTHERS)]) for k, name in enumerate(names)}


def _draw_boxes(figure: Figure, cases: Sequence[Case], outcomes: Mapping[str, Outcome]) -> None:
    """Draws clearance and convergence of every case: two boxes per model, one row per method."""
    models = list(dict.fromkeys(case.label.partition(", tau")[0] for case in cases))
    at = np.arange(len(models))
    axes = figure.subplots(max(len(outcomes), 1), 2, squeeze=False)
    for (name, outcome), (left, right) in zip(outcomes.items(), axes, strict=False):
        for case in cases:
            judged, scaled = outcome.of(case.label), case.setting.scale_time
            color = _BLACK if scaled else _RED
            position = models.index(case.label.partition(", tau")[0]) + (-0.18 if scaled else 0.18)
            parts = ("box", "whisker", "cap", "median")
            errors = np.maximum(judged.goal_error, _MIN_ERROR)
            for ax, values in ((left, judged.kept_clearance), (right, errors)):
                ax.boxplot(
                    values,
                    positions=[position],
                    widths=0.3,
                    flierprops={"marker": ".", "markersize": 3, "markeredgecolor": color},
                    **{f"{part}props": {"color": color} for part in parts},
                )
            left.plot([], color=color, label="tau scaled" if scaled else "tau = 1")
        of_delta = at[-len(FAMILIAR_CLEARANCES) :]
        left.hlines(FAMILIAR_CLEARANCES, of_delta - 0.45, of_delta + 0.45, _BLUE, label="asked")
        left.axhline(0.0, color="0.6", linewidth=0.8)
        left.set(title=f"{name}: clearance", ylabel="least distance to the obstacle [m]")
        right.set(title=f"{name}: convergence", ylabel="distance to the goal [m]", yscale="log")
        for ax in (left, right):
            ax.set_xticks(at, [model.replace("lambda'", "λ′") for model in models])
            ax.set_xlim(-0.6, len(models) - 0.4)
        add_legend(left, loc="upper left")


def _draw_histograms(figure: Figure, judged: Mapping[str, Judgement]) -> None:
    """Draws the distributions of clearance, shortfall, goal error and path length."""
    styles = _styles(judged)
    finite = [j.rows(np.isfinite(j.kept_clearance)) for j in judged.values()]
    errors = [np.maximum(j.goal_error, _MIN_ERROR) for j in judged.values()]
    highest = max((float(values.max()) for values in errors), default=1.0)
    panels: tuple[tuple[str, list[FloatArray], int | FloatArray], ...] = (
        ("clearance [m]", [j.kept_clearance for j in finite], 80),
        (
            "clearance - min(Δ, distance of start, of goal) [m]",
            [j.kept_clearance - j.feasible for j in finite],
            80,
        ),
        (
            "distance to the goal at the end [m]",
            errors,
            np.geomspace(_MIN_ERROR, max(highest, 2.0 * _MIN_ERROR), 60),
        ),
        ("path length / baseline", [j.path_ratio for j in judged.values()], 80),
    )
    axes = figure.subplots(2, 2)
    for ax, (label, samples, bins) in zip(axes.flat, panels, strict=True):
        if samples:
            ax.hist(samples, bins, histtype="step", color=list(styles.values()), label=list(styles))
        ax.set(xlabel=label, ylabel="scenes", yscale="log")
    axes[1, 0].set_xscale("log")
    for delta in np.unique([delta for j in judged.values() for delta in j.asked])[:5]:
        axes[0, 0].axvline(delta, **_DASHED)
    axes[0, 0].axvline(0.0, color="black", linewidth=0.8)
    axes[0, 1].axvline(0.0, **_DASHED)
    add_legend(axes[0, 0])


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
        outcomes: name of a method -> its outcome; a method without judged motions is omitted.
        paths: name of a method -> (N, S + 1, 3) paths [m].
        terms: both terms at several gains.

    Raises:
        OutputError: if the file cannot be written.
    """
    styles = _styles(outcomes)
    theta = np.linspace(-np.pi / 2, np.pi / 2, 1001)
    alpha, psi = matched_term(GAMMA)
    rates = {
        "original": np.abs(original_rate(theta, GAMMA, BETA)),
        "dead-zone free": dead_zone_free_rate(np.abs(theta), 0.0, alpha, psi, 0.0),
    }
    x, y, _ = scenes.center[0, 0].tolist()
    offset = 1e3 * scenes.center[:, 0, 1]
    with saved_figure(path, 11.0, 7.5) as figure:
        rate, way, kept, alone = figure.subplots(2, 2).flat
        for (name, values), color in zip(rates.items(), (_BLACK, _RED), strict=True):
            rate.plot(np.degrees(theta), values / alpha, color=color, label=name)
        rate.set(
            xlabel="heading from the obstacle [deg]",
            ylabel="turning rate / its peak",
            title="terms of the same peak and area",
        )
        for name, some in paths.items():
            way.plot(*some[0, :, :2].T, color=styles[name], label=name)
        way.add_patch(Circle((x, y), float(scenes.semi_axes[0, 0, 0]), color="0.7"))
        way.set_aspect("equal", adjustable="datalim")
        way.set(xlabel="x [m]", ylabel="y [m]", title="head-on")

        for name, outcome in outcomes.items():
            clearance = 1e3 * outcome.of().kept_clearance
            some = offset[: len(clearance)]
            kept.plot(some, clearance, color=styles[name], marker=".", label=name)
        kept.axhline(1e3 * float(scenes.clearance[0]), **_DASHED)
        kept.set(title="methods (dashed: asked)")
        for item, style in zip(terms[:3], ("-", "--", ":"), strict=False):
            label = f"gamma = {item.gamma:g}"
            alone.plot(offset, 1e3 * item.original, style, color=_BLACK, label=label)
            alone.plot(offset, 1e3 * item.dead_zone_free, style, color=_RED)
        alone.set(title="terms alone, same peak and area")
        for ax in (kept, alone):
            ax.axhline(0.0, color="0.6", linewidth=0.8)
            ax.set_xscale("symlog", linthresh=0.01)
            ax.set(
                xlabel="obstacle off the line by [mm]",
                ylabel="clearance [mm]",
                xlim=(-0.001, 110.0),
            )
        for ax in (rate, way, kept, alone):
            add_legend(ax)
