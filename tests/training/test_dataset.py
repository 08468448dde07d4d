"""The project's training set: what its rows promise, and that it goes on as before."""

import numpy as np
import pytest

from drake_oa.training import dataset
from drake_oa.training.checkpoint import Checkpoint
from drake_oa.training.dataset import Exploration, build_training_set
from drake_oa.training.rollouts import planar_rollouts

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
    degree=2,
)


@pytest.fixture(scope="module")
def rows():
    return build_training_set(SMALL, seed=0)


def rolled_out(rows, targets):
    return planar_rollouts(
        rows.inputs[:, :2],
        np.column_stack((rows.inputs[:, 3], np.zeros(len(rows.inputs)))),
        targets[:, None, [2, 1, 0]],
        dmp=SMALL.dmp,
        end=SMALL.end,
        fade=SMALL.fade,
    )


def test_every_row_keeps_its_clearance_and_arrives(rows):
    outcome = rolled_out(rows, rows.targets)
    excess = outcome.clearance[:, 0] - rows.inputs[:, 2]
    assert (excess >= SMALL.margin - 1e-6).all()
    assert (outcome.goal_error <= SMALL.goal_tolerance).all()


def test_alpha_is_the_weakest_that_keeps_it(rows):
    outcome = rolled_out(rows, rows.targets * (1.0, 1.0, 0.99))
    interior = rows.targets[:, 2] > 1.02 * SMALL.alpha[0]
    assert (outcome.clearance[:, 0] < rows.inputs[:, 2] + SMALL.margin)[interior].mean() > 0.95


def test_the_choices_lie_on_a_polynomial_of_the_inputs(rows):
    for column, axis in ((0, SMALL.kappa), (1, SMALL.psi)):
        target = rows.targets[:, column]
        free = rows.chosen & (target > axis[0]) & (target < axis[-1])
        x, y = rows.inputs[free], np.log(target[free])
        quadratic = [x[:, i] * x[:, j] for i in range(4) for j in range(i, 4)]
        features = np.column_stack((np.ones(len(x)), x, *quadratic))
        assert len(x) > 1.5 * features.shape[1]
        rest = y - features @ np.linalg.lstsq(features, y, rcond=None)[0]
        assert np.abs(rest).max() < 1e-9


def test_the_limit_is_the_largest_clearance_in_the_rows(rows):
    chosen = rows.inputs[rows.chosen]
    limit = rows.limit
    for i, j, k in np.ndindex(limit.clearance.shape):
        ellipse = (limit.lambda1[i], limit.lambda2[j], limit.position[k])
        own = chosen[(chosen[:, [0, 1, 3]] == ellipse).all(axis=1), 2]
        assert limit.clearance[i, j, k] <= own.max(initial=0.0)
    assert (limit.clearance[0, 0] == 0.15).all()


def test_after_an_interruption_the_rows_are_the_same(rows, tmp_path, monkeypatch):
    monkeypatch.setattr(dataset, "_CHUNK", 4)

    def interrupt(stage, fraction):
        if stage == "explore" and fraction > 0.4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build_training_set(SMALL, 0, interrupt, Checkpoint(tmp_path, SMALL.settings()))
    explored = []
    again = build_training_set(
        SMALL,
        0,
        lambda stage, fraction: explored.append(fraction) if stage == "explore" else None,
        Checkpoint(tmp_path, SMALL.settings()),
    )
    assert explored[0] > 0.4
    np.testing.assert_array_equal(again.inputs, rows.inputs)
    np.testing.assert_array_equal(again.targets, rows.targets)
    assert again.rollouts == rows.rollouts


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
