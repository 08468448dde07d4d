"""Tests of the projection of a pinhole camera."""

import numpy as np

from drake_oa.geometry.pinhole import pixel_at

K = np.array([260.0, 260.0, 159.5, 119.5])
SIZE = (240, 320)


def test_a_back_projected_pixel_projects_to_itself():
    for index in range(0, SIZE[0] * SIZE[1], 997):
        row, column = divmod(index, SIZE[1])
        x, y = 1.7 * (column - K[2]) / K[0], 1.7 * (row - K[3]) / K[1]
        assert pixel_at(np.array([x, y, 1.7]), SIZE, K) == index
        assert pixel_at(-np.array([x, y, 1.7]), SIZE, K) == -1
    assert pixel_at(np.array([9.0, 0.0, 1.0]), SIZE, K) == -1
