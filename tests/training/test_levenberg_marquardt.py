"""Levenberg-Marquardt: what it learns, that it descends, that it goes on as before."""

import itertools

import numpy as np
import pytest

from drake_oa.training.levenberg_marquardt import Progress, Schedule, fit
from drake_oa.training.normal_equations import least_squares
from drake_oa.training.perceptron import flatten, forward, initial_layers, unflatten


def begin(sizes, seed):
    return Progress(flatten(initial_layers(sizes, np.random.default_rng(seed))), 1e-3)


def test_it_learns_a_smooth_function():
    rng = np.random.default_rng(1)
    x = rng.uniform(-1.0, 1.0, (400, 2))
    y = np.sin(3.0 * x[:, 0]) * x[:, 1]
    sizes = [2, 10, 10, 1]
    found = fit(least_squares(sizes, x, y), begin(sizes, 0), Schedule(iterations=60))
    fresh = rng.uniform(-1.0, 1.0, (400, 2))
    truth = np.sin(3.0 * fresh[:, 0]) * fresh[:, 1]
    guess = forward(unflatten(found.parameters, sizes), fresh)
    assert np.mean((guess - truth) ** 2) < 1e-3 * np.var(truth)


@pytest.fixture
def problem():
    x = np.random.default_rng(2).uniform(-1.0, 1.0, (100, 2))
    return least_squares([2, 6, 1], x, np.abs(x[:, 0]) - x[:, 1] ** 2)


def test_the_loss_never_rises(problem):
    errors = []
    schedule = Schedule(iterations=30, decay=0.0)
    fit(problem, begin([2, 6, 1], 0), schedule, lambda state, e: errors.append(e))
    assert len(errors) == 30
    assert all(after <= before for before, after in itertools.pairwise(errors))


@pytest.mark.parametrize("after", [1, 7, 19])
def test_going_on_from_any_state_gives_the_same(problem, after):
    schedule = Schedule(iterations=20)
    states = []
    whole = fit(problem, begin([2, 6, 1], 0), schedule, lambda state, _: states.append(state))
    rest = fit(problem, states[after - 1], schedule)
    np.testing.assert_array_equal(rest.parameters, whole.parameters)
    assert (rest.damping, rest.iteration) == (whole.damping, whole.iteration)


def test_where_no_step_helps_it_stops():
    problem = least_squares([1, 2, 1], np.zeros((3, 1)), np.zeros(3))
    start = Progress(np.zeros(7), 1e-3)
    found = fit(problem, start, Schedule(iterations=5))
    assert found.stuck
    assert found.iteration == 0
    assert fit(problem, found, Schedule(iterations=9)) is found
