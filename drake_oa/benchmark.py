"""Measurement of the real-time factors of scenarios, and of the wall time that each system of their
diagrams needs.

The real-time factor is simulated time over wall time of a run as by `drake-oa run`. A second run
measures each callback (output port or event) of the systems that are written in Python. If a
callback evaluates a port of another Python system, the time of that evaluation counts for the other
system only. The time of Drake's own systems, such as a camera without delay, counts for the Python
system that evaluates their ports. The remainder is plant, Simulator and logs.
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
"""Name of the table row for the wall time of a simulation outside all systems written in Python."""
_WARMUP = 0.1
"""Simulated duration of a run before the measurements, which loads kernels and renderer [s]."""


def run_benchmark(scenarios: Mapping[str, Scenario], *, seconds: float = 3.0) -> dict[str, Any]:
    """Measures for each scenario the real-time factor of its simulation and the wall times of its
    systems.

    Args:
        scenarios: scenarios by name.
        seconds: simulated duration of each run [s].

    Returns:
        Dictionary of "machine" (processor and number of cores), "versions" (of the software) and
        "scenarios". The latter has for each name {"real_time_factor", "layers"}. "layers" is the
        wall time per simulated second [s/s] of each system that is written in Python, by the name
        of the system, and that of the remainder, `REMAINDER`.
    """
    metrics: dict[str, dict[str, Any]] = {}
    for name, scenario in scenarios.items():
        simulate(scenario, duration=_WARMUP)
        log = simulate(scenario, duration=seconds)
        with timed_systems() as wall_times:
            timed = simulate(scenario, duration=seconds)
        wall_times[REMAINDER] = max(0.0, timed.wall_time - sum(wall_times.values()))
        longest_first = sorted(wall_times, key=wall_times.__getitem__, reverse=True)
        layers = {of: wall_times[of] / timed.simulated_time for of in longest_first}
        factor = log.simulated_time / log.wall_time
        metrics[name] = {"real_time_factor": factor, "layers": layers}
    return {
        "machine": {"cpu": platform.processor() or platform.machine(), "cores": os.cpu_count()},
        "versions": software_versions(),
        "scenarios": metrics,
    }


def benchmark_table(metrics: Mapping[str, Any]) -> TextTable:
    """Returns the result of `run_benchmark` as a table, with a column for each scenario and a row
    for each system.
    """
    scenarios = metrics["scenarios"]
    rows = [{"name": name, **item, **item["layers"]} for name, item in scenarios.items()]
    layers = dict.fromkeys(of for item in scenarios.values() for of in item["layers"])
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
    """Measures the wall times of the callbacks (output ports and events) of all systems written in
    Python that are created in the `with` block.

    Yields:
        Name of the system -> sum of the wall times of its callbacks until now, without those of
        other systems that they call [s].
    """
    wall_times: dict[str, float] = defaultdict(float)
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

                def call(*values: Any) -> Any:
                    start = time.perf_counter()
                    inner.append(0.0)
                    try:
                        return item(*values)
                    finally:
                        total = time.perf_counter() - start
                        # A system has its name only after its construction.
                        wall_times[system.get_name()] += total - inner.pop()
                        inner[-1] += total

                return call

            named = {key: wrapped(item) for key, item in named.items()}
            return declare(system, *map(wrapped, arguments), **named)

        return declare_timed

    try:
        for name, declare in originals.items():
            setattr(LeafSystem, name, timed(declare))
        yield wall_times
    finally:
        for name, declare in originals.items():
            setattr(LeafSystem, name, declare)
