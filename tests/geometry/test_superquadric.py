"""Tests of the least-squares fit of superquadrics."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drake_oa.geometry.directions import sphere_points
from drake_oa.geometry.superquadric import fit_superquadric


@settings(max_examples=10)
@given(st.integers(0, 10**6), st.tuples(*[st.floats(0.02, 0.5)] * 3))
def test_fit_recovers_an_ellipsoid(seed, semi_axes):
    rng = np.random.default_rng(seed)
    center, turn = rng.uniform(-1.0, 1.0, 3), Rotation.random(rng=rng)
    p_WO, R, axes = fit_superquadric(center + turn.apply(sphere_points(156) * semi_axes))
    np.testing.assert_allclose(np.sort(axes), np.sort(semi_axes), rtol=1e-4)
    np.testing.assert_allclose(p_WO, center, atol=1e-5)
    assert np.linalg.det(R) == pytest.approx(1.0)
