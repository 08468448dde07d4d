"""The paper's Tables I to III, computed and compared with the printed values.

- Table I (tab:nn_training): prediction errors of the chains that are shipped. What training
  measured stands in the weights' metadata; nothing is computed here.
- Table II (tab:results_unseen_metrics): 4 x 1,000 novel scenes, by named readings. The print leaves
  open where the obstacles are, what is integrated, when a motion ends and how its clearance is
  taken. A `Choice` says how each is read; `ABLATION` varies one thing at a time.
- Table III (tab:franka_metrics): three kinds of obstacles before the whole robot: the scenarios
  `paper_box`, `paper_irregular` and `paper_clutter`, each with the noise of other seeds; a trial is
  a run. Printed are eleven trials of a real Panda in all, as means.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from drake_oa.common.console import Column, TextTable
from drake_oa.regulation.regressor import TARGETS
from drake_oa.scenario.loading import load_scenario, scenario_text
from drake_oa.studies.panda.evaluation import Drawing, PandaResults, PandaSuite, check_methods
from drake_oa.studies.results import Counts
from drake_oa.studies.scenes.evaluation import Evaluation, Outcome, evaluate, motion_figures
from drake_oa.studies.scenes.paper_method import SHIPPED, paper_chain, run, sections
from drake_oa.studies.scenes.reading import READING, Reading
from drake_oa.studies.scenes.scenes import Scenes
from drake_oa.studies.scenes.suites import SAMPLINGS, line_hits
from drake_oa.training.paper import error_table, printed_errors

_TOLD = ("chain", "action_level", "rollouts", "seed", "version", "date", "source_digest")
"""Keys of the weights' metadata that the JSON repeats."""


def table_one_figures(versions: Sequence[str]) -> dict[str, Any]:
    """What the JSON holds: of each shipped file its chain, and a row a network.

    NMSE on the train and the test rows; of the chains on the released code's action level the
    print beside them; the floor that no function of the inputs beats on that set.

    Args:
        versions: "name version" each.

    Raises:
        FileNotFoundError: if weights are missing.
        ValueError: if they are not of the paper's recipe.
    """
    chains = {}
    for (constrained, trained_on), file in SHIPPED.items():
        told = paper_chain(constrained, trained_on).metadata
        if told.get("recipe") != "paper" or "nmse" not in told:
            raise ValueError(f"{file}.safetensors is not of the paper's recipe")
        networks = {}
        for target in TARGETS:
            network = {**told["nmse"][target], "rows": told["rows"][target]}
            if trained_on == "released":
                network |= printed_errors(told["chain"], target)
            networks[target] = network
        chains[file] = {key: told[key] for key in _TOLD} | {"networks": networks}
    return {
        "table": "table1",
        "versions": dict(item.split(" ", 1) for item in versions),
        "chains": chains,
    }


def table_one(whole: Mapping[str, Any]) -> list[TextTable]:
    """What `table_one_figures` found, a table a file."""
    return [
        error_table(file, chain["networks"], [f"({chain['chain']}; {chain['action_level']})"])
        for file, chain in whole["chains"].items()
    ]


_CELLS = ("clearance_mean", "clearance_min", "goal_error_mean", "goal_error_max", "collisions")
TABLE_TWO: dict[float, dict[str, Any]] = {
    0.5: dict(zip(_CELLS, (0.144, -5.01e-4, 4.41e-4, 0.017, 2), strict=True)),
    1.0: dict(zip(_CELLS, (0.184, 0.060, 4.23e-4, 0.017, 0), strict=True)),
    1.5: dict(zip(_CELLS, (0.196, 0.068, 5.22e-4, 0.023, 0), strict=True)),
    2.0: dict(zip(_CELLS, (0.202, 0.076, 6.49e-4, 0.027, 0), strict=True)),
}
"""The print, by baseline."""
LINES_HIT = 0.324
"""Share of straight lines in collision there: 1,296 of 4,000."""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """A reading of the whole experiment.

    Attributes:
        sampling: which scenes, a key of `SAMPLINGS`.
        distance: plane: the clearance is that to the obstacle's section, in the P-plane; space:
            to the obstacle.
        reading: of the action level.
    """

    sampling: Literal["printed", "demo", "narrow", "near"] = "demo"
    distance: Literal["plane", "space"] = "plane"
    reading: Reading = READING

    def options(self) -> dict[str, str]:
        """All of it as the command names it."""
        return {"sampling": self.sampling, "distance": self.distance, **asdict(self.reading)}

    def changed(self, options: Mapping[str, Any]) -> Choice:
        """The same but for some options."""
        others = dict(options)
        own = {name: others.pop(name) for name in ("sampling", "distance") if name in others}
        return replace(self, **own, reading=replace(self.reading, **others))


