"""The figures of an evaluation, as its JSON holds them; lengths in metres, times in seconds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from drake_oa.common.messages import BoolArray, FloatArray
from drake_oa.studies.scenes.evaluation import Outcome
from drake_oa.studies.scenes.judge import Judgement
from drake_oa.studies.scenes.suites import Case

_ARRIVED = 1e-3


def evaluation_figures(
    suite: str,
    seed: int | None,
    versions: Sequence[str],
    cases: Sequence[Case],
    outcomes: Mapping[str, Outcome],
) -> dict[str, Any]:
    """{"suite", "seed", "versions", "methods": {name: figures}}; see `method_figures`.

    Args:
        suite: the suite's name.
        seed: of the scenes; None where they were read from a file.
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
    """The figures of one method.

    `motion_figures` over the suite's scenes; with several cases, over those that ask for
    a clearance and scale the duration, and `settings` has each case by its label. Besides:
    `step_us` (microseconds a policy step), `seconds` (computing time of all cases),
    `complete`, `error` (where it failed) and, for scenes of several baselines,
    `by_baseline`.
    """
    main = [case.label for case in cases if case.setting.constrained and case.setting.scale_time]
    judged = outcome.of(*main)
    figures = motion_figures(judged)
    figures["step_us"] = 1e6 * outcome.seconds / outcome.steps if outcome.steps else None
    figures["seconds"] = outcome.seconds
    figures["complete"] = outcome.complete
    if outcome.error is not None:
        figures["error"] = outcome.error
    if len(cases) > 1:
        figures["covers"] = main
        figures["settings"] = {case.label: motion_figures(outcome.of(case.label)) for case in cases}
    baselines = np.unique(judged.baseline)
    if 1 < len(baselines) <= 10:
        figures["by_baseline"] = [
            {"baseline": float(L), **motion_figures(judged.rows(judged.baseline == L))}
            for L in baselines
        ]
    return figures


def motion_figures(judged: Judgement) -> dict[str, Any]:
    """Figures of a batch of motions; None where there is nothing to average.

    Keys: `scenes`, `collisions`, `clearance_mean`, `clearance_min`, `short_of_feasible`
    (more than 1 mm short of min(Delta, distance of start, of goal)), `goal_error_mean`,
    `goal_error_max`, `path_ratio_mean`; and `goal_missed` (by more than 1 mm),
    `clearance_std`, `clearance_max`, `path_ratio_max`, `delta_feasible` (scenes where Delta
    itself is feasible) and over those `clearance_mean_feasible`, `short_worst` (most that
    was lacking of the feasible clearance), `duration_mean`, `arrival_mean` and `arrival_max` (the
    motion's duration over tau T with tau = path ratio, at least 1), `out_of_range` (scenes in
    which the regressor chain was asked outside its trained range).
    """
    there = np.isfinite(judged.clearance)
    feasible: BoolArray = there & (judged.feasible >= judged.asked - 1e-12)
    clearance = judged.clearance[there]
    lacking = np.maximum(judged.feasible - judged.clearance, 0.0)[there]
    return {
        "scenes": len(judged),
        "collisions": int(judged.collided.sum()),
        "clearance_mean": _mean(clearance),
        "clearance_min": _least(clearance),
        "short_of_feasible": int(judged.short.sum()),
        "goal_error_mean": _mean(judged.goal_error),
        "goal_error_max": _most(judged.goal_error),
        "path_ratio_mean": _mean(judged.path_ratio),
        "goal_missed": int((judged.goal_error > _ARRIVED).sum()),
        "clearance_std": float(clearance.std()) if len(clearance) else None,
        "clearance_max": _most(clearance),
        "path_ratio_max": _most(judged.path_ratio),
        "short_worst": _most(lacking),
        "delta_feasible": int(feasible.sum()),
        "clearance_mean_feasible": _mean(judged.clearance[feasible]),
        "duration_mean": _mean(judged.duration),
        "arrival_mean": _mean(judged.arrival),
        "arrival_max": _most(judged.arrival),
        "out_of_range": int(judged.out_of_range.sum()),
    }


def _mean(values: FloatArray) -> float | None:
    return float(values.mean()) if len(values) else None


def _least(values: FloatArray) -> float | None:
    return float(values.min()) if len(values) else None


def _most(values: FloatArray) -> float | None:
    return float(values.max()) if len(values) else None
