"""Least squares by torch: the normal equations, the descent, going on as before."""

import itertools

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn.utils import parameters_to_vector

from drake_oa.training import networks
from drake_oa.training.networks import LeastSquares, Progress, Schedule, fit


class Small(nn.Module):
    """tanh(W x + b) summed up."""

    def __init__(self, n_inputs, width, seed=0):
        super().__init__()
        torch.manual_seed(seed)
        self.inner = nn.Linear(n_inputs, width, dtype=torch.float64)
        self.outer = nn.Linear(width, 1, dtype=torch.float64)

    def forward(self, x):
        return self.outer(torch.tanh(self.inner(x)))[..., 0]


def begin(network):
    return Progress(parameters_to_vector(network.parameters()).detach(), 1e-3)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("block", [7, 2048])
def test_the_normal_equations_are_the_plain_formula(weighted, block, monkeypatch):
    monkeypatch.setattr(networks, "_COLUMNS", 10)
    rng = np.random.default_rng(0)
    x, weight = rng.uniform(-1.0, 1.0, (50, 3)), rng.uniform(0.0, 2.0, 50)
    y, network = np.sin(x.sum(axis=1)), Small(3, 5)
    problem = LeastSquares(network, x, y, weight if weighted else None)
    problem._block = block
    parameters = begin(network).parameters
    W, b, v, c = (p.detach().numpy() for p in network.parameters())
    inner = np.tanh(x @ W.T + b)
    slope = (1.0 - inner**2) * v
    J = np.hstack(
        ((slope[:, :, None] * x[:, None, :]).reshape(50, -1), slope, inner, np.ones((50, 1)))
    )
    w, error = weight if weighted else np.ones(50), y - (inner @ v[0] + c)
    gram, gradient, squares = problem.normal_equations(parameters)
    np.testing.assert_allclose(gram.numpy(), J.T @ (w[:, None] * J), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(gradient.numpy(), J.T @ (w * error), rtol=1e-10, atol=1e-12)
    assert squares == pytest.approx(np.sum(w * error**2), rel=1e-12)
    assert problem.squared_error(parameters) == pytest.approx(squares, rel=1e-12)


@pytest.mark.parametrize(
    ("x", "y", "weight", "message"),
    [
        (np.zeros(4), np.zeros(4), None, r"x must be \(N, d\)"),
        (np.zeros((0, 3)), np.zeros(0), None, r"x must be \(N, d\)"),
        (np.zeros((4, 3)), np.zeros(3), None, r"and y \(N,\)"),
        (np.full((4, 3), np.nan), np.zeros(4), None, "must be finite"),
        (np.zeros((4, 3)), np.zeros(4), -np.ones(4), "weight must be"),
        (np.zeros((4, 3)), np.zeros(4), np.ones(3), "weight must be"),
    ],
)
def test_rows_that_do_not_fit_are_refused(x, y, weight, message):
    with pytest.raises(ValueError, match=message):
        LeastSquares(Small(3, 5), x, y, weight)


def test_it_learns_a_smooth_function():
    rng = np.random.default_rng(1)
    x, fresh = rng.uniform(-1.0, 1.0, (2, 400, 2))
    network = Small(2, 20)

    def truth(x):
        return np.sin(3.0 * x[:, 0]) * x[:, 1]

    schedule = Schedule(iterations=40)
    found = fit(LeastSquares(network, x, truth(x)), begin(network), schedule)
    error = LeastSquares(network, fresh, truth(fresh)).squared_error(found.parameters)
    assert error < 1e-3 * 400 * np.var(truth(fresh))


@pytest.fixture
def network():
    return Small(2, 6)


@pytest.fixture
def problem(network):
    x = np.random.default_rng(2).uniform(-1.0, 1.0, (100, 2))
    return LeastSquares(network, x, np.abs(x[:, 0]) - x[:, 1] ** 2)


def test_the_loss_never_rises(problem, network):
    errors = []
    schedule = Schedule(iterations=30, decay=0.0)
    fit(problem, begin(network), schedule, lambda state, e: errors.append(e))
    assert len(errors) == 30
    assert all(after <= before for before, after in itertools.pairwise(errors))


@pytest.mark.parametrize("after", [1, 7, 19])
def test_going_on_from_any_state_gives_the_same(problem, network, after):
    schedule = Schedule(iterations=20)
    states = []
    whole = fit(problem, begin(network), schedule, lambda state, _: states.append(state))
    kept = Progress.of_arrays(states[after - 1].arrays(), "cpu")
    rest = fit(problem, kept, schedule)
    assert torch.equal(rest.parameters, whole.parameters)
    assert (rest.damping, rest.iteration) == (whole.damping, whole.iteration)


def test_where_no_step_helps_it_stops(network):
    problem = LeastSquares(network, np.zeros((3, 2)), np.zeros(3))
    start = Progress(torch.zeros(25, dtype=torch.float64), 1e-3)
    found = fit(problem, start, Schedule(iterations=5))
    assert found.stuck
    assert found.iteration == 0
    assert fit(problem, found, Schedule(iterations=9)) is found
