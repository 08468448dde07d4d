"""How far a surface has gone from one frame to the next."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_oa.perception.velocity import register_surface

NOISE, PRIOR = 1.5e-3, 0.02
shifts = st.lists(st.floats(-0.015, 0.015), min_size=3, max_size=3).map(np.array)


def cap(rng: np.random.Generator, center: np.ndarray, number: int = 600) -> np.ndarray:
    """(number, 3) points on the side of a ball that is seen from above, with noise."""
    u = rng.normal(size=(number, 3))
    u[:, 2] = np.abs(u[:, 2])
    u /= np.linalg.norm(u, axis=1)[:, None]
    return center + 0.08 * u + rng.normal(scale=NOISE, size=u.shape)


def plane(rng: np.random.Generator, offset: np.ndarray) -> np.ndarray:
    points = np.column_stack([rng.uniform(-0.1, 0.1, (800, 2)), np.zeros(800)])
    return offset + points + rng.normal(scale=NOISE, size=points.shape) * [0.0, 0.0, 1.0]


def lay(before: np.ndarray, now: np.ndarray):
    return register_surface(before, now, np.zeros(3), PRIOR)


@settings(max_examples=25, deadline=None)
@given(shift=shifts, seed=st.integers(0, 99))
def test_a_ball_is_followed_within_its_variance(shift: np.ndarray, seed: int) -> None:
    rng = np.random.default_rng(seed)
    found, variance = lay(cap(rng, np.zeros(3)), cap(rng, shift))
    assert (np.abs(found - shift) < 5.0 * np.sqrt(variance)).all()
    assert (np.sqrt(variance) < 2e-3).all()


def test_a_plane_that_slides_in_itself_tells_only_of_its_normal() -> None:
    rng = np.random.default_rng(1)
    found, variance = lay(plane(rng, np.zeros(3)), plane(rng, np.array([0.01, 0.0, 0.005])))
    assert found[2] == pytest.approx(0.005, abs=1e-3)
    assert variance[2] < 1e-6
    assert (variance[:2] > 25e-6).all()
