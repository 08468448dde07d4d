"""The paper's recipe on a small lattice: scored, recorded, resumed; Table I."""

import numpy as np
import pytest

from drake_oa.common.files import source_digest
from drake_oa.regulation.regressor import load_chain, save_chain
from drake_oa.training.checkpoint import Checkpoint
from drake_oa.training.lattice import PaperLattice
from drake_oa.training.networks import Round
from drake_oa.training.paper import CHAINS, PaperRecipe, table_one, train_paper

FULL = PaperLattice()
SMALL = PaperRecipe(
    PaperLattice(
        FULL.lambda1[1::7],
        FULL.lambda2[1::7],
        FULL.kappa[1::8],
        FULL.psi[1::8],
        FULL.alpha[1::8],
    ),
    {name: ((Round(2, 100), Round(1, 200)),) * 3 for name in CHAINS},
)


@pytest.fixture(scope="module")
def trained():
    return train_paper(SMALL, 3)


def test_both_chains_are_trained_and_recorded(trained, tmp_path):
    rows, chains, scores = trained
    assert [len(chains[name].lower) for name in CHAINS] == [2, 3]
    for name in CHAINS:
        assert [s.target for s in scores[name]] == ["kappa", "psi", "alpha"]
        assert all(s.train < 1.2 and s.floor < 1.2 for s in scores[name])
        save_chain(chains[name], tmp_path / "chain.safetensors")
        chain = load_chain(tmp_path / "chain.safetensors")
        assert chain.metadata["recipe"] == "paper"
        assert chain.metadata["seed"] == 3
        assert chain.metadata["source_digest"] == source_digest()
        assert chain.metadata["rows"]["psi"] == rows.near_goal.sum()
        assert len(chain.parameters([[0.1, 0.1]], 0.1, 1.0)) == 1
        assert not chain.parameters([[0.5, 0.1]], 0.1, 1.0).in_range[0]
    # RC(lambda') knows of no clearance.
    free = chains[CHAINS[0]]
    np.testing.assert_array_equal(
        free.parameters([[0.1, 0.1]], 0.1, 1.0).as_array(),
        free.parameters([[0.1, 0.1]], 0.4, 1.0).as_array(),
    )


def test_the_table_stands_beside_the_printed_one(trained):
    table = table_one(trained[2])
    assert "| RC(lambda') | psi |" in table
    assert "| 0.802 | 0.802 |" in table
    assert "| 1.6e-04 | 1.7e-04 |" in table


def test_after_an_interruption_the_chains_are_the_same(trained, tmp_path):
    calls = []

    def interrupt(stage, fraction):
        calls.extend([stage] * (stage != "roll out"))
        if len(calls) == 11:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_paper(SMALL, 3, checkpoint=Checkpoint(tmp_path, SMALL.settings()), report=interrupt)
    checkpoint = Checkpoint(tmp_path, SMALL.settings())
    _, chains, scores = train_paper(SMALL, 3, checkpoint=checkpoint)
    assert scores == trained[2]
    for name in CHAINS:
        for target, network in chains[name].networks.items():
            for ours, theirs in zip(
                network.weights, trained[1][name].networks[target].weights, strict=True
            ):
                np.testing.assert_array_equal(ours, theirs)
