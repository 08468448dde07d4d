"""Tests of the movement primitive without coupling terms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from drake_oa.policy.action_kernels import spring_flow
from drake_oa.policy.dmp import imitate, local_frame, minimum_jerk, trajectory

seeds = st.integers(0, 2**32 - 1)


def smooth_path(rng: np.random.Generator, samples: int):
    """Draws a curved path: uneven times (T,), and a function of its positions at times s."""
    t = np.sort(rng.uniform(0.0, 1.0, samples)) + np.linspace(0.0, 1.0, samples)
    t = (t - t[0]) / (t[-1] - t[0])
    start, way = rng.normal(size=(2, 3))
    way *= rng.uniform(0.3, 2.0) / np.linalg.norm(way)
    bends = 0.2 * np.linalg.norm(way) * rng.normal(size=(3, 3))

    def at(s):
        share = s**3 * (10.0 + s * (6.0 * s - 15.0))
        waves = np.stack([np.sin(np.pi * n * share) for n in (1, 2, 3)], axis=-1)
        return start + share[:, None] * way + waves @ bends

    return t, at


def test_motion_comes_to_rest_at_the_goal_after_its_end():
    dmp = imitate(*minimum_jerk(np.zeros(3), np.eye(3)[0]))
    motion = trajectory(dmp, [0.0, 0, 0], [1.0, 0, 0], steps=1000, end=3.0)
    assert np.abs(motion.p[motion.s >= 1.0] - [1, 0, 0]).max() < 3e-4
    assert np.abs(motion.p[-1] - [1, 0, 0]).max() < 1e-7
    assert np.abs(motion.z[-1]).max() < 1e-6


@settings(max_examples=25)
@given(seed=seeds, samples=st.integers(60, 300))
def test_smooth_paths_are_imitated_and_turned_and_scaled_to_other_ends(seed, samples):
    rng = np.random.default_rng(seed)
    t, at = smooth_path(rng, samples)
    dmp = imitate(at(t), 7.0 + 2.5 * t)
    assert np.isclose(dmp.duration, 2.5)
    s = np.linspace(0.0, 1.0, 301)
    reference = at(s)
    motion = trajectory(dmp, reference[0], reference[-1], steps=300)
    baseline = np.linalg.norm(reference[-1] - reference[0])
    assert np.sqrt(((motion.p - reference) ** 2).sum(axis=1).mean()) < 0.01 * baseline
    assert np.linalg.norm(motion.p[-1] - reference[-1]) < 1e-3 * baseline
    shapes = []
    for start, goal in ((reference[0], reference[-1]), rng.normal(size=(2, 3))):
        p = trajectory(dmp, start, goal, steps=60).p
        shapes.append((p - start) @ local_frame(start, goal) / np.linalg.norm(goal - start))
    np.testing.assert_allclose(shapes[0], shapes[1], atol=1e-9)


@pytest.mark.parametrize(
    ("path", "t", "message"),
    [
        ([[0.0, 0.0]], None, "at least 2 samples"),
        ([[0.0], [1.0], [2.0]], [0.0, 1.0, 1.0], "that of sample 2 does not"),
        ([[0.0], [1.0]], [0.0, 1.0, 2.0], "one time per sample"),
        ([[0.0], [np.nan], [2.0]], None, "path and t must be finite: sample 1"),
        ([[0.0], [1.0], [2.0]], [0.0, 1.0, np.inf], "path and t must be finite: sample 2"),
        ([[0.0], [1.0], [0.0]], None, "end away from its start"),
    ],
)
def test_unusable_demonstrations_are_refused(path, t, message):
    with pytest.raises(ValueError, match=message):
        imitate(path, t)


@settings(max_examples=50)
@given(
    alpha=st.floats(0.1, 200.0),
    ratio=st.sampled_from([0.01, 0.1, 0.25, 0.25000001, 0.5, 4.0]),
    h=st.floats(0.0, 2.0),
)
def test_spring_flow_is_the_matrix_exponential(alpha, ratio, h):
    beta = ratio * alpha
    exact = expm(np.array([[0.0, 1.0], [-alpha * beta, -alpha]]) * h)
    flow = np.array(spring_flow(alpha, beta, h)).reshape(2, 2)
    np.testing.assert_allclose(flow, exact, atol=1e-9 * max(1.0, alpha * beta))


@given(seed=seeds, up=st.sampled_from([0.0, 1.0, -1.0]))
def test_local_frame_is_right_handed_with_x_to_the_goal_and_z_up(seed, up):
    start, way = np.random.default_rng(seed).normal(size=(2, 3))
    way = np.array([0.0, 0.0, up]) if up else way
    R = local_frame(start, start + way)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    assert np.isclose(np.linalg.det(R), 1.0)
    np.testing.assert_allclose(R[:, 0] * np.linalg.norm(way), way, atol=1e-12)
    assert R[2, 2] >= -1e-12
    assert R[2, 1] == 0.0
    # A vertical baseline keeps the world's y.
    assert R[1, 1] == 1.0 or not up
