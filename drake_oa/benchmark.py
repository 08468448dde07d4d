"""`drake-oa benchmark`: what the layers cost, beside Drake alone in the same run."""

from __future__ import annotations

import os
import platform
import statistics
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from drake_oa.provenance import software_versions
from drake_oa.scenario import Scenario
from drake_oa.simulation import simulate
from drake_oa.timings import (
    OBSTACLES,
    bare_station,
    camera_rate,
    real_time_factor,
    record,
    time_controller,
    time_frames,
    time_layers,
    time_plant,
    time_policy,
    whole_real_time_factor,
)

REAL_TIME_TARGET = 1.0
"""Least real-time factor of the whole stack."""
POLICY_TARGET = 200.0
"""Most time for one policy step with six obstacles [us]."""
FRAME_TARGET = 33.0
"""Most time from one depth image to ellipsoids [ms]."""


@dataclass(frozen=True)
class Figure:
    """One measured figure beside its target and Drake alone.

    Attributes:
        name: short name.
        value: what was measured, in `unit`.
        unit: "" for a factor.
        relation: ">=" or "<=": how the value has to stand to the target.
        target: what is asked for, in `unit`.
        baseline: what Drake alone takes, in `unit`.
        baseline_name: what that is.
    """

    name: str
    value: float
    unit: str
    relation: str
    target: float
    baseline: float
    baseline_name: str

    @property
    def ratio(self) -> float:
        """Value over baseline."""
        return self.value / self.baseline

    @property
    def met(self) -> bool:
        """Whether the target is reached."""
        return (self.value >= self.target) if self.relation == ">=" else (self.value <= self.target)


@dataclass(frozen=True)
class Share:
    """Median time of one part of a step or a frame, in `unit`."""

    part: str
    layer: str
    value: float
    unit: str


def run_benchmark(
    scenario: Scenario, *, seconds: float = 3.0, steps: int = 400, frames: int = 30
) -> dict[str, Any]:
    """Times a scenario with a robot and a depth camera, on one BLAS thread.

    Args:
        scenario: what to time.
        seconds: simulated time that the real-time factors are measured over [s].
        steps: policy steps, and steps of the plant, that are timed.
        frames: images that are timed.

    Returns:
        `scenario` (its description), `machine`, `versions` and `commit` (None when
        unknown); `figures`, each with the fields of `Figure`, `ratio` and `met`; and
        `breakdown`, each with the fields of `Share`. Times are medians.

    Raises:
        ScenarioError: if the scenario has no robot or no depth camera, or its policy is
            held among six obstacles in free space.
        ValueError: if there is nothing to time.
    """
    if not (seconds > 0.0 and steps > 0 and frames > 0):
        raise ValueError(
            f"seconds, steps and frames must be positive, not {seconds}, {steps} and {frames}"
        )
    machine = _machine()
    with threadpool_limits(limits=1):
        # Compiles or loads the kernels, and the renderer.
        simulate(scenario, duration=2.0 / camera_rate(scenario))
        figures, breakdown = _measure(scenario, seconds, steps, frames)
    versions = dict(item.split(" ", 1) for item in software_versions())
    return {
        "scenario": scenario.description,
        "machine": machine,
        "commit": versions.pop("commit", None),
        "versions": versions,
        "figures": [asdict(item) | {"ratio": item.ratio, "met": item.met} for item in figures],
        "breakdown": [asdict(item) for item in breakdown],
    }


def _measure(
    scenario: Scenario, seconds: float, steps: int, frames: int
) -> tuple[list[Figure], list[Share]]:
    recorded, rendering_times = record(scenario, frames)
    rendering = statistics.median(rendering_times)
    seeing, describing = time_frames(scenario, recorded)
    complete, running = map(statistics.median, time_policy(scenario, steps))
    figures = [
        Figure(
            "real-time factor",
            whole_real_time_factor(scenario, seconds),
            "",
            ">=",
            REAL_TIME_TARGET,
            real_time_factor(bare_station(scenario), seconds),
            "plant and camera alone, arm held by gravity compensation",
        ),
        Figure(
            f"policy step, {OBSTACLES} obstacles",
            complete,
            "us",
            "<=",
            POLICY_TARGET,
            statistics.median(time_plant(scenario, steps)),
            f"one {1e3 * scenario.plant_step:g} ms step of the plant alone, arm held",
        ),
        Figure(
            "depth image to ellipsoids",
            statistics.median(map(sum, zip(seeing, describing, strict=True))),
            "ms",
            "<=",
            FRAME_TARGET,
            rendering,
            "rendering that image by Drake's RgbdSensor",
        ),
    ]
    times = time_layers(scenario, steps)
    decision = f"every {1e3 * scenario.policy.route_period:.3g} ms"
    breakdown = [
        *(
            Share(
                decision if layer == "route decision" else "policy step", layer, times[layer], "us"
            )
            for layer in ("route", "regressor chain", "coupling and DMP", "route decision")
            if layer in times
        ),
        Share("policy step", "all, while the route stays", running, "us"),
        Share("control step", "desired motion", times["desired motion"], "us"),
        Share("control step", "controller", time_controller(scenario, recorded, steps), "us"),
        Share("frame", "rendering", rendering, "ms"),
        Share("frame", "segmentation and fusion", statistics.median(seeing), "ms"),
        Share("frame", "descriptor", statistics.median(describing), "ms"),
    ]
    return figures, breakdown


def benchmark_table(figures: dict[str, Any]) -> str:
    """What `run_benchmark` returned, as text."""
    rows = [["", "measured", "target", "", "baseline", "ratio", "baseline is"]]
    for item in figures["figures"]:
        rows.append(
            [
                item["name"],
                _quantity(item["value"], item["unit"]),
                f"{item['relation']} {_quantity(item['target'], item['unit'])}",
                "met" if item["met"] else "MISSED",
                _quantity(item["baseline"], item["unit"]),
                f"{item['ratio']:.2f}",
                item["baseline_name"],
            ]
        )
    shares = [["where it goes", "", "median"]]
    shares += [
        [item["part"], item["layer"], _quantity(item["value"], item["unit"])]
        for item in figures["breakdown"]
    ]
    machine = figures["machine"]
    versions = [f"{name} {number}" for name, number in figures["versions"].items()]
    footer = [
        f"{machine['cpu']}, {machine['cores']} cores, load {machine['load']:.1f} at the start, "
        f"Python {machine['python']}",
        ", ".join([*versions, f"commit {figures['commit'] or 'unknown'}"]),
    ]
    return "\n".join([_aligned(rows, "lrrlrrl"), "", _aligned(shares, "llr"), "", *footer])


def _quantity(value: float, unit: str) -> str:
    return f"{value:.3g} {unit}".rstrip() if value < 100.0 else f"{value:.0f} {unit}".rstrip()


def _aligned(rows: list[list[str]], sides: str) -> str:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if side == "r" else cell.ljust(width)
            for cell, width, side in zip(row, widths, sides, strict=True)
        ).rstrip()
        for row in rows
    )


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
