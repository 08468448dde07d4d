"""Evaluation of avoidance methods on the same synthetic scenes: runs, metrics and tables.

A scene is a point, its goal and an ellipsoid. Metrics are the JSON data of an evaluation, in meters
and seconds.

The dead-zone figure of Pairet et al., RA-L 2019, compares two coupling terms of equal strength on
the same action level (equations of motion). Both terms turn the motion away from an obstacle. Their
turning rates depend on theta, the angle between the heading and the direction of the obstacle's
center:

- Original term (eq. 7): gamma theta exp(-beta |theta|), with several gains gamma and the published
  decay beta.
- Dead-zone free term (eq. 8): same peak gamma / (beta e), and for theta > 0 same area
  gamma / beta^2. Its decay kappa with the distance is 0, because the original term does not depend
  on the distance.
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
"""Maximum number of scenes for which one call of an avoidance method computes motions."""


class Outcome(NamedTuple):
    """Results of one avoidance method on the scenes of a suite.

    Attributes:
        results: label of a `Setting` (requested clearance and scaling of the duration) ->
            ground-truth results of all scenes.
        seconds: computing time of the method in all settings together [s].
    """

    results: dict[str, GroundTruthResult]
    seconds: float

    def of(self, *labels: str) -> GroundTruthResult:
        """Returns the joined results in the settings with given labels; without labels, in all.

        Args:
            labels: labels of settings, keys of `results`.
        """
        return GroundTruthResult.joined([self.results[label] for label in labels or self.results])


def evaluate(
    name: str,
    method: Method,
    scenes: Scenes,
    settings: Sequence[Setting],
    true_scenes: Callable[[Scenes], Scenes] = lambda scenes: scenes,
) -> Outcome:
    """Runs an avoidance method on all scenes in each setting and evaluates the motions.

    Args:
        name: name of the method, for the progress bar.
        method: function from scenes and a setting to one motion for each scene.
        scenes: scenes of a suite.
        settings: settings (requested clearance and scaling of the duration), in each of which all
            scenes are run.
        true_scenes: function from a batch of scenes to the ground-truth scenes in which the motions
            are evaluated, for example with other obstacles; by default the same scenes.

    Returns:
        Ground-truth results by the label of the setting, and the computing time of the method.
    """
    results, seconds, count = {}, 0.0, 0
    with progress_bar(len(settings) * len(scenes)) as update:
        for setting in settings:
            parts = []
            for first in range(0, len(scenes), BATCH):
                some = setting.of(scenes.rows(slice(first, first + BATCH)))
                begin = perf_counter()
                motions = method(some, setting)
                seconds += perf_counter() - begin
                parts.append(evaluate_motions(true_scenes(some), motions))
                count += len(some)
                update(f"{name} {count}", count)
            results[setting.label] = GroundTruthResult.joined(parts)
    return Outcome(results, seconds)


def over(statistic: Callable[..., Any], values: Iterable[float | None]) -> float | None:
    """Computes a statistic of the values that are not None; None without such values.

    Args:
        statistic: function of a list of numbers, for example `min`.
        values: numbers, or None where unknown.
    """
    known = [value for value in values if value is not None]
    return float(statistic(known)) if known else None


def evaluation_metrics(
    suite: str, seed: int | None, settings: Sequence[Setting], outcomes: Mapping[str, Outcome]
) -> dict[str, Any]:
    """Returns the JSON data of an evaluation of several methods on the scenes of a suite.

    The keys are "suite", "seed", "versions" (of libraries), and "methods", name of a method -> its
    metrics, the result of `method_metrics`.

    Args:
        suite: name of the suite.
        seed: seed of the scenes; None for scenes without a seed.
        settings: settings (requested clearance and scaling of the duration) of the runs.
        outcomes: name of a method -> result of `evaluate`.
    """
    return {
        "suite": suite,
        "seed": seed,
        "versions": software_versions(),
        "methods": {name: method_metrics(outcome, settings) for name, outcome in outcomes.items()},
    }


def method_metrics(outcome: Outcome, settings: Sequence[Setting]) -> dict[str, Any]:
    """Computes the metrics of one avoidance method over the scenes of a suite.

    The keys are those of `motion_statistics` (collisions, clearances, goal errors, path lengths),
    and `seconds`, the computing time in all settings. With several settings, the statistics include
    only the settings that have both a requested clearance and a scaled duration. `covers` then has
    the labels of these settings, and `settings` the statistics of every single setting. With
    several baselines (distances from start to goal), `by_baseline` has the statistics of each.

    Args:
        outcome: results of the method in all settings.
        settings: settings (requested clearance and scaling of the duration) of the runs.
    """
    main = [setting.label for setting in settings if setting.constrained and setting.scale_time]
    results = outcome.of(*main)
    metrics = motion_statistics(results) | {"seconds": outcome.seconds}
    if len(settings) > 1:
        metrics["covers"] = main
        metrics["settings"] = {of.label: motion_statistics(outcome.of(of.label)) for of in settings}
    baselines = np.unique(results.baseline)
    if len(baselines) > 1:
        metrics["by_baseline"] = [
            {"baseline": float(L), **motion_statistics(results.rows(results.baseline == L))}
            for L in baselines
        ]
    return metrics


def motion_statistics(results: GroundTruthResult) -> dict[str, Any]:
    """Computes statistics of the metrics of several motions, with one motion per scene.

    Clearances and goal errors are in meters; a statistic without values is None. The keys are:

    - scenes, collisions: numbers of scenes, and of those whose motion touches the obstacle.
    - clearance_mean, clearance_min, clearance_max: statistics of the minimum clearance of a motion.
    - clearance_mean_achievable: mean of this minimum over the scenes in which the requested
      clearance Delta is achievable.
    - shortfall_count: number of scenes with a clearance more than 1 mm below the achievable one,
      min(Delta, distance of the start, distance of the goal).
    - goal_error_mean, goal_error_max: statistics of the distance to the goal at the end.
    - path_ratio_mean: mean path length over the distance from start to goal.
    """
    known = np.isfinite(results.min_clearance)
    clearance = results.min_clearance[known]
    is_achievable = known & (results.achievable_clearance >= results.requested - 1e-12)
    return {
        "scenes": len(results),
        "collisions": int(results.collided.sum()),
        "clearance_mean": over(np.mean, clearance),
        "clearance_mean_achievable": over(np.mean, results.min_clearance[is_achievable]),
        "clearance_min": over(np.min, clearance),
        "clearance_max": over(np.max, clearance),
        "shortfall_count": int(results.is_short.sum()),
        "goal_error_mean": over(np.mean, results.goal_error),
        "goal_error_max": over(np.max, results.goal_error),
        "path_ratio_mean": over(np.mean, results.path_ratio),
    }


_COLUMNS = (
    Column("collisions"),
    Column("clearance_mean", "mean clearance [m]", "{:.3f}"),
    Column("clearance_mean_achievable", "mean if achievable [m]", "{:.3f}"),
    Column("clearance_min", "min. clearance [m]", "{:.4f}"),
    Column("shortfall_count", "scenes with shortfall"),
    Column("goal_error_max", "max. goal error [mm]", "{:.3f}", 1e3),
    Column("path_ratio_mean", "mean path ratio", "{:.3f}"),
)
"""Columns (metric, heading, format, scale) of tables of metrics in synthetic scenes.

