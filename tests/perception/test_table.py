"""Tests of the search for the support plane, on random points."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_oa.perception.table import find_table

ABOVE = np.diag([1.0, -1.0, -1.0, 1.0])
"""Pose X_WC of a camera that looks down from z = 1 m."""
ABOVE[2, 3] = 1.0


def levels(rng, *squares) -> np.ndarray:
    """Returns points in the world [m] on horizontal squares (height, half size, count)."""
    parts = []
    for height, half, count in squares:
        xy = rng.uniform(-half, half, (count, 2))
        parts.append(np.column_stack([xy, rng.normal(height, 0.002, count)]))
    return np.concatenate(parts)


def find(p_WQ, X_WC=ABOVE, height=None, is_pose_known=True):
    """Finds the table in points of the world, by a camera with a known or unknown pose."""
    p_CQ = (p_WQ - X_WC[:3, 3]) @ X_WC[:3, :3]
    pose = X_WC if is_pose_known else None
    return find_table(p_CQ, np.linalg.norm(p_CQ, axis=1), pose, height)


@settings(max_examples=20, deadline=None)
@given(
    st.floats(0.0, 0.07), st.floats(0.0, 6.28), st.sampled_from([None, -0.02]), st.integers(0, 9)
)
def test_a_plane_in_clutter_is_recovered(tilt, azimuth, height, seed):
    rng = np.random.default_rng(seed)
    slope = np.tan(tilt) * np.array([np.cos(azimuth), np.sin(azimuth)])
    table = levels(rng, (0.0, 0.4, 4000))
    table[:, 2] += table[:, :2] @ slope
    clutter = rng.uniform([-0.4, -0.4, 0.0], [0.4, 0.4, 0.6], (1500, 3))
    plane = find(np.concatenate([table, clutter]), height=height)
    normal = np.append(-slope, 1.0) * np.cos(tilt)
    # The camera's z axis points down.
    assert np.arccos(min(1.0, plane.normal @ (normal * [1.0, -1.0, -1.0]))) < 3e-3
    assert abs(plane.offset + np.cos(tilt)) < 3e-3
    assert plane.rms < 5e-3
    assert plane.inliers[:4000].mean() > 0.9


def test_points_without_a_plane_have_no_table():
    rng = np.random.default_rng(0)
    wall = levels(rng, (0.3, 1.0, 2000))[:, [2, 0, 1]]
    for points in (wall, wall[:0], np.zeros((100, 3)), wall[:300, :1] * [0.0, 1.0, 0.0]):
        assert find(points) is None
        assert find(points, height=-2.0) is None


@pytest.mark.parametrize("is_pose_known", [True, False])
@pytest.mark.parametrize(
    ("squares", "table"),
    [
        # A small table over the floor, a box on the floor, and the top of a large box on a table.
        ([(-0.5, 1.5, 6000), (0.2, 0.3, 2500)], 0.2),
        ([(-0.5, 1.5, 4000), (-0.2, 0.3, 1500)], -0.5),
        ([(0.0, 0.6, 2500), (0.25, 0.25, 5000)], 0.0),
    ],
)
def test_the_table_is_selected_among_parallel_planes(squares, table, is_pose_known):
    points = levels(np.random.default_rng(0), *squares)
    plane = find(points, is_pose_known=is_pose_known)
    assert abs(plane.offset + 1.0 - table) < 2e-3
    # With a known height, the plane at that height is selected.
    assert abs(find(points, height=squares[1][0]).offset + 1.0 - squares[1][0]) < 2e-3
