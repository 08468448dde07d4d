"""Tables I to III of Pairet et al. (RA-L 2019), reproduced beside the published values.

- Table I (tab:nn_training): prediction errors of the shipped regressor chains, which map an
  obstacle's section and the requested clearance to the parameters of the coupling term. The errors
  are read from the metadata of the weights, where training stored them.
- Table II (tab:results_unseen_metrics): 1,000 novel scenes of a point and an ellipsoid for each of
  four distances from start to goal. The paper leaves open the obstacles' positions, the action
  level (equations of motion), the end of a motion and the measurement of its clearance. Here
  positions are drawn as by the authors' demo program, `scenes.paper_method` has the action level
  and the end of a motion, and clearance is the distance to the obstacle's section in the P-plane
  (plane through start, goal and the obstacle's center).
- Table III (tab:franka_metrics): the simulated robot before three kinds of obstacles, the scenarios
  `paper_box`, `paper_irregular` and `paper_clutter`. A trial is a run with its own camera noise.
  The published values are means over trials of a real Panda, eleven for the whole table.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from drake_oa.common.console import Column, TextTable
from drake_oa.common.files import software_versions
from drake_oa.evaluation.panda.evaluation import PandaResults, PandaSuite
from drake_oa.evaluation.scenes.evaluation import Outcome, evaluate, motion_statistics, over
from drake_oa.evaluation.scenes.paper_method import SHIPPED, paper_chain, run, sections
from drake_oa.evaluation.scenes.scenes import Scenes, Setting
from drake_oa.evaluation.scenes.suites import line_distance
from drake_oa.inference.regressor import TARGETS
from drake_oa.scenario.loading import load_scenario, scenario_text

_TOLD = ("chain", "action_level", "rollouts", "seed", "version", "date", "source_digest")
"""Keys that the JSON of the reproduced Table I copies from the metadata of a chain's weights file.
"""


TABLE_ONE = {
    "RC(lambda')": {"kappa": (0.539, 0.543), "psi": (0.802, 0.802), "alpha": (0.893, 0.897)},
    "RC(lambda', Delta)": {
        "kappa": (0.251, 0.253),
        "psi": (0.244, 0.243),
        "alpha": (1.6e-4, 1.7e-4),
    },
}
"""Published Table I of Pairet et al., RA-L 2019: chain -> target -> errors of its network.

A regressor chain predicts the targets kappa, psi and alpha, the parameters of a coupling term. The
errors are the normalized mean squared errors (NMSE) on the rows of the training set and of the test
set, in this order."""


def published_errors(chain: str, target: str) -> dict[str, float]:
    """Returns the errors of one network as published in Table I of Pairet et al., RA-L 2019.

    Args:
        chain: name of the regressor chain, a key of `TABLE_ONE`.
        target: output of the network: "kappa", "psi" or "alpha".

    Returns:
        Normalized mean squared errors on training rows, `train_published`, and on test rows,
        `test_published`.
    """
    return dict(zip(("train_published", "test_published"), TABLE_ONE[chain][target], strict=True))


def error_table(
    title: str, networks: Mapping[str, Mapping[str, Any]], notes: Sequence[str] = ()
) -> TextTable:
    """Tabulates the errors of a regressor chain's networks beside the published values.

    NMSE is the normalized mean squared error.

    Args:
        title: heading of the first column.
        networks: target ("kappa", "psi" or "alpha") -> values of its network by key. `train` is the
            NMSE on the training rows, `test` that on the test rows, and `rows` the number of both
            together. Optional are the keys of `published_errors`, and `floor`, an estimate of the
            lowest NMSE that any function of the inputs can reach.
        notes: lines below the table.
    """
    columns = (
        Column("name", title),
        Column("train", "train NMSE", "{:.3g}"),
        Column("train_published", "published", "{:.3g}"),
        Column("test", "test NMSE", "{:.3g}"),
        Column("test_published", "published", "{:.3g}"),
        Column("floor", "lowest NMSE", "{:.3g}"),
        Column("rows", form="{:,d}"),
    )
    return TextTable(columns, [{"name": name, **row} for name, row in networks.items()], notes)


def table_one_metrics() -> dict[str, Any]:
    """Returns the JSON of Table I: errors of the networks of each shipped regressor chain.

    "chains" has an entry for each weights file. Its key "networks" has for each target ("kappa",
    "psi" or "alpha") the values of one network:

    - train, test: normalized mean squared error (NMSE) on the training rows, and on the test rows.
    - rows: number of training and test rows together.
    - floor: estimate of the lowest NMSE that any function of the network's inputs can reach.
    - the keys of `published_errors`, if the chain was trained on motions of the released code.

    The other keys of an entry are the chain's name in the paper, and data on its training:
    equations of motion, number of simulated motions, seed, package version, date and source digest.
    """
    chains = {}
    for file in SHIPPED:
        metadata = paper_chain(file).metadata
        networks = {}
        for target in TARGETS:
            network = {**metadata["nmse"][target], "rows": metadata["rows"][target]}
            # Published values are of the released code's action level.
            if file != SHIPPED[2]:
                network |= published_errors(metadata["chain"], target)
            networks[target] = network
        chains[file] = {key: metadata[key] for key in _TOLD} | {"networks": networks}
    return {"table": "table1", "versions": software_versions(), "chains": chains}


def table_one(whole: Mapping[str, Any]) -> list[TextTable]:
    """Tabulates the result of `table_one_metrics`: one table for each shipped regressor chain."""
    return [
        error_table(file, chain["networks"], [f"({chain['chain']}; {chain['action_level']})"])
        for file, chain in whole["chains"].items()
    ]


_METRICS = ("clearance_mean", "clearance_min", "goal_error_mean", "goal_error_max", "collisions")
TABLE_TWO: dict[float, dict[str, Any]] = {
    baseline: dict(zip(_METRICS, cells, strict=True))
    for baseline, *cells in (
        (0.5, 0.144, -5.01e-4, 4.41e-4, 0.017, 2),
        (1.0, 0.184, 0.060, 4.23e-4, 0.017, 0),
        (1.5, 0.196, 0.068, 5.22e-4, 0.023, 0),
        (2.0, 0.202, 0.076, 6.49e-4, 0.027, 0),
    )
}
"""Published Table II of Pairet et al., RA-L 2019: baseline -> metrics of 1,000 motions.

