"""Runs methods on the same scenes, batch by batch, has them judged, and sums up the judgements.

Figures are what an evaluation's JSON holds; metres and seconds.

The paper's dead-zone figure: both coupling terms, as strong, on the same action level. For each
gain gamma of the original term (eq. 7), gamma theta exp(-beta |theta|), the dead-zone free term
(eq. 8) of the same peak, gamma / (beta e), and of the same area over the heading, gamma / beta^2 to
each side; kappa = 0, as the original term knows no distance.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drake_oa.common.console import Column, TextTable
from drake_oa.studies.scenes.judge import Judgement, judge
from drake_oa.studies.scenes.methods import Method
from drake_oa.studies.scenes.paper_method import BETA, released_motions
from drake_oa.studies.scenes.scenes import Scenes, Setting
from drake_oa.studies.scenes.suites import Case

BATCH = 100
"""Number of scenes that a method receives at once."""


@dataclass
class Outcome:
    """Judgements of one method so far.

    Attributes:
        judged: label of each case -> the batches judged, in the order of the scenes.
        seconds: computing time [s].
        complete: whether all scenes were run in all cases.
        error: reason for which not, where the method failed.
    """

    judged: dict[str, list[Judgement]] = field(default_factory=dict)
    seconds: float = 0.0
    complete: bool = False
    error: str | None = None

    def of(self, *labels: str) -> Judgement:
        """Returns the judgement of some cases, of all without any label."""
        return Judgement.joined(
            [part for label in labels or self.judged for part in self.judged.get(label, [])]
        )


@dataclass(frozen=True)
class Evaluation:
    """Outcomes by the method's name, and whether it was interrupted before the end."""

    outcomes: dict[str, Outcome]
    interrupted: bool = False


def evaluate(
    scenes: Scenes,
    cases: Sequence[Case],
    methods: Mapping[str, Method],
    *,
    on_progress: Callable[[str, int], None] = lambda name, count: None,
    on_method: Callable[[Mapping[str, Outcome]], None] = lambda outcomes: None,
    judged_among: Callable[[Scenes], Scenes] = lambda scenes: scenes,
) -> Evaluation:
    """Runs each method on all scenes in each case.

    What was judged remains when a method fails, and when it is interrupted (Ctrl-C).

    Args:
        scenes: the scenes.
        cases: the ways in which each is run.
        methods: name -> method.
        on_progress: receives the method's name and the number of scenes judged since.
        on_method: receives all outcomes after each method.
        judged_among: of the scenes of a batch, those that its motions are judged among.

    Returns:
        The outcomes of the methods that were begun.
    """
    outcomes: dict[str, Outcome] = {}
    for name, method in methods.items():
        outcome = outcomes[name] = Outcome()
        try:
            for case in cases:
                parts = outcome.judged.setdefault(case.label, [])
                for first in range(0, len(scenes), BATCH):
                    some = case.of(scenes.rows(slice(first, first + BATCH)))
                    motions = method(some, case.setting)
                    parts.append(judge(judged_among(some), motions))
                    outcome.seconds += motions.seconds
                    on_progress(name, len(some))
            outcome.complete = True
        except KeyboardInterrupt:
            on_method(outcomes)
            return Evaluation(outcomes, interrupted=True)
        except Exception as error:
            # One method's failure, whatever it is, must not cost the others' results.
            outcome.error = f"{type(error).__name__}: {error}"
            logging.getLogger(__name__).info("where %s failed", name, exc_info=True)
        on_method(outcomes)
    return Evaluation(outcomes)


def over(statistic: Callable[..., Any], values: Iterable[float | None]) -> float | None:
    """Returns a statistic of the values that are not None; None if there are none."""
    known = [value for value in values if value is not None]
    return float(statistic(known)) if known else None


def evaluation_figures(
    suite: str,
    seed: int | None,
    versions: Sequence[str],
    cases: Sequence[Case],
    outcomes: Mapping[str, Outcome],
) -> dict[str, Any]:
    """Returns {"suite", "seed", "versions", "methods": {name: figures}}; see `method_figures`.

    Args:
        suite: the suite's name.
        seed: of the scenes; None for scenes without one.
        versions: "name version" each.
        cases: the cases that were run.
        outcomes: name of a method -> its outcome.
    """
    return {
        "suite": suite,
        "seed": seed,
        "versions": dict(item.split(" ", 1) for item in versions),
        "methods": {name: method_figures(outcome, cases) for name, outcome in outcomes.items()},
    }


