import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_oa.geometry.primitives import RobotShapes


def pose(p, rotation=None):
    X = np.eye(4)
    X[:3, 3] = p
    if rotation is not None:
        X[:3, :3] = rotation.as_matrix()
    return X


def one_each() -> RobotShapes:
    """Sphere on body 0, capsule and box on body 1, cylinder on body 2."""
    return RobotShapes(
        np.array([0, 1, 1]),
        np.stack([pose([0, 0, 0]), pose([0, 0, 0]), pose([0, 0.5, 0])]),
        np.array([[0, 0, 0], [0, 0, 0.2], [0.1, 0.2, 0.05]]),
        np.array([0.1, 0.05, 0.0]),
        np.array([2]),
        pose([0, 0, 0.1])[None],
        np.array([[0.08, 0.15]]),
    )


def distances(p: np.ndarray) -> np.ndarray:
    """Distance from the shapes of `one_each` with bodies at x = 0, 1, 2; inside: 0."""
    sphere = np.linalg.norm(p) - 0.1
    q = p - [1, 0, 0]
    capsule = np.linalg.norm(q - [0, 0, np.clip(q[2], -0.2, 0.2)]) - 0.05
    q = p - [1, 0.5, 0]
    box = np.linalg.norm(np.maximum(np.abs(q) - [0.1, 0.2, 0.05], 0))
    q = p - [2, 0, 0.1]
    cylinder = np.hypot(max(np.hypot(q[0], q[1]) - 0.08, 0), max(abs(q[2]) - 0.15, 0))
    return np.maximum([sphere, capsule, box, cylinder], 0.0)


BODIES = np.stack([pose([0, 0, 0]), pose([1, 0, 0]), pose([2, 0, 0])])


@settings(max_examples=200)
@given(st.floats(-0.4, 2.4), st.floats(-0.4, 0.9), st.floats(-0.5, 0.5), st.floats(0.001, 0.1))
def test_a_point_is_the_robots_within_the_margin_of_any_shape(x, y, z, margin):
    p = np.array([x, y, z])
    distance = distances(p).min()
    if abs(distance - margin) > 1e-9:
        assert one_each().posed(BODIES).contains(p[None], margin)[0] == (distance < margin)


def test_no_shapes_and_no_points_are_fine():
    nothing = RobotShapes().posed(np.zeros((0, 4, 4)))
    assert len(RobotShapes()) == 0
    assert not nothing.contains(np.ones((3, 3)), 0.1).any()
    assert one_each().posed(BODIES).contains(np.zeros((0, 3)), 0.1).shape == (0,)
