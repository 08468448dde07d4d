"""Tests of the paper's recipe on a small lattice: training set, chains, errors, metadata."""

import numpy as np
import pytest

from drake_oa.common.files import source_digest
from drake_oa.inference.regressor import load_chain, save_chain
from drake_oa.training.lattice import PaperLattice
from drake_oa.training.networks import Round
from drake_oa.training.paper import CHAINS, MIN_CLEARANCE, PaperRecipe, build_paper_set, train_paper

FULL = PaperLattice()
SMALL = PaperRecipe(
    PaperLattice(*(axis[1::7] for axis in FULL[:2]), *(axis[1::8] for axis in FULL[2:])),
    {name: ((Round(2, 100), Round(1, 200)),) * 3 for name in CHAINS},
)


def test_chains_are_trained_and_saved_with_metadata(tmp_path):
    rows, chains, errors = train_paper(SMALL, 3)
    assert 20 < len(rows.values) < rows.rollouts == 2 * 2 * 7**3
    assert rows.clearance.min() >= MIN_CLEARANCE
    for column, axis in enumerate(SMALL.lattice):
        assert np.isin(rows.values[:, column], axis).all()
    # The clearance of a motion is at most that of its start.
    assert (rows.clearance <= 0.5 - rows.values[:, 0] + 1e-3).all()
    assert [len(chains[name].lower) for name in CHAINS] == [2, 3]
    for name in CHAINS:
        assert list(errors[name]) == ["kappa", "psi", "alpha"]
        assert all(of["train"] < 1.2 for of in errors[name].values())
        save_chain(chains[name], tmp_path / "chain.safetensors")
        metadata = load_chain(tmp_path / "chain.safetensors").metadata
        assert (metadata["recipe"], metadata["seed"]) == ("paper", 3)
        assert metadata["source_digest"] == source_digest()
    assert train_paper(SMALL, 3)[2] == errors


def test_lattice_without_a_collision_free_motion_is_an_error():
    lattice = SMALL.lattice._replace(alpha=FULL.alpha[:1])
    with pytest.raises(ValueError, match="no motion of the lattice"):
        build_paper_set(lattice, "released")


@pytest.mark.slow
def test_full_lattice_has_the_rows_of_the_released_network():
    rows = build_paper_set(FULL, "released")
    assert rows.rollouts == 12_500_000
    assert len(rows.values) == pytest.approx(1_249_134, abs=300)
    # Upper limit of the input scaling in authors_rc.npz.
    assert rows.clearance.max() == pytest.approx(0.474818, abs=2e-4)