The baseline is the distance from start to goal [m]. The metrics are mean and minimum clearance [m],
mean and maximum goal error [m], and the number of collisions."""
LINE_COLLISION_RATE = 0.324
"""Published fraction of scenes in which the line from start to goal hits the obstacle [-].

Pairet et al., RA-L 2019, state 1,296 of the 4,000 scenes of their Table II."""


def evaluate_novel(scenes: Scenes) -> Outcome:
    """Runs the method of Pairet et al. on the scenes of their Table II and evaluates the motions.

    Clearances are distances to the obstacle's section with the P-plane, the plane through the line
    from start to goal and the obstacle's center.

    Args:
        scenes: scenes of the suite `demo`, drawn as by the authors' demo program.

    Returns:
        Ground-truth results of all motions, and the computing time. All motions have a requested
        clearance and the temporal scaling tau; the results are under the label of this setting.
    """
    return evaluate("paper", run, scenes, [Setting()], sections)


_MEAN_TOLERANCE = 0.01
"""Tolerance of a mean clearance in the reproduced Table II from its published value [m]."""
_MIN_TOLERANCE = 0.03
"""Tolerance of a minimum clearance in the reproduced Table II from its published value [m]."""
_ERROR_FACTOR = 2.0
"""Maximum ratio of a goal error in the reproduced Table II to the published value [-].

