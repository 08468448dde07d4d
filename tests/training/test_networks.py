"""One network: its least squares, that training goes on as before, devices."""

import itertools

import numpy as np
import pytest
import torch
from torch.nn.utils import parameters_to_vector

from drake_oa.training import networks
from drake_oa.training.checkpoint import Checkpoint
from drake_oa.training.networks import (
    LeastSquares,
    Perceptron,
    Progress,
    Round,
    Schedule,
    choose_device,
    fit,
    nmse,
    predict,
    train_network,
)

ROUNDS = (Round(3, 100), Round(2, 300))


@pytest.fixture(scope="module")
def rows():
    x = np.random.default_rng(0).uniform(0.0, 5.0, (300, 2))
    return x, np.exp(0.3 * x[:, 0]) + x[:, 1]


def trained(rows, folder, device="cpu"):
    columns = np.column_stack(rows)
    return train_network(
        "y",
        *rows,
        Schedule(),
        seed=(1, 2),
        rounds=ROUNDS,
        weight=np.ones(300),
        bounds=(columns.min(axis=0), columns.max(axis=0)),
        device=device,
        checkpoint=Checkpoint(folder, {}),
        report=lambda stage, fraction: None,
    )


@pytest.fixture
def small():
    """A network, and a problem that it cannot solve."""
    network = Perceptron(2, np.random.default_rng(0))
    x = np.random.default_rng(2).uniform(-1.0, 1.0, (100, 2))
    problem = LeastSquares(network, x, np.abs(x[:, 0]) - x[:, 1] ** 2, np.ones(100))
    return problem, Progress(parameters_to_vector(network.parameters()).detach(), 1e-3)


def test_the_normal_equations_are_the_plain_formula(monkeypatch):
    monkeypatch.setattr(networks, "_COLUMNS", 10)
    rng = np.random.default_rng(0)
    x, weight = rng.uniform(-1.0, 1.0, (50, 3)), rng.uniform(0.0, 2.0, 50)
    y, network = np.sin(x.sum(axis=1)), Perceptron(3, rng)
    problem = LeastSquares(network, x, y, weight)
    problem._block = 7
    output = network(torch.from_numpy(x))
    slopes = [
        torch.autograd.grad(one, list(network.parameters()), retain_graph=True) for one in output
    ]
    J = np.array([np.concatenate([s.numpy().ravel() for s in of]) for of in slopes])
    error = y - output.detach().numpy()
    parameters = parameters_to_vector(network.parameters()).detach()
    gram, gradient, squares = problem.normal_equations(parameters)
    np.testing.assert_allclose(gram.numpy(), J.T @ (weight[:, None] * J), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(gradient.numpy(), J.T @ (weight * error), rtol=1e-10, atol=1e-12)
    assert squares == pytest.approx(np.sum(weight * error**2), rel=1e-12)
    assert problem.squared_error(parameters) == pytest.approx(squares, rel=1e-12)


def test_the_loss_never_rises_and_going_on_from_any_state_gives_the_same(small):
    problem, begin = small
    schedule, states = Schedule(decay=0.0), []
    whole = fit(problem, begin, schedule, 20, states.append)
    errors = [problem.squared_error(state.parameters) for state in (begin, *states)]
    assert all(after < before for before, after in itertools.pairwise(errors))
    kept = Progress.of_arrays(states[6].arrays(), "cpu")
    rest = fit(problem, kept, schedule, 20)
    assert torch.equal(rest.parameters, whole.parameters)
    assert (rest.damping, rest.iteration) == (whole.damping, whole.iteration)


def test_where_no_step_helps_it_stops(small):
    begin = small[1]
    problem = LeastSquares(
        Perceptron(2, np.random.default_rng(0)), np.zeros((3, 2)), np.zeros(3), np.ones(3)
    )
    start = Progress(torch.zeros_like(begin.parameters), 1e-3)
    found = fit(problem, start, Schedule(), 5)
    assert found.stuck
    assert fit(problem, found, Schedule(), 9) is found


def test_a_network_learns_its_rows(rows, tmp_path):
    assert nmse(rows[1], predict(trained(rows, tmp_path), rows[0])) < 5e-3


@pytest.mark.parametrize("present", [False, True])
def test_cuda_is_used_where_torch_finds_it(monkeypatch, present):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: present)
    assert choose_device("auto") == ("cuda" if present else "cpu")
    if not present:
        with pytest.raises(ValueError, match="finds no CUDA device"):
            choose_device("cuda")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda_trains_the_same_network(rows, tmp_path):
    ours, theirs = (
        predict(trained(rows, tmp_path / device, device=device), rows[0])
        for device in ("cpu", "cuda")
    )
    np.testing.assert_allclose(ours, theirs, rtol=1e-6)
