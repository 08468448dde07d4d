"""Runs methods on the same scenes, batch by batch, has them judged, and sums up the judgements.

Figures are what an evaluation's JSON holds; meters and seconds.

The paper's dead-zone figure: both coupling terms, as strong, on the same action level. For each
gain gamma of the original term (eq. 7), gamma theta exp(-beta |theta|), the dead-zone free term
(eq. 8) of the same peak, gamma / (beta e), and of the same area over the heading, gamma / beta^2 to
each side; kappa = 0, as the original term knows no distance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from drake_oa.common.console import Column, TextTable, progress_bar
from drake_oa.common.files import software_versions
from drake_oa.evaluation.scenes.ground_truth import GroundTruthResult, evaluate_motions
from drake_oa.evaluation.scenes.methods import Method
from drake_oa.evaluation.scenes.paper_method import BETA, released_motions
from drake_oa.evaluation.scenes.scenes import Scenes, Setting

BATCH = 100
"""Number of scenes that a method receives at once."""


class Outcome(NamedTuple):
    """Judgements of one method, by the label of the setting, and its computing time [s]."""

    judged: dict[str, GroundTruthResult]
    seconds: float

    def of(self, *labels: str) -> GroundTruthResult:
        """Returns the judgement in some settings, in all without any label."""
        return GroundTruthResult.joined([self.judged[label] for label in labels or self.judged])


def evaluate(
    name: str,
    method: Method,
    scenes: Scenes,
    settings: Sequence[Setting],
    judged_among: Callable[[Scenes], Scenes] = lambda scenes: scenes,
) -> Outcome:
    """Runs a method on all scenes in each setting.

    Args:
        name: of the method.
        method: the method.
        scenes: the scenes.
        settings: the ways in which each is run.
        judged_among: of the scenes of a batch, those that its motions are judged among.
    """
    judged, seconds, done = {}, 0.0, 0
    with progress_bar(len(settings) * len(scenes)) as update:
        for setting in settings:
            parts = []
            for first in range(0, len(scenes), BATCH):
                some = setting.of(scenes.rows(slice(first, first + BATCH)))
                begin = perf_counter()
                motions = method(some, setting)
                seconds += perf_counter() - begin
                parts.append(evaluate_motions(judged_among(some), motions))
                done += len(some)
                update(f"{name} {done}", done)
            judged[setting.label] = GroundTruthResult.joined(parts)
    return Outcome(judged, seconds)


def over(statistic: Callable[..., Any], values: Iterable[float | None]) -> float | None:
    """Returns a statistic of the values that are not None; None if there are none."""
    known = [value for value in values if value is not None]
    return float(statistic(known)) if known else None


def evaluation_metrics(
    suite: str, seed: int | None, settings: Sequence[Setting], outcomes: Mapping[str, Outcome]
) -> dict[str, Any]:
    """Returns {"suite", "seed", "versions", "methods": {name: figures}}; see `method_metrics`.

    Args:
        suite: the suite's name.
        seed: of the scenes; None for scenes without one.
        settings: in which the scenes were run.
        outcomes: name of a method -> its outcome.
    """
    return {
        "suite": suite,
        "seed": seed,
        "versions": software_versions(),
        "methods": {name: method_metrics(outcome, settings) for name, outcome in outcomes.items()},
    }


def method_metrics(outcome: Outcome, settings: Sequence[Setting]) -> dict[str, Any]:
    """Returns the figures of one method.

    `motion_statistics` over the suite's scenes; with several settings, over those that ask for
    a clearance and scale the duration, and `settings` has each by its label. Besides:
    `seconds` (computing time in all settings) and, for scenes of several baselines,
    `by_baseline`.
    """
    main = [setting.label for setting in settings if setting.constrained and setting.scale_time]
    judged = outcome.of(*main)
    metrics = motion_statistics(judged) | {"seconds": outcome.seconds}
    if len(settings) > 1:
        metrics["covers"] = main
        metrics["settings"] = {of.label: motion_statistics(outcome.of(of.label)) for of in settings}
    baselines = np.unique(judged.baseline)
    if len(baselines) > 1:
        metrics["by_baseline"] = [
            {"baseline": float(L), **motion_statistics(judged.rows(judged.baseline == L))}
            for L in baselines
        ]
    return metrics


def motion_statistics(judged: GroundTruthResult) -> dict[str, Any]:
    """Returns the figures of a batch of motions; None where there is nothing to average.

    Keys: `scenes`, `collisions`, `clearance_mean`, `clearance_mean_feasible` (over the scenes where
    Delta itself is feasible), `clearance_min`, `clearance_max`, `clearance_shortfall` (more than 1 mm
    short of min(Delta, distance of start, of goal)), `goal_error_mean`, `goal_error_max`,
    `path_ratio_mean`.
    """
    known = np.isfinite(judged.min_clearance)
    clearance = judged.min_clearance[known]
    achievable_clearance = known & (judged.achievable_clearance >= judged.requested - 1e-12)
    return {
        "scenes": len(judged),
        "collisions": int(judged.collided.sum()),
        "clearance_mean": over(np.mean, clearance),
        "clearance_mean_feasible": over(np.mean, judged.min_clearance[achievable_clearance]),
        "clearance_min": over(np.min, clearance),
        "clearance_max": over(np.max, clearance),
        "clearance_shortfall": int(judged.is_short.sum()),
        "goal_error_mean": over(np.mean, judged.goal_error),
        "goal_error_max": over(np.max, judged.goal_error),
        "path_ratio_mean": over(np.mean, judged.path_ratio),
    }


_COLUMNS = (
    Column("collisions"),
    Column("clearance_mean", "clearance mean [m]", "{:.3f}"),
    Column("clearance_mean_feasible", "where feasible [m]", "{:.3f}"),
    Column("clearance_min", "min [m]", "{:.4f}"),
    Column("clearance_shortfall", "short"),
    Column("goal_error_max", "goal error max [mm]", "{:.3f}", 1e3),
    Column("path_ratio_mean", "path ratio", "{:.3f}"),
)


def evaluation_tables(metrics: Mapping[str, Any], notes: Sequence[str] = ()) -> list[TextTable]:
    """Tabulates all methods side by side; then each setting, or each baseline.

    Args:
        metrics: as `evaluation_metrics` makes them.
        notes: lines below the first table.
    """
    methods: Mapping[str, Any] = metrics["methods"]
    rows = [{"name": name, **method} for name, method in methods.items()]
    tables = [TextTable((Column("name", "method"), *_COLUMNS), rows, notes)]
    for name, method in methods.items():
        parts = method.get("settings", {}) | {
            f"goal at {part['baseline']:g} m": part for part in method.get("by_baseline", ())
        }
        if parts:
            rows = [{"name": label, **part} for label, part in parts.items()]
            tables.append(TextTable((Column("name", name), *_COLUMNS), rows))
    return tables


GAMMAS = (10.0, 30.0, 100.0, 300.0, 1000.0)


def matched_term(gamma: float) -> tuple[float, float]:
    """Returns alpha [rad/s] and psi [rad] of the same peak and area as the original term."""
    return gamma / (BETA * math.e), 2.0 * math.e / (BETA * math.sqrt(math.pi))


def compare_terms(scenes: Scenes) -> list[dict[str, float]]:
    """Runs both terms on all scenes at each gain, with the duration not scaled.

    Returns:
        A row for each gain: clearances [m] in the first scene, head-on, and scenes that touch.
    """
    setting = Setting(constrained=False, scale_time=False)
    rows = []
    for gamma in GAMMAS:
        row = {"gamma": gamma}
        for name, parameters in (
            ("original", (gamma, BETA, 0.0)),
            ("dead_zone_free", (*matched_term(gamma), 0.0)),
        ):
            is_original = name == "original"
            motions = released_motions(scenes, setting, np.array(parameters), original=is_original)
            clearance = evaluate_motions(scenes, motions).min_clearance
            row[f"{name}_head_on"] = float(clearance[0])
            row[f"{name}_collisions"] = int((clearance <= 0.0).sum())
        rows.append(row)
    return rows


def term_table(metrics: Sequence[dict[str, float]]) -> TextTable:
    """Tabulates the rows of `compare_terms`."""
    columns = (
        Column("gamma", "terms alone", "gamma = {:g}"),
        Column("original_head_on", "head-on: original [mm]", "{:.1f}", 1e3),
        Column("dead_zone_free_head_on", "dead-zone free [mm]", "{:.1f}", 1e3),
        Column("original_collisions", "collisions: original"),
        Column("dead_zone_free_collisions", "dead-zone free"),
    )
    return TextTable(columns, metrics)
