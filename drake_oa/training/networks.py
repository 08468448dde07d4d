"""Networks of the regressor chain in torch: layers, training by Levenberg-Marquardt, errors.

A regressor chain predicts the parameters of a coupling term, which turns the motion away from an
obstacle. Levenberg-Marquardt takes damped Gauss-Newton steps; each accepted step has a lower loss
than the previous one.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.func import functional_call, grad_and_value, vmap
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from drake_oa.common.messages import FloatArray
from drake_oa.inference.regressor import Network

HIDDEN = (24, 24, 24)
"""Widths of the hidden tanh layers of each regressor network, as in Pairet et al., RA-L 2019."""
TRAIN_SHARE = 0.7
"""Fraction of the data rows used for training, as in Pairet et al., RA-L 2019 [-].

The other rows are used to test the trained networks."""
DECAY = 1e-8
"""Weight of the squared network parameters in the training loss (weight decay) [-].

It is small, because the network for the strength alpha of the coupling term needs large parameters.
"""
_DAMPING = 1e-3
"""Initial damping of the Levenberg-Marquardt steps by which networks are trained [-]."""
_DECREASE = 0.1
"""Factor on the Levenberg-Marquardt damping after a training step that lowers the loss [-]."""
_INCREASE = 10.0
"""Factor on the Levenberg-Marquardt damping after a step that does not lower the loss [-]."""
_DAMPING_RANGE = 1e-12, 1e10
"""Minimum and maximum damping of the Levenberg-Marquardt steps by which networks are trained [-].

Training ends if no step with a damping up to the maximum lowers the loss."""
_BLOCK = 8192
"""Number of training rows that are differentiated at once, which limits the required memory."""


class Round(NamedTuple):
    """Training round of a network, with a limited number of iterations and training rows.

    Many iterations on few rows find the minimum; few iterations on many rows refine it.

    Attributes:
        iterations: maximum number of Levenberg-Marquardt steps.
        rows: number of training rows, from the first one.
    """

    iterations: int
    rows: int


def make_perceptron(n_inputs: int, rng: np.random.Generator) -> nn.Sequential:
    """Makes a network of tanh layers and one linear output, with random initial parameters.

    In a layer with n_in inputs, the variance of the weights is 1 / n_in, that of the biases 1 / 4.

    Args:
        n_inputs: number of inputs.
        rng: random generator.

    Returns:
        Network from (N, n_inputs) to (N, 1) in float64.
    """
    layers: list[nn.Module] = []
    for n_in, n_out in pairwise([n_inputs, *HIDDEN, 1]):
        layer = nn.Linear(n_in, n_out, dtype=torch.float64)
        weight, bias = rng.standard_normal((n_out, n_in)), rng.standard_normal(n_out)
        with torch.no_grad():
            layer.weight.copy_(torch.from_numpy(weight / np.sqrt(n_in)))
            layer.bias.copy_(torch.from_numpy(0.5 * bias))
        layers += [layer, nn.Tanh()]
    return nn.Sequential(*layers[:-1])


def normal_equations(
    network: nn.Module, x: Tensor, y: Tensor, weight: Tensor
) -> tuple[Tensor, Tensor, float]:
    """Computes the terms of a weighted Gauss-Newton step for the P parameters of a network.

    Args:
        network: module from rows (N, d) to (N, 1).
        x: (N, d) inputs.
        y: (N,) targets.
        weight: (N,) nonnegative weights of the rows, the diagonal of W.

    Returns:
        J^T W J (P, P), J^T W e (P,) and e^T W e, with the errors e = y - network(x) and the
        Jacobian J of the outputs with respect to the parameters.
    """
    parameters = {name: value.detach() for name, value in network.named_parameters()}
    derivatives = vmap(
        grad_and_value(lambda values, row: functional_call(network, values, (row,))[0]),
        in_dims=(None, 0),
        chunk_size=_BLOCK,
    )
    slopes, outputs = derivatives(parameters, x)
    root = weight.sqrt()
    J = torch.cat([slope.flatten(1) for slope in slopes.values()], dim=1) * root[:, None]
    error = (y - outputs) * root
    return J.T @ J, J.T @ error, float(error @ error)


def fit(network: nn.Module, x: Tensor, y: Tensor, weight: Tensor, iterations: int) -> None:
    """Fits a network to targets by weighted least squares (Levenberg 1944, Marquardt 1963).

    Args:
        network: module from rows (N, d) to (N, 1), whose parameters are the initial values and
            receive the result.
        x: (N, d) inputs, about within [-1, 1].
        y: (N,) targets, about within [-1, 1].
        weight: (N,) nonnegative weights of the rows.
        iterations: maximum number of Levenberg-Marquardt steps that lower the loss.
    """
    best, damping = parameters_to_vector(network.parameters()).detach(), _DAMPING
    for _ in range(iterations):
        gram, gradient, squares = normal_equations(network, x, y, weight)
        loss, lower = squares + DECAY * float(best @ best), None
        gradient = gradient - DECAY * best
        while lower is None and damping <= _DAMPING_RANGE[1]:
            diagonal = (DECAY + damping) * torch.eye(len(gram)).to(gram)
            trial = best + torch.linalg.solve(gram + diagonal, gradient)
            vector_to_parameters(trial, network.parameters())
            with torch.no_grad():
                error = y - network(x)[:, 0]
            after = float(weight @ error.square()) + DECAY * float(trial @ trial)
            if after < loss:
                lower = trial
            damping *= _INCREASE if lower is None else _DECREASE
        vector_to_parameters(best if lower is None else lower, network.parameters())
        if lower is None:
            return
        best, damping = lower, max(damping, _DAMPING_RANGE[0])


def train_network(
    x: FloatArray,
    y: FloatArray,
    *,
    seed: tuple[int, ...],
    rounds: Sequence[Round],
    weight: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
) -> Network:
    """Makes a network and trains it on rows of inputs and targets, which are scaled to [-1, 1].

    Args:
        x: (N, d) unscaled inputs, in random order.
        y: (N,) unscaled targets.
        seed: seed of the initial weights.
        rounds: rounds of training, in order, each with a maximum number of iterations and a number
            of rows, counted from the first one.
        weight: (N,) weights of the rows.
        bounds: (d + 1,) minima and (d + 1,) maxima of inputs and target, scaled to -1 and 1.

    Returns:
        Trained network from unscaled inputs to unscaled outputs; the scaling is part of it.
    """
    low, high = bounds
    gain = 2.0 / np.where(high > low, high - low, 1.0)
    scaled = (np.column_stack((x, y)) - low) * gain - 1.0
    rows, weights = torch.tensor(scaled), torch.tensor(weight)
    network = make_perceptron(x.shape[1], np.random.default_rng(seed))
    for iterations, n in rounds:
        fit(network, rows[:n, :-1], rows[:n, -1], weights[:n], iterations)
    layers = [layer for layer in network if isinstance(layer, nn.Linear)]
    weights_, biases = (
        tuple(getattr(layer, name).detach().numpy() for layer in layers)
        for name in ("weight", "bias")
    )
    return Network(weights_, biases, low[:-1], gain[:-1], float(low[-1]), float(gain[-1]))


def nmse(y: FloatArray, prediction: FloatArray) -> float:
    """Computes the normalized mean squared error of predictions, mean of (y - p)^2 / variance of y.

    Args:
        y: (N,) true values.
        prediction: (N,) predicted values p.
    """
    return float(np.mean((y - prediction) ** 2) / np.var(y))
