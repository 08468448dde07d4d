"""The coupling terms and the integration of the whole action level."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from drake_oa.policy.coupling import dead_zone_free_rate, original_rate
from drake_oa.policy.dmp import imitate, local_frame, minimum_jerk
from tests.reference.coupling import CouplingTerms, coupling_force, guidance_rate, rotate
from tests.reference.dmp import step, trajectory
from tests.reference.released_code import euler_trajectory

seeds = st.integers(0, 2**32 - 1)
finite = st.floats(allow_nan=False, allow_infinity=False)
nonnegative = st.floats(0.0, allow_infinity=False)
vectors = st.tuples(finite, finite, finite)

DMP = imitate(*minimum_jerk(np.zeros(3), np.eye(3)[0]))


def terms(p_WO, parameters, heading=None, normal=None, **options) -> CouplingTerms:
    """Terms of lists; a single obstacle may be given as one row."""

    def rows(value):
        return None if value is None else np.atleast_2d(np.asarray(value, dtype=float))

    return CouplingTerms(rows(p_WO), rows(parameters), rows(heading), rows(normal), **options)


def random_terms(rng: np.random.Generator, **options) -> CouplingTerms:
    M = int(rng.integers(1, 7))
    parameters = np.exp(rng.uniform([-3, -3, -2], [14, 1, 6], size=(M, 3)))
    heading = rng.normal(size=(M, 3)) * rng.integers(0, 2, size=(M, 1))
    return terms(rng.normal(size=(M, 3)), parameters, heading, rng.normal(size=(M, 3)), **options)


def angle(a, b):
    return np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)


# Rates


def test_original_rate_has_a_dead_zone_and_the_new_one_has_none():
    theta = np.array([-0.5, 0.0, 1e-3, 0.5])
    original = original_rate(theta, 1000.0, 20.0 / np.pi)
    assert original[1] == 0.0
    assert original[2] < original[3] == -original[0]
    np.testing.assert_allclose(original[3], 500.0 * np.exp(-10.0 / np.pi))
    rate = dead_zone_free_rate(theta, 0.2, 100.0, 0.7, 5.0)
    assert rate[1] > rate[2] > rate[3] == -rate[0] > 0.0
    np.testing.assert_allclose(rate[3], 100.0 * np.exp(-((0.5 / 0.7) ** 2)) * np.exp(-0.2))


def test_guidance_acts_in_counterphase_and_the_printed_form_is_saturated():
    d = np.array([0.0, 0.1, 1.0, 100.0])
    rate = guidance_rate(0.4, d, 50.0, 20.0)
    np.testing.assert_allclose(rate, 20.0 * (1.0 - np.exp(-20.0 * d**2)))
    printed = guidance_rate(0.4, d, 50.0, 20.0, "printed", 500.0)
    np.testing.assert_allclose(printed[:2], 20.0 * np.exp(1.0 + 20.0 * d[:2] ** 2))
    np.testing.assert_array_equal(printed[2:], 500.0)
    np.testing.assert_allclose(guidance_rate(-0.4, d, 50.0, 20.0, "printed", 500.0), -printed)


def test_composed_rates_are_those_of_the_paper():
    p, z, center = np.array([0.0, 0, 0]), np.array([1.0, 0.5, 0]), np.array([0.5, 0, 0])
    v_d = np.array([0.0, 1.0, 1.0])
    one = terms(center, [30.0, 0.7, 4.0])
    expected = dead_zone_free_rate(angle(center, z), 0.5, 30.0, 0.7, 4.0)
    np.testing.assert_allclose(one.turning_rate(p, z), [0, 0, expected], rtol=1e-12)
    both = terms(center, [30.0, 0.7, 4.0], v_d, guidance_alpha=np.array([8.0]))
    axis = np.cross(z, v_d)
    guide = guidance_rate(angle(z, v_d), 0.5, 8.0, 4.0) * axis / np.linalg.norm(axis)
    np.testing.assert_allclose(both.turning_rate(p, z) - guide, [0, 0, expected], atol=1e-12)


@pytest.mark.parametrize("form", ["counterphase", "printed"])
def test_a_short_step_turns_by_the_rate_times_the_step(form):
    rng = np.random.default_rng(4)
    for _ in range(20):
        some = random_terms(rng, form=form)
        p, z = rng.normal(size=(2, 3))
        rate = some.turning_rate(p, z)
        h = 1e-9 / (1.0 + np.linalg.norm(rate))
        np.testing.assert_allclose(some.turn(p, z, h), rate * h, rtol=1e-5, atol=1e-20)


# Signs and degenerate geometry


def test_positive_turns_lead_away_from_the_obstacle_and_toward_the_desired_heading():
    p, z, center = np.zeros(3), np.array([1.0, 0.1, 0.0]), np.array([0.5, 0.0, 0.0])
    force = coupling_force(terms(center, [10.0, 1.0, 1.0]).turning_rate(p, z), z)
    assert force[1] > 0.0
    v_d = np.array([0.0, 0.0, 1.0])
    guided = terms(center, [0.0, 1.0, 1.0], v_d, guidance_alpha=np.array([10.0]))
    assert coupling_force(guided.turning_rate(p, z), z) @ v_d > 0.0


@pytest.mark.parametrize("side", [[0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0.6, -0.8]])
@pytest.mark.parametrize("offset", [0.0, 1e-12])
def test_heading_exactly_at_the_centre_turns_to_the_chosen_side(side, offset):
    center = np.array([0.5, offset, -offset])
    normal = np.cross([1.0, 0, 0], side)
    path = trajectory(
        DMP, np.zeros(3), [1.0, 0, 0], turn=terms(center, [150.0, 0.6, 10.0], None, normal).turn
    ).p
    # Later on, strong coupling amplifies what leaves the plane (docs/equations.md).
    early = (path[:, 0] > 1e-3) & (path[:, 0] < 0.02)
    assert (path[early] @ np.array(side) > 5e-5).all()
    np.testing.assert_allclose(path[early] @ normal, 0.0, atol=1e-7)


@pytest.mark.parametrize("normal", [None, [0, 0, 0], [1.0, 0, 0]])
def test_without_a_usable_normal_a_head_on_motion_passes_on_the_left(normal):
    some = terms([0.5, 0, 0], [10.0, 0.6, 1.0], None, normal)
    rate = some.turning_rate(np.zeros(3), np.array([2.0, 0, 0]))
    np.testing.assert_allclose(rate / np.linalg.norm(rate), [0, 0, 1])
    upright = terms([0, 0, 0.5], [10.0, 0.6, 1.0]).turning_rate(np.zeros(3), np.array([0, 0, 1.0]))
    np.testing.assert_allclose(upright / np.linalg.norm(upright), [1, 0, 0])


def test_opposite_desired_heading_is_reached_about_the_normal():
    v_d, normal = [-1.0, 0, 0], [0.0, 0, -3.0]
    guided = terms([0.5, 0.5, 0], [0.0, 1, 4], v_d, normal, guidance_alpha=np.array([10.0]))
    rate = guided.turning_rate(np.zeros(3), np.array([1.0, 0, 0]))
    assert rate[2] < 0.0
    np.testing.assert_allclose(rate[:2], 0.0)


def test_terms_without_a_defined_direction_are_absent():
    some = terms([0.5, 0, 0], [10.0, 1.0, 1.0])
    away = np.array([-1.0, 0, 0])
    for p, z in ((np.zeros(3), away), (np.zeros(3), np.zeros(3)), (np.array([0.5, 0, 0]), away)):
        np.testing.assert_array_equal(some.turning_rate(p, z), 0.0)
        np.testing.assert_array_equal(some.turn(p, z, 0.1), 0.0)
    np.testing.assert_array_equal(CouplingTerms().turn(np.zeros(3), away, 0.1), 0.0)


@settings(max_examples=300, deadline=None)
@given(
    p=vectors,
    z=vectors,
    p_WO=vectors,
    alpha=nonnegative,
    psi=st.floats(0.0, exclude_min=True, allow_infinity=False),
    kappa=nonnegative,
    v_d=vectors,
    normal=vectors,
    guide=nonnegative,
    h=st.floats(0.0, 1e3),
    form=st.sampled_from(["counterphase", "printed"]),
)
@example(*([(0.0,) * 3] * 3), 1.0, 1.0, 1.0, (0.0,) * 3, (0.0,) * 3, 1.0, 0.1, "printed")
@example(
    *((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
    *(1e308, 1e-308, 0.0, (-1.0, 0.0, 0.0), (5e-324, 0.0, 0.0), 1e308, 1e3, "printed"),
)
def test_no_finite_input_yields_anything_but_a_finite_turn(
    p, z, p_WO, alpha, psi, kappa, v_d, normal, guide, h, form
):
    two = CouplingTerms(
        np.array([p_WO, p_WO[::-1]]),
        np.array([[alpha, psi, kappa]] * 2),
        np.array([v_d, v_d[::-1]]),
        np.array([normal, normal]),
        np.array([guide, guide]),
        form,
    )
    p, z = np.array(p), np.array(z)
    turn = two.turn(p, z, h)
    assert np.isfinite(turn).all()
    assert np.linalg.norm(turn) <= np.pi * (1.0 + 1e-12)
    assert not np.isnan(two.turning_rate(p, z)).any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parameters": [[-1.0, 1, 1]]}, "alpha, psi, kappa"),
        ({"parameters": [[1.0, 0, 1]]}, "alpha, psi, kappa"),
        ({"parameters": [[1.0, 1, np.nan]]}, "obstacle 0 has a value that is not finite"),
        ({"p_WO": [[np.inf, 0, 0]]}, "not finite"),
        ({"parameters": [[1.0, 1, 1]] * 2}, r"parameters must be \(M, 3\) with M = 1"),
        ({"heading_W": [[1.0, 0]]}, "heading_W"),
        ({"guidance_alpha": [1.0, 2.0]}, "guidance_alpha"),
        ({"form": "sharp"}, 'must be "counterphase" or "printed"'),
        ({"max_rate": 0.0}, "max_rate"),
    ],
)
def test_unusable_terms_are_refused(change, message):
    good = {"p_WO": [[1.0, 0, 0]], "parameters": [[1.0, 1, 1]]}
    given = {k: np.array(v) if isinstance(v, list) else v for k, v in (good | change).items()}
    with pytest.raises(ValueError, match=message):
        CouplingTerms(**given)


# What every coupling term keeps


@settings(max_examples=100, deadline=None)
@given(seed=seeds)
def test_coupling_force_is_orthogonal_to_the_scaled_velocity(seed):
    rng = np.random.default_rng(seed)
    some, (p, z) = random_terms(rng), rng.normal(size=(2, 3))
    rate = some.turning_rate(p, z)
    force = coupling_force(rate, z)
    np.testing.assert_allclose(force, np.cross(rate, z))
    size = np.linalg.norm(z) * max(np.linalg.norm(force), np.linalg.norm(rate))
    assert abs(force @ z) <= 1e-12 * size + 1e-100
    assert abs(rate @ z) <= 1e-12 * size * len(some) * 2 + 1e-100


@settings(max_examples=100, deadline=None)
@given(seed=seeds, size=st.floats(0.0, 1e4))
def test_rotation_is_that_of_rodrigues_and_keeps_the_length(seed, size):
    from scipy.spatial.transform import Rotation

    z, w = np.random.default_rng(seed).normal(size=(2, 3))
    w *= size / np.linalg.norm(w)
    turned = rotate(z, w)
    np.testing.assert_allclose(turned, Rotation.from_rotvec(w).apply(z), atol=1e-11)
    assert np.isclose(np.linalg.norm(turned), np.linalg.norm(z), rtol=1e-14)


@settings(max_examples=150, deadline=None)
@given(seed=seeds, h=st.floats(1e-6, 10.0), log_alpha=st.floats(-3, 14), head_on=st.booleans())
def test_one_term_never_turns_past_where_it_leads(seed, h, log_alpha, head_on):
    rng = np.random.default_rng(seed)
    p, z, center, normal = rng.normal(size=(4, 3))
    if head_on:
        center = p + 0.7 * z
    alpha = np.exp(log_alpha)
    psi = np.exp(rng.uniform(-3, 2))
    before = angle(center - p, z)
    after = rotate(z, terms(center, [alpha, psi, 0.2], None, normal).turn(p, z, h))
    assert before - 1e-9 <= angle(center - p, after)
    away = np.cross(center - p, z) @ np.cross(center - p, after)
    if not head_on:
        assert away >= -1e-9
    v_d = rng.normal(size=3)
    guided = terms(center, [0.0, 1, 1], v_d, normal, guidance_alpha=np.array([alpha]))
    after = rotate(z, guided.turn(p, z, h))
    assert angle(after, v_d) <= angle(z, v_d) + 1e-9
    assert np.cross(z, v_d) @ np.cross(after, v_d) >= -1e-9


@pytest.mark.parametrize("theta", [0.0, 0.1, 0.7, 1.6])
@pytest.mark.parametrize("size", [0.01, 0.3, 1.0, 10.0, 1000.0])
def test_an_avoidance_turn_is_the_exact_flow_within_three_hundredths(theta, size):
    from scipy.integrate import solve_ivp

    psi = 0.8
    rate = dead_zone_free_rate(theta, 1.0, size, psi, 0.0)
    exact = solve_ivp(
        lambda _, y: size * np.exp(-((y / psi) ** 2)),
        (0.0, 1.0),
        [theta],
        method="LSODA",
        rtol=1e-10,
        atol=1e-12,
    )
    z = np.array([np.cos(theta), np.sin(theta), 0.0])
    turn = terms([1.0, 0, 0], [size, psi, 0.0], None, [0, 0, 1.0]).turn(np.zeros(3), z, 1.0)
    expected = min(exact.y[0, -1], np.pi) - theta
    np.testing.assert_allclose(turn, [0, 0, expected], rtol=0.03)
    assert turn[2] <= rate * (1.0 + 1e-12)


@pytest.mark.parametrize("h", [1e-4, 0.1, 0.4, 3.0])
def test_the_saturated_guidance_turn_is_the_exact_flow(h):
    theta, gain, limit = 2.0, 3.0 * np.e, 2.5
    z, v_d = np.array([1.0, 0, 0]), [np.cos(theta), np.sin(theta), 0]
    guided = terms(
        [0.5, 0, 0],
        [0.0, 1, 0],
        v_d,
        guidance_alpha=np.array([3.0]),
        form="printed",
        max_rate=limit,
    )
    linear = theta - limit / gain
    if h < linear / limit:
        expected = limit * h
    else:
        expected = theta - limit / gain * np.exp(-gain * (h - linear / limit))
    np.testing.assert_allclose(guided.turn(np.zeros(3), z, h), [0, 0, expected], rtol=1e-12)


def test_many_obstacles_in_line_do_not_turn_more_than_one_of_their_joint_strength():
    z, p = np.array([1.0, 0.2, 0]), np.zeros(3)
    row = [1e5, 0.6, 0.0]
    six = terms([[0.5, 0, 0]] * 6, [row] * 6).turn(p, z, 1e-3)
    one = terms([0.5, 0, 0], [6e5, 0.6, 0.0]).turn(p, z, 1e-3)
    np.testing.assert_allclose(six, one, rtol=0.2)
    assert angle([0.5, 0, 0], rotate(z, six)) < np.pi / 2 + 0.4


# Invariances of the whole action level


def scene(seed: int):
    rng = np.random.default_rng(seed)
    M = int(rng.integers(1, 4))
    start, goal = np.zeros(3), np.array([1.0, 0, 0])
    p_WO = np.array([0.5, 0, 0]) + rng.uniform(-0.25, 0.25, size=(M, 3))
    parameters = np.exp(rng.uniform(np.log([5, 0.3, 2]), np.log([500, 1, 60]), size=(M, 3)))
    heading = rng.normal(size=(M, 3)) * rng.integers(0, 2, size=(M, 1))
    return start, goal, p_WO, parameters, heading, rng.normal(size=(M, 3)), rng


def run(start, goal, p_WO, parameters, heading, normal, steps=100):
    options = {"guidance_alpha": np.full(len(p_WO), 5.0)}
    return trajectory(
        DMP,
        start,
        goal,
        steps=steps,
        turn=terms(p_WO, parameters, heading, normal, **options).turn,
    ).p


@settings(max_examples=15, deadline=None)
@given(seed=seeds, scale=st.floats(0.01, 100.0))
def test_paths_scale_with_the_scene_when_kappa_scales_by_its_inverse_square(seed, scale):
    start, goal, p_WO, parameters, heading, normal, _ = scene(seed)
    path = run(start, goal, p_WO, parameters, heading, normal)
    scaled = parameters * [1.0, 1.0, scale**-2]
    again = run(scale * start, scale * goal, scale * p_WO, scaled, heading, normal)
    np.testing.assert_allclose(again, scale * path, atol=1e-7 * scale)


@settings(max_examples=15, deadline=None)
@given(seed=seeds)
def test_paths_move_with_the_scene(seed):
    start, goal, p_WO, parameters, heading, normal, rng = scene(seed)
    path = run(start, goal, p_WO, parameters, heading, normal)
    R, shift = np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.normal(size=3)
    R *= np.linalg.det(R)
    moved = [v @ R.T + shift for v in (start, goal, p_WO)]
    again = run(*moved, parameters, heading @ R.T, normal @ R.T)
    np.testing.assert_allclose(again, path @ R.T + shift, atol=1e-7)


@settings(max_examples=15, deadline=None)
@given(seed=seeds)
def test_the_order_of_the_obstacles_does_not_matter(seed):
    start, goal, *rows, rng = scene(seed)
    order = rng.permutation(len(rows[0]))
    path = run(start, goal, *rows)
    np.testing.assert_allclose(run(start, goal, *(r[order] for r in rows)), path, atol=1e-7)


@settings(max_examples=15, deadline=None)
@given(seed=seeds, tau=st.floats(0.2, 20.0), duration=st.floats(0.5, 20.0))
def test_the_path_does_not_depend_on_tau(seed, tau, duration):
    start, goal, p_WO, parameters, heading, normal, _ = scene(seed)
    path = run(start, goal, p_WO, parameters, heading, normal)
    turn = terms(p_WO, parameters, heading, normal, guidance_alpha=np.full(len(p_WO), 5.0)).turn
    dt = tau * duration / 100
    p, z, k = start, np.zeros(3), 1.0
    frame = local_frame(start, goal)
    for row in range(100):
        np.testing.assert_allclose(p, path[row], atol=1e-9)
        ds = dt / (tau * duration)
        p, z, k = step(DMP, p, z, k, ds, goal, frame=frame, baseline=1.0, turn=turn)


@pytest.mark.parametrize(("alpha", "kappa"), [(200.0, 10.0), (1e3, 30.0), (1e4, 60.0)])
def test_the_clearance_hardly_depends_on_the_step(alpha, kappa):
    some = terms([0.5, 0, 0], [alpha, 0.6, kappa], None, [0, 0, 1.0])
    nearest = [
        np.linalg.norm(
            trajectory(DMP, np.zeros(3), [1.0, 0, 0], steps=steps, turn=some.turn).p - [0.5, 0, 0],
            axis=1,
        ).min()
        for steps in (500, 2000)
    ]
    assert 0.97 < nearest[0] / nearest[1] < 1.03


def test_an_avoiding_motion_still_reaches_the_goal():
    some = terms([0.5, 0, 0], [1e3, 0.6, 30.0], None, [0, 0, 1.0])
    motion = trajectory(DMP, np.zeros(3), [1.0, 0, 0], turn=some.turn)
    assert np.linalg.norm(motion.p - [0.5, 0, 0], axis=1).min() > 0.07
    assert np.linalg.norm(motion.p[-1] - [1.0, 0, 0]) < 1e-3


# The released code's integrator


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


def test_unknown_released_terms_are_refused():
    with pytest.raises(ValueError, match="dead_zone_free"):
        euler_trajectory(np.ones(3), np.ones(3), np.zeros((1, 3)), (1.0, 2.0))
