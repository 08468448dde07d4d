"""Trains one network of the chain: scaling, Levenberg-Marquardt, checkpoints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from drake_oa.common.messages import BoolArray, FloatArray
from drake_oa.regulation.regressor import Network
from drake_oa.training.checkpoint import Checkpoint
from drake_oa.training.levenberg_marquardt import Progress, Schedule, fit
from drake_oa.training.normal_equations import least_squares
from drake_oa.training.perceptron import flatten, initial_layers, unflatten

HIDDEN = (24, 24, 24)
"""Widths of the tanh layers, as in the paper."""

TRAIN_SHARE = 0.7
"""Share of the rows to train on, as in the paper."""

Report = Callable[[str, float], None]
"""Told the stage and the fraction of it that is done."""


@dataclass(frozen=True)
class Round:
    """Some steps on some of the rows: many on few find the way, few on many refine.

    Attributes:
        iterations: accepted steps of Levenberg-Marquardt at most.
        rows: how many rows, from the first on.
    """

    iterations: int
    rows: int


@dataclass(frozen=True)
class Score:
    """Normalised mean squared error (over the variance of the targets) of one network.

    Attributes:
        target: kappa, psi or alpha (of its logarithm, where the network learns that).
        train: NMSE on the rows to train on.
        test: NMSE on the others.
        rows: number of rows, both together.
        floor: NMSE of the conditional means of the target, which no function of the
            inputs can beat; NaN where it was not computed.
    """

    target: str
    train: float
    test: float
    rows: int
    floor: float = float("nan")


def train_network(
    stage: str,
    x: FloatArray,
    y: FloatArray,
    schedule: Schedule,
    *,
    seed: tuple[int, ...],
    rounds: tuple[Round, ...] = (),
    weight: FloatArray | None = None,
    bounds: tuple[FloatArray, FloatArray] | None = None,
    device: str = "cpu",
    checkpoint: Checkpoint | None = None,
    report: Report | None = None,
) -> Network:
    """Fits a network to rows.

    Args:
        stage: name of its checkpoint, and what `report` is told.
        x: (N, d) inputs, shuffled where there are rounds.
        y: (N,) targets.
        schedule: of Levenberg-Marquardt.
        seed: of the first weights.
        rounds: how to go about it; their iterations stand for the schedule's. Empty:
            one with all rows.
        weight: (N,) of the rows; None: 1.
        bounds: (d + 1,) least and greatest inputs and target, for the scaling; None:
            those of the rows.
        device: "cpu", or a torch device.
        checkpoint: where to keep each iteration, and to go on from.
        report: told how far it is.

    Returns:
        The network with the least loss found.
    """
    columns = np.column_stack((x, y))
    low, high = bounds or (columns.min(axis=0), columns.max(axis=0))
    gain = 2.0 / np.where(high > low, high - low, 1.0)
    scaled = (columns - low) * gain - 1.0
    sizes = [x.shape[1], *HIDDEN, 1]
    inputs, targets = np.ascontiguousarray(scaled[:, :-1]), np.ascontiguousarray(scaled[:, -1])
    state = checkpoint.load_progress(stage) if checkpoint else None
    if state is None:
        first = flatten(initial_layers(sizes, np.random.default_rng(seed)))
        state = Progress(first, schedule.damping)
    rounds = rounds or (Round(schedule.iterations, len(x)),)
    total = sum(each_round.iterations for each_round in rounds)

    def each(state: Progress, _: float) -> None:
        if checkpoint is not None:
            checkpoint.save_progress(stage, state)
        if report is not None:
            report(stage, state.iteration / total)

    until = 0
    for each_round in rounds:
        until += each_round.iterations
        if state.iteration >= until:
            continue
        first_rows = slice(each_round.rows)
        problem = least_squares(
            sizes,
            inputs[first_rows],
            targets[first_rows],
            None if weight is None else weight[first_rows],
            device=device,
        )
        # The rows are shared out among threads already; and the sums' order is fixed.
        with threadpool_limits(limits=1, user_api="blas"):
            state = fit(problem, state, replace(schedule, iterations=until), each)
        # Where it got stuck, the next round's rows may let it go on.
        state = replace(state, iteration=until, stuck=False)
        if checkpoint is not None:
            checkpoint.save_progress(stage, state)
    weights, biases = zip(*unflatten(state.parameters, sizes), strict=True)
    return Network(weights, biases, low[:-1], gain[:-1], float(low[-1]), float(gain[-1]))


def predict(network: Network, x: FloatArray) -> FloatArray:
    """The network at rows x (N, d) -> (N,), by blocks."""
    blocks = [x[i : i + 65536] for i in range(0, len(x), 65536)]
    return np.concatenate(
        [network.evaluate(np.vstack((block.T, np.ones(len(block))))) for block in blocks]
    )


def nmse(y: FloatArray, prediction: FloatArray, rows: BoolArray | None = None) -> float:
    """Mean squared error over the variance of y, both of the given rows."""
    if rows is not None:
        y, prediction = y[rows], prediction[rows]
    return float(np.mean((y - prediction) ** 2) / np.var(y))
