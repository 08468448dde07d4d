"""The paper's method and Hoffmann's term: action level, chain at the section, temporal scaling."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drake_oa.geometry.ellipsoid import plane_section
from drake_oa.studies.scenes import paper_method
from drake_oa.studies.scenes.judge import judge
from drake_oa.studies.scenes.methods import Setting
from drake_oa.studies.scenes.paper_method import (
    ALPHA_X,
    ARRIVED,
    BETA_X,
    STEPS,
    Reading,
    constant_motions,
    paper_chain,
    regulated_motions,
    released_forcing,
    run,
    run_original,
    section_axes,
    time_scale,
)
from drake_oa.studies.scenes.scenes import Scenes, single_obstacle
from drake_oa.studies.scenes.suites import draw_scenes, random_rotations
from tests.reference.width_chain import load_width_chain

PARAMETERS = (9000.0, 0.77, 25.0)
UNSCALED = Setting(scale_time=False)
DEMO = Reading(tau="widths", time="fixed", steps="demo")
"""The released demonstration program."""


@pytest.fixture(scope="module")
def authors_chain(reference):
    return load_width_chain(reference("authors_rc.npz"))


@given(st.integers(0, 2**32 - 1))
def test_the_first_axis_of_the_section_is_within_45_degrees_of_the_baseline(seed):
    rng = np.random.default_rng(seed)
    R, frame = random_rotations(rng, 2)
    a, normal = rng.uniform(0.02, 0.3, 3), frame[:, 2]
    (found,) = section_axes(frame[None, :, 0], normal[None], R[None], a[None])
    e1 = frame[:, 0]
    section = plane_section(R, a, e1, np.cross(normal, e1))
    across = [abs(axis[0]) for axis in section.axes]
    expected = section.semi_axes if across[0] >= across[1] else section.semi_axes[::-1]
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_a_plane_square_to_the_baseline_is_measured_along_the_way():
    way, normal, a = np.array([[0, 0, 1.0]]), np.array([[1.0, 0, 0]]), np.array([[0.1, 0.2, 0.3]])
    np.testing.assert_allclose(section_axes(way, normal, np.eye(3)[None], a), [[0.3, 0.2]])


def test_the_forcing_term_is_the_released_one(reference):
    data = np.load(reference("authors_action_level.npz"))
    expected = data["forcing"][:, :, 0] / data["baseline"][:, None]
    fitted = np.broadcast_to(released_forcing(STEPS["demo"]), expected.shape)
    np.testing.assert_allclose(fitted, expected, atol=5e-9)


@pytest.mark.parametrize("name", ["trajectory", "trajectory_original_term"])
def test_released_trajectories_are_reproduced(reference, name, monkeypatch):
    data = np.load(reference("authors_action_level.npz"))
    monkeypatch.setattr(paper_method, "time_scale", lambda scenes, reading: tau)
    for row in range(len(data["tau"])):
        # Each has its forcing term and tau as the authors' code computed them.
        i, tau = slice(row, row + 1), data["tau"][row : row + 1]
        forcing = data["forcing"][row, :, 0] / data["baseline"][row]
        monkeypatch.setattr(paper_method, "released_forcing", lambda steps, f=forcing: f)
        scenes = single_obstacle(data["baseline"][i], data["center"][i], data["semi_axes"][i])
        if name == "trajectory":
            parameters = np.array([data[key][row] for key in ("alpha", "psi", "kappa")])
            motions = constant_motions(scenes, Setting(), parameters, reading=DEMO)
        else:
            parameters = np.array((1000.0, 20.0 / math.pi, 0.0))
            motions = constant_motions(scenes, Setting(), parameters, original=True, reading=DEMO)
        np.testing.assert_allclose(motions.path[0, 1:], data[name][row], atol=1e-9)


@pytest.mark.parametrize("original", [False, True])
def test_several_moving_obstacles_add_up(original):
    rng = np.random.default_rng(5)
    center = np.array([[[0.4, 0.1, 0.05], [0.7, -0.1, 0.1], [np.nan] * 3]])
    drift = np.array([[[0.0, -0.02, 0.0], [-0.05, 0.03, 0.01], [np.nan] * 3]])
    a = np.where(np.isnan(center), np.nan, 0.05)
    R = np.broadcast_to(np.eye(3), (1, 3, 3, 3)).copy()
    scenes = Scenes(np.ones(1), center, a, R, drift, np.full(1, 0.1))
    between = ((10, 4, 0), (90, 7, 1)) if original else ((100, 0.4, 5), (900, 0.9, 30))
    parameters = rng.uniform(*between, (1, 3, 3))
    motions = constant_motions(scenes, Setting(), parameters, original=original, reading=DEMO)
    tau, h = time_scale(scenes, DEMO)[0], STEPS["demo"].length
    x, v = np.zeros(3), np.zeros(3)
    for step, f in enumerate(released_forcing(STEPS["demo"])):
        push = np.array((f, 0.0, 0.0))
        if np.linalg.norm(v) > 1e-5:
            for m in range(2):
                alpha, psi, kappa = parameters[0, m]
                o = center[0, m] + step * h * drift[0, m] - x
                r = np.cross(o, v)
                theta = math.atan2(np.linalg.norm(r), o @ v)
                rate = alpha * math.exp(-((theta / psi) ** 2) - kappa * (o @ o))
                if original:
                    rate = alpha * theta * math.exp(-psi * theta)
                push += rate * np.cross(r / np.linalg.norm(r), v)
        v = v + h * (tau**2 * ALPHA_X * (BETA_X * (scenes.goal[0] - x) - v) + push)
        x = x + h * v
        np.testing.assert_allclose(motions.path[0, step + 1], x, atol=1e-9)
        np.testing.assert_allclose(motions.velocity[0, step + 1], v, atol=1e-7)
    assert motions.duration == pytest.approx(2.5)


def test_the_chain_is_asked_at_the_section_of_the_p_plane():
    chain = paper_chain(True)
    scenes = draw_scenes("novel", 40, seed=1)
    center, a = scenes.center[:, 0], scenes.semi_axes[:, 0]
    side = center[:, 1:] / np.linalg.norm(center[:, 1:], axis=1, keepdims=True)
    across = 1.0 / np.linalg.norm(side / a[:, 1:], axis=1)
    inputs = np.column_stack((a[:, 0], across, scenes.clearance))
    regulated = regulated_motions(scenes, Setting(), chain, DEMO)
    constant = constant_motions(scenes, Setting(), chain.evaluate(inputs)[:, None], reading=DEMO)
    # A motion that heads for the centre leaves the plane by rounding: compare the rest.
    apart = np.abs(regulated.path - constant.path).max(axis=(1, 2))
    assert np.median(apart) < 1e-7
    assert (apart < 1e-4).mean() > 0.9


def test_figures_of_the_released_network_on_novel_scenes(authors_chain):
    """The reference's table: mean clearance by baseline, of 1,000 scenes each."""
    scenes = draw_scenes("novel", 1600, seed=0)
    judged = judge(scenes, regulated_motions(scenes, Setting(), authors_chain, DEMO))
    for baseline, mean in ((0.5, 0.120), (1.0, 0.163), (1.5, 0.183), (2.0, 0.199)):
        some = judged.rows(scenes.baseline == baseline)
        assert some.kept_clearance.mean() == pytest.approx(mean, abs=0.005)
        assert some.collided.sum() <= 3
        assert some.goal_error.max() < 0.3


