"""Unseen share of the space near an arm."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_oa.perception.coverage import ViewVolume, points_near, unobserved_share
from tests.reference.depth_images import look_at

COLUMN = np.array([[[0.0, 0.0, z] for z in np.arange(0.05, 0.7, 0.05)]])
"""A column of spheres for an arm."""
RADIUS = np.full(COLUMN.shape[1], 0.06)
NEAR = points_near(COLUMN, RADIUS, 0.0)
ANGLES = st.floats(-np.pi, np.pi)


def view(p_WC, p_WT=(0.0, 0.0, 0.35), near=0.3, far=4.0, focal=500.0):
    K = np.array([focal, focal, 320.0, 240.0])
    return ViewVolume(look_at(p_WC, p_WT), K, (480, 640), near, far)


def unseen(views):
    return unobserved_share(COLUMN, RADIUS, NEAR, views)


def around(azimuth, distance=2.0, **options):
    place = [distance * np.cos(azimuth), distance * np.sin(azimuth), 0.6]
    return view(place, **options)


@pytest.mark.parametrize(
    "unmeasured_time",
    [
        view((2.0, 0.0, 0.6), (4.0, 0.0, 0.6)),
        around(0.0, near=3.0),
        around(0.0, far=1.0),
    ],
    ids=["looks away", "too near", "too far"],
)
def test_a_camera_that_sees_nothing_leaves_everything(unmeasured_time):
    assert unseen([unmeasured_time]) == 1.0
    assert unseen([]) == 1.0
    both = unseen([around(1.0), unmeasured_time])
    assert both == unseen([around(1.0)])


@settings(deadline=None, max_examples=30)
@given(ANGLES, ANGLES, st.floats(0.8, 2.5), st.floats(300.0, 900.0))
def test_a_second_camera_never_raises_the_share(first, second, distance, focal):
    one, other = around(first, focal=focal), around(second, distance=distance)
    shares = [unseen([camera]) for camera in (one, other)]
    both = unseen([one, other])
    assert 0.0 <= both <= min(shares) <= max(shares) <= 1.0
    assert both == unseen([other, one])


@settings(deadline=None, max_examples=20)
@given(ANGLES)
def test_the_arm_hides_what_is_behind_it(azimuth):
    alone = unseen([around(azimuth)])
    assert 0.02 < alone < 0.5
    # The camera on the other side sees what the arm hides from this one.
    assert unseen([around(azimuth), around(azimuth + np.pi)]) < 0.1 * alone
