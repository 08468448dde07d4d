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
    ARRIVED,
    SHIPPED,
    paper_chain,
    released_motions,
    run,
    run_original,
    section_axes,
    sections,
    time_scale,
)
from drake_oa.studies.scenes.scenes import Scenes, single_obstacle
from drake_oa.studies.scenes.suites import draw_scenes, random_rotations
from drake_oa.training import released_law
from drake_oa.training.released_law import ALPHA_X, BETA_X, STEPS, Steps, released_forcing

DEMO = Steps(500, 0.005)
"""Time steps of the released demonstration program."""


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


def test_the_forcing_term_is_the_released_one(reference):
    data = np.load(reference("authors_action_level.npz"))
    expected = data["forcing"][:, :, 0] / data["baseline"][:, None]
    fitted = np.broadcast_to(released_forcing(DEMO), expected.shape)
    np.testing.assert_allclose(fitted, expected, atol=5e-9)


@pytest.mark.parametrize("name", ["trajectory", "trajectory_original_term"])
def test_released_trajectories_are_reproduced(reference, name, monkeypatch):
    data = np.load(reference("authors_action_level.npz"))
    monkeypatch.setattr(paper_method, "time_scale", lambda scenes: tau)
    for row in range(len(data["tau"])):
        # Each has its forcing term and tau as the authors' code computed them.
        i, tau = slice(row, row + 1), data["tau"][row : row + 1]
        forcing = data["forcing"][row, :, 0] / data["baseline"][row]
        monkeypatch.setattr(released_law, "released_forcing", lambda steps, f=forcing: f)
        scenes = single_obstacle(data["baseline"][i], data["center"][i], data["semi_axes"][i])
        original = name != "trajectory"
        parameters = np.array([data[key][row] for key in ("alpha", "psi", "kappa")])
        if original:
            parameters = np.array((1000.0, 20.0 / math.pi, 0.0))
        motions = released_motions(scenes, Setting(), parameters, original=original, steps=DEMO)
        np.testing.assert_allclose(motions.path[0, 1:501], data[name][row], atol=1e-9)


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
    motions = released_motions(scenes, Setting(), parameters, original=original)
    tau, h = time_scale(scenes)[0], STEPS.length
    x, v = np.zeros(3), np.zeros(3)
    for step, f in enumerate(released_forcing(STEPS)):
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


@pytest.mark.parametrize(
    "parameters",
    [(1e9, 0.8, 0.0), (1e4, 0.0, 0.0), (1e4, 1.0, -50.0)],
)
@pytest.mark.filterwarnings("error")
def test_motions_stay_finite(parameters):
    scenes = draw_scenes("clutter", 5, seed=2)
    motions = released_motions(scenes, Setting(), np.array(parameters))
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


def test_tau_of_one_obstacle():
    scenes = single_obstacle(1.0, [[0.5, 0.12, 0.0]], [[0.1, 0.2, 0.05]], clearance=0.15)
    way = 2.0 * math.hypot(0.5, 0.12) + 2.0 * (0.2 + 0.15)
    assert time_scale(scenes)[0] == pytest.approx(way)


@pytest.mark.parametrize("constrained", [True, False])
def test_the_shipped_chains_are_used_until_arrival(constrained):
    assert len(paper_chain(SHIPPED[0] if constrained else SHIPPED[1]).lower) == 2 + constrained
    scenes, number = draw_scenes("novel", 40, seed=0), STEPS.number
    motions = run(scenes, Setting(constrained=constrained))
    assert number <= motions.steps <= 2 * number
    np.testing.assert_allclose(motions.duration, STEPS.length * motions.steps)
    assert judge(scenes, motions).collided.mean() < 0.1
    error = np.linalg.norm(motions.path - scenes.goal[:, None], axis=2)
    has_arrived = error[:, -1] <= ARRIVED
    assert has_arrived.mean() > 0.4
    assert (error[~has_arrived, number:] > ARRIVED).all()


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
    assert np.abs(motions.path[0, : STEPS.number, 1:]).max() < 1e-9
    assert judge(scenes, motions).collided[0]


def test_distances_in_the_p_plane_are_those_to_the_section():
    rng = np.random.default_rng(4)
    center = np.column_stack([np.full(20, 0.5), rng.uniform(-0.2, 0.2, (20, 2))])
    center[0, 1:] = 0.0
    a = rng.uniform(0.05, 0.2, (20, 3))
    scenes = single_obstacle(1.0, center, a, R=random_rotations(rng, 20))
    cut = sections(scenes)
    R = cut.R[:, 0]
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
    np.testing.assert_allclose(np.einsum("ni,ni->n", R[:, :, 2], center), 0.0, atol=1e-9)
    # Points of the section's outline are on the ellipsoid.
    for k in range(2):
        point = np.einsum("nij,ni->nj", scenes.R[:, 0], cut.semi_axes[:, 0, k, None] * R[:, :, k])
        np.testing.assert_allclose(((point / a) ** 2).sum(axis=1), 1.0)
