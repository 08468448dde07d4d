"""Table II of the paper (tab:results_unseen_metrics): 4 x 1,000 novel scenes, by named readings.

The print leaves open where the obstacles are, what is integrated, when a motion ends and how its
clearance is taken. A `Choice` says how each is read; `ABLATION` varies one thing at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, Literal

from drake_oa.common.console import Column, TextTable
from drake_oa.studies.scenes.evaluation import Evaluation, Outcome, evaluate
from drake_oa.studies.scenes.figures import motion_figures
from drake_oa.studies.scenes.paper_method import READING, Reading, run, sections
from drake_oa.studies.scenes.sampling import line_hits
from drake_oa.studies.scenes.scenes import Scenes
from drake_oa.studies.scenes.suites import SAMPLINGS

_PRINTED = ("clearance_mean", "clearance_min", "goal_error_mean", "goal_error_max", "collisions")
PRINTED: dict[float, dict[str, Any]] = {
    0.5: dict(zip(_PRINTED, (0.144, -5.01e-4, 4.41e-4, 0.017, 2), strict=True)),
    1.0: dict(zip(_PRINTED, (0.184, 0.060, 4.23e-4, 0.017, 0), strict=True)),
    1.5: dict(zip(_PRINTED, (0.196, 0.068, 5.22e-4, 0.023, 0), strict=True)),
    2.0: dict(zip(_PRINTED, (0.202, 0.076, 6.49e-4, 0.027, 0), strict=True)),
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


ABLATION: tuple[dict[str, str], ...] = (
    {"sampling": "demo"},
    {"sampling": "printed"},
    {"sampling": "narrow"},
    {"sampling": "near"},
    {"distance": "plane"},
    {"distance": "space"},
    {"tau": "semi-axes"},
    {"tau": "widths"},
    {"tau": "extreme"},
    {"time": "until-arrived"},
    {"time": "fixed"},
    {"time": "tau"},
    {"steps": "training"},
    {"steps": "demo"},
    {"chain": "released"},
    {"chain": "running"},
    {"scale": "metres"},
    {"scale": "baselines"},
    {"law": "released"},
    {"law": "printed"},
    {"law": "printed", "tau": "extreme", "time": "tau"},
    {"law": "running"},
    {"law": "running", "chain": "running"},
    {"law": "running", "chain": "running", "scale": "baselines"},
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
        for baseline, printed in PRINTED.items():
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
            "by_baseline": [{"baseline": L, **row} for L, row in PRINTED.items()],
        },
        "readings": readings,
    }


_COLUMNS = (
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
            rows.append({"name": "  the paper prints", **PRINTED[row["baseline"]]})
        title = name if reading["complete"] else f"{name} (not complete)"
        tables.append(TextTable((Column("name", title), *_COLUMNS), rows))
        counts = {
            key: sum(row["agrees"][key] for row in reading["by_baseline"]) for key in _PRINTED
        }
        summary.append({"name": title, **reading, **counts})
    columns = (
        Column("name", "cells that agree"),
        *(Column(key, heading) for key, heading in _HEADINGS.items()),
        Column("cells", "of 20"),
        Column("lines_hit", "lines hit", "{:.0f} %", 1e2),
    )
    return [*tables, TextTable(columns, summary, _NOTES)]