def method_figures(outcome: Outcome, cases: Sequence[Case]) -> dict[str, Any]:
    """Returns the figures of one method.

    `motion_figures` over the suite's scenes; with several cases, over those that ask for
    a clearance and scale the duration, and `settings` has each case by its label. Besides:
    `seconds` (computing time of all cases), `complete`, `error` (where it failed) and, for scenes
    of several baselines, `by_baseline`.
    """
    main = [case.label for case in cases if case.setting.constrained and case.setting.scale_time]
    judged = outcome.of(*main)
    figures = motion_figures(judged)
    figures["seconds"] = outcome.seconds
    figures["complete"] = outcome.complete
    if outcome.error is not None:
        figures["error"] = outcome.error
    if len(cases) > 1:
        figures["covers"] = main
        figures["settings"] = {case.label: motion_figures(outcome.of(case.label)) for case in cases}
    baselines = np.unique(judged.baseline)
    if len(baselines) > 1:
        figures["by_baseline"] = [
            {"baseline": float(L), **motion_figures(judged.rows(judged.baseline == L))}
            for L in baselines
        ]
    return figures


def motion_figures(judged: Judgement) -> dict[str, Any]:
    """Returns the figures of a batch of motions; None where there is nothing to average.

    Keys: `scenes`, `collisions`, `clearance_mean`, `clearance_mean_feasible` (over the scenes where
    Delta itself is feasible), `clearance_min`, `clearance_max`, `short_of_feasible` (more than 1 mm
    short of min(Delta, distance of start, of goal)), `goal_error_mean`, `goal_error_max`,
    `path_ratio_mean`.
    """
    clearance = judged.kept_clearance[np.isfinite(judged.kept_clearance)]
    feasible = np.isfinite(judged.kept_clearance) & (judged.feasible >= judged.asked - 1e-12)
    return {
        "scenes": len(judged),
        "collisions": int(judged.collided.sum()),
        "clearance_mean": over(np.mean, clearance),
        "clearance_mean_feasible": over(np.mean, judged.kept_clearance[feasible]),
        "clearance_min": over(np.min, clearance),
        "clearance_max": over(np.max, clearance),
        "short_of_feasible": int(judged.short.sum()),
        "goal_error_mean": over(np.mean, judged.goal_error),
        "goal_error_max": over(np.max, judged.goal_error),
        "path_ratio_mean": over(np.mean, judged.path_ratio),
    }


_COLUMNS = (
    Column("collisions"),
    Column("clearance_mean", "clearance mean [m]", "{:.3f}"),
    Column("clearance_mean_feasible", "where feasible [m]", "{:.3f}"),
    Column("clearance_min", "min [m]", "{:.4f}"),
    Column("short_of_feasible", "short"),
    Column("goal_error_max", "goal error max [mm]", "{:.3f}", 1e3),
    Column("path_ratio_mean", "path ratio", "{:.3f}"),
)


def evaluation_tables(figures: Mapping[str, Any], notes: Sequence[str] = ()) -> list[TextTable]:
    """Tabulates all methods side by side; then each setting, or each baseline.

    Args:
        figures: as `evaluation_figures` makes them.
        notes: lines below the first table.
    """
    methods: Mapping[str, Any] = figures["methods"]
    rows = [
        {"name": name if method["complete"] else f"{name} (not complete)", **method}
        for name, method in methods.items()
    ]
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
            clearance = judge(scenes, motions).kept_clearance
            row[f"{name}_head_on"] = float(clearance[0])
            row[f"{name}_collisions"] = int((clearance <= 0.0).sum())
        rows.append(row)
    return rows


def term_table(figures: Sequence[dict[str, float]]) -> TextTable:
    """Tabulates the rows of `compare_terms`."""
    columns = (
        Column("gamma", "terms alone", "gamma = {:g}"),
        Column("original_head_on", "head-on: original [mm]", "{:.1f}", 1e3),
        Column("dead_zone_free_head_on", "dead-zone free [mm]", "{:.1f}", 1e3),
        Column("original_collisions", "collisions: original"),
        Column("dead_zone_free_collisions", "dead-zone free"),
    )
    return TextTable(columns, figures)
