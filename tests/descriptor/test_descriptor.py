"""Tests of obstacles that are divided into several ellipsoids near free points."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_oa.common.messages import PART_ID_STRIDE, FloatArray, ObstacleClouds
from drake_oa.descriptor.descriptor import cloud_parts, describe, merged_parts
from drake_oa.geometry.ellipsoid import signed_distance

HAND = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.03, 0.03) for z in (0.04, 0.1)])
FINGERS = np.array([[x, y, z] for x in (-0.03, 0.03) for y in (-0.01, 0.01) for z in (0.0, 0.04)])
TOOL = np.concatenate([HAND, FINGERS])


def box_cloud(size: tuple[float, float, float], spacing: float = 0.02) -> FloatArray:
    axes = [np.linspace(-s / 2, s / 2, max(2, round(s / spacing))) for s in size]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    face = (np.abs(grid) > np.array(size) / 2 - 1e-9).any(axis=1)
    return grid[face] + np.array([0.5, 0.0, size[2] / 2])


@given(seed=st.integers(0, 10_000), count=st.integers(1, 60), halvings=st.integers(0, 3))
@settings(max_examples=50)
def test_parts_partition_the_cloud(seed: int, count: int, halvings: int) -> None:
    cloud = np.random.default_rng(seed).normal(size=(count, 3))
    parts = cloud_parts(cloud, halvings)
    assert 1 <= len(parts) <= 2**halvings
    joined = np.concatenate(parts)
    np.testing.assert_array_equal(np.unique(joined, axis=0), np.unique(cloud, axis=0))


def test_tool_parts_that_fill_their_common_box_are_merged() -> None:
    left, right = FINGERS[FINGERS[:, 0] < 0.0], FINGERS[FINGERS[:, 0] > 0.0]
    left = np.concatenate([left, left + [0.028, 0.0, 0.0]])
    right = np.concatenate([right, right - [0.028, 0.0, 0.0]])
    hand, fingers = merged_parts([HAND, left, right])
    np.testing.assert_array_equal(hand, HAND)
    assert len(fingers) == len(left) + len(right)


def test_an_obstacle_near_a_free_point_has_several_rows() -> None:
    # The ellipsoid of the box contains the point, although the tool is free there.
    obstacles = ObstacleClouds(0.0, (box_cloud((0.2, 0.3, 0.2)),), np.array([7]))
    free = np.array([0.5, -0.25, 0.1])
    one = describe(obstacles, TOOL)
    assert len(one) == 1
    assert signed_distance(free, one.p_WO[0], one.R_WO[0], one.semi_axes[0]) < 0.0

    several = describe(obstacles, TOOL, free_W=[free], tool_parts=[HAND, FINGERS])
    assert len(several) > 1
    assert len(set(several.ids.tolist())) == len(several)
    assert set((several.ids % PART_ID_STRIDE).tolist()) == {7}
    assert several.v_WO.shape == (len(several), 3)
    room = signed_distance(free, several.p_WO, several.R_WO, several.semi_axes)
    assert room.min() > 0.0

    dilated = (obstacles.clouds_W[0][:, None] - TOOL).reshape(-1, 1, 3)
    distance = signed_distance(dilated, several.p_WO, several.R_WO, several.semi_axes)
    assert distance.min(axis=1).max() <= 1e-9
    # An obstacle far from the free points has one ellipsoid.
    far = describe(obstacles, TOOL, free_W=[[0.5, 0.9, 0.1]], tool_parts=[HAND, FINGERS])
    np.testing.assert_array_equal(far.p_WO, one.p_WO)
    # A point in the middle is inside any parts.
    middle = describe(obstacles, TOOL, free_W=one.p_WO, tool_parts=[TOOL])
    assert signed_distance(one.p_WO[0], middle.p_WO, middle.R_WO, middle.semi_axes).min() < 0.0
