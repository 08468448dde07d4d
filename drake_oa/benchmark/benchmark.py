"""`drake-oa benchmark`: what roll-outs, layers and a run cost, beside baselines of the same run."""

from __future__ import annotations

import importlib
import math
import os
import platform
import statistics
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from drake_oa.benchmark.benchmark_figures import Figure, Share, benchmark_table
from drake_oa.benchmark.frame_timings import record, time_controller, time_frames
from drake_oa.benchmark.policy_timings import OBSTACLES, time_kernel, time_layers, time_policy
from drake_oa.benchmark.rollout_timings import BASELINE_ROWS, PAPER_ROWS, ROWS, time_rollouts
from drake_oa.benchmark.run_budget import LayerTime, time_run
from drake_oa.benchmark.run_timings import (
    bare_station,
    camera_rate,
    real_time_factor,
    time_plant,
    whole_real_time_factor,
)
from drake_oa.benchmark.thinking_timings import time_thinking
from drake_oa.benchmark.verification_timings import CANDIDATES, time_verification
from drake_oa.common.provenance import software_versions
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.scenario import Scenario

__all__ = ["PARTS", "Effort", "benchmark_table", "run_benchmark"]

PAPER_TARGET = 10.0
"""Most time for the paper's 12.5 million roll-outs of 1,000 steps, on two cores [s]."""
TIMES_TARGET = 10.0
"""How many times as fast as NumPy, and as torch eager, the kernel has to be on one core."""
KERNEL_TARGET = 10.0
"""Most time for one policy step with six obstacles in the kernel [us]."""
POLICY_TARGET = 60.0
"""Most time for one policy step with six obstacles through the Drake systems [us]."""
VERIFICATION_TARGET = 3.0
"""Most time for one online verification [ms]."""
REAL_TIME_TARGET = 1.0
"""Least real-time factor of the whole stack."""
FRAME_TARGET = 33.0
"""Most time from one depth image to ellipsoids [ms]."""


@dataclass(frozen=True)
class Effort:
    """How much is timed.

    Attributes:
        seconds: simulated time of runs that are timed [s].
        steps: policy steps, and steps of the plant.
        frames: images.
        rows: roll-outs of the paper's motion.
        baseline_rows: how many of them NumPy and torch are timed on.
        scenes: scenes that a motion is verified in.
        runs: runs whose decisions are timed.
        readable_rows: of 64 candidates, how many are rolled out by the readable reference.

    Raises:
        ValueError: for a number that is not positive, or that exceeds what it is part of.
    """

    seconds: float = 3.0
    steps: int = 400
    frames: int = 30
    rows: int = ROWS
    baseline_rows: int = BASELINE_ROWS
    scenes: int = 20
    readable_rows: int = 4
    runs: int = 2

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not 0 < value < math.inf:
                raise ValueError(f"{name} must be positive, not {value}")
        for name, least in (("baseline_rows", self.rows), ("readable_rows", CANDIDATES)):
            if getattr(self, name) > least:
                raise ValueError(f"{name} must be at most {least}, not {getattr(self, name)}")


@dataclass
class _Results:
    figures: list[Figure] = field(default_factory=list)
    breakdown: list[Share] = field(default_factory=list)
    budget: list[LayerTime] = field(default_factory=list)
    notes: dict[str, str] = field(default_factory=dict)


def run_benchmark(
    scenario: Scenario,
    parts: Sequence[str] | None = None,
    *,
    effort: Effort | None = None,
    on_part: Callable[[str], None] = lambda part: None,
) -> dict[str, Any]:
    """Times what is asked for, on one BLAS thread.

    Args:
        scenario: whose policy, perception and run are timed; all parts but "rollouts" and
            "verification" need a robot and a depth camera in it.
        parts: of `PARTS`, timed in that order; None: all.
        effort: how much is timed; None: the defaults.
        on_part: called with the name of each part before it is timed.

    Returns:
        `scenario` (its description), `machine`, `versions` and `commit` (None when
        unknown); `figures`, each with the fields of `Figure`, `ratio`, `times_better` and
        `met`; `breakdown`, each with the fields of `Share`; `budget`, what each layer takes
        of a run, with the fields of `LayerTime`, empty unless "run" was asked for; `notes`,
        how a part was measured. Times are medians, those of roll-outs the best of three and
        those of the budget means.

    Raises:
        ScenarioError: if the scenario lacks a robot or a depth camera that is needed, or
            its policy is held among six obstacles in free space.
        ValueError: for an unknown part.
    """
    asked = tuple(PARTS) if parts is None else tuple(parts)
    unknown = [part for part in asked if part not in PARTS]
    if unknown or not asked:
        raise ValueError(f"parts: {unknown} unknown; valid are: {', '.join(PARTS)}")
    effort, results, machine = effort or Effort(), _Results(), _machine()
    of_scenario = [part for part in asked if part not in ("rollouts", "verification")]
    if of_scenario:
        # Refuses a scenario without camera before anything is timed.
        camera_rate(scenario)
    with threadpool_limits(limits=1):
        for part, measure in PARTS.items():
            if part in asked:
                on_part(part)
                measure(scenario, effort, results)
    versions = dict(item.split(" ", 1) for item in software_versions())
    return {
        "scenario": scenario.description if of_scenario else None,
        "machine": machine,
        "commit": versions.pop("commit", None),
        "versions": versions,
        "figures": [item.as_dict() for item in results.figures],
        "breakdown": [asdict(item) for item in results.breakdown],
        "budget": [asdict(item) for item in results.budget],
        "notes": results.notes,
    }


