import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drake_oa.geometry.rotation import rotation_of, rotation_vector, turned_about, unit_axis


@settings(deadline=None)
@given(st.integers(0, 10**6), st.floats(1e-3, 1e3))
def test_rotations_are_those_of_scipy(seed, size):
    rng = np.random.default_rng(seed)
    R = Rotation.random(rng=rng)
    quaternion = size * R.as_quat()[[3, 0, 1, 2]]
    np.testing.assert_allclose(rotation_of(quaternion), R.as_matrix(), atol=1e-12)
    r = rotation_vector(R.as_matrix())
    np.testing.assert_allclose(Rotation.from_rotvec(r).as_matrix(), R.as_matrix(), atol=1e-9)
    points, axis, turn = rng.normal(size=(5, 3)), unit_axis(rng.normal(size=3)), rng.normal()
    turned = Rotation.from_rotvec(turn * axis).apply(points)
    np.testing.assert_allclose(turned_about(points, axis, turn), turned, atol=1e-12)


@pytest.mark.parametrize("axis", np.vstack([np.eye(3), -np.eye(3), [[0.6, -0.8, 0.0]]]))
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 1.0, np.pi - 1e-7, np.pi])
def test_rotation_vector_at_the_ends_of_its_range(axis, angle):
    R = Rotation.from_rotvec(axis * angle).as_matrix()
    r = rotation_vector(R)
    assert np.linalg.norm(r) == pytest.approx(angle, abs=1e-9)
    np.testing.assert_allclose(Rotation.from_rotvec(r).as_matrix(), R, atol=1e-9)


@pytest.mark.parametrize("axis", [[0.0, 0.0, 0.0], [1.0, 0.0], [np.nan, 0.0, 1.0]])
def test_an_axis_without_a_direction_is_refused(axis):
    with pytest.raises(ValueError, match="axis of a turn"):
        unit_axis(axis)