_VALUES = {
    "sampling": ("demo", "printed", "narrow", "near"),
    "distance": ("plane", "space"),
    "tau": ("semi-axes", "widths", "extreme"),
    "time": ("until-arrived", "fixed", "tau"),
    "steps": ("training", "demo"),
    "chain": ("released", "running"),
    "scale": ("metres", "baselines"),
    "law": ("released", "printed"),
}
_RUNNING = {"law": "running", "chain": "running"}
ABLATION: tuple[dict[str, str], ...] = (
    *({name: value} for name, values in _VALUES.items() for value in values),
    {"law": "printed", "tau": "extreme", "time": "tau"},
    {"law": "running"},
    _RUNNING,
    {**_RUNNING, "scale": "baselines"},
)
"""What is varied, one thing at a time but for laws that have a tau, a chain or a unit of their
own; what the choice has already is left out."""


def choices(choice: Choice, ablation: bool) -> dict[str, Choice]:
    """By name: the choice, and those that the ablation makes of it."""
    found = {"chosen": choice}
    for options in ABLATION if ablation else ():
        varied = choice.changed(options)
        if varied not in found.values():
            found[", ".join(f"{name} {value}" for name, value in options.items())] = varied
    return found


def judge_choice(
    name: str,
    choice: Choice,
    scenes: Scenes,
    on_progress: Callable[[str, int], None] = lambda name, done: None,
) -> Evaluation:
    """Runs a choice on scenes of its sampling, and has it judged; the outcome has its name."""
    return evaluate(
        scenes,
        SAMPLINGS[choice.sampling].cases,
        {name: partial(run, reading=choice.reading)},
        on_progress=on_progress,
        judged_among=sections if choice.distance == "plane" else lambda given: given,
    )


_MEAN, _LEAST, _FACTOR, _COLLISIONS = 0.01, 0.03, 2.0, 3
"""How far apart a figure may be to agree with the print [m, m, -, -]."""


def agrees(found: Mapping[str, Any], printed: Mapping[str, Any]) -> dict[str, bool]:
    """Which cells of a row agree with the print; none of a row without scenes."""
    within = {"clearance_mean": _MEAN, "clearance_min": _LEAST, "collisions": _COLLISIONS}
    close: dict[str, bool] = {}
    for key, value in printed.items():
        ours = found[key]
        if not found["scenes"]:
            close[key] = False
        elif key in within:
            close[key] = abs(ours - value) <= within[key]
        else:
            close[key] = value / _FACTOR <= ours <= value * _FACTOR
    return close


def table_two_figures(
    chosen: Mapping[str, Choice],
    outcomes: Mapping[str, Outcome],
    scenes: Mapping[str, Scenes],
    seed: int,
    versions: Sequence[str],
) -> dict[str, Any]:
    """What the JSON holds: of each choice its options and a row a baseline, lengths in m.

    Args:
        chosen: choices by name.
        outcomes: of some of them.
        scenes: by the name of their sampling.
        seed: of the scenes.
        versions: "name version" each.
    """
    hit = {name: float(line_hits(of).any(axis=1).mean()) for name, of in scenes.items()}
    readings: dict[str, Any] = {}
    for name, outcome in outcomes.items():
        rows = []
        judged = outcome.of()
        for baseline, printed in TABLE_TWO.items():
            row = motion_figures(judged.rows(judged.baseline == baseline))
            rows.append({"baseline": baseline, **row, "agrees": agrees(row, printed)})
        readings[name] = {
            "options": chosen[name].options(),
            "lines_hit": hit[chosen[name].sampling],
            "complete": outcome.complete,
            "error": outcome.error,
            "cells": sum(sum(row["agrees"].values()) for row in rows),
            "by_baseline": rows,
        }
    return {
        "table": "table2",
        "seed": seed,
        "versions": dict(item.split(" ", 1) for item in versions),
        "print": {
            "lines_hit": LINES_HIT,
            "by_baseline": [{"baseline": L, **row} for L, row in TABLE_TWO.items()],
        },
        "readings": readings,
    }


