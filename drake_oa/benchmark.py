"""How fast scenarios run, where their time goes, and what their decisions take.

The real-time factor is that of `drake-oa run`, beside that of Drake alone: the scenario's plant
and camera, its arm held by gravity compensation. What each layer takes is of another run, whose
Python systems tell a stopwatch when they work: while the diagram is built, each callback that a
system declares is put into a section of the system's name. What a callback asks of other Python
systems is theirs, so that nothing counts twice and the rows add up to the whole, the stopwatch's
own few per cent included. What C++ computes when it is asked, as an image of a camera without
delay, counts for who asked; what is left is Drake's: plant, Simulator and logs.
"""

from __future__ import annotations

import copy
import inspect
import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, astuple, fields
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.controllers import InverseDynamics
from pydrake.systems.framework import Diagram, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ZeroOrderHold
from scipy.optimize import nnls

from drake_oa.common import thinking
from drake_oa.common.console import Column, TextTable
from drake_oa.common.files import software_versions
from drake_oa.common.thinking import Thinking, Work
from drake_oa.perception.config import CameraSource
from drake_oa.robot.plant import home_positions, make_robot_plant
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.sources import perception_period, simulated
from drake_oa.world.station import make_station

PARTS = ("run", "thinking")
"""What can be timed."""
REST = "plant, Simulator and logs"
"""Name of what is outside all sections."""
_LEAD = 0.1
"""What is simulated before the layers are timed: a first frame loads the renderer [s]."""
_SHORTEST = 2e-3
"""Decisions that are shorter weigh as much as those that take so long [s]."""


def run_benchmark(
    scenarios: Mapping[str, Scenario],
    parts: Sequence[str] = PARTS,
    *,
    seconds: float = 3.0,
    runs: int = 2,
    on_part: Callable[[str], None] = lambda part: None,
) -> dict[str, Any]:
    """Times what is asked for.

    Args:
        scenarios: name -> what is timed.
        parts: of `PARTS`.
        seconds: simulated time of runs that are timed [s].
        runs: whose decisions are timed, each being taken as the quickest of them.
        on_part: called with the name of each part before it is timed.

    Returns:
        `machine`, `versions` and `scenarios`: name -> {"run":
        {`real_time_factor`, `drake_alone` (None without a robot), `layers` (system -> wall time
        of a simulated second [s])}, "thinking": see `time_thinking`}.

    Raises:
        ValueError: for an unknown part, a number that is not positive, or a scenario whose
            thinking is null.
    """
    unknown = [part for part in parts if part not in PARTS]
    if unknown or not parts:
        raise ValueError(f"parts: {unknown} unknown; valid are: {', '.join(PARTS)}")
    if not 0.0 < seconds < np.inf or runs < 1:
        raise ValueError(f"seconds and runs must be positive, not {seconds} and {runs}")
    machine = _machine()
    found: dict[str, dict[str, Any]] = {name: {} for name in scenarios}
    for name, scenario in scenarios.items():
        # Compiles or loads the kernels, and the renderer.
        simulate(scenario, duration=_LEAD)
        if "run" in parts:
            on_part(f"{name}: run")
            found[name]["run"] = {
                "real_time_factor": real_time_factor(scenario, seconds),
                "drake_alone": _factor_alone(scenario, seconds),
                "layers": time_layers(scenario, seconds),
            }
        if "thinking" in parts:
            on_part(f"{name}: thinking")
            found[name]["thinking"] = time_thinking(scenario, seconds, runs)
    return {
        "machine": machine,
        "versions": dict(item.split(" ", 1) for item in software_versions()),
        "scenarios": found,
    }


