"""Sources of the executed motions, and the results without each of them: `evaluate sources`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from drake_oa.common.console import Column, TextTable
from drake_oa.planning.search import SOURCES
from drake_oa.studies.panda.evaluation import PandaResults
from drake_oa.studies.panda.tables import run_figures
from drake_oa.studies.scenes.evaluation import over

_COLUMNS = (
    Column("suite"),
    Column("method"),
    Column("scenes"),
    Column("success"),
    Column("contacts"),
    Column("clearance", "clearance [m]", "{:.3f}"),
    Column("length", "path [m]", "{:.3f}"),
    Column("sources", "motions executed"),
)


def sources_figures(
    results: Sequence[PandaResults], figures: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Computes a row for each suite and method.

    Args:
        results: of the suites, with the method `verified` and those without a source.
        figures: of each, as they are written besides.

    Returns:
        {"suites": the figures, "rows": [{"suite", "method", "scenes", "success", "contacts",
        "clearance" (median of the robot's least clearance [m]), "length" (median length of the
        tool's path in the scenes in which every method succeeds [m]), "executed" (source ->
        scenes in which a motion of it was executed), "sources" (the same in words)}]}.
    """
    rows = []
    for found in results:
        runs = found.runs
        solved = [
            {scene for scene, run in of.items() if run["outcome"] == "success"}
            for of in runs.values()
        ]
        common = sorted(set.intersection(*solved))
        for method, of in runs.items():
            executed = {
                name: sum(name in (run.get("sources") or ()) for run in of.values())
                for name in SOURCES
            }
            counts = run_figures(list(of.values()))
            rows.append(
                {
                    "suite": found.suite.kind,
                    "method": method,
                    **{key: counts[key] for key in ("scenes", "success", "contacts")},
                    "clearance": over(
                        np.median, (run["robot_clearance_min"] for run in of.values())
                    ),
                    "length": over(np.median, (of[scene]["path_length"] for scene in common)),
                    "executed": executed,
                    "sources": ", ".join(f"{name} {n}" for name, n in executed.items() if n),
                }
            )
    return {"suites": list(figures), "rows": rows}


def sources_table(figures: Mapping[str, Any]) -> TextTable:
    """Returns the rows of `sources_figures` as a table."""
    notes = ("path: median over the scenes in which every method succeeds",)
    return TextTable(_COLUMNS, figures["rows"], notes)
