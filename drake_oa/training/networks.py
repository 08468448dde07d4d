"""One network of the chain in torch: its layers, its training, its score."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from drake_oa.common.messages import BoolArray, FloatArray
from drake_oa.regulation.network import Network
from drake_oa.training.checkpoint import Checkpoint, Report
from drake_oa.training.levenberg_marquardt import LeastSquares, Progress, Schedule, fit

HIDDEN = (24, 24, 24)
"""Widths of the tanh layers, as in the paper."""

TRAIN_SHARE = 0.7
"""Share of the rows to train on, as in the paper."""


class Perceptron(nn.Module):
    """Tanh layers and a linear output, in float64."""

    def __init__(self, n_inputs: int, rng: np.random.Generator) -> None:
        """Draws the first weights: variance 1 / n_in for weights, 1 / 4 for biases."""
        super().__init__()
        sizes = [n_inputs, *HIDDEN, 1]
        layers: list[nn.Module] = []
        for n_in, n_out in pairwise(sizes):
            layer = nn.Linear(n_in, n_out, dtype=torch.float64)
            with torch.no_grad():
                layer.weight.copy_(
                    torch.from_numpy(rng.standard_normal((n_out, n_in)) / np.sqrt(n_in))
                )
                layer.bias.copy_(torch.from_numpy(0.5 * rng.standard_normal(n_out)))
            layers += [layer, nn.Tanh()]
        self.layers = nn.Sequential(*layers[:-1])

    def forward(self, x: Tensor) -> Tensor:
        """Rows (..., n_inputs) -> (...)."""
        return self.layers(x)[..., 0]

    def arrays(self) -> tuple[tuple[FloatArray, ...], tuple[FloatArray, ...]]:
        """Weights and biases, layer by layer."""
        layers = [layer for layer in self.layers if isinstance(layer, nn.Linear)]
        return (
            tuple(layer.weight.detach().cpu().numpy() for layer in layers),
            tuple(layer.bias.detach().cpu().numpy() for layer in layers),
        )


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
        device: a torch device.
        checkpoint: where to keep each iteration, and to go on from.
        report: told how far it is.

    Returns:
        The network with the least loss found.
    """
    columns = np.column_stack((x, y))
    low, high = bounds or (columns.min(axis=0), columns.max(axis=0))
    gain = 2.0 / np.where(high > low, high - low, 1.0)
    scaled = (columns - low) * gain - 1.0
    perceptron = Perceptron(x.shape[1], np.random.default_rng(seed))
    found = checkpoint.load(stage) if checkpoint else None
    if found is None:
        first = parameters_to_vector(perceptron.parameters()).detach().to(device)
        state = Progress(first, schedule.damping)
    else:
        state = Progress.of_arrays(found, device)
    rounds = rounds or (Round(schedule.iterations, len(x)),)
    total = sum(each_round.iterations for each_round in rounds)

    def save(state: Progress) -> None:
        if checkpoint is not None:
            checkpoint.save(stage, **state.arrays())

    def each(state: Progress, _: float) -> None:
        save(state)
        if report is not None:
            report(stage, state.iteration / total)

    until = 0
    for each_round in rounds:
        until += each_round.iterations
        if state.iteration >= until:
            continue
        n = each_round.rows
        problem = LeastSquares(
            perceptron,
            scaled[:n, :-1],
            scaled[:n, -1],
            None if weight is None else weight[:n],
            device=device,
        )
        state = fit(problem, state, replace(schedule, iterations=until), each)
        # Where it got stuck, the next round's rows may let it go on.
        state = replace(state, iteration=until, stuck=False)
        save(state)
    vector_to_parameters(state.parameters.cpu(), perceptron.parameters())
    weights, biases = perceptron.arrays()
    return Network(weights, biases, low[:-1], gain[:-1], float(low[-1]), float(gain[-1]))


def choose_device(asked: str) -> str:
    """Where to train.

    Args:
        asked: "cpu", "cuda", or "auto" for CUDA where torch finds it.

    Returns:
        "cpu" or "cuda".

    Raises:
        ValueError: if CUDA is asked for and torch finds none, or for any other name.
    """
    if asked not in ("auto", "cpu", "cuda"):
        raise ValueError(f"device must be auto, cpu or cuda, not {asked!r}")
    if asked != "cpu" and torch.cuda.is_available():
        return "cuda"
    if asked == "cuda":
        raise ValueError(
            f"device cuda was asked for, but torch {torch.__version__} finds no CUDA device; "
            "use --device cpu"
        )
    return "cpu"


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