def benchmark_table(figures: Mapping[str, Any]) -> TextTable:
    """Returns the figures of `run_benchmark` as a table with a column for each scenario.

    The layers that take most come first.
    """
    rows: list[dict[str, Any]] = []
    layers: dict[str, float] = {}
    for name, found in figures["scenarios"].items():
        run, times = found.get("run", {"layers": {}}), found.get("thinking", {"fitted": {}})
        rows.append({"name": name, **run, **run["layers"], **times, **times["fitted"]})
        layers |= {of: max(layers.get(of, 0.0), time) for of, time in run["layers"].items()}
    columns = [
        Column("name", ""),
        Column("real_time_factor", "real-time factor", "{:.2f}"),
        Column("drake_alone", "  of Drake alone", "{:.2f}"),
        *(
            Column(layer, form="{:.1f}", scale=1e3)
            for layer in sorted(layers, key=layers.__getitem__, reverse=True)
        ),
        Column("decisions"),
        Column("measured", "processor time [s]", "{:.2f}"),
        Column("modelled", "simulated time that they cost [s]", "{:.2f}"),
        *(
            Column(item.name, f"  {item.name} that fits best [us]", "{:.3g}", 1e6)
            for item in fields(Thinking)
        ),
    ]
    machine = figures["machine"]
    notes = (
        "layers: wall time [ms] of a simulated second, without what they ask of one another",
        "a constant is not told by a run with little work of its kind",
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


# Real-time factors ------------------------------------------------------------------------


def real_time_factor(scenario: Scenario, seconds: float) -> float:
    """As `drake-oa run` has it for so many seconds [s]: logs and supervision, no viewer."""
    log = simulate(scenario, duration=seconds)
    return log.simulated_time / log.wall_time


def drake_alone(scenario: Scenario) -> Diagram:
    """The scenario's plant and camera without our systems.

    The arm is held at its home posture by Drake's gravity compensation, and the image is pulled
    at the camera's rate.

    Raises:
        ValueError: if it has no robot.
    """
    if scenario.robot is None:
        raise ValueError("robot: this scenario has null")
    present = simulated(copy.deepcopy(scenario))
    for camera in present.cameras:
        # Rendered when it is asked for, and not beside the run.
        camera.output_delay = 0.0
    builder = DiagramBuilder()
    station = make_station(builder, present)
    plant = station.plant
    plant.SetDefaultPositions(station.robot, home_positions(scenario.robot))
    mode = InverseDynamics.InverseDynamicsMode.kGravityCompensation
    holder = builder.AddSystem(InverseDynamics(make_robot_plant(scenario.robot).plant, mode))
    state = plant.get_state_output_port(station.robot)
    builder.Connect(state, holder.get_input_port_estimated_state())
    builder.Connect(holder.get_output_port(), plant.get_actuation_input_port(station.robot))
    if isinstance(scenario.perception, CameraSource):
        for name in scenario.perception.names:
            image = station.cameras[name].depth_image
            puller = builder.AddSystem(ZeroOrderHold(perception_period(scenario), image.Allocate()))
            builder.Connect(image, puller.get_input_port())
    return builder.Build()


def _factor_alone(scenario: Scenario, seconds: float) -> float | None:
    if scenario.robot is None:
        return None
    simulator = Simulator(drake_alone(scenario))
    # The first image loads the renderer.
    simulator.AdvanceTo(_LEAD)
    begun = time.perf_counter()
    simulator.AdvanceTo(_LEAD + seconds)
    return seconds / (time.perf_counter() - begun)


# Layers -----------------------------------------------------------------------------------


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


# Decisions --------------------------------------------------------------------------------


def time_thinking(
    scenario: Scenario, duration: float | None = None, runs: int = 2
) -> dict[str, Any]:
    """Times the decisions of a scenario's motion, each the quickest of some runs.

    Args:
        scenario: whose.
        duration: time limit of a run [s]; None: that of `simulate`.
        runs: how many there are, at least 1.

    Returns:
        `decisions`: how many there were; `measured`: their processor time, of all threads [s];
        `modelled`: the simulated time that they cost [s]; `fitted`: the constants of `Thinking`
        that fit these decisions best.

    Raises:
        ValueError: if none costs time: the scenario's `thinking` is null.
    """
    if scenario.thinking is None:
        raise ValueError("thinking: this scenario has null, and its decisions cost no time")
    each = [_timed_decisions(scenario, duration) for _ in range(runs)]
    work = each[0][0]
    seconds = np.min([taken for _, taken in each], axis=0)
    # The columns are in the order of `Thinking`.
    amounts = np.column_stack([np.ones(len(work)), [astuple(one) for one in work]])
    weight = 1.0 / np.sqrt(np.maximum(seconds, _SHORTEST))
    fitted, _ = nnls(amounts * weight[:, None], seconds * weight)
    return {
        "decisions": len(work),
        "measured": float(seconds.sum()),
        "modelled": float(sum(map(scenario.thinking.seconds, work))),
        "fitted": asdict(Thinking(*fitted.tolist())),
    }


def _timed_decisions(scenario: Scenario, duration: float | None) -> tuple[list[Work], list[float]]:
    """The work of each decision of a run, the same in every run, and its processor time [s]."""
    work: list[Work] = []
    taken: list[float] = []
    plain = thinking.counted

    @contextmanager
    def timed() -> Iterator[Work]:
        begun = time.process_time()
        with plain() as account:
            yield account
        taken.append(time.process_time() - begun)
        work.append(account)

    thinking.counted = timed
    try:
        simulate(scenario, duration=duration)
    finally:
        thinking.counted = plain
    return work, taken
