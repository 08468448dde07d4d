"""The paper's training set: what its rows are, and the floors of what can be learnt."""

import numpy as np
import pytest

from drake_oa.training.lattice import PaperLattice
from drake_oa.training.paper import (
    KEPT,
    build_paper_set,
    floor_of_means,
    floor_of_windows,
    group_means,
)

FULL = PaperLattice()
SMALL = PaperLattice(
    FULL.lambda1[[0, 9]], FULL.lambda2[[0, 5]], FULL.kappa[1::8], FULL.psi[1::8], FULL.alpha[1::8]
)


@pytest.fixture(scope="module")
def rows():
    return build_paper_set(SMALL)


def test_rows_keep_their_clearance_and_stand_in_the_lattice(rows):
    assert rows.rollouts == 2 * 2 * 7**3
    assert 20 < len(rows) < rows.rollouts
    assert rows.clearance.min() >= KEPT
    for column, axis in enumerate(SMALL):
        np.testing.assert_array_equal(rows.values[:, column], axis[rows.index[:, column]])
    # Nobody keeps more than the start does.
    assert (rows.clearance <= 0.5 - rows.values[:, 0] + 1e-3).all()
    assert rows.near_goal.any()
    assert rows.unsaturated.any()


@pytest.mark.slow
def test_the_whole_lattice_has_the_rows_that_the_released_network_tells_of():
    rows = build_paper_set(FULL)
    assert rows.rollouts == 12_500_000
    assert len(rows) == pytest.approx(1_249_134, abs=300)
    # The range of its scaling, authors_rc.npz.
    assert rows.clearance.max() == pytest.approx(0.474818, abs=2e-4)


def test_a_lattice_that_keeps_nothing_is_an_error():
    none = SMALL._replace(alpha=FULL.alpha[:1])
    with pytest.raises(ValueError, match="no motion of the lattice"):
        build_paper_set(none)


def test_fitting_the_means_is_fitting_the_rows():
    rng = np.random.default_rng(0)
    index = rng.integers(0, 3, (200, 2))
    y = index @ (1.0, -2.0) + rng.normal(size=200)
    some = rng.random(200) < 0.7
    groups, mean, count = group_means(index, y, some)
    assert count.sum() == some.sum()
    root = np.sqrt(count)
    of_means = np.linalg.lstsq(root[:, None] * groups, root * mean, rcond=None)[0]
    of_rows = np.linalg.lstsq(index[some].astype(float), y[some], rcond=None)[0]
    np.testing.assert_allclose(of_means, of_rows, rtol=1e-10)


def test_the_floor_of_means_is_the_variance_within_groups():
    index = np.array([[0], [0], [1], [1]])
    y = np.array([1.0, 3.0, 5.0, 7.0])
    assert floor_of_means(index, y, np.ones(4, dtype=bool)) == pytest.approx(1.0 / 5.0)


@pytest.mark.parametrize("width", [3, 20])
def test_the_floor_of_windows_finds_the_noise_on_a_curve(width):
    rng = np.random.default_rng(1)
    index, t = rng.integers(0, 4, (20000, 1)), rng.uniform(0.0, 1.0, 20000)
    curve = np.sin(6.0 * t) * (1.0 + index[:, 0])
    noise = 0.3 * rng.normal(size=20000)
    everything = np.ones(20000, dtype=bool)
    found = floor_of_windows(index, t, curve + noise, everything, width)
    assert found == pytest.approx(0.09 / np.var(curve + noise), rel=0.05)
    assert floor_of_windows(index, t, curve, everything, width) < 1e-6
    assert np.isnan(floor_of_windows(index, t, curve, index[:, 0] > 9, width))
