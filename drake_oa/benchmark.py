"""Real-time factors of scenarios, and the wall time of each system.

The real-time factor is that of `drake-oa run`. The wall time of the systems is measured in another
run, in which each callback that a Python system declares is timed. Time in other Python systems,
whose ports a callback evaluates, belongs to these, so that nothing counts twice. Drake's systems
that are computed on demand, as an image of a camera without delay, belong to the system that
demands them; the rest is plant, Simulator and logs.
"""

from __future__ import annotations

import inspect
import os
import platform
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from pydrake.systems.framework import LeafSystem

from drake_oa.common.console import Column, TextTable
from drake_oa.common.files import software_versions
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.scenario import Scenario

REMAINDER = "plant, Simulator and logs"
"""Name of what is outside all Python systems."""
_WARMUP = 0.1
"""Simulated time that compiles or loads the kernels and the renderer [s]."""


def run_benchmark(scenarios: Mapping[str, Scenario], *, seconds: float = 3.0) -> dict[str, Any]:
    """Times runs.

    Args:
        scenarios: name -> scenario.
        seconds: simulated time of a run [s].

    Returns:
        `machine`, `versions` and `scenarios`: name -> {"run": {`real_time_factor`, `layers` (system
        -> wall time of a simulated second [s])}}.
    """
    found: dict[str, dict[str, Any]] = {}
    for name, scenario in scenarios.items():
        simulate(scenario, duration=_WARMUP)
        log = simulate(scenario, duration=seconds)
        with timed_systems() as spent:
            timed = simulate(scenario, duration=seconds)
        spent[REMAINDER] = max(0.0, timed.wall_time - sum(spent.values()))
        longest_first = sorted(spent, key=spent.__getitem__, reverse=True)
        layers = {of: spent[of] / timed.simulated_time for of in longest_first}
        factor = log.simulated_time / log.wall_time
        found[name] = {"run": {"real_time_factor": factor, "layers": layers}}
    return {
        "machine": {"cpu": platform.processor() or platform.machine(), "cores": os.cpu_count()},
        "versions": software_versions(),
        "scenarios": found,
    }


def benchmark_table(metrics: Mapping[str, Any]) -> TextTable:
    """Returns the figures of `run_benchmark` as a table with a column for each scenario."""
    runs = {name: found["run"] for name, found in metrics["scenarios"].items()}
    rows = [{"name": name, **run, **run["layers"]} for name, run in runs.items()]
    layers = dict.fromkeys(of for run in runs.values() for of in run["layers"])
    columns = [
        Column("name", ""),
        Column("real_time_factor", "real-time factor", "{:.2f}"),
        *(Column(of, f"{of} [ms/s]", "{:.1f}", 1e3) for of in layers),
    ]
    machine = metrics["machine"]
    return TextTable(
        columns, rows, [f"{machine['cpu']}, {machine['cores']} cores"], transposed=True
    )


@contextmanager
def timed_systems() -> Iterator[dict[str, float]]:
    """Measures the wall time of each Python system that is created inside [s]."""
    spent: dict[str, float] = defaultdict(float)
    inner = [0.0]
    originals = {
        name: declare
        for name, declare in vars(LeafSystem).items()
        if name.startswith("Declare") and name.endswith(("OutputPort", "Event"))
    }

    def timed(declare: Callable[..., Any]) -> Callable[..., Any]:
        def declare_timed(system: Any, *arguments: Any, **named: Any) -> Any:
            def wrapped(item: Any) -> Any:
                if not inspect.isroutine(item):
                    return item

                def call(*given: Any) -> Any:
                    begun = time.perf_counter()
                    inner.append(0.0)
                    try:
                        return item(*given)
                    finally:
                        whole = time.perf_counter() - begun
                        # A system is named once it has declared all.
                        spent[system.get_name()] += whole - inner.pop()
                        inner[-1] += whole

                return call

            named = {key: wrapped(item) for key, item in named.items()}
            return declare(system, *map(wrapped, arguments), **named)

        return declare_timed

    try:
        for name, declare in originals.items():
            setattr(LeafSystem, name, timed(declare))
        yield spent
    finally:
        for name, declare in originals.items():
            setattr(LeafSystem, name, declare)
