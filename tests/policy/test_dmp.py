"""The movement primitive without coupling terms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_oa.policy.dmp import (
    Dmp,
    forcing,
    imitate,
    local_frame,
    minimum_jerk,
    spring_flow,
    trajectory,
)
from tests.reference import dmp as readable

seeds = st.integers(0, 2**32 - 1)


def default_dmp() -> Dmp:
    return imitate(*minimum_jerk(np.zeros(3), np.eye(3)[0]))


def smooth_path(rng: np.random.Generator, samples: int):
    """A curved path from rest to rest with uneven stamps, and the path at any s."""
    t = np.sort(rng.uniform(0.0, 1.0, samples))
    t = 0.5 * t + 0.5 * np.linspace(0.0, 1.0, samples)
    t = (t - t[0]) / (t[-1] - t[0])
    start = rng.normal(size=3)
    goal = start + rng.uniform(0.3, 2.0) * unit(rng)
    size = 0.2 * np.linalg.norm(goal - start)
    bends = size * rng.normal(size=(3, 3))

    def at(s):
        share = s**3 * (10.0 + s * (6.0 * s - 15.0))
        waves = np.stack([np.sin(np.pi * n * share) for n in (1, 2, 3)], axis=-1)
        return start + share[:, None] * (goal - start) + waves @ bends

    return t, at


def unit(rng: np.random.Generator):
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def nmse(path, reference):
    spread = ((reference - reference.mean(axis=0)) ** 2).sum()
    return ((path - reference) ** 2).sum() / spread


# Imitation


def test_motion_comes_to_rest_at_the_goal_after_its_end():
    motion = trajectory(default_dmp(), [0.0, 0, 0], [1.0, 0, 0], steps=1000, end=3.0)
    assert np.abs(motion.p[motion.s >= 1.0] - [1, 0, 0]).max() < 3e-4
    assert np.abs(motion.p[-1] - [1, 0, 0]).max() < 1e-7
    assert np.abs(motion.z[-1]).max() < 1e-6


@settings(max_examples=25)
@given(seed=seeds, samples=st.integers(60, 300))
def test_smooth_paths_are_imitated_at_uneven_stamps(seed, samples):
    t, at = smooth_path(np.random.default_rng(seed), samples)
    dmp = imitate(at(t), 7.0 + 2.5 * t)
    s = np.linspace(0.0, 1.0, 301)
    reference = at(s)
    motion = trajectory(dmp, reference[0], reference[-1], steps=300)
    assert np.isclose(dmp.duration, 2.5)
    assert nmse(motion.p, reference) < 1e-4
    baseline = np.linalg.norm(reference[-1] - reference[0])
    assert np.linalg.norm(motion.p[-1] - reference[-1]) < 1e-3 * baseline


@settings(max_examples=25)
@given(seed=seeds)
def test_new_start_and_goal_turn_and_scale_the_path(seed):
    rng = np.random.default_rng(seed)
    t, at = smooth_path(rng, 100)
    dmp = imitate(at(t), t)
    ends = rng.normal(size=(2, 2, 3))
    shapes = []
    for start, goal in ends:
        p = trajectory(dmp, start, goal, steps=60).p
        shapes.append((p - start) @ local_frame(start, goal) / np.linalg.norm(goal - start))
    np.testing.assert_allclose(shapes[0], shapes[1], atol=1e-9)


def test_the_compiled_motion_is_the_readable_one() -> None:
    rng = np.random.default_rng(3)
    t, at = smooth_path(rng, 40)
    dmp = imitate(at(t), t)
    start, goal = rng.normal(size=(2, 3))
    compiled = trajectory(dmp, start, goal, steps=80, end=1.5)
    for found, expected in zip(
        compiled, readable.trajectory(dmp, start, goal, steps=80, end=1.5), strict=True
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(
    ("path", "t", "message"),
    [
        ([[0.0, 0.0]], None, "at least 2 samples"),
        ([[0.0], [1.0], [2.0]], [0.0, 1.0, 1.0], "sample 2 at 1.0 s follows 1.0 s"),
        ([[0.0], [1.0]], [0.0, 1.0, 2.0], "one stamp a sample"),
        ([[0.0], [np.nan], [2.0]], None, "path must be finite: sample 1"),
        ([[0.0], [1.0], [2.0]], [0.0, 1.0, np.inf], "t must be finite: sample 2"),
        ([[0.0], [1.0], [0.0]], None, "end away from where it starts"),
    ],
)
def test_unusable_demonstrations_are_refused(path, t, message):
    with pytest.raises(ValueError, match=message):
        imitate(path, t)


# Forcing term and canonical system


def force(dmp: Dmp, k: float) -> np.ndarray:
    found = np.empty(1)
    forcing(dmp.kernel.basis, k, found)
    return found


def test_forcing_is_the_normalised_weighted_sum_times_the_phase():
    dmp = Dmp(80.0, 20.0, 4.6, np.array([1.0, 0.5]), np.array([4.0, 8.0]), np.array([[3.0, -2.0]]))
    k = 0.7
    basis = np.exp([-4.0 * 0.3**2, -8.0 * 0.2**2])
    expected = (3.0 * basis[0] - 2.0 * basis[1]) / basis.sum() * k
    np.testing.assert_allclose(force(dmp, k), [expected], rtol=1e-14)


def test_forcing_far_from_every_centre_is_that_of_the_nearest():
    narrow = np.full(2, 1e9)
    dmp = Dmp(80.0, 20.0, 4.6, np.array([1.0, 0.5]), narrow, np.array([[3.0, -2.0]]))
    np.testing.assert_allclose(force(dmp, 0.1), [-0.2], rtol=1e-14)
    np.testing.assert_allclose(force(dmp, 0.0), [0.0])


# Spring


@settings(max_examples=50)
@given(
    alpha=st.floats(0.1, 200.0),
    ratio=st.sampled_from([0.01, 0.1, 0.25, 0.25000001, 0.5, 4.0]),
    h=st.floats(0.0, 2.0),
)
def test_spring_flow_is_the_matrix_exponential(alpha, ratio, h):
    from scipy.linalg import expm

    beta = ratio * alpha
    exact = expm(np.array([[0.0, 1.0], [-alpha * beta, -alpha]]) * h)
    flow = np.array(spring_flow(alpha, beta, h)).reshape(2, 2)
    np.testing.assert_allclose(flow, exact, atol=1e-9 * max(1.0, alpha * beta))


# Local frame


@settings(max_examples=100)
@given(
    start=st.lists(st.floats(-10, 10), min_size=3, max_size=3),
    way=st.lists(st.floats(-1, 1), min_size=3, max_size=3),
)
def test_local_frame_is_right_handed_with_x_to_the_goal_and_z_up(start, way):
    start, way = np.array(start), np.array(way)
    if np.linalg.norm(way) < 1e-6:
        way = np.array([0.0, 0.0, -0.5])
    goal = start + way
    R = local_frame(start, goal)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    assert np.isclose(np.linalg.det(R), 1.0)
    np.testing.assert_allclose(R[:, 0] * np.linalg.norm(goal - start), goal - start, atol=1e-12)
    assert R[2, 2] >= -1e-12
    assert R[2, 1] == 0.0


@pytest.mark.parametrize("up", [1.0, -1.0])
def test_local_frame_of_a_vertical_baseline_keeps_the_worlds_y(up):
    R = local_frame([1.0, 2.0, 3.0], [1.0, 2.0, 3.0 + up])
    np.testing.assert_allclose(R, [[0, 0, -up], [0, 1, 0], [up, 0, 0]], atol=1e-15)
    leaning = local_frame([0.0, 0, 0], [1e-6, 0, up])
    np.testing.assert_allclose(R, leaning, atol=1e-5)
