"""The float32 roll-outs: rows by themselves."""

import numpy as np
import pytest

from drake_oa.training.planar_rollout import planar_rollouts, released_rollouts


def paper_sample(rows, seed):
    """Semi-axes (rows, 2) [m] and alpha, psi, kappa (rows, 3), drawn from the paper's lattice."""
    rng = np.random.default_rng(seed)
    widths = np.linspace(0.025, 0.25, 10)[rng.integers(0, 10, (rows, 2))]
    axes = (
        np.linspace(0.01, 3e4, 50),
        np.linspace(0.1, 1.0, 50),
        np.linspace(0.0, 1e3, 50),
    )
    return widths, np.stack([axis[rng.integers(0, 50, rows)] for axis in axes], axis=1)


@pytest.mark.parametrize("rows", [1, 63, 64, 65, 2048, 2049])
def test_rows_do_not_depend_on_their_neighbours(rows):
    semi_axes, parameters = paper_sample(2049, seed=4)
    parameters[::2, 2] *= 0.05
    whole = planar_rollouts(semi_axes, parameters, steps=100)
    some = planar_rollouts(semi_axes[-rows:], parameters[-rows:], steps=100)
    np.testing.assert_array_equal(some.clearance, whole.clearance[-rows:])
    np.testing.assert_array_equal(some.path_length, whole.path_length[-rows:])


def test_no_rows_are_no_outcome():
    assert planar_rollouts(np.zeros((0, 2)), np.zeros((0, 3))).clearance.size == 0
    assert released_rollouts(np.zeros((0, 2)), np.zeros((0, 3))).clearance.size == 0
