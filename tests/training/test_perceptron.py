"""The perceptron's forward pass and Jacobian."""

import numpy as np
import pytest

from drake_oa.training.perceptron import (
    flatten,
    forward,
    initial_layers,
    jacobian,
    unflatten,
)


@pytest.mark.parametrize("sizes", [[3, 5, 4, 1], [2, 3, 1]])
def test_jacobian_is_the_derivative_of_the_output(sizes):
    rng = np.random.default_rng(0)
    layers = initial_layers(sizes, rng)
    x = rng.uniform(-1.0, 1.0, (7, sizes[0]))
    y, J = jacobian(layers, x)
    np.testing.assert_allclose(y, forward(layers, x), rtol=1e-14)
    parameters, step = flatten(layers), 1e-6
    assert J.shape == (7, parameters.size)
    for k in range(parameters.size):
        move = step * np.eye(parameters.size)[k]
        up = forward(unflatten(parameters + move, sizes), x)
        down = forward(unflatten(parameters - move, sizes), x)
        np.testing.assert_allclose(J[:, k], (up - down) / (2.0 * step), atol=1e-8)


def test_a_vector_of_all_parameters_gives_back_the_layers():
    layers = initial_layers([3, 5, 4, 1], np.random.default_rng(1))
    for (w, b), (w2, b2) in zip(layers, unflatten(flatten(layers), [3, 5, 4, 1]), strict=True):
        np.testing.assert_array_equal(w, w2)
        np.testing.assert_array_equal(b, b2)
