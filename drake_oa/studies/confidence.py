"""How well the probability that a chain tells agrees with what happens: reliability.

Three times: in new scenes of the kind that it was fitted to; in the suites of one ellipsoid a
scene, judged by `drake_oa.studies.scenes.judge`; and in whole runs of
the scenarios of `regulation: !Paper`, judged on the true shapes. What is asked is the same:
nothing is touched, of the clearance no more than `SHORT` lacks, the goal is missed by no more than
`MISSED`, in baselines.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drake_oa.common.console import TextTable
from drake_oa.common.messages import BoolArray, FloatArray
from drake_oa.policy.coupling import ALPHA, KAPPA, N_COLUMNS, NORMAL, PSI
from drake_oa.regulation.confidence import MISSED, SHORT
from drake_oa.regulation.regressor import ChainWeights, section_rows
from drake_oa.regulation.rollout import spatial_rollouts
from drake_oa.runs.report import motion_report
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario
from drake_oa.studies.scenes.judge import judge
from drake_oa.studies.scenes.methods import Motions
from drake_oa.studies.scenes.scenes import DURATION, Scenes
from drake_oa.studies.scenes.suites import draw_scenes
from drake_oa.studies.scenes.verified import spatial_scenes
from drake_oa.studies.tables import text_table
from drake_oa.training import confidence as measured

MEASURED = "as measured"
SUITES = ("novel", "posed", "hit", "head-on")
"""Suites of one ellipsoid a scene."""
SCENARIOS = ("paper_box", "paper_irregular", "paper_clutter", "paper_guidance")
"""Scenarios of `regulation: !Paper`."""

_END = measured.ConfidenceRecipe().end
_STEPS = 1000
_DRAWN = 20
"""Bins of fewer scenes than this are not drawn."""


def reliability(stated: FloatArray, in_range: BoolArray, kept: BoolArray) -> dict[str, Any]:
    """Figures of N scenes: of the probability, in all and inside and outside of the range.

    Args:
        stated: (N,) probability.
        in_range: (N,) what it stands in for.
        kept: (N,) whether what is asked was kept.

    Returns:
        By name, see `measured.Calibration`; None for a part without scenes.
    """
    parts = {
        "confidence": (stated, np.ones(len(kept), dtype=bool)),
        "confidence, inside": (stated, in_range),
        "confidence, outside": (stated, ~in_range),
        "in_range": (in_range.astype(float), np.ones(len(kept), dtype=bool)),
    }
    return {
        name: _figures(values[rows], kept[rows]) if rows.any() else None
        for name, (values, rows) in parts.items()
    }


def _figures(stated: FloatArray, kept: BoolArray) -> dict[str, Any]:
    told = measured.calibration(stated, kept)
    return {
        "scenes": len(kept),
        "kept": float(kept.mean()),
        "mean": float(stated.mean()),
        "error": told.error,
        "brier": told.brier,
        "bins": [list(row) for row in zip(*(v.tolist() for v in told[:3]), strict=True)],
    }


def as_measured(chain: ChainWeights, scenes: int, seed: int) -> dict[str, Any]:
    """Reliability in new scenes of the kind that the confidence was fitted to.

    Raises:
        ValueError: for a chain without a confidence, or of another action level.
    """
    drawn = measured.draw_scenes(chain, scenes, (seed, 2), _END)
    if chain.confidence is None:
        raise ValueError("the chain tells no confidence: drake-oa train --recipe confidence")
    stated = chain.confidence.probability(drawn.descriptor)
    return reliability(stated, drawn.in_range, drawn.kept)


def in_a_suite(chain: ChainWeights, suite: str, scenes: int, seed: int) -> dict[str, Any]:
    """Reliability among ellipsoids, one a scene, of what is told before the motion begins."""
    drawn = draw_scenes(suite, scenes, seed)
    L = drawn.baseline
    terms, stated, in_range = _asked(chain, drawn)
    rolled = spatial_rollouts(
        spatial_scenes(drawn, drawn.clearance),
        np.arange(scenes),
        terms,
        seconds=DURATION,
        steps=_STEPS,
        end=_END,
        keep_path=True,
    )
    last = np.full(scenes, _END * DURATION)
    judged = judge(drawn, Motions(rolled.path, rolled.velocity / DURATION, last, 0.0))
    kept = (
        ~judged.collided
        & (judged.kept_clearance >= judged.feasible - SHORT * L)
        & (judged.goal_error <= MISSED * L)
    )
    return reliability(stated, in_range, kept)


def _asked(chain: ChainWeights, scenes: Scenes) -> tuple[FloatArray, FloatArray, BoolArray]:
    """(N, 13) terms, (N,) probabilities and whether in range, of motions that set out straight."""
    x, eye, start = np.array([1.0, 0.0, 0.0]), np.eye(3), np.zeros(3)
    terms, stated = np.zeros((len(scenes), N_COLUMNS)), np.zeros(len(scenes))
    in_range = np.zeros(len(scenes), dtype=bool)
    for row in range(len(scenes)):
        obstacle = (scenes.center[row], scenes.R[row], scenes.semi_axes[row])
        extents, (plane,) = section_rows(start, x, eye, *map(np.ascontiguousarray, obstacle))
        along, *beside = scenes.center[row, 0]
        found = chain.parameters(
            extents, scenes.clearance[row], scenes.baseline[row], along, np.linalg.norm(beside)
        )
        terms[row, :3] = scenes.center[row, 0]
        terms[row, [ALPHA, PSI, KAPPA]] = found.as_array()[0]
        terms[row, NORMAL : NORMAL + 3] = np.cross(*plane)
        stated[row], in_range[row] = found.confidence[0], found.in_range[0]
    return terms, stated, in_range


def in_a_run(name: str, seed: int) -> dict[str, Any]:
    """What is told at the beginning of a run of a scenario, and what became of it."""
    scenario = load_scenario(name)
    scenario.seed = seed
    log = simulate(scenario)
    found = motion_report(scenario, log)
    told = log.least_confidence
    baseline = float(np.linalg.norm(np.subtract(scenario.task.goal, scenario.task.start)))
    first = np.flatnonzero(np.isfinite(told))[:1]
    kept = (
        found["collisions"] == 0
        and found["short_of_feasible"] <= SHORT * baseline
        and found["goal_error"] <= MISSED * baseline
    )
    return {
        "seed": seed,
        "stated": float(told[first[0]]) if len(first) else None,
        "least": found["confidence"],
        "in_range": found["out_of_range"] == 0.0,
        "kept": kept,
        "short_mm": 1e3 * found["short_of_feasible"],
        "goal_mm": 1e3 * found["goal_error"],
        "collisions": found["collisions"],
    }


def confidence_figures(
    chain: ChainWeights,
    scenes: int,
    suite_scenes: int,
    trials: int,
    seed: int,
    report: Callable[[str, float], None] = lambda stage, done: None,
) -> dict[str, Any]:
    """All of it, as the JSON holds it.

    Args:
        chain: the chain of `regulation: !Paper`.
        scenes: of the kind that the confidence was fitted to.
        suite_scenes: of each of `SUITES`.
        trials: runs of each of `SCENARIOS`, of consecutive seeds.
        seed: of all, the first of the trials.
        report: told how far it is.
    """
    stages = 1 + len(SUITES) + trials * len(SCENARIOS)
    report(MEASURED, 0.0)
    found: dict[str, Any] = {MEASURED: as_measured(chain, scenes, seed)}
    for suite in SUITES:
        report(suite, len(found) / stages)
        found[suite] = in_a_suite(chain, suite, suite_scenes, seed)
    runs: dict[str, list[dict[str, Any]]] = {name: [] for name in SCENARIOS}
    for k, name in enumerate(SCENARIOS):
        for trial in range(trials):
            report(name, (len(found) + k * trials + trial) / stages)
            runs[name].append(in_a_run(name, seed + trial))
    return {"seed": seed, "scenes": found, "runs": runs}


_COLUMNS = (
    ("scenes", "scenes", "{:,d}", 1.0),
    ("kept", "kept", "{:.3f}", 1.0),
    ("mean", "stated, mean", "{:.3f}", 1.0),
    ("error", "calibration error", "{:.4f}", 1.0),
    ("brier", "Brier score", "{:.4f}", 1.0),
)
_RUN_COLUMNS = (
    ("seed", "seed", "{:d}", 1.0),
    ("stated", "stated", "{:.2f}", 1.0),
    ("least", "least on the way", "{:.2f}", 1.0),
    ("in_range", "in range", "{!s}", 1.0),
    ("kept", "kept", "{!s}", 1.0),
    ("short_mm", "short by [mm]", "{:.1f}", 1.0),
    ("goal_mm", "goal error [mm]", "{:.1f}", 1.0),
)


def confidence_tables(whole: Mapping[str, Any]) -> list[TextTable]:
    """A table a kind of scenes, and one of the runs."""
    tables = [
        text_table(name, [(of, figures or {}) for of, figures in found.items()], _COLUMNS)
        for name, found in whole["scenes"].items()
    ]
    runs = [(name, run) for name, trials in whole["runs"].items() for run in trials]
    return [*tables, text_table("run", runs, _RUN_COLUMNS)] if runs else tables


def plot_reliability(path: Path, whole: Mapping[str, Any]) -> None:
    """Draws what happened over what was stated, and how often it was stated.

    Args:
        path: .png, .svg or .pdf.
        whole: of `confidence_figures`.
    """
    figure = Figure(figsize=(11.0, 6.5), layout="constrained")
    axes = figure.subplots(2, 2, height_ratios=[3.0, 1.0], sharex=True)
    found = whole["scenes"]
    inside, outside = ("confidence, inside", "confidence, outside")
    fitted = [
        ("confidence, inside of the trained range", found[MEASURED][inside], "#00798c"),
        ("confidence, outside", found[MEASURED][outside], "#edae49"),
        ("bare in_range", found[MEASURED]["in_range"], "#d1495b"),
    ]
    colors = ("#0072b2", "#009e73", "#cc79a7", "#e69f00")
    suites = [
        (f"{suite}, confidence", found[suite]["confidence"], color)
        for suite, color in zip(SUITES, colors, strict=True)
    ]
    _draw(axes[:, 0], "new scenes of the kind that it was fitted to", fitted)
    _draw(axes[:, 1], "suites of one ellipsoid a scene", suites)
    figure.savefig(path, dpi=110)


def _draw(
    axes: Sequence[Axes], title: str, shown: Sequence[tuple[str, Mapping[str, Any] | None, str]]
) -> None:
    above, below = axes
    above.plot([0.0, 1.0], [0.0, 1.0], color="0.6", linewidth=1.0, linestyle="--")
    for name, figures, color in shown:
        if figures is None:
            continue
        stated, happened, count = np.array(figures["bins"]).T
        shown_bins = count >= _DRAWN
        # Two standard errors of a share of so many.
        error = 2.0 * np.sqrt(happened * (1.0 - happened) / count)
        spread = np.clip([happened - error, happened + error], 0.0, 1.0) - happened
        line = "none" if name.startswith("bare") else "-"
        above.errorbar(
            stated[shown_bins],
            happened[shown_bins],
            np.abs(spread[:, shown_bins]),
            color=color,
            marker="o",
            markersize=4,
            linestyle=line,
            linewidth=1.2,
            label=f"{name}: calibration error {figures['error']:.3f}",
        )
        below.step(stated, count / count.sum(), where="mid", color=color, marker=".", markersize=4)
    above.set(ylabel="share kept [1]", xlim=(-0.03, 1.03), ylim=(-0.03, 1.03))
    above.set_title(title, loc="left", fontsize=10)
    above.legend(fontsize=8, loc="upper left")
    below.set(xlabel="stated probability [1]", ylabel="of the scenes [1]", yscale="log")
    for ax in axes:
        ax.grid(color="0.92")
        ax.set_axisbelow(True)
