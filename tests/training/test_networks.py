"""Tests of the networks of the regressor chain: least squares and convergence."""

import itertools

import numpy as np
import torch

from drake_oa.training import networks


def loss(network, x, y, weight):
    squares = sum(values.detach().square().sum() for values in network.parameters())
    return networks.normal_equations(network, x, y, weight)[2] + networks.DECAY * float(squares)


def test_each_step_lowers_the_loss_and_the_fit_ends_at_the_minimum():
    network = networks.make_perceptron(2, np.random.default_rng(0))
    x = np.random.default_rng(2).uniform(-1.0, 1.0, (100, 2))
    y = np.abs(x[:, 0]) - x[:, 1] ** 2
    rows = [torch.from_numpy(column) for column in (x, y, np.ones(100))]
    losses = [loss(network, *rows)]
    for _ in range(20):
        networks.fit(network, *rows, 1)
        losses.append(loss(network, *rows))
    assert all(after < before for before, after in itertools.pairwise(losses))
    zero = torch.zeros((3, 2), dtype=torch.float64)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.zero_()
    networks.fit(network, zero, zero[:, 0], zero[:, 0] + 1.0, 5)
    assert not any(parameter.any() for parameter in network.parameters())


def test_network_learns_its_rows():
    x = np.random.default_rng(0).uniform(0.0, 5.0, (300, 2))
    y = np.exp(0.3 * x[:, 0]) + x[:, 1]
    columns = np.column_stack([x, y])
    network = networks.train_network(
        x,
        y,
        seed=(1, 2),
        rounds=(networks.Round(3, 100), networks.Round(2, 300)),
        weight=np.ones(300),
        bounds=(columns.min(axis=0), columns.max(axis=0)),
    )
    assert networks.nmse(y, network.evaluate(x)) < 5e-3
