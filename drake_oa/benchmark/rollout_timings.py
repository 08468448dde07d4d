"""How long the paper's roll-outs take, against NumPy and torch, for `drake-oa benchmark`."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numba
import numpy as np

from drake_oa.benchmark.rollout_baselines import SingleArray, numpy_rollouts, torch_rollouts
from drake_oa.common.messages import FloatArray
from drake_oa.training.planar_rollout import (
    STEPS,
    planar_rollouts,
    released_forcing,
    released_lattice,
    released_rollouts,
)

PAPER_ROWS = 12_500_000
"""10 x 10 ellipses and 50 values each of alpha, psi and kappa."""

ROWS = 1_000_000
"""Rows that the kernel is timed on: a random sample of the paper's."""

PAPER_LATTICE = (
    np.linspace(0.025, 0.25, 10),
    np.linspace(0.025, 0.25, 10),
    np.linspace(0.01, 30000.0, 50),
    np.linspace(0.1, 1.0, 50),
    np.linspace(0.0, 1000.0, 50),
)
"""The paper's training lattice: semi-axes [m], alpha, psi, kappa."""

BASELINE_ROWS = 16_384
"""How many of them NumPy and torch are timed on."""


@dataclass(frozen=True)
class RolloutTimings:
    """Wall times of the released code's motion, 1,000 steps a row, this run.

    Attributes:
        rows: rows that the kernel was timed on, drawn at random from the paper's.
        baseline_rows: rows that NumPy and torch were timed on, the first of those.
        kernel: seconds a million rows, best of the repetitions.
        kernel_cpu: the same in processor time, all threads together.
        paper: seconds for the paper's 12.5 million: the better of two runs over the whole
            lattice, or scaled up from `rows`.
        kept: share of the rows that keep 0.01 m (the paper's: 0.09993).
        numpy: processor seconds a million rows of cache-sized NumPy blocks.
        torch: processor seconds a million rows of torch eager; None: it is not installed.
        on_few: processor seconds a million of those rows by the kernel on one core.
        project: microseconds a row of the project's own motion, same scenes' ellipses,
            best of the repetitions.
        project_double: the same in float64.
    """

    rows: int
    baseline_rows: int
    kernel: float
    kernel_cpu: float
    paper: float
    kept: float
    numpy: float
    torch: float | None
    on_few: float
    project: float
    project_double: float


def paper_sample(rows: int, seed: int = 0) -> tuple[FloatArray, FloatArray]:
    """Rows of the paper's training lattice, drawn evenly with replacement.

    Args:
        rows: how many.
        seed: of the draw.

    Returns:
        (rows, 2) semi-axes [m] and (rows, 3) alpha, psi, kappa.
    """
    rng = np.random.default_rng(seed)
    widths = PAPER_LATTICE[0][rng.integers(0, 10, (rows, 2))]
    picked = [axis[rng.integers(0, 50, rows)] for axis in PAPER_LATTICE[2:]]
    return widths, np.stack(picked, axis=1)


def time_rollouts(
    rows: int = ROWS,
    baseline_rows: int = BASELINE_ROWS,
    repeats: int = 3,
    seed: int = 0,
    *,
    lattice: bool = False,
) -> RolloutTimings:
    """Times kernel, NumPy and torch on the same scenes, one after another.

    The rows cost very different amounts (most touch early), so the baselines are
    compared with the kernel on the very rows that they take, on one core each and by
    processor time: what else the machine does then counts for neither.

    Args:
        rows: rows for the kernel.
        baseline_rows: how many of those for NumPy and torch.
        repeats: the best of so many.
        seed: of the draw of the rows.
        lattice: whether to roll out all of the paper's 12.5 million, twice.

    Returns:
        The times.

    Raises:
        ValueError: if a number is not positive, or baseline_rows exceeds rows.
    """
    if not 0 < baseline_rows <= rows or repeats < 1:
        raise ValueError(
            f"rows >= baseline_rows > 0 and repeats > 0 are needed, not {rows}, "
            f"{baseline_rows} and {repeats}"
        )
    semi_axes, parameters = paper_sample(rows, seed)
    few = semi_axes[:baseline_rows], parameters[:baseline_rows]
    released_rollouts(semi_axes[:1], parameters[:1])  # Compiles.
    kept = float(
        (released_rollouts(semi_axes, parameters, threshold=0.01).clearance >= 0.01).mean()
    )
    kernel, kernel_cpu = _best(lambda: released_rollouts(semi_axes, parameters), repeats)
    whole = (
        _best(lambda: released_lattice(*PAPER_LATTICE, threshold=0.01), 2)[0] if lattice else None
    )
    with _one_core():
        _, on_few = _best(lambda: released_rollouts(*few), max(repeats, 5))
    single = [np.ascontiguousarray(a, np.float32) for a in (*few, released_forcing(STEPS))]
    by_numpy = _slow(numpy_rollouts, single)
    has_torch = importlib.util.find_spec("torch") is not None
    with _one_core():
        by_torch = _slow(torch_rollouts, single) if has_torch else None
    # alpha of the project's motion is per duration, and its reaction reaches further.
    ours = parameters[:baseline_rows] * (1.0, 1.0, 0.05)
    planar_rollouts(few[0][:1], ours[:1])
    planar_rollouts(few[0][:1], ours[:1], precision="double")
    project, _ = _best(lambda: planar_rollouts(few[0], ours), repeats)
    double, _ = _best(lambda: planar_rollouts(few[0], ours, precision="double"), 1)
    return RolloutTimings(
        rows=rows,
        baseline_rows=baseline_rows,
        kernel=kernel * 1e6 / rows,
        kernel_cpu=kernel_cpu * 1e6 / rows,
        paper=kernel * PAPER_ROWS / rows if whole is None else whole,
        kept=kept,
        numpy=by_numpy * 1e6 / baseline_rows,
        torch=None if by_torch is None else by_torch * 1e6 / baseline_rows,
        on_few=on_few * 1e6 / baseline_rows,
        project=project * 1e6 / baseline_rows,
        project_double=double * 1e6 / baseline_rows,
    )


@contextmanager
def _one_core() -> Iterator[None]:
    """Keeps kernels and torch to one thread; NumPy's element-wise functions have no more."""
    kernel_threads = numba.get_num_threads()
    torch: Any = import_module("torch") if importlib.util.find_spec("torch") else None
    torch_threads = torch.get_num_threads() if torch else 1
    try:
        numba.set_num_threads(1)
        if torch:
            torch.set_num_threads(1)
        yield
    finally:
        numba.set_num_threads(kernel_threads)
        if torch:
            torch.set_num_threads(torch_threads)


def _best(call: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Least wall time and least processor time [s]."""
    times = []
    for _ in range(repeats):
        started, cpu = time.perf_counter(), time.process_time()
        call()
        times.append((time.perf_counter() - started, time.process_time() - cpu))
    return min(t[0] for t in times), min(t[1] for t in times)


def _slow(
    rollouts: Callable[[SingleArray, SingleArray, SingleArray], object],
    arguments: list[SingleArray],
) -> float:
    semi_axes, parameters, drive = arguments
    rollouts(semi_axes[:64], parameters[:64], drive[:2])
    return _best(lambda: rollouts(semi_axes, parameters, drive), 2)[1]