The minimum ratio is the inverse."""
_COLLISION_TOLERANCE = 3
"""Tolerance of a number of collisions in the reproduced Table II from its published value [-]."""


def agrees(metrics: Mapping[str, Any], published: Mapping[str, Any]) -> dict[str, bool]:
    """Checks whether the metrics in a row of the reproduced Table II agree with published values.

    Args:
        metrics: metrics of the row, and `scenes`, the number of its scenes.
        published: metric -> published value: mean and minimum clearance [m], mean and maximum goal
            error [m], number of collisions.

    Returns:
        Metric -> whether it is within its tolerance; always False without scenes.
    """
    if not metrics["scenes"]:
        return dict.fromkeys(published, False)
    tolerances = {
        "clearance_mean": _MEAN_TOLERANCE,
        "clearance_min": _MIN_TOLERANCE,
        "collisions": _COLLISION_TOLERANCE,
    }
    # Goal errors may differ by a factor, hence their logarithms are compared.
    return {
        key: bool(
            abs(metrics[key] - value) <= tolerances[key]
            if key in tolerances
            else abs(np.log(metrics[key] / value)) <= np.log(_ERROR_FACTOR)
        )
        for key, value in published.items()
    }


def table_two_metrics(outcome: Outcome, scenes: Scenes, seed: int) -> dict[str, Any]:
    """Returns the JSON of the reproduced Table II: metrics for each baseline and published ones.

    "by_baseline" has a row for each baseline (distance from start to goal): the metrics by
    `motion_statistics`, and "agrees", the result of `agrees`. "cells" is the number of metrics in
    all rows that agree with the published value; "line_collision_rate", the fraction of scenes in
    which the line from start to goal enters the obstacle.

    Args:
        outcome: result of `evaluate_novel`.
        scenes: scenes of this result, from the suite `demo`.
        seed: seed of the scenes.
    """
    rows, results = [], outcome.of()
    for baseline, published in TABLE_TWO.items():
        row = motion_statistics(results.rows(results.baseline == baseline))
        rows.append({"baseline": baseline, **row, "agrees": agrees(row, published)})
    return {
        "table": "table2",
        "seed": seed,
        "versions": software_versions(),
        "published": {
            "line_collision_rate": LINE_COLLISION_RATE,
            "by_baseline": [{"baseline": L, **row} for L, row in TABLE_TWO.items()],
        },
        "line_collision_rate": float((line_distance(scenes) < 0.0).mean()),
        "cells": sum(sum(row["agrees"].values()) for row in rows),
        "by_baseline": rows,
    }


_CELL_COLUMNS = (
    Column("collisions"),
    Column("clearance_mean", "mean clearance [m]", "{:.3f}"),
    Column("clearance_min", "min. clearance [m]", "{:.4f}"),
    Column("goal_error_mean", "mean goal error [mm]", "{:.2f}", 1e3),
    Column("goal_error_max", "max. goal error [mm]", "{:.0f}", 1e3),
    Column("differing", "differing metrics"),
)
"""Columns (metric, heading, format, scale) of the reproduced Table II, except the first.

The first column has the names of the rows. There are two rows for each distance from start to goal:
computed metrics and published values."""
_NOTES = (
    f"Metrics agree if mean clearances differ by at most {1e3 * _MEAN_TOLERANCE:g} mm,",
    f"minimum clearances by {1e3 * _MIN_TOLERANCE:g} mm, collisions by {_COLLISION_TOLERANCE}, and"
    f" goal errors by a factor of {_ERROR_FACTOR:g}.",
    f"Published fraction of straight lines in collision: {1e2 * LINE_COLLISION_RATE:.0f} %.",
)
"""Lines below the reproduced Table II, which state when a metric agrees with the paper's value."""


def table_two(whole: Mapping[str, Any]) -> TextTable:
    """Tabulates the result of `table_two_metrics` beside the published values of Table II."""
    rows = []
    for row in whole["by_baseline"]:
        differing = [key.replace("_", " ") for key, same in row["agrees"].items() if not same]
        title = f"goal at {row['baseline']:g} m"
        rows.append({"name": title, "differing": ", ".join(differing) or "none", **row})
        rows.append({"name": "  published", **TABLE_TWO[row["baseline"]]})
    rate = whole["line_collision_rate"]
    note = f"{whole['cells']} of 20 metrics agree; {rate:.0%} of the straight lines collide."
    return TextTable((Column("name", "table2"), *_CELL_COLUMNS), rows, (*_NOTES, note))


_PUBLISHED_KEYS = (
    "clearance_published",
    "goal_error_published",
    "contacts_published",
    "shortfall_count_published",
)
TABLE_THREE: dict[tuple[str, str], dict[str, Any]] = {
    (kind, method): dict(zip(_PUBLISHED_KEYS, cells, strict=True))
    for kind, method, *cells in (
        ("box", "nominal", None, None, 1, 1),
        ("box", "paper", 0.168, 9.58e-3, 0, 0),
        ("irregular", "nominal", None, None, 1, 1),
        ("irregular", "paper", 0.163, 4.17e-3, 0, 0),
        ("clutter", "nominal", None, None, 2, 5),
        ("clutter", "paper", 0.172, 1.29e-2, 0, 0),
    )
}
"""Published Table III of Pairet et al., RA-L 2019: (kind of obstacles, method) -> metrics.

The metrics are mean clearance [m] and mean goal error [m] (None for "fail"), number of touched
obstacles, and number of obstacles passed at less than 0.15 m."""

TRIAL_KINDS = ("box", "irregular", "clutter")
"""Kinds of obstacles in Table III of Pairet et al.; the scenario of a kind is named paper_KIND."""

_TRIAL_COLUMNS = (
    Column("name", "scene, method"),
    Column("trials"),
    Column("obstacles_touched", "touched objects"),
    Column("clearance_mean", "mean clearance [m]", "{:.3f}"),
    Column("clearance_published", "published [m]", "{:.3f}"),
    Column("shortfall_count", "trials with shortfall"),
    Column("goal_error_mean", "mean goal error [mm]", "{:.2f}", 1e3),
    Column("goal_error_published", "published [mm]", "{:.2f}", 1e3),
)
"""Columns (metric, heading, format, scale) of the reproduced Table III.

The table has a row for each kind of obstacles and method."""


