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
from drake_oa.studies.scenes.scenes import make_scenes
from drake_oa.studies.scenes.suites import draw_scenes, random_rotations
from drake_oa.training import released_law
from drake_oa.training.released_law import STEPS, Steps, released_forcing

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
        scenes = make_scenes(data["baseline"][row], data["center"][i], data["semi_axes"][i])
        original = name != "trajectory"
        parameters = np.array([data[key][row] for key in ("alpha", "psi", "kappa")])
        if original:
            parameters = np.array((1000.0, 20.0 / math.pi, 0.0))
        motions = released_motions(scenes, Setting(), parameters, original=original, steps=DEMO)
        np.testing.assert_allclose(motions.path[0, 1:501], data[name][row], atol=1e-9)


def test_tau_of_one_obstacle():
    scenes = make_scenes(1.0, [[0.5, 0.12, 0.0]], [[0.1, 0.2, 0.05]], clearance=0.15)
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


def test_hoffmanns_term_does_not_turn_head_on():
    scenes = make_scenes(1.0, [[0.5, 0.0, 0.0]], [[0.05, 0.05, 0.05]])
    motions = run_original(scenes, Setting())
    # Beyond the goal it turns round, and sees the obstacle ahead again.
    assert np.abs(motions.path[0, : STEPS.number, 1:]).max() < 1e-9
    assert judge(scenes, motions).collided[0]


def test_distances_in_the_p_plane_are_those_to_the_section():
    rng = np.random.default_rng(4)
    center = np.column_stack([np.full(20, 0.5), rng.uniform(-0.2, 0.2, (20, 2))])
    center[0, 1:] = 0.0
    a = rng.uniform(0.05, 0.2, (20, 3))
    scenes = make_scenes(1.0, center, a, R=random_rotations(rng, 20))
    cut = sections(scenes)
    R = cut.R
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
    np.testing.assert_allclose(np.einsum("ni,ni->n", R[:, :, 2], center), 0.0, atol=1e-9)
    # Points of the section's outline are on the ellipsoid.
    for k in range(2):
        point = np.einsum("nij,ni->nj", scenes.R, cut.semi_axes[:, k, None] * R[:, :, k])
        np.testing.assert_allclose(((point / a) ** 2).sum(axis=1), 1.0)
