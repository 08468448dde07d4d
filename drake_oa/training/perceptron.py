"""A perceptron with one output and tanh layers: forward pass and Jacobian."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from drake_oa.common.messages import FloatArray

Layers = list[tuple[FloatArray, FloatArray]]
"""(n_out, n_in) weights and (n_out,) biases, layer by layer."""


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
    derivatives = np.empty((len(x), sum(w.size + b.size for w, b in layers)))
    end = derivatives.shape[1]
    sensitivity = np.ones((len(x), 1))
    for i in range(len(layers) - 1, -1, -1):
        n_out, n_in = layers[i][0].shape
        derivatives[:, end - n_out : end] = sensitivity
        end -= n_out + n_out * n_in
        block = derivatives[:, end : end + n_out * n_in].reshape(len(x), n_out, n_in)
        np.multiply(sensitivity[:, :, None], inputs[i][:, None, :], out=block)
        if i:
            sensitivity = (sensitivity @ layers[i][0]) * (1.0 - inputs[i] ** 2)
    return y, derivatives


def flatten(layers: Layers) -> FloatArray:
    """All parameters in one vector (P,)."""
    return np.concatenate([part.ravel() for layer in layers for part in layer])


def unflatten(parameters: FloatArray, sizes: list[int]) -> Layers:
    """The layers of a vector that `flatten` made.

    Args:
        parameters: (P,) the vector.
        sizes: widths from input to output.

    Returns:
        The layers, views of the vector.
    """
    layers, at = [], 0
    for n_in, n_out in pairwise(sizes):
        middle, end = at + n_in * n_out, at + n_in * n_out + n_out
        layers.append((parameters[at:middle].reshape(n_out, n_in), parameters[middle:end]))
        at = end
    return layers
