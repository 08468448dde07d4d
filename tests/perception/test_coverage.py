"""Tests of the share of the space near an arm that no camera observes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_oa.perception.coverage import ViewVolume, points_near, unobserved_fraction
from tests.reference.depth_images import look_at

COLUMN = np.array([[[0.0, 0.0, z] for z in np.arange(0.05, 0.7, 0.05)]])
"""Centers (1, S, 3) of the spheres of an arm: an upright column [m]."""
RADIUS = np.full(COLUMN.shape[1], 0.06)
NEAR = points_near(COLUMN, RADIUS, 0.0)
ANGLES = st.floats(-np.pi, np.pi)


def view(p_WC, p_WT=(0.0, 0.0, 0.35), near=0.3, far=4.0, focal=500.0):
    K = np.array([focal, focal, 320.0, 240.0])
    return ViewVolume(look_at(p_WC, p_WT), K, (480, 640), near, far)


def unobserved(views):
    return unobserved_fraction(COLUMN, RADIUS, NEAR, views)


def around(azimuth, distance=2.0, **options):
    place = [distance * np.cos(azimuth), distance * np.sin(azimuth), 0.6]
    return view(place, **options)


@pytest.mark.parametrize(
    "blind_view",
    [view((2.0, 0.0, 0.6), (4.0, 0.0, 0.6)), around(0.0, near=3.0), around(0.0, far=1.0)],
    ids=["looks away", "too near", "too far"],
)
def test_a_camera_without_a_view_of_the_arm_observes_nothing(blind_view):
    assert unobserved([blind_view]) == 1.0
    assert unobserved([]) == 1.0
    both = unobserved([around(1.0), blind_view])
    assert both == unobserved([around(1.0)])


@settings(deadline=None, max_examples=30)
@given(ANGLES, ANGLES, st.floats(0.8, 2.5), st.floats(300.0, 900.0))
def test_a_second_camera_never_raises_the_share(first, second, distance, focal):
    one, other = around(first, focal=focal), around(second, distance=distance)
    shares = [unobserved([camera]) for camera in (one, other)]
    both = unobserved([one, other])
    assert 0.0 <= both <= min(shares) <= max(shares) <= 1.0
    assert both == unobserved([other, one])


@settings(deadline=None, max_examples=20)
@given(ANGLES)
def test_the_arm_occludes_the_space_behind_it(azimuth):
    alone = unobserved([around(azimuth)])
    assert 0.02 < alone < 0.5
    # The camera on the other side observes the space that the arm occludes.
    assert unobserved([around(azimuth), around(azimuth + np.pi)]) < 0.1 * alone
