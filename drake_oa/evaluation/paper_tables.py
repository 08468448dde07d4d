"""The paper's Tables I to III, computed and compared with the printed values.

- Table I (tab:nn_training): prediction errors of the chains that are shipped. What training
  measured stands in the weights' metadata; nothing is computed here.
- Table II (tab:results_unseen_metrics): 4 x 1,000 novel scenes. The print leaves open where the
  obstacles are, what is integrated, when a motion ends and how its clearance is taken. Here
  obstacles are where the released demo program has them, the action level is that of
  `scenes.paper_method`, and the clearance is that to the obstacle's section in the P-plane.
- Table III (tab:franka_metrics): three kinds of obstacles before the whole robot: the scenarios
  `paper_box`, `paper_irregular` and `paper_clutter`, each with the noise of other seeds; a trial is
  a run. Printed are eleven trials of a real Panda in all, as means.
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
"""Keys of the weights' metadata that the JSON repeats."""


TABLE_ONE = {
    "RC(lambda')": {"kappa": (0.539, 0.543), "psi": (0.802, 0.802), "alpha": (0.893, 0.897)},
    "RC(lambda', Delta)": {
        "kappa": (0.251, 0.253),
        "psi": (0.244, 0.243),
        "alpha": (1.6e-4, 1.7e-4),
    },
}
"""Table I of the paper (tab:nn_training): NMSE on the train and on the test rows."""


def published_errors(chain: str, target: str) -> dict[str, float]:
    """Returns the train and test errors of a network as Table I prints them."""
    return dict(zip(("train_printed", "test_printed"), TABLE_ONE[chain][target], strict=True))


def error_table(
    title: str, networks: Mapping[str, Mapping[str, Any]], notes: Sequence[str] = ()
) -> TextTable:
    """Tabulates the errors of a chain's networks beside the printed ones and the set's floor.

    Args:
        title: heading of the targets.
        networks: target -> `train`, `test`, `rows`, and where they are known `published_errors` and
            `floor`.
        notes: lines below.
    """
    columns = (
        Column("name", title),
        Column("train", form="{:.3g}"),
        Column("train_printed", "print", "{:.3g}"),
        Column("test", form="{:.3g}"),
        Column("test_printed", "print", "{:.3g}"),
        Column("floor", form="{:.3g}"),
        Column("rows", form="{:,d}"),
    )
    return TextTable(columns, [{"name": name, **row} for name, row in networks.items()], notes)


def table_one_metrics() -> dict[str, Any]:
    """Returns the content of the JSON: the chain of each shipped file, and a row a network.

    NMSE on the train and the test rows; of the chains on the released code's action level the
    print beside them; the floor that no function of the inputs beats on that set.

    """
    chains = {}
    for file in SHIPPED:
        metadata = paper_chain(file).metadata
        networks = {}
        for target in TARGETS:
            network = {**metadata["nmse"][target], "rows": metadata["rows"][target]}
            # The print is of the released code's action level.
            if file != SHIPPED[2]:
                network |= published_errors(metadata["chain"], target)
            networks[target] = network
        chains[file] = {key: metadata[key] for key in _TOLD} | {"networks": networks}
    return {"table": "table1", "versions": software_versions(), "chains": chains}


def table_one(whole: Mapping[str, Any]) -> list[TextTable]:
    """Tabulates `table_one_metrics`, a table a file."""
    return [
        error_table(file, chain["networks"], [f"({chain['chain']}; {chain['action_level']})"])
        for file, chain in whole["chains"].items()
    ]


_CELLS = ("clearance_mean", "clearance_min", "goal_error_mean", "goal_error_max", "collisions")
TABLE_TWO: dict[float, dict[str, Any]] = {
    baseline: dict(zip(_CELLS, cells, strict=True))
    for baseline, *cells in (
        (0.5, 0.144, -5.01e-4, 4.41e-4, 0.017, 2),
        (1.0, 0.184, 0.060, 4.23e-4, 0.017, 0),
        (1.5, 0.196, 0.068, 5.22e-4, 0.023, 0),
        (2.0, 0.202, 0.076, 6.49e-4, 0.027, 0),
    )
}
"""The print, by baseline."""
LINES_HIT = 0.324
"""Share of straight lines in collision there: 1,296 of 4,000."""


def evaluate_novel(scenes: Scenes) -> Outcome:
    """Runs the paper's method on scenes of the suite `demo`, and judges it in the P-plane."""
    return evaluate("paper", run, scenes, [Setting()], sections)


_MEAN, _LEAST, _FACTOR, _COLLISIONS = 0.01, 0.03, 2.0, 3
"""Maximum difference of a figure that agrees with the print [m, m, -, -]."""


def agrees(found: Mapping[str, Any], published: Mapping[str, Any]) -> dict[str, bool]:
    """Finds the cells of a row that agree with the print; none of a row without scenes."""
    if not found["scenes"]:
        return dict.fromkeys(published, False)
    within = {"clearance_mean": _MEAN, "clearance_min": _LEAST, "collisions": _COLLISIONS}
    # Of goal errors within a factor: of their logarithms.
    return {
        key: abs(found[key] - value) <= within[key]
        if key in within
        else abs(np.log(found[key] / value)) <= np.log(_FACTOR)
        for key, value in published.items()
    }


