"""Tests of the registration of surfaces: displacement between two frames."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_oa.perception.velocity import register_surface

NOISE, PRIOR = 1.5e-3, 0.02
shifts = st.lists(st.floats(-0.015, 0.015), min_size=3, max_size=3).map(np.array)


def cap(rng: np.random.Generator, center: np.ndarray, number: int = 600) -> np.ndarray:
    """Returns points (number, 3) with noise on the upper half of a ball [m]."""
    u = rng.normal(size=(number, 3))
    u[:, 2] = np.abs(u[:, 2])
    u /= np.linalg.norm(u, axis=1)[:, None]
    return center + 0.08 * u + rng.normal(scale=NOISE, size=u.shape)


def plane(rng: np.random.Generator, offset: np.ndarray) -> np.ndarray:
    """Returns points (800, 3) with noise on a horizontal square about an offset [m]."""
    points = np.column_stack([rng.uniform(-0.1, 0.1, (800, 2)), np.zeros(800)])
    return offset + points + rng.normal(scale=NOISE, size=points.shape) * [0.0, 0.0, 1.0]


def flat_box(rng: np.random.Generator, offset: np.ndarray) -> np.ndarray:
    """Returns points (800, 3) with noise on top and front, 5 cm high, of a box at an offset [m]."""
    u, v = rng.uniform(-0.1, 0.1, (2, 800))
    is_front = np.arange(800) < 200
    points = np.column_stack([np.where(is_front, 0.1, u), v, np.where(is_front, u / 4.0, 0.025)])
    return offset + points + rng.normal(scale=NOISE, size=points.shape)


def register(before: np.ndarray, now: np.ndarray, prior: float = PRIOR):
    """Returns displacement and variances of two surfaces, with the guess 0."""
    return register_surface(before, now, np.zeros(3), prior, NOISE)


@settings(max_examples=25, deadline=None)
@given(shift=shifts, seed=st.integers(0, 99))
def test_the_displacement_of_a_ball_is_within_its_variance(shift: np.ndarray, seed: int) -> None:
    rng = np.random.default_rng(seed)
    result, variance = register(cap(rng, np.zeros(3)), cap(rng, shift))
    assert (np.abs(result - shift) < 5.0 * np.sqrt(variance)).all()
    assert (np.sqrt(variance) < 2e-3).all()


def test_only_the_displacement_along_its_normal_is_measured_of_a_plane() -> None:
    rng = np.random.default_rng(1)
    result, variance = register(plane(rng, np.zeros(3)), plane(rng, np.array([0.01, 0.0, 0.005])))
    assert result[2] == pytest.approx(0.005, abs=1e-3)
    assert variance[2] < 1e-6
    assert (variance[:2] > 25e-6).all()


@settings(max_examples=25, deadline=None)
@given(distance=st.floats(-0.12, 0.12), seed=st.integers(0, 99))
def test_a_box_may_move_farther_than_its_front_is_high(distance: float, seed: int) -> None:
    rng, shift = np.random.default_rng(seed), np.array([distance, 0.0, 0.0])
    before, now = flat_box(rng, np.zeros(3)), flat_box(rng, shift)
    moved = now.mean(axis=0) - before.mean(axis=0)
    result, variance = register_surface(before, now, np.zeros(3), 0.07, NOISE, moved)
    assert result[0] == pytest.approx(distance, abs=5e-3)
    assert variance[0] < 1e-4


@settings(max_examples=25, deadline=None)
@given(side=st.floats(-0.05, 0.05), seed=st.integers(0, 99))
def test_occlusion_of_a_part_does_not_move_a_resting_box(side: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    before, now = flat_box(rng, np.zeros(3)), flat_box(rng, np.zeros(3))
    now = now[now[:, 1] > side]
    moved = now.mean(axis=0) - before.mean(axis=0)
    result, _ = register_surface(before, now, np.zeros(3), 0.07, NOISE, moved)
    expected, _ = register(before, now, 0.07)
    np.testing.assert_array_equal(result, expected)
