"""The command `drake-oa benchmark`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from drake_oa.app.scenarios import quiet, scenario_name
from drake_oa.common.console import show
from drake_oa.common.files import check_outputs, replace_json


def benchmark(
    *,
    scenarios: Annotated[tuple[str, ...], Parameter(name="--scenario")] = (
        "tabletop_box",
        "moving_obstacle",
    ),
    only: tuple[Literal["run", "thinking"], ...] = ("run", "thinking"),
    seconds: float = 3.0,
    json: Path | None = None,
) -> None:
    """Time runs, their layers and their decisions.

      run       the real-time factor, beside that of Drake alone (plant and camera, the arm
                held), and what each system takes of a simulated second
      thinking  the processor time of a run's decisions, the simulated time that their work
                costs, and the constants that would fit this run best

    For example:

        drake-oa benchmark --json benchmark.json
        drake-oa benchmark --only thinking --scenario shelf_elbow

    Args:
        scenarios: a shipped name (see `drake-oa scenarios`) or a file; may be repeated.
        only: time this part only; may be repeated.
        seconds: simulated time of each run.
        json: write the figures.
    """
    from drake_oa.benchmark import benchmark_table, run_benchmark
    from drake_oa.scenario.loading import load_scenario

    chosen = {scenario_name(name): load_scenario(name) for name in scenarios}
    check_outputs(json)
    with quiet():
        figures = run_benchmark(
            chosen,
            only,
            seconds=seconds,
            on_part=lambda part: print(f"timing {part} ...", file=sys.stderr),
        )
    show(benchmark_table(figures))
    replace_json(json, figures)
