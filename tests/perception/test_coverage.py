"""Tests of the share of the space near an arm that no camera observes."""

import numpy as np

from drake_oa.geometry.pinhole import View
from drake_oa.perception.coverage import HEIGHT, REACH, points_near, unobserved_fraction
from drake_oa.perception.depth_perception import FreeSpace
from tests.reference.depth_images import look_at

COLUMN = np.array([[[0.0, 0.0, z] for z in np.arange(0.05, 0.7, 0.05)]])
"""Centers (1, S, 3) of the spheres of an arm: an upright column [m]."""
NEAR = points_near(COLUMN, np.full(COLUMN.shape[1], 0.06), 0.0)


def view(p_WC, p_WT=(0.0, 0.0, 0.35), depth=9.0):
    K = np.array([500.0, 500.0, 320.0, 240.0])
    return View(np.full((480, 640), depth, np.float32), K, look_at(p_WC, p_WT))


def around(azimuth, **options):
    return view([2.0 * np.cos(azimuth), 2.0 * np.sin(azimuth), 0.6], **options)


def unobserved(*views, near=0.3, far=4.0):
    return unobserved_fraction(NEAR, [FreeSpace(views, ranges=((near, far),) * len(views))])


def test_points_near_the_arm_are_outside_it_and_above_the_table():
    (points,) = NEAR
    distance = np.linalg.norm(points[:, None] - COLUMN[0], axis=2).min(axis=1) - 0.06
    assert (distance > 0.0).all()
    assert (distance < REACH).all()
    assert 0.0 < points[:, 2].min() < points[:, 2].max() < HEIGHT


def test_a_camera_without_depth_or_sight_observes_nothing():
    assert unobserved() == 1.0
    assert unobserved(view((2.0, 0.0, 0.6), (4.0, 0.0, 0.6))) == 1.0
    assert unobserved(around(0.0), near=3.0) == unobserved(around(0.0), far=1.0) == 1.0
    blind = around(0.0, depth=np.nan)
    assert unobserved(around(1.0), blind) == unobserved(around(1.0)) < unobserved(blind) == 1.0


def test_a_camera_with_a_shorter_range_does_not_limit_another_one():
    views, ranges = (around(1.0), around(-2.0, depth=1.9)), ((0.3, 4.0), (0.3, 1.8))
    one, other = (FreeSpace((v,), ranges=(r,)) for v, r in zip(views, ranges, strict=True))
    shares = [unobserved_fraction(NEAR, [x]) for x in (one, other, FreeSpace(views, ranges=ranges))]
    assert shares[2] == shares[0] < shares[1] < 1.0