def test_a_heading_straight_at_the_centre_turns_to_one_side(authors_chain):
    scenes = single_obstacle(1.0, [[0.5, 0.0, 0.0]], [[0.1, 0.1, 0.1]])
    motions = regulated_motions(scenes, Setting(), authors_chain)
    assert judge(scenes, motions).kept_clearance[0] > 0.08
    assert motions.path[0, :, 1].min() > -1e-3
    assert (motions.path[0, :, 2] == 0.0).all()


def test_turning_the_scene_about_the_baseline_turns_the_motion():
    cos, sin = math.cos(0.7), math.sin(0.7)
    Q = np.array(((1, 0, 0), (0, cos, -sin), (0, sin, cos)))
    center, a = np.array([[0.5, 0.12, 0.02]]), np.array([[0.1, 0.15, 0.06]])
    R = random_rotations(np.random.default_rng(3), 1)[0]
    paths = [
        run(single_obstacle(1.0, center @ turn.T, a, R=turn @ R), Setting()).path[0]
        for turn in (np.eye(3), Q)
    ]
    np.testing.assert_allclose(paths[1], paths[0] @ Q.T, atol=1e-6)


@pytest.mark.parametrize(
    "parameters",
    [(1e9, 0.8, 0.0), (5e4, 3.0, 0.0), (1e4, 0.0, 0.0), (1e4, 1.0, -50.0), (-1e4, 1.0, 5.0)],
)
@pytest.mark.filterwarnings("error")
def test_motions_stay_finite(parameters):
    scenes = draw_scenes("clutter", 5, seed=2)
    motions = constant_motions(scenes, Setting(), np.array(parameters))
    assert np.isfinite(motions.path).all()
    assert np.isfinite(motions.velocity).all()


