"""Plots of an evaluation: the paper's box plots, its dead-zone figure, histograms else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from drake_oa.common.files import save_figure
from drake_oa.common.messages import FloatArray
from drake_oa.policy.coupling import dead_zone_free_rate, original_rate
from drake_oa.studies.scenes.dead_zone import Comparison, matched_term
from drake_oa.studies.scenes.evaluation import Outcome
from drake_oa.studies.scenes.paper_method import BETA, GAMMA
from drake_oa.studies.scenes.scenes import Scenes
from drake_oa.studies.scenes.suites import FAMILIAR_CLEARANCES, Case

FORMATS = (".pdf", ".png", ".svg")

_COLORS = {
    "original": "#111111",
    "paper": "#d1495b",
    "verified": "#00798c",
    "movement_primitives": "#edae49",
}
_OTHERS = ("#66a182", "#2e4057", "#8d96a3")
_LEAST_ERROR = 1e-6
"""Goal errors below this are drawn as this [m]: they have no place on a logarithmic axis."""


def check_plot_file(path: Path) -> None:
    """Raises ValueError for a suffix that no plot can be written in."""
    if path.suffix not in FORMATS:
        raise ValueError(f"--plot must end in {', '.join(FORMATS)}, not {path.name!r}")


def plot_evaluation(
    path: Path,
    suite: str,
    cases: Sequence[Case],
    outcomes: Mapping[str, Outcome],
) -> None:
    """Draws a suite: the paper's boxes of several cases, else histograms.

    Args:
        path: a file of one of `FORMATS`.
        suite: the suite's name.
        cases: the cases that were run.
        outcomes: name of a method -> its outcome; one that judged nothing is left out.
    """
    drawn = {name: outcome for name, outcome in outcomes.items() if len(outcome.of())}
    if len(cases) > 1:
        figure = Figure(figsize=(12.0, 3.8 * max(len(drawn), 1)), layout="constrained")
        _boxes(figure, cases, drawn)
    else:
        figure = Figure(figsize=(10.0, 7.0), layout="constrained")
        _histograms(figure, suite, drawn)
    save_figure(path, figure, dpi=150)


def _color(name: str, k: int) -> str:
    return _COLORS.get(name, _OTHERS[k % len(_OTHERS)])


def _boxes(figure: Figure, cases: Sequence[Case], outcomes: Mapping[str, Outcome]) -> None:
    """Clearance and convergence of every case: a pair of boxes a model, a row a method."""
    axes = figure.subplots(max(len(outcomes), 1), 2, squeeze=False)
    models = list(dict.fromkeys(case.label.partition(", tau")[0] for case in cases))
    for row, (name, outcome) in enumerate(outcomes.items()):
        for case in cases:
            judged = outcome.of(case.label)
            if not len(judged):
                continue
            scaled = case.setting.scale_time
            at = models.index(case.label.partition(", tau")[0]) + (-0.18 if scaled else 0.18)
            errors = np.maximum(judged.goal_error, _LEAST_ERROR)
            for ax, values in ((axes[row, 0], judged.kept_clearance), (axes[row, 1], errors)):
                _box(ax, values, at, "black" if scaled else "#c1121f")
        for model, delta in enumerate(FAMILIAR_CLEARANCES, start=len(models) - 5):
            axes[row, 0].hlines(delta, model - 0.45, model + 0.45, "#00798c", linewidth=1.0)
        axes[row, 0].axhline(0.0, color="0.6", linewidth=0.8)
        axes[row, 0].set(title=f"{name}: clearance", ylabel="least distance to the obstacle [m]")
        axes[row, 1].set(title=f"{name}: convergence", ylabel="distance to the goal [m]")
        axes[row, 1].set_yscale("log")
        for ax in axes[row]:
            names = [model.replace("lambda'", "λ′") for model in models]
            ax.set_xticks(range(len(models)), names)
            ax.set_xlim(-0.6, len(models) - 0.4)
    axes[0, 0].plot([], [], color="black", label="tau scaled")
    axes[0, 0].plot([], [], color="#c1121f", label="tau = 1")
    axes[0, 0].plot([], [], color="#00798c", label="asked")
    axes[0, 0].legend(loc="upper left", fontsize=8)


def _box(ax: Axes, values: FloatArray, at: float, color: str) -> None:
    line = {"color": color}
    ax.boxplot(
        values,
        positions=[at],
        widths=0.3,
        boxprops=line,
        whiskerprops=line,
        capprops=line,
        medianprops=line,
        flierprops={"marker": ".", "markersize": 3, "markeredgecolor": color},
    )


def _histograms(figure: Figure, suite: str, outcomes: Mapping[str, Outcome]) -> None:
    axes = figure.subplots(2, 2)
    figure.suptitle(suite)
    judged = {name: outcome.of() for name, outcome in outcomes.items()}
    panels = (
        (
            "clearance [m]",
            {name: j.kept_clearance[np.isfinite(j.kept_clearance)] for name, j in judged.items()},
            False,
        ),
        (
            "clearance - min(Δ, distance of start, of goal) [m]",
            {
                name: (j.kept_clearance - j.feasible)[np.isfinite(j.kept_clearance)]
                for name, j in judged.items()
            },
            False,
        ),
        (
            "distance to the goal at the end [m]",
            {name: np.maximum(j.goal_error, _LEAST_ERROR) for name, j in judged.items()},
            True,
        ),
        ("path length / baseline", {name: j.path_ratio for name, j in judged.items()}, False),
    )
    for ax, (label, samples, logarithmic) in zip(axes.flat, panels, strict=True):
        values = np.concatenate([np.zeros(0), *samples.values()])
        if not len(values):
            continue
        low, high = float(values.min()), float(values.max())
        if logarithmic:
            bins = np.geomspace(low, max(high, 2.0 * low), 60)
            ax.set_xscale("log")
        else:
            bins = np.linspace(low, max(high, low + 1e-6), 80)
        for k, (name, sample) in enumerate(samples.items()):
            ax.hist(sample, bins, histtype="step", color=_color(name, k), linewidth=1.4, label=name)
        ax.set(xlabel=label, ylabel="scenes", yscale="log")
    for delta in np.unique(np.concatenate([np.zeros(0), *(j.asked for j in judged.values())]))[:5]:
        axes[0, 0].axvline(delta, color="0.5", linewidth=0.8, linestyle="--")
    axes[0, 0].axvline(0.0, color="black", linewidth=0.8)
    axes[0, 1].axvline(0.0, color="0.5", linewidth=0.8, linestyle="--")
    if axes[0, 0].get_legend_handles_labels()[1]:
        axes[0, 0].legend()


def plot_dead_zone(
    path: Path,
    scenes: Scenes,
    outcomes: Mapping[str, Outcome],
    paths: Mapping[str, FloatArray],
    terms: Sequence[Comparison],
) -> None:
    """Draws both terms over the heading, head-on paths, and clearances over the offset.

    Args:
        path: a file of one of `FORMATS`.
        scenes: the point obstacle's places.
        outcomes: name of a method -> its outcome; one that judged nothing is left out.
        paths: name of a method -> (N, S + 1, 3) paths [m].
        terms: both terms at several gains.
    """
    outcomes = {name: outcome for name, outcome in outcomes.items() if len(outcome.of())}
    figure = Figure(figsize=(11.0, 7.5), layout="constrained")
    rates, way, kept, alone = figure.subplots(2, 2).flat
    theta = np.linspace(-np.pi / 2, np.pi / 2, 1001)
    alpha, psi = matched_term(GAMMA)
    black, red = _COLORS["original"], _COLORS["paper"]
    original = np.abs(original_rate(theta, GAMMA, BETA)) / alpha
    free = dead_zone_free_rate(np.abs(theta), 0.0, alpha, psi, 0.0) / alpha
    rates.plot(np.degrees(theta), original, color=black, label="original")
    rates.plot(np.degrees(theta), free, color=red, label="dead-zone free")
    rates.set(
        xlabel="heading from the obstacle [deg]",
        ylabel="turning rate / its peak",
        title="terms of the same peak and area",
    )

    head_on = scenes.center[0, 0].tolist()
    for k, (name, some) in enumerate(paths.items()):
        way.plot(*some[0, :, :2].T, color=_color(name, k), label=name)
    way.add_patch(Circle((head_on[0], head_on[1]), float(scenes.semi_axes[0, 0, 0]), color="0.7"))
    way.set_aspect("equal", adjustable="datalim")
    way.set(xlabel="x [m]", ylabel="y [m]", title="head-on")

    offset = 1e3 * scenes.center[:, 0, 1]
    for k, (name, outcome) in enumerate(outcomes.items()):
        clearance = 1e3 * outcome.of().kept_clearance
        kept.plot(
            offset[: len(clearance)], clearance, color=_color(name, k), marker=".", label=name
        )
    kept.axhline(1e3 * float(scenes.clearance[0]), color="0.5", linewidth=0.8, linestyle="--")
    kept.set(title="methods (dashed: asked)")
    for item, style in zip(terms[:3], ("-", "--", ":"), strict=False):
        label = f"gamma = {item.gamma:g}"
        alone.plot(offset, 1e3 * item.original, color=black, linestyle=style, label=label)
        alone.plot(offset, 1e3 * item.dead_zone_free, color=red, linestyle=style)
    alone.set(title="terms alone, same peak and area")
    for ax in (kept, alone):
        ax.axhline(0.0, color="0.6", linewidth=0.8)
        ax.set_xscale("symlog", linthresh=0.01)
        ax.set_xlim(-0.001, 110.0)
        ax.set(xlabel="obstacle off the line by [mm]", ylabel="clearance [mm]")
    for ax in (rates, way, kept, alone):
        if ax.get_legend_handles_labels()[1]:
            ax.legend(fontsize=8)
    save_figure(path, figure, dpi=150)