def _rollouts(scenario: Scenario, effort: Effort, results: _Results) -> None:
    lattice = effort.rows >= ROWS
    found = time_rollouts(effort.rows, effort.baseline_rows, lattice=lattice)
    part, same = "rollouts", f"the same {found.baseline_rows:,} rows, one core each"
    numpy, torch = found.numpy, found.torch
    results.figures += [
        Figure(
            part,
            "12.5 million roll-outs, 1,000 steps",
            found.paper,
            "s",
            "<=",
            PAPER_TARGET,
            numpy * PAPER_ROWS / 1e6,
            "cache-blocked NumPy, processor time of one core, scaled up",
        ),
        Figure(
            part,
            "a roll-out, kernel and NumPy",
            found.on_few,
            "us",
            "<=",
            TIMES_TARGET,
            numpy,
            f"cache-blocked NumPy, {same}",
            relative=True,
        ),
        Figure(
            part,
            "a roll-out, kernel and torch",
            found.on_few,
            "us",
            "<=",
            TIMES_TARGET,
            torch,
            "torch is not installed" if torch is None else f"torch eager, {same}",
            relative=True,
        ),
    ]
    results.breakdown += [
        Share("roll-out", "released code's motion, all cores", found.kernel, "us"),
        Share("roll-out", "released code's motion, processor time", found.kernel_cpu, "us"),
        Share("roll-out", "project's motion in the plane, 500 steps", found.project, "us"),
        Share("roll-out", "the same in float64", found.project_double, "us"),
    ]
    measured = "of the better of two runs over all of them"
    if not lattice:
        measured = f"scaled up from {found.rows:,} of them drawn at random"
    results.notes[part] = (
        f"the kernel's time for 12.5 million is {measured}; {100.0 * found.kept:.2f} % of "
        f"{found.rows:,} drawn at random keep 1 cm; a roll-out is one of those, and beside NumPy "
        "and torch processor time"
    )


def _policy(scenario: Scenario, effort: Effort, results: _Results) -> None:
    part, name = "policy", f"policy step, {OBSTACLES} obstacles"
    complete, running = map(statistics.median, time_policy(scenario, effort.steps))
    kernel = statistics.median(time_kernel(scenario, effort.steps))
    peer, peer_name = _peer_step(OBSTACLES)
    results.figures += [
        Figure(part, f"{name}, kernel", kernel, "us", "<=", KERNEL_TARGET, peer, peer_name),
        Figure(
            part,
            f"{name}, Drake, between frames",
            running,
            "us",
            "<=",
            POLICY_TARGET,
            peer,
            peer_name,
        ),
        Figure(
            part,
            f"{name}, Drake, all layers anew",
            complete,
            "us",
            "<=",
            None,
            statistics.median(time_plant(scenario, effort.steps)),
            f"one {1e3 * scenario.plant_step:g} ms step of the plant alone, arm held",
        ),
    ]
    times = time_layers(scenario, effort.steps)
    decision = f"every {1e3 * scenario.policy.route_period:.3g} ms"
    results.breakdown += [
        *(
            Share(
                decision if layer == "route decision" else "policy step", layer, times[layer], "us"
            )
            for layer in ("route", "regressor chain", "coupling and DMP", "route decision")
            if layer in times
        ),
        Share("control step", "desired motion", times["desired motion"], "us"),
    ]
    results.notes[part] = (
        "six active terms of the paper's regulation; between frames: steps as they come in a "
        "run; all layers anew: route and regressor chain answer again, as after a frame"
    )


def _peer_step(obstacles: int) -> tuple[float | None, str]:
    """movement_primitives' own step [us], and what to call it."""
    try:
        peers = importlib.import_module("drake_oa.studies.scenes.peers")
    except ModuleNotFoundError as error:
        if error.name not in ("movement_primitives", "pytransform3d"):
            raise
        return None, f"{error.name} is not installed: pip install 'drake_oa[peers]'"
    return (
        1e6 * peers.step_seconds(obstacles),
        f"movement_primitives' step of {1e3 * peers.STEP:g} ms with {obstacles} obstacle couplings",
    )


