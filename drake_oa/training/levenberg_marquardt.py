"""Levenberg-Marquardt by torch: damped Gauss-Newton steps, each lower than the one before."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.func import functional_call, grad_and_value, vmap

from drake_oa.common.messages import FloatArray

_COLUMNS = 448
"""Columns of J^T J that are added up at a time, from the diagonal down: it is symmetric."""


@dataclass(frozen=True)
class Schedule:
    """How long to go on and how the damping moves.

    Attributes:
        iterations: largest number of accepted steps.
        damping: first damping mu.
        decrease: factor on mu after a step that lowers the loss.
        increase: factor on mu after one that does not.
        largest_damping: where to give up.
        decay: weight of the parameters' own squares in the loss, against overfitting.
    """

    iterations: int = 60
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
        weight: FloatArray | None = None,
        *,
        device: str = "cpu",
    ) -> None:
        """Takes the rows to the device.

        Args:
            network: maps rows (..., d) to (...); its parameters give names and shapes only.
            x: (N, d) inputs, about within [-1, 1].
            y: (N,) targets, about within [-1, 1].
            weight: (N,) not negative; None: 1 for each.
            device: a torch device.

        Raises:
            ValueError: if shapes do not fit, or values are not finite.
        """
        if x.ndim != 2 or y.shape != (len(x),) or not len(x):
            raise ValueError(f"x must be (N, d) and y (N,), not {x.shape} and {y.shape}")
        if not (np.isfinite(x).all() and np.isfinite(y).all()):
            raise ValueError("x and y must be finite")
        if weight is not None and (weight.shape != y.shape or not (weight >= 0.0).all()):
            raise ValueError("weight must be (N,) and not negative")
        root = np.ones_like(y) if weight is None else np.sqrt(weight)
        self._rows = [torch.tensor(v, dtype=torch.float64, device=device) for v in (x, y, root)]
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
    each: Callable[[Progress, float], None] | None = None,
) -> Progress:
    """Fits by least squares (Levenberg 1944, Marquardt 1963).

    Args:
        problem: the rows and the network.
        start: where to begin, or to go on.
        schedule: how long, and the damping.
        each: told each new state, and the sum of squares before its step.

    Returns:
        The state at the end. Going on from any state that `each` was told gives the
        same, bit for bit.
    """
    state = start
    while state.iteration < schedule.iterations and not state.stuck:
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
        if each is not None:
            each(state, squares)
    return state