def table_two_metrics(outcome: Outcome, scenes: Scenes, seed: int) -> dict[str, Any]:
    """Returns the content of the JSON: a row for each baseline, lengths in m.

    Args:
        outcome: of `evaluate_novel`.
        scenes: of the suite `demo`.
        seed: of the scenes.
    """
    rows, judged = [], outcome.of()
    for baseline, published in TABLE_TWO.items():
        row = motion_statistics(judged.rows(judged.baseline == baseline))
        rows.append({"baseline": baseline, **row, "agrees": agrees(row, published)})
    return {
        "table": "table2",
        "seed": seed,
        "versions": software_versions(),
        "print": {
            "lines_hit": LINES_HIT,
            "by_baseline": [{"baseline": L, **row} for L, row in TABLE_TWO.items()],
        },
        "lines_hit": float((line_distance(scenes) < 0.0).mean()),
        "cells": sum(sum(row["agrees"].values()) for row in rows),
        "by_baseline": rows,
    }


_CELL_COLUMNS = (
    Column("collisions"),
    Column("clearance_mean", "clearance mean [m]", "{:.3f}"),
    Column("clearance_min", "min [m]", "{:.4f}"),
    Column("goal_error_mean", "goal error mean [mm]", "{:.2f}", 1e3),
    Column("goal_error_max", "max [mm]", "{:.0f}", 1e3),
    Column("off", "differs"),
)
_NOTES = (
    f"agree: mean clearances within {1e3 * _MEAN:g} mm, least ones within {1e3 * _LEAST:g} mm,",
    f"collisions within {_COLLISIONS}, goal errors within a factor of {_FACTOR:g}.",
    f"Of the print's straight lines {1e2 * LINES_HIT:.0f} % are in collision.",
)


def table_two(whole: Mapping[str, Any]) -> TextTable:
    """Tabulates `table_two_metrics` beside the print."""
    rows = []
    for row in whole["by_baseline"]:
        off = [key.replace("_", " ") for key, same in row["agrees"].items() if not same]
        title = f"goal at {row['baseline']:g} m"
        rows.append({"name": title, "off": ", ".join(off) or "none", **row})
        rows.append({"name": "  the paper prints", **TABLE_TWO[row["baseline"]]})
    note = f"{whole['cells']} of 20 cells agree; {whole['lines_hit']:.0%} of the lines collide."
    return TextTable((Column("name", "table2"), *_CELL_COLUMNS), rows, (*_NOTES, note))


_PUBLISHED = ("clearance_printed", "goal_error_printed", "contacts_printed", "short_printed")
TABLE_THREE: dict[tuple[str, str], dict[str, Any]] = {
    (kind, method): dict(zip(_PUBLISHED, cells, strict=True))
    for kind, method, *cells in (
        ("box", "nominal", None, None, 1, 1),
        ("box", "paper", 0.168, 9.58e-3, 0, 0),
        ("irregular", "nominal", None, None, 1, 1),
        ("irregular", "paper", 0.163, 4.17e-3, 0, 0),
        ("clutter", "nominal", None, None, 2, 5),
        ("clutter", "paper", 0.172, 1.29e-2, 0, 0),
    )
}
"""Table III of the paper, by kind and method: clearance to the obstacle [m] and convergence to the
goal [m], None for "fail"; obstacles that were touched, and passed nearer than 0.15 m."""

TRIAL_KINDS = ("box", "irregular", "clutter")

_TRIAL_COLUMNS = (
    Column("name", "scene, method"),
    Column("trials"),
    Column("obstacles_touched", "touched"),
    Column("clearance_mean", "clearance [m]", "{:.3f}"),
    Column("clearance_printed", "print", "{:.3f}"),
    Column("trials_short", "short"),
    Column("goal_error_mean", "goal error [mm]", "{:.2f}", 1e3),
    Column("goal_error_printed", "print", "{:.2f}", 1e3),
)


def trial_text(name: str, seed: int) -> str:
    """Returns a shipped scenario with the noise of a seed as text."""
    return scenario_text(load_scenario(name, [f"seed={seed}"]))


def trial_suites(
    methods: Sequence[str], trials: int, seed: int, perception: str, duration: float | None
) -> list[PandaSuite]:
    """Makes a suite for each kind of obstacles: trials are of consecutive seeds of the noise.

    Raises:
        ValueError: for an unknown method.
    """
    return [
        PandaSuite(
            "table3",
            kind,
            seed,
            tuple(methods),
            perception,
            duration,
            f"paper_{kind}-seed{seed}",
            {trial: partial(trial_text, f"paper_{kind}", seed + trial) for trial in range(trials)},
        )
        for kind in TRIAL_KINDS
    ]


def trial_metrics(
    runs: Mapping[int, Mapping[str, Any]], published: Mapping[str, Any] | None
) -> dict[str, Any]:
    """The figures of one row, lengths in m; of a row that the paper has, the print beside them.

    Args:
        runs: trial -> result, see `run_and_evaluate`.
        published: the paper's row.
    """
    known = [run for run in runs.values() if run["tool_clearance_min"] is not None]
    clearance = [run["tool_clearance_min"] for run in known]
    error = [run["goal_error"] for run in known]
    touched = {part for run in known for pair in run["contacts"] for part in pair.split(" - ")[1:]}
    return {
        "trials": len(runs),
        "obstacles_touched": len(touched),
        "trials_short": sum(
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
    """{"suite", "rows": {kind: {method: figures}}, "kinds": {kind: figures}}.

    Args:
        results: of each kind.
        metrics: of each, see `panda_metrics`.
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
    """Tabulates `trials_metrics` beside the print."""
    rows = [
        {"name": f"{kind}, {method}", **metrics}
        for kind, methods in whole["rows"].items()
        for method, metrics in methods.items()
    ]
    notes = (
        "touched: obstacles and the table, in any trial; short: trials keeping less than is asked;",
        "print: Table III of the paper, of a real Panda",
    )
    return TextTable(_TRIAL_COLUMNS, rows, notes)
