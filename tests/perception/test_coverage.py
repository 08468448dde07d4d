"""Tests of the share of the space near an arm that no camera observes."""

import numpy as np

from drake_oa.geometry.pinhole import View
from drake_oa.perception.coverage import HEIGHT, REACH, points_near, unobserved_fraction
from drake_oa.perception.depth_perception import FreeSpace
from tests.reference.depth_images import look_at

COLUMN = np.array([[[0.0, 0.0, z] for z in np.arange(0.05, 0.7, 0.05)]])
"""Centers (1, S, 3) of the spheres of an arm: an upright column [m]."""
FRONT = (2.0, 0.0, 0.6)
NEAR = points_near(COLUMN, np.full(COLUMN.shape[1], 0.06), 0.0)


def view(p_WC, p_WT=(0.0, 0.0, 0.35), depth=9.0):
    K = np.array([500.0, 500.0, 320.0, 240.0])
    return View(np.full((480, 640), depth, np.float32), K, look_at(p_WC, p_WT))


def unobserved(*views, ranges=((0.3, 4.0), (0.3, 4.0))):
    return unobserved_fraction(NEAR, [FreeSpace(views, ranges=ranges[: len(views)])])


def test_points_near_the_arm_are_outside_it_and_above_the_table():
    (points,) = NEAR
    distance = np.linalg.norm(points[:, None] - COLUMN[0], axis=2).min(axis=1) - 0.06
    assert 0.0 < distance.min() < distance.max() < REACH
    assert 0.0 < points[:, 2].min() < points[:, 2].max() < HEIGHT


def test_a_camera_without_depth_or_sight_observes_nothing():
    front, blind = view(FRONT), view(FRONT, depth=np.nan)
    assert unobserved() == unobserved(view(FRONT, (4.0, 0.0, 0.6))) == 1.0
    assert unobserved(front, ranges=((3.0, 4.0),)) == unobserved(front, ranges=((0.3, 1.0),)) == 1.0
    assert unobserved(front, blind) == unobserved(front) < unobserved(blind) == 1.0


def test_a_camera_with_a_shorter_range_does_not_limit_another_one():
    front, left = view(FRONT), view((0.0, 2.0, 0.6), depth=1.9)
    both = unobserved(front, left, ranges=((0.3, 4.0), (0.3, 1.8)))
    assert both == unobserved(front) < unobserved(left, ranges=((0.3, 1.8),)) < 1.0
