"""Networks of the regressor chain in torch: layers, training by Levenberg-Marquardt, scores.

Levenberg-Marquardt: damped Gauss-Newton steps, each with a lower loss than the one before.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.func import functional_call, grad_and_value, vmap
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from drake_oa.common.messages import BoolArray, FloatArray
from drake_oa.regulation.regressor import Network
from drake_oa.training.checkpoint import Checkpoint, Report

_COLUMNS = 448
"""Columns of J^T J that are added up at a time, from the diagonal down: it is symmetric."""


@dataclass(frozen=True)
class Schedule:
    """Damping of the steps, and the end of the iteration.

    Attributes:
        damping: first damping mu.
        decrease: factor on mu after a step that lowers the loss.
        increase: factor on mu after one that does not.
        largest_damping: where to give up.
        decay: weight of the parameters' own squares in the loss, against overfitting.
    """

    damping: float = 1e-3
    decrease: float = 0.1
    increase: float = 10.0
    largest_damping: float = 1e10
    decay: float = 1e-5


@dataclass(frozen=True, eq=False)
class Progress:
    """Where the iteration stands; all that is needed to go on.

    Attributes:
        parameters: (P,) the best found, as `torch.nn.utils.parameters_to_vector` orders them.
        damping: mu of the next step.
        iteration: number of accepted steps.
        stuck: whether no step lowers the loss any more.
    """

    parameters: Tensor
    damping: float
    iteration: int = 0
    stuck: bool = False

    def arrays(self) -> dict[str, Any]:
        """All of it for a checkpoint."""
        return {**vars(self), "parameters": self.parameters.cpu().numpy()}

    @staticmethod
    def of_arrays(found: Mapping[str, Any], device: str) -> Progress:
        """What `arrays` gave."""
        return Progress(
            torch.as_tensor(found["parameters"], device=device),
            float(found["damping"]),
            int(found["iteration"]),
            bool(found["stuck"]),
        )


class LeastSquares:
    """Sum of w_i (y_i - network(x_i; parameters))^2 over the rows, in float64."""

    def __init__(
        self,
        network: nn.Module,
        x: FloatArray,
        y: FloatArray,
        weight: FloatArray,
        *,
        device: str = "cpu",
    ) -> None:
        """Copies the rows to the device.

        Args:
            network: maps rows (..., d) to (...); its parameters give names and shapes only.
            x: (N, d) inputs, about within [-1, 1].
            y: (N,) targets, about within [-1, 1].
            weight: (N,) weights, not negative.
            device: a torch device.

        """
        columns = (x, y, np.sqrt(weight))
        self._rows = [torch.tensor(v, dtype=torch.float64, device=device) for v in columns]
        # Derivatives of 90 MB a block on a processor; an accelerator wants more at once.
        self._block = 8192 if device == "cpu" else 65536
        self._shapes = {name: p.shape for name, p in network.named_parameters()}

        def output(parameters: dict[str, Tensor], x: Tensor) -> Tensor:
            return functional_call(network, parameters, (x,))

        self._outputs = output
        self._derivatives = vmap(grad_and_value(output), in_dims=(None, 0))

    def squared_error(self, parameters: Tensor) -> float:
        """The sum at parameters (P,)."""
        named = self._named(parameters)
        squares = [
            ((y - self._outputs(named, x)) * root).square().sum() for x, y, root in self._blocks()
        ]
        return float(torch.stack(squares).sum())

    def normal_equations(self, parameters: Tensor) -> tuple[Tensor, Tensor, float]:
        """J^T W J (P, P), J^T W (y - network) (P,), and the sum."""
        named, n = self._named(parameters), len(parameters)
        gram, gradient, total = parameters.new_zeros(n, n), parameters.new_zeros(n), 0.0
        for x, y, root in self._blocks():
            slopes, outputs = self._derivatives(named, x)
            J = torch.cat([slope.flatten(1) for slope in slopes.values()], dim=1) * root[:, None]
            error = (y - outputs) * root
            for i in range(0, n, _COLUMNS):
                gram[i:, i : i + _COLUMNS] += J[:, i:].T @ J[:, i : i + _COLUMNS]
            gradient += error @ J
            total += float(error @ error)
        return torch.tril(gram) + torch.tril(gram, -1).T, gradient, total

    def _named(self, parameters: Tensor) -> dict[str, Tensor]:
        parts = parameters.split([math.prod(shape) for shape in self._shapes.values()])
        return {
            name: part.view(shape)
            for (name, shape), part in zip(self._shapes.items(), parts, strict=True)
        }

    def _blocks(self) -> Iterator[tuple[Tensor, ...]]:
        yield from zip(*(rows.split(self._block) for rows in self._rows), strict=True)


def fit(
    problem: LeastSquares,
    start: Progress,
    schedule: Schedule,
    iterations: int,
    on_step: Callable[[Progress], None] = lambda state: None,
) -> Progress:
    """Fits by least squares (Levenberg 1944, Marquardt 1963).

    Args:
        problem: the rows and the network.
        start: where to begin, or to go on.
        schedule: the damping.
        iterations: largest number of accepted steps, those of the start included.
        on_step: called with each new state.

    Returns:
        The state at the end. Going on from any state that `on_step` was called with gives the
        same, bit for bit.
    """
    state = start
    while state.iteration < iterations and not state.stuck:
        gram, gradient, squares = problem.normal_equations(state.parameters)
        loss = squares + schedule.decay * float(state.parameters @ state.parameters)
        gradient -= schedule.decay * state.parameters
        gram.diagonal().add_(schedule.decay)
        mu, lower = state.damping, None
        while lower is None and mu <= schedule.largest_damping:
            factor, failed = torch.linalg.cholesky_ex(gram + mu * torch.eye(len(gram)).to(gram))
            if not failed:
                trial = state.parameters + torch.cholesky_solve(gradient[:, None], factor)[:, 0]
                after = problem.squared_error(trial) + schedule.decay * float(trial @ trial)
                if after < loss:
                    lower = trial
                    break
            mu *= schedule.increase
        if lower is None:
            state = replace(state, stuck=True)
        else:
            mu = max(mu * schedule.decrease, 1e-12)
            state = Progress(lower, mu, state.iteration + 1)
        on_step(state)
    return state


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
    rounds: Sequence[Round],
    weight: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    device: str,
    checkpoint: Checkpoint,
    report: Report,
) -> Network:
    """Fits a network to rows.

    Args:
        stage: name of its checkpoint, and what `report` is told.
        x: (N, d) inputs, shuffled.
        y: (N,) targets.
        schedule: of Levenberg-Marquardt.
        seed: of the first weights.
        rounds: of the fit, one after the other.
        weight: (N,) of the rows.
        bounds: (d + 1,) least and greatest inputs and target, for the scaling.
        device: a torch device.
        checkpoint: keeps each iteration, and is gone on from.
        report: told how far it is.

    Returns:
        The network with the least loss found.
    """
    low, high = bounds
    gain = 2.0 / np.where(high > low, high - low, 1.0)
    scaled = (np.column_stack((x, y)) - low) * gain - 1.0
    perceptron = Perceptron(x.shape[1], np.random.default_rng(seed))
    found = checkpoint.load(stage)
    if found is None:
        first = parameters_to_vector(perceptron.parameters()).detach().to(device)
        state = Progress(first, schedule.damping)
    else:
        state = Progress.of_arrays(found, device)
    total = sum(each_round.iterations for each_round in rounds)

    def keep(state: Progress) -> None:
        checkpoint.save(stage, **state.arrays())
        report(stage, state.iteration / total)

    until = 0
    for each_round in rounds:
        until += each_round.iterations
        if state.iteration >= until:
            continue
        n = each_round.rows
        some = scaled[:n]
        problem = LeastSquares(perceptron, some[:, :-1], some[:, -1], weight[:n], device=device)
        state = fit(problem, state, schedule, until, keep)
        # Where it got stuck, the next round's rows may let it go on.
        state = replace(state, iteration=until, stuck=False)
        checkpoint.save(stage, **state.arrays())
    vector_to_parameters(state.parameters.cpu(), perceptron.parameters())
    weights, biases = perceptron.arrays()
    return Network(weights, biases, low[:-1], gain[:-1], float(low[-1]), float(gain[-1]))


def choose_device(asked: str) -> str:
    """Returns where to train, "cpu" or "cuda".

    Args:
        asked: "cpu", "cuda", or "auto" for CUDA if torch finds it.

    Raises:
        ValueError: if CUDA is requested and torch finds none.
    """
    available = torch.cuda.is_available()
    if asked == "cuda" and not available:
        raise ValueError(
            f"device cuda was asked for, but torch {torch.__version__} finds no CUDA device; "
            "use --device cpu"
        )
    return "cuda" if available and asked != "cpu" else "cpu"


def predict(network: Network, x: FloatArray) -> FloatArray:
    """The network at rows x (N, d) -> (N,), by blocks."""
    blocks = [x[i : i + 65536] for i in range(0, len(x), 65536)]
    return np.concatenate([network.evaluate(block) for block in blocks])


def nmse(y: FloatArray, prediction: FloatArray, rows: BoolArray | None = None) -> float:
    """Mean squared error over the variance of y, both of the given rows."""
    if rows is not None:
        y, prediction = y[rows], prediction[rows]
    return float(np.mean((y - prediction) ** 2) / np.var(y))
