"""Levenberg-Marquardt for a perceptron with one output and tanh layers.

The Jacobian is written out layer by layer; the Gram matrix takes half the work by
symmetry (BLAS dsyrk), the step a Cholesky factorisation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.linalg.blas import dsyrk

from drake_oa.values import FloatArray

Layers = list[tuple[FloatArray, FloatArray]]
"""(n_out, n_in) weights and (n_out,) biases, layer by layer."""


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

    iterations: int = 40
    damping: float = 1e-3
    decrease: float = 0.1
    increase: float = 10.0
    largest_damping: float = 1e10
    decay: float = 1e-3


def initial_layers(sizes: list[int], rng: np.random.Generator) -> Layers:
    """Random layers: variance 1 / n_in for weights, small biases.

    Args:
        sizes: widths from input to output, for example [3, 24, 24, 24, 1].
        rng: random generator.

    Returns:
        The layers.
    """
    return [
        (rng.standard_normal((n_out, n_in)) / np.sqrt(n_in), 0.5 * rng.standard_normal(n_out))
        for n_in, n_out in pairwise(sizes)
    ]


def forward(layers: Layers, x: FloatArray) -> FloatArray:
    """The network at rows x (N, d) -> (N,)."""
    for weight, bias in layers[:-1]:
        x = np.tanh(x @ weight.T + bias)
    weight, bias = layers[-1]
    return (x @ weight.T + bias)[:, 0]


def jacobian(layers: Layers, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Outputs (N,) and their derivatives (N, P) by all parameters.

    The columns go layer by layer, weights row-wise before biases, as `flatten` does.
    """
    inputs = [x]
    for weight, bias in layers[:-1]:
        inputs.append(np.tanh(inputs[-1] @ weight.T + bias))
    weight, bias = layers[-1]
    y = (inputs[-1] @ weight.T + bias)[:, 0]
    sensitivity = np.ones((len(x), 1))
    blocks: list[FloatArray] = []
    for i in range(len(layers) - 1, -1, -1):
        by_weights = sensitivity[:, :, None] * inputs[i][:, None, :]
        blocks += [sensitivity, by_weights.reshape(len(x), -1)]
        if i:
            sensitivity = (sensitivity @ layers[i][0]) * (1.0 - inputs[i] ** 2)
    return y, np.concatenate(blocks[::-1], axis=1)


def flatten(layers: Layers) -> FloatArray:
    """All parameters in one vector (P,)."""
    return np.concatenate([part.ravel() for layer in layers for part in layer])


def unflatten(parameters: FloatArray, like: Layers) -> Layers:
    """The layers of a vector that `flatten` made."""
    layers, at = [], 0
    for weight, bias in like:
        middle, end = at + weight.size, at + weight.size + bias.size
        layers.append((parameters[at:middle].reshape(weight.shape), parameters[middle:end]))
        at = end
    return layers


def train(
    layers: Layers,
    x: FloatArray,
    y: FloatArray,
    schedule: Schedule,
    progress: Callable[[int, float], None] | None = None,
) -> Layers:
    """Fits the network to rows by least squares.

    Args:
        layers: where to begin.
        x: (N, d) inputs, about within [-1, 1].
        y: (N,) targets, about within [-1, 1].
        schedule: how long, and the damping.
        progress: told the iteration and the mean squared error.

    Returns:
        The layers with the least loss found.

    Raises:
        ValueError: if x, y and the layers do not fit, or hold values not finite.
    """
    if x.ndim != 2 or y.shape != (len(x),) or x.shape[1] != layers[0][0].shape[1]:
        raise ValueError(
            f"x must be (N, {layers[0][0].shape[1]}) and y (N,), not {x.shape} and {y.shape}"
        )
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise ValueError("x and y must be finite")
    parameters, mu = flatten(layers), schedule.damping
    diagonal = np.diag_indices(len(parameters))
    for iteration in range(schedule.iterations):
        output, J = jacobian(layers, x)
        error = y - output
        loss = error @ error + schedule.decay * (parameters @ parameters)
        if progress is not None:
            progress(iteration, float(error @ error) / len(x))
        # J is row-major: as Fortran sees it it is J^T, and dsyrk forms J^T J.
        gram = dsyrk(1.0, J.T, lower=1)
        gradient = error @ J - schedule.decay * parameters
        while True:
            damped = gram.copy()
            damped[diagonal] += mu + schedule.decay
            try:
                move = cho_solve(cho_factor(damped, lower=True, overwrite_a=True), gradient)
            except LinAlgError:
                move = None
            if move is not None:
                trial = parameters + move
                candidate = unflatten(trial, layers)
                residual = y - forward(candidate, x)
                if residual @ residual + schedule.decay * (trial @ trial) < loss:
                    parameters, layers = trial, candidate
                    mu = max(mu * schedule.decrease, 1e-12)
                    break
            mu *= schedule.increase
            if mu > schedule.largest_damping:
                return layers
    return layers
