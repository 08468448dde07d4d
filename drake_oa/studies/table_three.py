"""Table III of the paper (tab:franka_metrics): three kinds of obstacles before the whole robot.

The scenarios `paper_box`, `paper_irregular` and `paper_clutter`, each with the noise of other
seeds: a trial is a run. Printed are eleven trials of a real Panda in all, as means.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from drake_oa.common.console import Column, TextTable
from drake_oa.scenario.loading import load_scenario, scenario_text
from drake_oa.studies.panda.evaluation import Drawing, PandaResults, PandaSuite
from drake_oa.studies.tally import Counts


@dataclass(frozen=True)
class Printed:
    """A row of the print; None: "fail".

    Attributes:
        title: the row's name there.
        clearance: to the obstacle [m].
        goal_error: convergence to the goal [m].
        contacts, short: obstacles that were touched, and that were passed nearer than 0.15 m.
    """

    title: str
    clearance: float | None
    goal_error: float | None
    contacts: int
    short: int


PRINTED = {
    ("box", "preplanned"): Printed("regular", None, None, 1, 1),
    ("box", "paper"): Printed("regular", 0.168, 9.58e-3, 0, 0),
    ("irregular", "preplanned"): Printed("irregular", None, None, 1, 1),
    ("irregular", "paper"): Printed("irregular", 0.163, 4.17e-3, 0, 0),
    ("clutter", "preplanned"): Printed("multi-obs", None, None, 2, 5),
    ("clutter", "paper"): Printed("multi-obs", 0.172, 1.29e-2, 0, 0),
}
"""Table III of the paper, by kind and method."""

KINDS = ("box", "irregular", "clutter")
METHODS = ("preplanned", "paper")

_COLUMNS = (
    Column("name", "scene, method"),
    Column("trials"),
    Column("obstacles_touched", "touched"),
    Column("clearance_mean", "clearance [m]", "{:.3f}"),
    Column("clearance_min", "least", "{:.3f}"),
    Column("clearance_printed", "print", "{:.3f}"),
    Column("trials_short", "short"),
    Column("goal_error_mean", "goal error [mm]", "{:.2f}", 1e3),
    Column("goal_error_max", "most", "{:.2f}", 1e3),
    Column("goal_error_printed", "print", "{:.2f}", 1e3),
    Column("duration_median", "duration [s]", "{:.1f}"),
)


@dataclass(frozen=True)
class TrialSuite(PandaSuite):
    """Trials of one of the scenarios: those of consecutive seeds of the camera's noise."""

    name: ClassVar[str] = "table3"

    def _check_kind(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"unknown kind '{self.kind}': it must be one of {', '.join(KINDS)}")
        for method in self.methods:
            if method not in METHODS:
                raise ValueError(f"unknown method {method!r}; table3 has: {', '.join(METHODS)}")

    def scene_name(self, scene: int) -> str:
        """Name of a trial's files."""
        return f"paper_{self.kind}-seed{self.seed}-scene{scene:04d}"

    def drawing(self, scene: int) -> tuple[Drawing, tuple[Any, ...]]:
        """What makes a trial's scenario, and its arguments."""
        return trial_text, (f"paper_{self.kind}", self.seed + scene)


def trial_text(name: str, seed: int) -> tuple[str, Counts]:
    """A shipped scenario with the noise of a seed, as text; nothing is dropped."""
    scenario = load_scenario(name)
    scenario.seed = seed
    return scenario_text(scenario), {}


def trial_suites(
    methods: Sequence[str], trials: int, seed: int, perception: str, duration: float | None
) -> list[TrialSuite]:
    """One suite for each kind of obstacles; `PandaSuite` tells the arguments.

    Raises:
        ValueError: for no trials, a negative seed or an unknown method.
    """
    return [
        TrialSuite(
            scenes=trials,
            seed=seed,
            methods=tuple(dict.fromkeys(methods)),
            perception=perception,
            kind=kind,
            duration=duration,
        )
        for kind in KINDS
    ]


def trial_figures(runs: Mapping[int, Mapping[str, Any]], printed: Printed | None) -> dict[str, Any]:
    """The figures of one row, lengths in m; of a row that the paper has, the print beside them.

    Args:
        runs: trial -> result, see `run_and_judge`.
        printed: the paper's row.
    """
    known = [run for run in runs.values() if run["tool_clearance_min"] is not None]
    clearance = [run["tool_clearance_min"] for run in known]
    error = [run["goal_error"] for run in known]
    touched = {part for run in known for pair in run["contacts"] for part in pair.split(" - ")[1:]}
    short = [run["tool_clearance_min"] < run["asked_clearance"] for run in known]
    found: dict[str, Any] = {
        "trials": len(runs),
        "obstacles_touched": len(touched),
        "trials_short": sum(short),
    }
    if known:
        found |= {
            "clearance_mean": float(np.mean(clearance)),
            "clearance_min": min(clearance),
            "goal_error_mean": float(np.mean(error)),
            "goal_error_max": max(error),
            "duration_median": float(np.median([run["duration"] for run in known])),
        }
    if printed is not None:
        found |= {
            "clearance_printed": printed.clearance,
            "goal_error_printed": printed.goal_error,
            "contacts_printed": printed.contacts,
            "short_printed": printed.short,
        }
    return found


def trials_figures(
    results: Sequence[PandaResults], figures: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """{"suite", "rows": {kind: {method: figures}}, "kinds": {kind: figures}}.

    Args:
        results: of each kind.
        figures: of each, see `panda_figures`.
    """
    return {
        "suite": results[0].suite.name,
        "rows": {
            of.suite.kind: {
                method: trial_figures(runs, PRINTED.get((of.suite.kind, method)))
                for method, runs in of.runs.items()
            }
            for of in results
        },
        "kinds": {of["kind"]: of for of in figures},
    }


def table_three(whole: Mapping[str, Any]) -> TextTable:
    """What `trials_figures` found, beside the print."""
    rows = [
        {"name": f"{kind}, {method}", **figures}
        for kind, methods in whole["rows"].items()
        for method, figures in methods.items()
    ]
    notes = (
        "touched: obstacles and the table, in any trial; short: trials keeping less than is asked;",
        "print: Table III of the paper, of a real Panda",
    )
    return TextTable(_COLUMNS, rows, notes)
