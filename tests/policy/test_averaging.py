"""Tests of the mean of several recorded demonstrations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import FloatArray
from drake_oa.policy.averaging import POINTS, SPARSE, average_orientations, average_paths
from drake_oa.policy.dmp import imitate, minimum_jerk_profile, trajectory

START, GOAL = np.array([0.4, -0.4, 0.2]), np.array([0.4, 0.4, 0.2])


def arc(s: FloatArray, bulge: float = 0.2) -> FloatArray:
    """Computes positions (T, 3) at times s (T,) of a motion from rest to rest, bulging to +x."""
    share = minimum_jerk_profile(s)
    return (
        START + share[:, None] * (GOAL - START) + bulge * np.outer(np.sin(np.pi * share), [1, 0, 0])
    )


def recording(
    seed: int, *, count: int = 500, duration: float = 5.0, noise: float = 1e-3, bulge: float = 0.2
) -> tuple[FloatArray, FloatArray]:
    """Returns a path (T, 3) along `arc` with a tremor of 10 Hz, and its uneven times (T,)."""
    random = np.random.default_rng(seed)
    t = np.sort(random.uniform(0.0, duration, count))
    t[0], t[-1] = 0.0, duration
    phase = random.uniform(0.0, 2.0 * np.pi, 3)
    tremor = noise * np.sin(2.0 * np.pi * 10.0 * t[:, None] + phase)
    return arc(t / duration, bulge) + tremor, t


def test_the_mean_of_one_recording_has_its_path_without_tremor_and_ends_at_rest() -> None:
    path, t = recording(1)
    mean, stamps = average_paths([path], [t])
    assert mean.shape == (POINTS, 3)
    assert stamps[-1] == pytest.approx(5.0)
    motion = trajectory(imitate(mean, stamps), START, GOAL, steps=1000, end=2.0)
    assert np.linalg.norm(motion.p - arc(np.minimum(motion.s, 1.0)), axis=1).max() < 2e-3
    assert np.linalg.norm(motion.p[500:] - GOAL, axis=1).max() < 4e-4
    # Imitating the recording without averaging also imitates the acceleration of the tremor.
    raw = trajectory(imitate(path, t), START, GOAL, steps=1000, end=2.0)
    jerk, raw_jerk = (np.abs(np.diff(one.z, n=2, axis=0)).max() for one in (motion, raw))
    assert raw_jerk > 10.0 * jerk


def test_recordings_have_equal_weight_whatever_their_pose_size_and_sampling() -> None:
    # The second recording has four times as many samples.
    recordings = [
        recording(1, bulge=0.1, count=300, duration=4.0, noise=0.0),
        recording(2, bulge=0.3, count=1200, duration=6.0, noise=0.0),
    ]
    mean, t = average_paths(*zip(*recordings, strict=True))
    assert t[-1] == pytest.approx(5.0)
    np.testing.assert_allclose(mean, arc(t / 5.0, 0.2), atol=1e-3)
    path, t = recording(1, noise=0.0)
    turn = Rotation.from_rotvec([0.0, 0.0, 1.2])
    other = 1.5 * turn.apply(path) + [0.1, 0.2, 0.05]
    means = average_paths([path, other], [t, 2.0 * t + 100.0])[0], average_paths([path], [t])[0]
    a, b = (trajectory(imitate(one), START, GOAL).p for one in means)
    np.testing.assert_allclose(a, b, atol=1e-9)


def test_waypoints_are_interpolated_and_a_gap_of_a_recording_is_bridged() -> None:
    s = np.linspace(0.0, 1.0, SPARSE // 5)
    mean, t = average_paths([arc(s)], [s])
    np.testing.assert_allclose(mean, arc(t), atol=1e-4)
    path, t = recording(1)
    is_recorded = (t < 2.0) | (t > 2.8)
    mean, stamps = average_paths([arc(s), path[is_recorded]], [s, t[is_recorded]])
    assert np.linalg.norm(mean - arc(stamps / stamps[-1]), axis=1).max() < 5e-3


def test_waypoints_at_uneven_times_are_not_overshot() -> None:
    path = np.array([[0.45, y, z] for y, z in ((-0.45, 0.3), (-0.2, 0.5), (0.2, 0.5), (0.45, 0.3))])
    mean, _ = average_paths([path], [np.array([0.0, 0.5, 1.0, 6.0])])
    assert (mean >= path.min(axis=0) - 0.05).all()
    assert (mean <= path.max(axis=0) + 0.05).all()


def test_a_recording_that_returns_to_its_start_is_refused() -> None:
    path, t = recording(1)
    with pytest.raises(ValueError, match="demonstrate it in two parts"):
        average_paths([path, np.vstack([path, path[::-1]])], [t, np.arange(1000.0)])


# Orientations


def turning(s: FloatArray, angle: float, wiggle: float = 0.0) -> Rotation:
    """Returns T rotations by up to `angle` about one axis, with a tremor about another axis."""
    r = np.outer(angle * minimum_jerk_profile(s), [0.6, 0.0, 0.8])
    r[:, 1] += wiggle * np.sin(2.0 * np.pi * 50.0 * s)
    return Rotation.from_rotvec([np.pi, 0.0, 0.0]) * Rotation.from_rotvec(r)


@pytest.mark.parametrize("angle", [0.8, 4.0, 7.0])
def test_orientations_are_averaged(angle: float) -> None:
    s = np.linspace(0.0, 1.0, 400)
    recordings = [
        turning(s, angle * k, wiggle=0.01).as_quat(scalar_first=True) for k in (0.95, 1.05)
    ]
    mean, t = average_orientations(recordings, [3.0 * s, 5.0 * s])
    assert t[-1] == pytest.approx(4.0)
    between = Rotation.from_matrix(mean).inv() * turning(t / 4.0, angle)
    assert between.magnitude().max() < 0.01


def test_opposite_rotations_are_refused() -> None:
    s = np.linspace(0.0, 1.0, 400)
    there, back = (turning(s, angle).as_matrix() for angle in (3.3, -3.3))
    with pytest.raises(ValueError, match="demonstration 1 of 2 differs from the mean by 95 deg"):
        average_orientations([there, back], [s, s])
    with pytest.raises(ValueError, match="no rotation matrix"):
        average_orientations([there, 2.0 * there], [s, s])
