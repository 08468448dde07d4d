"""Training of the regressor chain: Jacobian, optimiser, data set, whole run."""

import itertools

import numpy as np
import pytest

from drake_oa.regressor import load_chain
from drake_oa.rollout import planar_rollouts
from drake_oa.training import __main__ as command
from drake_oa.training.chain import train_chain
from drake_oa.training.dataset import Exploration, build_training_set
from drake_oa.training.levenberg_marquardt import (
    Schedule,
    flatten,
    forward,
    initial_layers,
    jacobian,
    train,
    unflatten,
)
from drake_oa.training.validation import validate

SMALL = Exploration(
    lambda1=np.array([0.05, 0.15, 0.25]),
    lambda2=np.array([0.05, 0.15, 0.25]),
    clearances=np.array([0.05, 0.1, 0.15]),
    positions=np.array([0.4, 0.6]),
    kappa=np.geomspace(0.5, 20.0, 5),
    psi=np.geomspace(1.0, 2.2, 3),
    alpha=np.geomspace(30.0, 1e4, 12),
    copies=1,
    grid_steps=300,
)


@pytest.fixture(scope="module")
def rows():
    return build_training_set(SMALL, seed=0)


def test_jacobian_is_the_derivative_of_the_output():
    rng = np.random.default_rng(0)
    layers = initial_layers([3, 5, 4, 1], rng)
    x = rng.uniform(-1.0, 1.0, (7, 3))
    y, J = jacobian(layers, x)
    np.testing.assert_allclose(y, forward(layers, x), rtol=1e-14)
    parameters, step = flatten(layers), 1e-6
    assert J.shape == (7, parameters.size)
    for k in range(parameters.size):
        move = step * np.eye(parameters.size)[k]
        up = forward(unflatten(parameters + move, layers), x)
        down = forward(unflatten(parameters - move, layers), x)
        np.testing.assert_allclose(J[:, k], (up - down) / (2.0 * step), atol=1e-8)


def test_levenberg_marquardt_learns_a_smooth_function():
    rng = np.random.default_rng(1)
    x = rng.uniform(-1.0, 1.0, (400, 2))
    y = np.sin(3.0 * x[:, 0]) * x[:, 1]
    layers = train(initial_layers([2, 10, 10, 1], rng), x, y, Schedule(iterations=60))
    fresh = rng.uniform(-1.0, 1.0, (400, 2))
    truth = np.sin(3.0 * fresh[:, 0]) * fresh[:, 1]
    assert np.mean((forward(layers, fresh) - truth) ** 2) < 1e-3 * np.var(truth)


def test_the_loss_never_rises():
    rng = np.random.default_rng(2)
    x = rng.uniform(-1.0, 1.0, (100, 2))
    y = np.abs(x[:, 0]) - x[:, 1] ** 2
    errors = []
    schedule = Schedule(iterations=30, decay=0.0)
    train(initial_layers([2, 6, 1], rng), x, y, schedule, lambda k, e: errors.append(e))
    assert all(after <= before for before, after in itertools.pairwise(errors))


@pytest.mark.parametrize(
    ("x", "y", "message"),
    [
        (np.zeros((4, 3)), np.zeros(4), r"x must be \(N, 2\)"),
        (np.zeros((4, 2)), np.zeros(3), r"and y \(N,\)"),
        (np.full((4, 2), np.nan), np.zeros(4), "must be finite"),
    ],
)
def test_rows_that_do_not_fit_are_refused(x, y, message):
    layers = initial_layers([2, 3, 1], np.random.default_rng(0))
    with pytest.raises(ValueError, match=message):
        train(layers, x, y, Schedule())


def rolled_out(rows, targets):
    centers = np.column_stack((rows.inputs[:, 3], np.zeros(len(rows.inputs))))
    return planar_rollouts(rows.inputs[:, :2], targets[:, [2, 1, 0]], centers=centers)


def test_every_row_keeps_its_clearance_and_arrives(rows):
    outcome = rolled_out(rows, rows.targets)
    excess = outcome.clearance - rows.inputs[:, 2]
    assert (excess >= SMALL.margin - 1e-9).all()
    assert (outcome.goal_error <= SMALL.goal_tolerance).all()


def test_alpha_is_the_weakest_that_keeps_it(rows):
    outcome = rolled_out(rows, rows.targets * (1.0, 1.0, 0.99))
    interior = rows.targets[:, 2] > 1.02 * SMALL.alpha[0]
    assert (outcome.clearance < rows.inputs[:, 2] + SMALL.margin)[interior].mean() > 0.95


def test_the_limit_is_the_largest_clearance_in_the_rows(rows):
    chosen = rows.inputs[rows.chosen]
    limit = rows.limit
    for i, j, k in np.ndindex(limit.clearance.shape):
        ellipse = (limit.lambda1[i], limit.lambda2[j], limit.position[k])
        own = chosen[(chosen[:, [0, 1, 3]] == ellipse).all(axis=1), 2]
        assert limit.clearance[i, j, k] <= own.max(initial=0.0)
    assert (limit.clearance[0, 0] == 0.15).all()


def test_the_same_seed_gives_the_same_rows(rows):
    again = build_training_set(SMALL, seed=0)
    np.testing.assert_array_equal(again.inputs, rows.inputs)
    np.testing.assert_array_equal(again.targets, rows.targets)


def test_an_exploration_that_keeps_nothing_is_an_error():
    weak = Exploration(
        lambda1=np.array([0.1]),
        lambda2=np.array([0.1]),
        clearances=np.array([0.1]),
        positions=np.array([0.5]),
        alpha=np.array([1e-3, 1e-2]),
    )
    with pytest.raises(ValueError, match="no input of the exploration can be kept"):
        build_training_set(weak, seed=0)


def test_a_chain_is_trained_scored_and_repeatable(rows):
    schedule = Schedule(iterations=8)
    chain, scores = train_chain(rows, SMALL, 0, schedule, commit="abc")
    assert [s.target for s in scores] == ["kappa", "psi", "alpha"]
    assert scores[2].train < 0.1
    assert chain.metadata["commit"] == "abc"
    again, _ = train_chain(rows, SMALL, 0, schedule)
    np.testing.assert_array_equal(again.evaluate(rows.inputs), chain.evaluate(rows.inputs))
    outcome = validate(chain, scenes=20)
    assert outcome.scenes == 20
    assert 0.0 <= outcome.kept <= 1.0


def test_the_command_writes_a_file_that_loads(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(command, "Exploration", lambda: SMALL)
    monkeypatch.setattr(command, "validate", lambda chain, **_: validate(chain, scenes=20))
    path = tmp_path / "new" / "chain.npz"
    assert command.main(["--out", str(path), "--seed", "4", "--iterations", "2"]) == 0
    assert load_chain(path).metadata["seed"] == 4
    assert "| ln alpha |" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments",
    [["--out", "chain.mat"], ["--out", "chain.npz", "--iterations", "0"], []],
)
def test_wrong_arguments_end_the_command(arguments):
    with pytest.raises(SystemExit):
        command.main(arguments)
