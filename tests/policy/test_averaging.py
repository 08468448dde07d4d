"""Several recordings as one motion."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import FloatArray
from drake_oa.policy.averaging import (
    POINTS,
    SPARSE,
    average_orientations,
    average_paths,
)
from drake_oa.policy.dmp import imitate, minimum_jerk_share, trajectory

START, GOAL = np.array([0.4, -0.4, 0.2]), np.array([0.4, 0.4, 0.2])


def arc(s: FloatArray, bulge: float = 0.2) -> FloatArray:
    """A motion from rest to rest round to +x, at s of its time."""
    share = minimum_jerk_share(s)
    return (
        START + share[:, None] * (GOAL - START) + bulge * np.outer(np.sin(np.pi * share), [1, 0, 0])
    )


def recording(
    seed: int, *, count: int = 500, duration: float = 5.0, noise: float = 1e-3, bulge: float = 0.2
) -> tuple[FloatArray, FloatArray]:
    """Path (T, 3) and stamps (T,) of `arc` at uneven times, with a tremor at 10 Hz."""
    random = np.random.default_rng(seed)
    t = np.sort(random.uniform(0.0, duration, count))
    t[0], t[-1] = 0.0, duration
    phase = random.uniform(0.0, 2.0 * np.pi, 3)
    tremor = noise * np.sin(2.0 * np.pi * 10.0 * t[:, None] + phase)
    return arc(t / duration, bulge) + tremor, t


def test_one_recording_loses_its_tremor_keeps_its_way_and_ends_at_rest() -> None:
    path, t = recording(1)
    mean, stamps = average_paths([path], [t])
    assert mean.shape == (POINTS, 3)
    assert stamps[-1] == pytest.approx(5.0)
    way = trajectory(imitate(mean, stamps), START, GOAL, steps=1000, end=2.0)
    assert np.linalg.norm(way.p - arc(np.minimum(way.s, 1.0)), axis=1).max() < 2e-3
    assert np.linalg.norm(way.p[500:] - GOAL, axis=1).max() < 4e-4
    # What a spline through every sample learns is far off: of the tremor's acceleration.
    raw = trajectory(imitate(path, t), START, GOAL, steps=1000, end=2.0)
    jerk, of_raw = (np.abs(np.diff(one.z, n=2, axis=0)).max() for one in (way, raw))
    assert of_raw > 10.0 * jerk


def test_repetitions_elsewhere_turned_larger_and_denser_count_the_same() -> None:
    # The second is sampled four times as often.
    shown = [
        recording(1, bulge=0.1, count=300, duration=4.0, noise=0.0),
        recording(2, bulge=0.3, count=1200, duration=6.0, noise=0.0),
    ]
    mean, t = average_paths(*zip(*shown, strict=True))
    assert t[-1] == pytest.approx(5.0)
    np.testing.assert_allclose(mean, arc(t / 5.0, 0.2), atol=1e-3)
    path, t = recording(1, noise=0.0)
    turn = Rotation.from_rotvec([0.0, 0.0, 1.2])
    other = 1.5 * turn.apply(path) + [0.1, 0.2, 0.05]
    means = average_paths([path, other], [t, 2.0 * t + 100.0])[0], average_paths([path], [t])[0]
    a, b = (trajectory(imitate(one), START, GOAL).p for one in means)
    np.testing.assert_allclose(a, b, atol=1e-9)


def test_a_few_points_are_gone_through_and_a_gap_is_bridged() -> None:
    s = np.linspace(0.0, 1.0, SPARSE // 5)
    mean, t = average_paths([arc(s)], [s])
    np.testing.assert_allclose(mean, arc(t), atol=1e-4)
    path, t = recording(1)
    kept = (t < 2.0) | (t > 2.8)
    mean, stamps = average_paths([arc(s), path[kept]], [s, t[kept]])
    assert np.linalg.norm(mean - arc(stamps / stamps[-1]), axis=1).max() < 5e-3


def test_a_recording_that_leads_back_is_refused() -> None:
    path, t = recording(1)
    with pytest.raises(ValueError, match="show it in two parts"):
        average_paths([path, np.vstack([path, path[::-1]])], [t, np.arange(1000.0)])


# Orientations


def turning(s: FloatArray, angle: float, wiggle: float = 0.0) -> Rotation:
    """T orientations from a start by an angle about one axis, with a wiggle about another."""
    r = np.outer(angle * minimum_jerk_share(s), [0.6, 0.0, 0.8])
    r[:, 1] += wiggle * np.sin(2.0 * np.pi * 50.0 * s)
    return Rotation.from_rotvec([np.pi, 0.0, 0.0]) * Rotation.from_rotvec(r)


@pytest.mark.parametrize("angle", [0.8, 4.0, 7.0])
def test_orientations_are_averaged(angle: float) -> None:
    s = np.linspace(0.0, 1.0, 400)
    shown = [turning(s, angle * k, wiggle=0.01).as_quat(scalar_first=True) for k in (0.95, 1.05)]
    mean, t = average_orientations(shown, [3.0 * s, 5.0 * s])
    assert t[-1] == pytest.approx(4.0)
    between = Rotation.from_matrix(mean).inv() * turning(t / 4.0, angle)
    assert between.magnitude().max() < 0.01


def test_turns_that_differ_too_much_are_refused() -> None:
    s = np.linspace(0.0, 1.0, 400)
    there, back = (turning(s, angle).as_matrix() for angle in (3.3, -3.3))
    with pytest.raises(ValueError, match="demonstration 1 of 2 is turned by 95 degrees"):
        average_orientations([there, back], [s, s])
    with pytest.raises(ValueError, match="no rotation matrix"):
        average_orientations([there, 2.0 * there], [s, s])
