"""Real-time factors of scenarios, and the wall time of each system.

The real-time factor is that of `drake-oa run`. The wall time of the systems is measured in another
run, in which Python systems drive a stopwatch: while the diagram is built, each callback that a
system declares is put into a section of the system's name. Time in other Python systems, whose
ports a callback evaluates, belongs to their sections, so that nothing counts twice and the rows add
up to the whole, including a few per cent for the stopwatch. What C++ computes on demand, as an
image of a camera without delay, belongs to the section that demands it; the rest is Drake's:
plant, Simulator and logs.
"""

from __future__ import annotations

import inspect
import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.systems.framework import LeafSystem

from drake_oa.common.console import Column, TextTable
from drake_oa.common.files import software_versions
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.scenario import Scenario

REST = "plant, Simulator and logs"
"""Name of what is outside all sections."""
_LEAD = 0.1
"""What is simulated before the layers are timed: a first frame loads the renderer [s]."""


def run_benchmark(
    scenarios: Mapping[str, Scenario],
    *,
    seconds: float = 3.0,
    on_scenario: Callable[[str], None] = lambda name: None,
) -> dict[str, Any]:
    """Times runs.

    Args:
        scenarios: name -> scenario.
        seconds: simulated time of a run [s].
        on_scenario: called with the name of each scenario before it is timed.

    Returns:
        `machine`, `versions` and `scenarios`: name -> {"run": {`real_time_factor`, `layers` (system
        -> wall time of a simulated second [s])}}.

    Raises:
        ValueError: if the time is not positive.
    """
    if not 0.0 < seconds < np.inf:
        raise ValueError(f"seconds must be positive, not {seconds}")
    machine = _machine()
    found: dict[str, dict[str, Any]] = {}
    for name, scenario in scenarios.items():
        on_scenario(name)
        # Compiles or loads the kernels, and the renderer.
        simulate(scenario, duration=_LEAD)
        log = simulate(scenario, duration=seconds)
        factor = log.simulated_time / log.wall_time
        layers = time_layers(scenario, seconds)
        found[name] = {"run": {"real_time_factor": factor, "layers": layers}}
    return {
        "machine": machine,
        "versions": dict(item.split(" ", 1) for item in software_versions()),
        "scenarios": found,
    }


def benchmark_table(figures: Mapping[str, Any]) -> TextTable:
    """Returns the figures of `run_benchmark` as a table with a column for each scenario.

    The systems that take most come first.
    """
    rows: list[dict[str, Any]] = []
    layers: dict[str, float] = {}
    for name, found in figures["scenarios"].items():
        run = found["run"]
        rows.append({"name": name, **run, **run["layers"]})
        layers |= {of: max(layers.get(of, 0.0), time) for of, time in run["layers"].items()}
    columns = [
        Column("name", ""),
        Column("real_time_factor", "real-time factor", "{:.2f}"),
        *(
            Column(layer, form="{:.1f}", scale=1e3)
            for layer in sorted(layers, key=layers.__getitem__, reverse=True)
        ),
    ]
    machine = figures["machine"]
    notes = (
        "systems: wall time [ms] of a simulated second, without that of other systems",
        f"{machine['cpu']}, {machine['cores']} cores, load {machine['load']:.1f} at the start",
        ", ".join(f"{name} {value[:12]}" for name, value in figures["versions"].items()),
    )
    return TextTable(columns, rows, notes, transposed=True)


def _machine() -> dict[str, Any]:
    """CPU model, usable cores, and how busy the machine was."""
    known = Path("/proc/cpuinfo")
    lines = known.read_text().splitlines() if known.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    affinity = getattr(os, "sched_getaffinity", None)
    return {
        "cpu": models[0] if models else platform.machine(),
        "cores": len(affinity(0)) if affinity else os.cpu_count(),
        "load": os.getloadavg()[0],
    }


class Stopwatch:
    """Each moment belongs to the innermost section that is open, or to `REST`.

    So the sections add up to the whole, however they call one another. `spent` [s] is by name.
    """

    def __init__(self) -> None:
        self._open = [REST]
        self.reset()

    def reset(self) -> None:
        """Forgets what was spent; sections that are open go on."""
        self.spent: dict[str, float] = {}
        self._since = time.perf_counter()

    def stop(self) -> None:
        """Charges the time until now."""
        now = time.perf_counter()
        self.spent[self._open[-1]] = self.spent.get(self._open[-1], 0.0) + now - self._since
        self._since = now

    @contextmanager
    def section(self, name: str) -> Iterator[None]:
        """Charges what happens inside to `name`."""
        self.stop()
        self._open.append(name)
        try:
            yield
        finally:
            self.stop()
            self._open.pop()


def time_layers(scenario: Scenario, seconds: float) -> dict[str, float]:
    """Wall time that each system takes of a simulated second of a run [s].

    Args:
        scenario: what is run.
        seconds: simulated [s], after the first frames; ends early where the motion does.
    """
    watch, times = Stopwatch(), [0.0]

    def on_progress(now: float, phase: float) -> None:
        if times[0] < _LEAD:
            times[:] = [now]
            watch.reset()
        else:
            times.append(now)
            watch.stop()

    with _watched_systems(watch):
        simulate(scenario, duration=_LEAD + seconds, on_progress=on_progress)
    covered = times[-1] - times[0]
    return {name: spent / covered for name, spent in watch.spent.items()}


@contextmanager
def _watched_systems(watch: Stopwatch) -> Iterator[None]:
    """Inside, what Python systems declare tells the stopwatch when it is called."""
    originals = {
        name: declare
        for name, declare in vars(LeafSystem).items()
        if name.startswith("Declare") and name.endswith(("OutputPort", "Event"))
    }
    try:
        for name, declare in originals.items():
            setattr(LeafSystem, name, _watching(watch, declare))
        yield
    finally:
        for name, declare in originals.items():
            setattr(LeafSystem, name, declare)


def _watching(watch: Stopwatch, declare: Callable[..., Any]) -> Callable[..., Any]:
    def declare_watched(system: Any, *arguments: Any, **named: Any) -> Any:
        def watched(item: Any) -> Any:
            if not inspect.isroutine(item):
                return item

            def called(*given: Any) -> Any:
                # Not before: a system is named once it has declared all.
                with watch.section(system.get_name()):
                    return item(*given)

            return called

        return declare(
            system, *map(watched, arguments), **{key: watched(item) for key, item in named.items()}
        )

    return declare_watched
