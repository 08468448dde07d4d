"""The project's chain on a small set: scored, recorded, repeatable, resumed."""

import numpy as np
import pytest

from drake_oa.regulation.regressor import ClearanceLimit
from drake_oa.training.chain import score_table, train_chain
from drake_oa.training.dataset import Exploration, TrainingSet
from drake_oa.training.levenberg_marquardt import Schedule
from drake_oa.training.validation import validate, validation_table

SCHEDULE = Schedule(iterations=12)


@pytest.fixture(scope="module")
def rows():
    """A smooth map stands in for the roll-outs."""
    x = np.random.default_rng(0).uniform((0.02, 0.02, 0.02, 0.3), (0.2, 0.2, 0.1, 0.7), (200, 4))
    kappa, psi = np.exp(3.0 * x[:, 0] + x[:, 2]), 1.0 + x[:, 1]
    alpha = np.exp(4.0 + 20.0 * x[:, 2] + 10.0 * x[:, 1])
    chosen = np.arange(200) < 150
    return TrainingSet(x, np.column_stack((kappa, psi, alpha)), chosen, ClearanceLimit(), 7)


@pytest.fixture(scope="module")
def trained(rows):
    return train_chain(rows, Exploration(), 5, SCHEDULE)


def test_it_is_scored_and_recorded(trained):
    chain, scores = trained
    assert [s.target for s in scores] == ["kappa", "psi", "alpha"]
    assert [s.rows for s in scores] == [150, 150, 200]
    assert all(s.train < 0.05 for s in scores)
    metadata = chain.metadata
    assert metadata["recipe"] == "project"
    assert (metadata["seed"], metadata["rollouts"]) == (5, 7)
    assert metadata["ranges"]["lower"] == chain.lower.tolist()
    assert metadata["nmse"]["psi"]["test"] == scores[1].test
    assert metadata["rows"] == {"chosen": 150, "alpha": 200}
    assert "| ln alpha |" in score_table(scores)


def test_validation_rolls_out_what_it_proposes(trained):
    outcome = validate(trained[0], scenes=20)
    assert outcome.scenes == 20
    assert 0.0 <= outcome.kept <= 1.0
    assert "| here | 20 |" in validation_table({"here": outcome})