_CELL_COLUMNS = (
    Column("collisions"),
    Column("clearance_mean", "clearance mean [m]", "{:.3f}"),
    Column("clearance_min", "min [m]", "{:.4f}"),
    Column("goal_error_mean", "goal error mean [mm]", "{:.2f}", 1e3),
    Column("goal_error_max", "max [mm]", "{:.0f}", 1e3),
    Column("off", "differs"),
)
_HEADINGS = {
    "collisions": "collisions",
    "clearance_mean": "clearance mean",
    "clearance_min": "clearance min",
    "goal_error_mean": "goal mean",
    "goal_error_max": "goal max",
}
_NOTES = (
    f"agree: mean clearances within {1e3 * _MEAN:g} mm, least ones within {1e3 * _LEAST:g} mm,",
    f"collisions within {_COLLISIONS}, goal errors within a factor of {_FACTOR:g}.",
    f"Of the print's straight lines {1e2 * LINES_HIT:.0f} % are in collision.",
)


def table_two(whole: Mapping[str, Any]) -> list[TextTable]:
    """What `table_two_figures` found: each reading's rows, and which of its cells agree."""
    tables, summary = [], []
    for name, reading in whole["readings"].items():
        rows = []
        for row in reading["by_baseline"]:
            off = [_HEADINGS[key] for key, same in row["agrees"].items() if not same]
            title = f"goal at {row['baseline']:g} m"
            rows.append({"name": title, "off": ", ".join(off) or "none", **row})
            rows.append({"name": "  the paper prints", **TABLE_TWO[row["baseline"]]})
        title = name if reading["complete"] else f"{name} (not complete)"
        tables.append(TextTable((Column("name", title), *_CELL_COLUMNS), rows))
        counts = {key: sum(row["agrees"][key] for row in reading["by_baseline"]) for key in _CELLS}
        summary.append({"name": title, **reading, **counts})
    columns = (
        Column("name", "cells that agree"),
        *(Column(key, heading) for key, heading in _HEADINGS.items()),
        Column("cells", "of 20"),
        Column("lines_hit", "lines hit", "{:.0f} %", 1e2),
    )
    return [*tables, TextTable(columns, summary, _NOTES)]


def _printed(
    clearance: float | None, goal_error: float | None, contacts: int, short: int
) -> dict[str, Any]:
    """Returns a row of Table III; the print has "fail" for None.

    Args:
        clearance: to the obstacle [m].
        goal_error: convergence to the goal [m].
        contacts: number of obstacles that were touched.
        short: number of those that were passed nearer than 0.15 m.
    """
    return {
        "clearance_printed": clearance,
        "goal_error_printed": goal_error,
        "contacts_printed": contacts,
        "short_printed": short,
    }


_BLIND = _printed(None, None, 1, 1)
TABLE_THREE = {
    ("box", "preplanned"): _BLIND,
    ("box", "paper"): _printed(0.168, 9.58e-3, 0, 0),
    ("irregular", "preplanned"): _BLIND,
    ("irregular", "paper"): _printed(0.163, 4.17e-3, 0, 0),
    ("clutter", "preplanned"): _printed(None, None, 2, 5),
    ("clutter", "paper"): _printed(0.172, 1.29e-2, 0, 0),
}
"""Table III of the paper, by kind and method."""

TRIAL_KINDS = ("box", "irregular", "clutter")
TRIAL_METHODS = ("preplanned", "paper")

_TRIAL_COLUMNS = (
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


def trial_text(name: str, seed: int) -> tuple[str, Counts]:
    """A shipped scenario with the noise of a seed, as text; nothing is dropped."""
    scenario = load_scenario(name)
    scenario.seed = seed
    return scenario_text(scenario), {}


def trial_suites(
    methods: Sequence[str], trials: int, seed: int, perception: str, duration: float | None
) -> list[PandaSuite]:
    """Makes a suite for each kind of obstacles: trials are of consecutive seeds of the noise.

    Raises:
        ValueError: for no trials, a negative seed or an unknown method.
    """
    chosen = check_methods("table3", methods, TRIAL_METHODS)
    return [
        PandaSuite(
            "table3",
            kind,
            seed,
            chosen,
            perception,
            duration,
            {
                trial: Drawing(
                    f"paper_{kind}-seed{seed}-scene{trial:04d}",
                    trial_text,
                    (f"paper_{kind}", seed + trial),
                )
                for trial in range(trials)
            },
        )
        for kind in TRIAL_KINDS
    ]


def trial_figures(
    runs: Mapping[int, Mapping[str, Any]], printed: Mapping[str, Any] | None
) -> dict[str, Any]:
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
    return found | dict(printed or {})


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
                method: trial_figures(runs, TABLE_THREE.get((of.suite.kind, method)))
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
    return TextTable(_TRIAL_COLUMNS, rows, notes)
