"""The released code's motions over a lattice: against the readable form, path by path."""

import numpy as np
import pytest

from drake_oa.training.released_method import PaperLattice, forcing_term, roll_out
from tests.reference.released_code import euler_trajectory
from tests.training.test_rollouts import densely_measured

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


def test_an_ellipse_about_the_start_is_touched():
    wide = LATTICE._replace(lambda1=np.array([0.6]))
    assert (roll_out(wide)[0] == 0.0).all()


def test_the_forcing_term_is_what_the_released_code_fitted(reference):
    data = np.load(reference("authors_action_level.npz"))
    on_one_metre = np.flatnonzero(data["baseline"] == 1.0)[0]
    table = forcing_term(500, 0.005)
    np.testing.assert_allclose(table, data["forcing"][on_one_metre, :, 0], atol=2e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"psi": np.zeros(1)}, "psi must be a row of finite numbers, positive"),
        ({"kappa": -np.ones(1)}, "kappa must be a row of finite numbers, not negative"),
        ({"alpha": np.array([np.nan])}, "alpha must be a row"),
        ({"lambda2": np.zeros((0,))}, "lambda2 must be a row"),
    ],
)
def test_bad_lattices_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        roll_out(LATTICE._replace(**change))


# The readable form itself.


@pytest.mark.parametrize("term", ["dead_zone_free", "original"])
def test_released_trajectories_are_reproduced(reference, term):
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


@pytest.mark.parametrize(
    ("term", "parameters", "third", "eighth"),
    [
        (
            "dead_zone_free",
            (11026.055663209949, 0.7699037123810009, 24.188755881967893),
            [0.0026161928095, 0.0007277780072, 0.0016370637172],
            [0.0098859299601, 0.0034630706622, 0.0077898305181],
        ),
        (
            "original",
            (1000.0, 20.0 / np.pi),
            [0.0027867511929, 0.0000757142515, 0.0001703116236],
            [0.0135655128403, 0.0007839960771, 0.0017635206333],
        ),
    ],
)
def test_the_first_steps_of_a_released_trajectory_are_reproduced(term, parameters, third, eighth):
    forcing = np.zeros((8, 3))
    forcing[:, 0] = [
        *(-10.495990263368, -10.4709422671561, -10.4458930533492, -10.4208429379493),
        *(-10.3957922273462, -10.3707412171922, -10.3456902179982, -10.3206396738286),
    ]
    path = euler_trajectory(
        np.array([0.31719211855949414, -0.06755015017212038, -0.15194729551783312]),
        np.array([0.5, 0.0, 0.0]),
        forcing,
        parameters,
        term=term,
        tau=1.567690200884412,
    )
    np.testing.assert_allclose(path[[2, 7]], [third, eighth], atol=1e-12)
