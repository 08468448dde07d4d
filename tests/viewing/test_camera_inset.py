"""The picture of what a camera sees."""

import numpy as np

from drake_oa.common.messages import ObstacleClouds
from drake_oa.geometry.pinhole import View
from drake_oa.viewing.camera_inset import depth_picture


def test_near_is_light_missing_dark_and_obstacles_are_coloured() -> None:
    depth = np.full((48, 64), 2.0)
    depth[:, 32:] = 1.0
    depth[:4] = np.nan
    view = View.of(depth, np.array([60.0, 60.0, 31.5, 23.5]), np.eye(4))
    cloud = np.array([[0.0, 0.0, 1.0], [5.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    picture = depth_picture(view, ObstacleClouds(clouds_W=(cloud,), ids=np.array([2])), 32)
    assert picture.shape == (24, 32, 3)
    light = picture.sum(axis=2)
    assert light[20, 28] > light[20, 4] > light[0, 4]
    # The one point in sight; what is beside or behind the camera is nowhere.
    near_grey, far_grey = picture[20, 28], picture[20, 4]
    coloured = ~(
        np.isclose(picture, near_grey).all(axis=2)
        | np.isclose(picture, far_grey).all(axis=2)
        | np.isclose(picture, picture[0, 4]).all(axis=2)
    )
    assert np.argwhere(coloured).tolist() == [[12, 16]]


def test_an_image_without_depth_is_dark() -> None:
    view = View.of(np.full((12, 16), np.nan), np.array([15.0, 15.0, 7.5, 5.5]), np.eye(4))
    picture = depth_picture(view, ObstacleClouds(), 16)
    assert picture.max() < 0.2
