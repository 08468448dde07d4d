"""Motions over a lattice: the released code's against the readable form; the running ones."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from drake_oa.training.lattice import PaperLattice, forcing_term, roll_out, running_lattice
from tests.reference.released_code import euler_trajectory

LATTICE = PaperLattice(
    np.array([0.05, 0.2]),
    np.array([0.03, 0.25]),
    np.array([0.0, 15.0, 60.0, 800.0]),
    np.array([0.2, 0.8]),
    np.array([0.01, 20.0, 3000.0, 25000.0]),
)


@pytest.fixture(scope="module")
def found():
    return roll_out(LATTICE)


def densely_measured(path, extents, center):
    """Clearance by brute force: the samples against 20,000 points on the ellipse."""
    angle = np.linspace(0.0, 2.0 * np.pi, 20001)
    ellipse = center + extents * np.column_stack((np.cos(angle), np.sin(angle)))
    inside = (((path[:, :2] - center) / extents) ** 2).sum(axis=1) <= 1.0
    return 0.0 if inside.any() else cKDTree(ellipse).query(path[:, :2])[0].min()


def readable(place):
    lambda1, lambda2, kappa, psi, alpha = (axis[i] for axis, i in zip(LATTICE, place, strict=True))
    path = euler_trajectory(
        np.array([0.5, 0.0, 0.0]),
        np.array([1.0, 0.0, 0.0]),
        np.column_stack((forcing_term(), np.zeros((1000, 2)))),
        (alpha, psi, kappa),
        tau=np.sqrt(1.0 + 4.0 * lambda2**2) + 0.1,
        step=0.003,
        # Exactly head-on it has no side to turn to.
        start=np.array([0.0, 1e-12, 0.0]),
    )
    return path, densely_measured(path, (lambda1, lambda2), (0.5, 0.0))


def test_motions_agree_with_the_readable_path(found):
    free, touched = np.argwhere(found[0] > 0.0), np.argwhere(found[0] == 0.0)
    compared = 0
    for place in map(tuple, (*free[::3], *touched[:: len(touched) // 6])):
        path, measured = readable(place)
        assert (found[0][place] == 0.0) == (measured == 0.0)
        goal_error = np.linalg.norm(path[-1] - (1.0, 0.0, 0.0))
        if measured == 0.0 or (LATTICE.kappa[place[2]] < 10.0 and goal_error > 0.02):
            continue  # Turned about all the way, a path amplifies the last bit of a sum.
        compared += 1
        assert found[0][place] == pytest.approx(measured, abs=1e-4)
        assert found[1][place] == pytest.approx(goal_error, abs=1e-5)
    assert compared > 3


def test_motions_do_not_depend_on_their_neighbours(found):
    # The last alpha alone: it begins when its own coupling term wakes.
    alone = roll_out(LATTICE._replace(alpha=LATTICE.alpha[1:2]))
    calm = (found[0][..., 1:2] > 0.0) & (found[1][..., 1:2] < 0.02)
    assert calm.sum() > 2
    np.testing.assert_allclose(alone[0][calm], found[0][..., 1:2][calm], atol=1e-6)
    # More of them than one block takes.
    many = roll_out(LATTICE._replace(alpha=np.tile(LATTICE.alpha, 20)))
    np.testing.assert_array_equal(many[0][..., -4:], found[0])


def test_bad_lattices_are_named():
    with pytest.raises(ValueError, match="kappa must be a row of finite numbers, not negative"):
        roll_out(LATTICE._replace(kappa=-np.ones(1)))


@pytest.mark.parametrize("go", [roll_out, running_lattice])
def test_what_touches_has_no_clearance_and_no_goal(go):
    clearance, goal_error = go(PaperLattice(*(axis[:1] for axis in LATTICE)))
    assert clearance.shape == (1, 1, 1, 1, 1)
    assert (clearance == 0.0).all()
    assert np.isinf(goal_error).all()


@pytest.mark.parametrize("term", ["dead_zone_free", "original"])
def test_the_readable_form_reproduces_released_trajectories(reference, term):
    data = np.load(reference("authors_action_level.npz"))
    key = "trajectory" if term == "dead_zone_free" else "trajectory_original_term"
    for row in range(24):
        given = tuple(float(data[name][row]) for name in ("alpha", "psi", "kappa"))
        path = euler_trajectory(
            data["center"][row],
            np.array([data["baseline"][row], 0.0, 0.0]),
            data["forcing"][row],
            given if term == "dead_zone_free" else (1000.0, 20.0 / np.pi),
            term=term,
            tau=float(data["tau"][row]),
        )
        np.testing.assert_allclose(path, data[key][row], atol=1e-9)
