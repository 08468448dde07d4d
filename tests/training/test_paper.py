"""The paper's recipe on a small lattice: its set, and chains that are scored and recorded."""

import numpy as np
import pytest

from drake_oa.common.files import source_digest
from drake_oa.regulation.regressor import load_chain, save_chain
from drake_oa.training.checkpoint import Checkpoint
from drake_oa.training.lattice import PaperLattice
from drake_oa.training.networks import Round
from drake_oa.training.paper import (
    CHAINS,
    KEPT,
    PaperRecipe,
    build_paper_set,
    floor_of_means,
    floor_of_windows,
    group_means,
    train_paper,
)

FULL = PaperLattice()
SMALL = PaperRecipe(
    PaperLattice(*(axis[1::7] for axis in FULL[:2]), *(axis[1::8] for axis in FULL[2:])),
    {name: ((Round(2, 100), Round(1, 200)),) * 3 for name in CHAINS},
)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return train_paper(SMALL, 3, checkpoint=Checkpoint(tmp_path_factory.mktemp("paper"), {}))


def test_rows_keep_their_clearance_and_stand_in_the_lattice(trained):
    rows = trained[0]
    assert 20 < len(rows) < rows.rollouts == 2 * 2 * 7**3
    assert rows.clearance.min() >= KEPT
    for column, axis in enumerate(SMALL.lattice):
        np.testing.assert_array_equal(rows.values[:, column], axis[rows.index[:, column]])
    # Nobody keeps more than the start does.
    assert (rows.clearance <= 0.5 - rows.values[:, 0] + 1e-3).all()


def test_both_chains_are_trained_and_recorded(trained, tmp_path):
    rows, chains, scores = trained
    assert [len(chains[name].lower) for name in CHAINS] == [2, 3]
    for name in CHAINS:
        assert [s.target for s in scores[name]] == ["kappa", "psi", "alpha"]
        assert all(s.train < 1.2 and s.floor < 1.2 for s in scores[name])
        save_chain(chains[name], tmp_path / "chain.safetensors")
        metadata = load_chain(tmp_path / "chain.safetensors").metadata
        assert (metadata["recipe"], metadata["seed"]) == ("paper", 3)
        assert metadata["source_digest"] == source_digest()
        assert metadata["rows"]["psi"] == rows.near_goal.sum()


def test_after_an_interruption_the_chains_are_the_same(trained, tmp_path):
    def interrupt(stage, fraction):
        if stage == "asked-psi":
            raise KeyboardInterrupt

    checkpoint = Checkpoint(tmp_path, {})
    with pytest.raises(KeyboardInterrupt):
        train_paper(SMALL, 3, checkpoint=checkpoint, report=interrupt)
    assert train_paper(SMALL, 3, checkpoint=checkpoint)[2] == trained[2]


def test_a_lattice_that_keeps_nothing_is_an_error():
    none = SMALL.lattice._replace(alpha=FULL.alpha[:1])
    with pytest.raises(ValueError, match="no motion of the lattice"):
        build_paper_set(none, lambda stage, done: None, "released")


@pytest.mark.slow
def test_the_whole_lattice_has_the_rows_that_the_released_network_tells_of():
    rows = build_paper_set(FULL, lambda stage, done: None, "released")
    assert rows.rollouts == 12_500_000
    assert len(rows) == pytest.approx(1_249_134, abs=300)
    # The range of its scaling, authors_rc.npz.
    assert rows.clearance.max() == pytest.approx(0.474818, abs=2e-4)


def test_fitting_the_means_is_fitting_the_rows():
    rng = np.random.default_rng(0)
    index = rng.integers(0, 3, (200, 2))
    y = index @ (1.0, -2.0) + rng.normal(size=200)
    some = rng.random(200) < 0.7
    groups, mean, count, _ = group_means(index, y, some)
    root = np.sqrt(count)
    of_means = np.linalg.lstsq(root[:, None] * groups, root * mean, rcond=None)[0]
    of_rows = np.linalg.lstsq(index[some].astype(float), y[some], rcond=None)[0]
    np.testing.assert_allclose(of_means, of_rows, rtol=1e-10)


def test_the_floors_are_the_noise_within_groups_and_on_a_curve():
    y = np.array([1.0, 3.0, 5.0, 7.0])
    groups = np.array([[0], [0], [1], [1]])
    assert floor_of_means(groups, y, np.ones(4, dtype=bool)) == pytest.approx(1.0 / 5.0)
    rng = np.random.default_rng(1)
    index, t = rng.integers(0, 4, (20000, 1)), rng.uniform(0.0, 1.0, 20000)
    y = np.sin(6.0 * t) * (1.0 + index[:, 0]) + 0.3 * rng.normal(size=20000)
    found = floor_of_windows(index, t, y, np.ones(20000, dtype=bool), 20)
    assert found == pytest.approx(0.09 / np.var(y), rel=0.05)