def trial_text(name: str, seed: int) -> str:
    """Returns the YAML text of a shipped scenario with another seed of its camera noise.

    Args:
        name: name of the scenario.
        seed: seed of the scenario, which determines the noise.
    """
    return scenario_text(load_scenario(name, [f"seed={seed}"]))


def trial_suites(
    methods: Sequence[str], trials: int, seed: int, perception: str, duration: float | None
) -> list[PandaSuite]:
    """Returns one suite of runs for each kind of obstacles in Table III of Pairet et al.

    A suite consists of trials: runs of the same scenario, each with its own camera noise.

    Args:
        methods: names of methods, from `panda.evaluation.METHODS`.
        trials: number of trials of each kind.
        seed: seed of the first trial; the next ones have consecutive seeds.
        perception: source of the obstacles: "depth" (camera), "depth2" (two cameras beside the
            robot) or "truth" (exact obstacles).
        duration: time limit of a run [s]; None: 6 times the duration of the demonstration.

    Raises:
        ValueError: for an unknown method.
    """
    suites, of_runs = [], (tuple(methods), perception, duration)
    for kind in TRIAL_KINDS:
        name = f"paper_{kind}"
        drawings = {trial: partial(trial_text, name, seed + trial) for trial in range(trials)}
        suites.append(PandaSuite("table3", kind, seed, *of_runs, f"{name}-seed{seed}", drawings))
    return suites


def trial_metrics(
    runs: Mapping[int, Mapping[str, Any]], published: Mapping[str, Any] | None
) -> dict[str, Any]:
    """Returns the metrics of one row of the reproduced Table III, and the published values.

    The keys are:

    - trials: number of runs. All other metrics leave out runs with an unknown tool clearance.
    - obstacles_touched: number of different obstacles in contact in any run, the table included.
    - shortfall_count: number of runs with a tool clearance below the requested one.
    - clearance_mean, clearance_min: statistics of the minimum tool clearance of a run [m].
    - goal_error_mean, goal_error_max: statistics of the distance to the goal at the end [m].
    - duration_median: median duration of a run [s].
    - the keys of `published`: the values that the paper printed.

    Args:
        runs: number of a trial -> result of its run, see `panda.evaluation.run_and_evaluate`.
        published: row of `TABLE_THREE` with the published values; None if the paper has no such
            row.
    """
    known = [run for run in runs.values() if run["tool_clearance_min"] is not None]
    clearance = [run["tool_clearance_min"] for run in known]
    error = [run["goal_error"] for run in known]
    touched = {part for run in known for pair in run["contacts"] for part in pair.split(" - ")[1:]}
    return {
        "trials": len(runs),
        "obstacles_touched": len(touched),
        "shortfall_count": sum(
            run["tool_clearance_min"] < run["requested_clearance"] for run in known
        ),
        "clearance_mean": over(np.mean, clearance),
        "clearance_min": over(min, clearance),
        "goal_error_mean": over(np.mean, error),
        "goal_error_max": over(max, error),
        "duration_median": over(np.median, (run["duration"] for run in known)),
        **(published or {}),
    }


def trials_metrics(
    results: Sequence[PandaResults], metrics: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Returns the JSON of the reproduced Table III: metrics of each kind of obstacles and method.

    The keys are "suite", the suite's name; "rows", kind -> method -> its row of the table, the
    result of `trial_metrics`; and "kinds", kind -> further metrics, the result of `panda_metrics`.

    Args:
        results: results of `panda.evaluation.evaluate_panda`, one for the suite of each kind.
        metrics: results of `panda_metrics` for the same suites.
    """
    return {
        "suite": results[0].suite.name,
        "rows": {
            of.suite.kind: {
                method: trial_metrics(runs, TABLE_THREE.get((of.suite.kind, method)))
                for method, runs in of.runs.items()
            }
            for of in results
        },
        "kinds": {of["kind"]: of for of in metrics},
    }


def table_three(whole: Mapping[str, Any]) -> TextTable:
    """Tabulates the result of `trials_metrics` beside the published values of Table III."""
    rows = [
        {"name": f"{kind}, {method}", **metrics}
        for kind, methods in whole["rows"].items()
        for method, metrics in methods.items()
    ]
    notes = (
        "Touched objects: obstacles and the table, in any trial. Trials with shortfall: minimum",
        "clearance below the requested one. Published: Table III of the paper, of a real Panda.",
    )
    return TextTable(_TRIAL_COLUMNS, rows, notes)
