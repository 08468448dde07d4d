"""Roll-outs over a lattice: clearances by brute force, and contact on both action levels."""

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


def densely_measured(path, extents, center):
    """Clearance by brute force: the samples against 20,000 points on the ellipse."""
    angle = np.linspace(0.0, 2.0 * np.pi, 20001)
    ellipse = center + extents * np.column_stack((np.cos(angle), np.sin(angle)))
    inside = (((path[:, :2] - center) / extents) ** 2).sum(axis=1) <= 1.0
    return 0.0 if inside.any() else cKDTree(ellipse).query(path[:, :2])[0].min()


def test_clearances_are_those_of_dense_sampling():
    found = roll_out_lattice(LATTICE, "released")
    free, touched = np.argwhere(found[0] > 0.0), np.argwhere(found[0] == 0.0)
    assert len(free) > 20
    for place in map(tuple, (*free[::3], *touched[:: len(touched) // 6])):
        lambda1, lambda2, kappa, psi, alpha = (
            axis[i] for axis, i in zip(LATTICE, place, strict=True)
        )
        (path,) = released_paths(np.array([[alpha, psi, kappa]]), lambda1, lambda2)
        measured = densely_measured(path, (lambda1, lambda2), (0.5, 0.0))
        assert found[0][place] == pytest.approx(measured, abs=1e-4)
        missing = np.linalg.norm(path[-1] - (1.0, 0.0, 0.0)) if measured else np.inf
        assert found[1][place] == pytest.approx(missing)


@pytest.mark.parametrize("level", ["released", "running"])
def test_what_touches_has_no_clearance_and_no_goal(level):
    first = PaperLattice(*(axis[:1] for axis in LATTICE))
    clearance, goal_error = roll_out_lattice(first, level)
    assert clearance.shape == (1, 1, 1, 1, 1)
    assert (clearance == 0.0).all()
    assert np.isinf(goal_error).all()
