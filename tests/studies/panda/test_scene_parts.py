"""Things on the table: as large as is said, and in the image or outside it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_oa.geometry.shapes import Box, Cylinder, pose
from drake_oa.studies.panda.scene_parts import (
    LARGEST,
    bounding_ball,
    draw_obstacles,
    footprint_radius,
    view_margin,
)

_DIRECTIONS = np.random.default_rng(0).normal(size=(400, 3))


def _surface(shape):
    """Points of a shape's surface, extreme ones among them, in the obstacle's frame."""
    unit = _DIRECTIONS / np.linalg.norm(_DIRECTIONS, axis=1, keepdims=True)
    if isinstance(shape, Box):
        points = 0.5 * np.sign(_DIRECTIONS) * np.asarray(shape.size)
    elif isinstance(shape, Cylinder):
        flat = unit[:, :2] / np.linalg.norm(unit[:, :2], axis=1, keepdims=True)
        points = np.c_[shape.radius * flat, 0.5 * shape.length * np.sign(unit[:, 2])]
    else:
        points = shape.radius * unit
    return (pose(shape) @ points.T).T


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_an_obstacle_stands_on_the_table_and_is_no_larger_than_said(seed):
    (obstacle,) = draw_obstacles(np.random.default_rng(seed), 1)
    points = np.concatenate([_surface(shape) for shape in obstacle.shapes])
    assert -1e-9 <= points[:, 2].min() < 0.03
    assert points[:, 2].max() <= LARGEST + 1e-9
    assert np.hypot(points[:, 0], points[:, 1]).max() <= footprint_radius(obstacle) + 1e-9
    center, radius = bounding_ball(obstacle)
    from_center = np.linalg.norm(points + obstacle.translation - center, axis=1)
    assert from_center.max() <= radius + 1e-9


@pytest.mark.parametrize(
    ("place", "low", "high"),
    [
        ([0.45, 0.0, 0.2], 0.1, 1.0),
        ([0.45, 1.2, 0.2], -1.0, -0.1),
        ([3.0, 0.5, 1.5], -3.0, -0.1),
    ],
)
def test_points_are_inside_the_image_or_outside_by_a_distance(place, low, high):
    assert low < view_margin(np.array([place]))[0] < high