def test_obstacles_at_the_start_and_absent_ones_are_no_trouble():
    center = np.array([[[0.0, 0.0, 0.0]], [[np.nan] * 3]])
    a = np.array([[[0.05, 0.05, 0.05]], [[np.nan] * 3]])
    R, still = np.broadcast_to(np.eye(3), (2, 1, 3, 3)).copy(), np.zeros((2, 1, 3))
    scenes = Scenes(np.ones(2), center, a, R, still, np.full(2, 0.15))
    motions = run(scenes, Setting())
    assert np.isfinite(motions.path).all()
    assert time_scale(scenes)[1] == 1.0
    assert (motions.path[1, :, 1:] == 0.0).all()
    assert np.linalg.norm(motions.path[1, -1] - scenes.goal[1]) < 0.01
    none = np.zeros((2, 0, 3))
    scenes = Scenes(np.ones(2), none, none, np.zeros((2, 0, 3, 3)), none, np.full(2, 0.15))
    np.testing.assert_array_equal(run(scenes, Setting()).path[1], motions.path[1])


def test_tau_of_one_obstacle():
    scenes = single_obstacle(1.0, [[0.5, 0.12, 0.0]], [[0.1, 0.2, 0.05]], clearance=0.15)
    centre, extreme = 2.0 * math.hypot(0.5, 0.12), 2.0 * math.hypot(0.5, 0.12 - 0.2)
    for tau, way in (
        ("widths", centre + 2.0 * (0.4 + 0.15)),
        ("semi-axes", centre + 2.0 * (0.2 + 0.15)),
        ("extreme", extreme),
    ):
        assert time_scale(scenes, Reading(tau=tau))[0] == pytest.approx(way)


def test_the_way_past_several_goes_through_their_extreme_points_in_order():
    center = np.array([[[0.7, 0.0, 0.2], [0.3, -0.1, 0.0], [np.nan] * 3]])
    a = np.where(np.isnan(center), np.nan, 0.05)
    R = np.broadcast_to(np.eye(3), (1, 3, 3, 3)).copy()
    scenes = Scenes(np.ones(1), center, a, R, np.zeros_like(center), np.full(1, 0.1))
    points = np.array([[0, 0, 0], [0.3, -0.05, 0], [0.7, 0, 0.15], [1, 0, 0]])
    way = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    assert time_scale(scenes, Reading(tau="extreme"))[0] == pytest.approx(way)


@pytest.fixture(scope="module")
def few():
    return draw_scenes("novel", 40, seed=3)


