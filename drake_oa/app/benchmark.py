"""Command `drake-oa benchmark`: real-time factors of scenarios, and wall times of their systems."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from drake_oa.app.scenarios import Positive, scenario_name
from drake_oa.common.console import quiet, show
from drake_oa.common.files import check_outputs, replace_json


def benchmark(
    *,
    scenarios: Annotated[tuple[str, ...], Parameter(name="--scenario")] = (
        "tabletop_box",
        "moving_obstacle",
    ),
    seconds: Positive = 3.0,
    json: Path | None = None,
) -> None:
    """Measure the real-time factor of scenarios, and the wall time of each system.

    The table has a column for each scenario and these rows:

      real-time factor   simulated time over wall time of a run
      SYSTEM [ms/s]      wall time of the system for each simulated second
      plant, Simulator and logs [ms/s]
                         wall time outside the Python systems

    For example:

        drake-oa benchmark --json benchmark.json
        drake-oa benchmark --scenario shelf_elbow

    Args:
        scenarios: a shipped name (see `drake-oa scenarios`) or a file; may be repeated.
        seconds: simulated duration of each run [s].
        json: write the metrics to this file.
    """
    from drake_oa.benchmark import benchmark_table, run_benchmark
    from drake_oa.scenario.loading import load_scenario

    chosen = {scenario_name(name): load_scenario(name) for name in scenarios}
    check_outputs(json)
    with quiet():
        metrics = run_benchmark(chosen, seconds=seconds)
    show(benchmark_table(metrics))
    replace_json(json, metrics)