In a table, a column with the names of the rows precedes these columns."""


def evaluation_tables(metrics: Mapping[str, Any], notes: Sequence[str] = ()) -> list[TextTable]:
    """Tabulates the metrics of all methods, then those of each setting or baseline of a method.

    Args:
        metrics: result of `evaluation_metrics`.
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
"""Gains gamma of Hoffmann's coupling term in the dead-zone figure of Pairet et al. [1/s].

The coupling term turns the motion away from an obstacle, except straight ahead, its dead zone."""


def matched_term(gamma: float) -> tuple[float, float]:
    """Computes parameters of the paper's coupling term that make it as strong as Hoffmann's.

    Coupling terms turn the motion away from an obstacle. As functions of the angle theta between
    the heading and the direction of the obstacle's center, both turning rates have the same peak,
    and the same area for theta > 0:

        alpha = gamma / (beta e),   psi = 2 e / (beta sqrt(pi)).

    Args:
        gamma: gain of Hoffmann's coupling term [1/s]; its decay beta with theta is `BETA`.

    Returns:
        Strength alpha [rad/s] and angular width psi [rad] of the paper's coupling term.
    """
    return gamma / (BETA * math.e), 2.0 * math.e / (BETA * math.sqrt(math.pi))


def compare_terms(scenes: Scenes) -> list[dict[str, float]]:
    """Runs Hoffmann's and the paper's coupling term, equally strong, on all scenes.

    Coupling terms turn the motion away from an obstacle. Their strength is varied by the gains in
    `GAMMAS`; the temporal scaling tau is 1.

    Args:
        scenes: scenes of the suite `dead-zone`, in the first of which the obstacle is straight
            ahead.

    Returns:
        A row for each gain, with the keys "gamma", "TERM_head_on" (minimum clearance in the first
        scene [m]) and "TERM_collisions" (number of scenes with a collision). TERM is "original" for
        Hoffmann's coupling term, "dead_zone_free" for the paper's.
    """
    setting = Setting(constrained=False, scale_time=False)
    rows = []
    for gamma in GAMMAS:
        row = {"gamma": gamma}
        for name, term in (("original", (gamma, BETA)), ("dead_zone_free", matched_term(gamma))):
            parameters, original = np.array((*term, 0.0)), name == "original"
            motions = released_motions(scenes, setting, parameters, original=original)
            clearance = evaluate_motions(scenes, motions).min_clearance
            row[f"{name}_head_on"] = float(clearance[0])
            row[f"{name}_collisions"] = int((clearance <= 0.0).sum())
        rows.append(row)
    return rows


def term_table(metrics: Sequence[dict[str, float]]) -> TextTable:
    """Tabulates the result of `compare_terms`: clearances and collisions of both coupling terms."""
    columns = (
        Column("gamma", "coupling terms", "gamma = {:g}"),
        Column("original_head_on", "clearance head-on: original [mm]", "{:.1f}", 1e3),
        Column("dead_zone_free_head_on", "dead-zone free [mm]", "{:.1f}", 1e3),
        Column("original_collisions", "collisions: original"),
        Column("dead_zone_free_collisions", "dead-zone free"),
    )
    return TextTable(columns, metrics)