@pytest.mark.parametrize("law", ["released", "printed"])
def test_a_motion_ends_when_its_reading_says(few, law):
    tau = time_scale(few)
    last = {
        time: run(few, Setting(), Reading(law=law, time=time))
        for time in ("fixed", "tau", "until-arrived")
    }
    # Paths are the same as far as each goes; what has ended stays.
    n = last["fixed"].steps if law == "released" else last["tau"].steps
    assert n == STEPS["training"].number
    for motions in last.values():
        k = min(n, motions.steps) // 4
        np.testing.assert_array_equal(motions.path[:, :k], last["tau"].path[:, :k])
        assert motions.duration / motions.steps == pytest.approx(
            0.003 * (tau if law == "printed" else 1.0)
        )
    assert last["tau"].steps == (math.ceil(1000 * tau.max()) if law == "released" else 1000)
    error = np.linalg.norm(last["until-arrived"].path - few.goal[:, None], axis=2)
    arrived = error[:, -1] <= ARRIVED
    assert arrived.mean() > 0.4
    still = (np.diff(last["until-arrived"].path[arrived, -3:], axis=1) == 0.0).all()
    assert still or last["until-arrived"].steps <= 2 * n
    assert (error[~arrived, n:] > ARRIVED).all()


def test_the_running_law_turns_exactly_and_is_for_one_obstacle(few):
    reading = Reading(law="running", chain="running", scale="baselines")
    some = few.rows(few.baseline >= 1.0)
    motions = run(some, Setting(), reading)
    judged = judge(some, motions)
    assert judged.collided.sum() <= 1
    assert np.isfinite(motions.path).all()
    # The path does not depend on tau.
    unscaled = run(some, UNSCALED, reading)
    np.testing.assert_allclose(unscaled.path, motions.path, atol=1e-9)
    assert (unscaled.duration <= motions.duration).all()
    with pytest.raises(ValueError, match="one obstacle"):
        run(draw_scenes("clutter", 2), Setting(), reading)


def test_in_baselines_a_scene_and_the_same_one_magnified_go_alike():
    small = single_obstacle(1.0, [[0.5, 0.05, 0.02]], [[0.1, 0.12, 0.08]], clearance=0.1)
    large = single_obstacle(2.0, [[1.0, 0.1, 0.04]], [[0.2, 0.24, 0.16]], clearance=0.2)
    reading = Reading(scale="baselines", time="fixed")
    paths = [run(scenes, Setting(), reading).path for scenes in (small, large)]
    np.testing.assert_allclose(paths[1], 2.0 * paths[0], atol=1e-9)


def test_no_unconstrained_chain_went_where_the_running_system_goes(few):
    with pytest.raises(ValueError, match="without Delta"):
        run(few, Setting(constrained=False), Reading(chain="running"))


@pytest.mark.parametrize("constrained", [True, False])
def test_the_shipped_chains_are_used(constrained):
    assert len(paper_chain(constrained).lower) == (3 if constrained else 2)
    scenes = draw_scenes("novel", 40, seed=0)
    motions = run(scenes, Setting(constrained=constrained))
    assert STEPS["training"].number <= motions.steps <= 2 * STEPS["training"].number
    np.testing.assert_allclose(motions.duration, 0.003 * motions.steps)
    assert judge(scenes, motions).collided.mean() < 0.1


def test_hoffmanns_term_knows_no_clearance_and_does_not_turn_head_on():
    scenes = draw_scenes("novel", 8, seed=0)
    first, second = (
        run_original(scenes, Setting(constrained=constrained, scale_time=False))
        for constrained in (True, False)
    )
    np.testing.assert_array_equal(first.path, second.path)
    scenes = single_obstacle(1.0, [[0.5, 0.0, 0.0]], [[0.05, 0.05, 0.05]])
    motions = run_original(scenes, Setting())
    # Beyond the goal it turns round, and sees the obstacle ahead again.
    assert np.abs(motions.path[0, : STEPS["training"].number, 1:]).max() < 1e-9
    assert judge(scenes, motions).collided[0]