def _verification(scenario: Scenario, effort: Effort, results: _Results) -> None:
    found = time_verification(effort.scenes, readable_rows=effort.readable_rows)
    part = "verification"
    results.figures.append(
        Figure(
            part,
            f"verification, {CANDIDATES} candidates, 6 obstacles",
            found.rollouts,
            "ms",
            "<=",
            VERIFICATION_TARGET,
            found.readable,
            f"the readable NumPy step, one core, scaled up from {found.readable_rows} candidates",
        )
    )
    results.breakdown += [
        Share("decision", f"from rest, {found.first_rollouts:g} roll-outs", found.first, "ms"),
        Share("decision", "from rest, slowest scene", found.first_worst, "ms"),
        Share("decision", f"at a frame, {found.frame_rollouts:g} roll-outs", found.frame, "ms"),
        Share("decision", "at a frame, slowest scene", found.frame_worst, "ms"),
    ]
    results.notes[part] = (
        f"the chain's proposals, from s = 0.4 to arrival or s = 2, {found.steps:.0f} steps a "
        f"candidate, 500 a unit of s; decisions in {found.scenes} scenes of the suite clutter, "
        f"{found.kept} of which keep the clearance"
    )


def _run(scenario: Scenario, effort: Effort, results: _Results) -> None:
    _warm_up(scenario)
    results.figures.append(
        Figure(
            "run",
            "real-time factor",
            whole_real_time_factor(scenario, effort.seconds),
            "",
            ">=",
            REAL_TIME_TARGET,
            real_time_factor(bare_station(scenario), effort.seconds),
            "plant and camera alone, arm held by gravity compensation",
        )
    )
    results.budget = time_run(scenario, effort.seconds)
    frames = camera_rate(scenario)
    results.notes["run"] = (
        f"camera at {frames:g} Hz, no viewer; the budget is of another run, whose systems tell "
        "a stopwatch when they work: each moment is that of the innermost one, so that rows add "
        "up to the whole, the stopwatch's own few per cent included; the plant's row is the "
        "median of its step at instants of the run times their number; the first frame and the "
        "decision from rest are left out"
    )


def _perception(scenario: Scenario, effort: Effort, results: _Results) -> None:
    _warm_up(scenario)
    recorded, rendering_times, noise_times = record(scenario, effort.frames)
    rendering = statistics.median(rendering_times)
    seeing, describing = time_frames(scenario, recorded)
    results.figures.append(
        Figure(
            "perception",
            "depth image to ellipsoids",
            statistics.median(map(sum, zip(seeing, describing, strict=True))),
            "ms",
            "<=",
            FRAME_TARGET,
            rendering,
            "rendering that image by Drake's RgbdSensor",
        )
    )
    controller = time_controller(scenario, recorded, effort.steps)
    results.breakdown += [
        Share("control step", "controller", controller, "us"),
        Share("frame", "rendering", rendering, "ms"),
        *([Share("frame", "noise", statistics.median(noise_times), "ms")] if noise_times else []),
        Share("frame", "segmentation and fusion", statistics.median(seeing), "ms"),
        Share("frame", "descriptor", statistics.median(describing), "ms"),
    ]


def _thinking(scenario: Scenario, effort: Effort, results: _Results) -> None:
    _warm_up(scenario)
    found = time_thinking(scenario, effort.seconds, effort.runs)
    results.figures.append(
        Figure(
            "thinking",
            "decisions of a run, processor time",
            found.measured,
            "s",
            "<=",
            None,
            found.modelled,
            "the simulated time that they cost",
        )
    )
    results.breakdown += [
        Share("thinking", f"{name}, least squares", 1e6 * value, "us")
        for name, value in vars(found.fitted).items()
        if value > 0.0
    ]
    results.notes["thinking"] = (
        f"{found.decisions} decisions, each the quickest of {effort.runs} runs; constants are not "
        "told by a run with little work of their kind"
    )


PARTS: dict[str, Callable[[Scenario, Effort, _Results], None]] = {
    "rollouts": _rollouts,
    "policy": _policy,
    "verification": _verification,
    "run": _run,
    "perception": _perception,
    "thinking": _thinking,
}
"""What can be timed, in order."""


def _warm_up(scenario: Scenario) -> None:
    """Compiles or loads the kernels, and the renderer."""
    simulate(scenario, duration=2.0 / camera_rate(scenario))


def _machine() -> dict[str, Any]:
    """CPU model, usable cores, Python, and how busy the machine was."""
    cpu = platform.processor() or platform.machine()
    known = Path("/proc/cpuinfo")
    if known.is_file():
        for line in known.read_text().splitlines():
            if line.startswith("model name"):
                cpu = line.partition(":")[2].strip()
                break
    affinity = getattr(os, "sched_getaffinity", None)
    return {
        "cpu": cpu,
        "cores": len(affinity(0)) if affinity else os.cpu_count(),
        "load": os.getloadavg()[0],
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()}",
    }
