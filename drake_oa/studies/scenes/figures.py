"""The figures of an evaluation, as its JSON holds them, and their table; metres and seconds."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from drake_oa.common.console import Column, TextTable
from drake_oa.common.messages import BoolArray
from drake_oa.studies.scenes.evaluation import Outcome
from drake_oa.studies.scenes.judge import Judgement
from drake_oa.studies.scenes.suites import Case

_ARRIVED = 1e-3


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
    there = np.isfinite(judged.kept_clearance)
    feasible: BoolArray = there & (judged.feasible >= judged.asked - 1e-12)
    clearance = judged.kept_clearance[there]
    lacking = np.maximum(judged.feasible - judged.kept_clearance, 0.0)[there]
    return {
        "scenes": len(judged),
        "collisions": int(judged.collided.sum()),
        "clearance_mean": over(np.mean, clearance),
        "clearance_min": over(np.min, clearance),
        "short_of_feasible": int(judged.short.sum()),
        "goal_error_mean": over(np.mean, judged.goal_error),
        "goal_error_max": over(np.max, judged.goal_error),
        "path_ratio_mean": over(np.mean, judged.path_ratio),
        "goal_missed": int((judged.goal_error > _ARRIVED).sum()),
        "clearance_std": over(np.std, clearance),
        "clearance_max": over(np.max, clearance),
        "path_ratio_max": over(np.max, judged.path_ratio),
        "short_worst": over(np.max, lacking),
        "delta_feasible": int(feasible.sum()),
        "clearance_mean_feasible": over(np.mean, judged.kept_clearance[feasible]),
        "duration_mean": over(np.mean, judged.duration),
        "arrival_mean": over(np.mean, judged.arrival),
        "arrival_max": over(np.max, judged.arrival),
        "out_of_range": int(judged.out_of_range.sum()),
    }


_COLUMNS = (
    Column("scenes"),
    Column("collisions"),
    Column("clearance_mean", "clearance mean [m]", "{:.3f}"),
    Column("clearance_min", "min [m]", "{:.4f}"),
    Column("short_of_feasible", "short"),
    Column("goal_error_mean", "goal error mean [mm]", "{:.3f}", 1e3),
    Column("goal_error_max", "max [mm]", "{:.3f}", 1e3),
    Column("path_ratio_mean", "path ratio", "{:.3f}"),
)
_WHOLE = (
    *_COLUMNS[:3],
    Column("clearance_mean_feasible", "where feasible [m]", "{:.3f}"),
    *_COLUMNS[3:],
    Column("step_us", "step [us]", "{:.3g}"),
    Column("seconds", form="{:.2f}"),
)


def evaluation_tables(figures: Mapping[str, Any]) -> list[TextTable]:
    """All methods side by side; then each setting, or each baseline.

    Args:
        figures: as `evaluation_figures` makes them.
    """
    methods: Mapping[str, Any] = figures["methods"]
    rows = [
        {"name": name if method["complete"] else f"{name} (not complete)", **method}
        for name, method in methods.items()
    ]
    covered = next((m["covers"] for m in methods.values() if "covers" in m), None)
    notes = [f"(over: {'; '.join(covered)}; seconds: all settings)"] if covered else []
    tables = [TextTable((Column("name", "method"), *_WHOLE), rows, notes)]
    for name, method in methods.items():
        settings = [{"name": label, **part} for label, part in method.get("settings", {}).items()]
        baselines = [
            {"name": f"goal at {part['baseline']:g} m", **part}
            for part in method.get("by_baseline", ())
        ]
        columns = (Column("name", name), *_COLUMNS)
        tables += [TextTable(columns, rows) for rows in (settings, baselines) if rows]
    return tables


FAMILIAR_MOST = 0.03
"""Distance to the goal that the paper tells as the most of its familiar scenes, tau scaled [m]."""


def familiar_tables(figures: Mapping[str, Any]) -> list[TextTable]:
    """Each method in the settings of the paper's familiar scenes, with what the print tells.

    Args:
        figures: as `evaluation_figures` makes them.
    """
    columns = (
        Column("collisions"),
        Column("collisions_printed", "print"),
        Column("clearance_mean", "clearance mean [m]", "{:.3f}"),
        Column("clearance_min", "min [m]", "{:.3f}"),
        Column("clearance_max", "max [m]", "{:.3f}"),
        Column("goal_error_mean", "goal error mean [mm]", "{:.2f}", 1e3),
        Column("goal_error_max", "max [mm]", "{:.1f}", 1e3),
        Column("goal_error_printed", "print, at most", "{:.0f}", 1e3),
    )
    notes = (
        "print: no collision in any setting; the goal within 30 mm where tau is scaled; else",
        'convergence "rapidly deteriorates" as Delta grows; clearances are drawn as boxes only',
    )
    tables = []
    for name, method in figures["methods"].items():
        rows = []
        for label, setting in method["settings"].items():
            most = FAMILIAR_MOST if label.endswith("scaled") else None
            printed = {"collisions_printed": 0, "goal_error_printed": most}
            rows.append({"name": label, **setting, **printed})
        tables.append(TextTable((Column("name", name), *columns), rows, notes))
    return tables
