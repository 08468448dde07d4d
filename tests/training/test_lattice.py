"""Tests of roll-outs over a lattice: clearances, and contacts on both action levels."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from drake_oa.training.lattice import PaperLattice, released_paths, roll_out_lattice

LATTICE = PaperLattice(
    np.array([0.05, 0.2]),
    np.array([0.03, 0.25]),
    np.array([0.0, 15.0, 60.0, 800.0]),
    np.array([0.2, 0.8]),
    np.array([0.01, 20.0, 3000.0, 25000.0]),
)


def dense_clearance(path, extents, center):
    """Computes the clearance of a path by brute force: its samples and 20,000 ellipse points."""
    angle = np.linspace(0.0, 2.0 * np.pi, 20001)
    ellipse = center + extents * np.column_stack((np.cos(angle), np.sin(angle)))
    inside = (((path[:, :2] - center) / extents) ** 2).sum(axis=1) <= 1.0
    return 0.0 if inside.any() else cKDTree(ellipse).query(path[:, :2])[0].min()


def test_clearances_equal_those_of_dense_sampling():
    results = roll_out_lattice(LATTICE, "released")
    free, touched = np.argwhere(results[0] > 0.0), np.argwhere(results[0] == 0.0)
    assert len(free) > 20
    for place in map(tuple, (*free[::3], *touched[:: len(touched) // 6])):
        lambda1, lambda2, kappa, psi, alpha = (
            axis[i] for axis, i in zip(LATTICE, place, strict=True)
        )
        (path,) = released_paths(np.array([[alpha, psi, kappa]]), lambda1, lambda2)
        measured = dense_clearance(path, (lambda1, lambda2), (0.5, 0.0))
        assert results[0][place] == pytest.approx(measured, abs=1e-4)
        goal_error = np.linalg.norm(path[-1] - (1.0, 0.0, 0.0)) if measured else np.inf
        assert results[1][place] == pytest.approx(goal_error)


@pytest.mark.parametrize("level", ["released", "running"])
def test_motion_in_contact_has_zero_clearance_and_infinite_goal_error(level):
    first = PaperLattice(*(axis[:1] for axis in LATTICE))
    clearance, goal_error = roll_out_lattice(first, level)
    assert clearance.shape == (1, 1, 1, 1, 1)
    assert (clearance == 0.0).all()
    assert np.isinf(goal_error).all()
