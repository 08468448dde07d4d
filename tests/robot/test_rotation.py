"""Rotation matrices of quaternions, and rotation vectors, against scipy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drake_oa.robot.arm import rotation_of, rotation_vector


@given(st.integers(0, 10**6), st.floats(1e-3, 1e3))
def test_rotations_are_those_of_scipy(seed, size):
    rng = np.random.default_rng(seed)
    R = Rotation.random(rng=rng)
    quaternion = size * R.as_quat()[[3, 0, 1, 2]]
    np.testing.assert_allclose(rotation_of(quaternion), R.as_matrix(), atol=1e-12)
    r = rotation_vector(R.as_matrix())
    np.testing.assert_allclose(Rotation.from_rotvec(r).as_matrix(), R.as_matrix(), atol=1e-9)


@pytest.mark.parametrize("axis", np.vstack([np.eye(3), -np.eye(3), [[0.6, -0.8, 0.0]]]))
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 1.0, np.pi - 1e-7, np.pi])
def test_rotation_vector_at_the_ends_of_its_range(axis, angle):
    R = Rotation.from_rotvec(axis * angle).as_matrix()
    r = rotation_vector(R)
    assert np.linalg.norm(r) == pytest.approx(angle, abs=1e-9)
    np.testing.assert_allclose(Rotation.from_rotvec(r).as_matrix(), R, atol=1e-9)
