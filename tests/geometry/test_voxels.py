import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components

from drake_oa.geometry.pinhole import View, pixel_at
from drake_oa.geometry.voxels import (
    connected_clusters,
    filed,
    joined_across_unseen,
    points_of_groups,
    voxel_keys,
    voxel_means,
)

K = np.array([260.0, 260.0, 159.5, 119.5])
SIZE = (240, 320)


@given(st.lists(st.tuples(*[st.integers(-1000, 1000)] * 3), min_size=1, max_size=50))
def test_voxel_keys_tell_voxels_apart(cells):
    centers = (np.array(cells) + 0.5) * 0.01
    assert len(np.unique(voxel_keys(centers, 0.01))) == len(set(cells))


def test_clusters_join_by_nearness_and_by_group():
    points = np.array([[0.0, 0, 0], [0.02, 0, 0], [0.1, 0, 0], [0.3, 0, 0]])
    label = connected_clusters(points, 0.03)
    assert label[0] == label[1]
    assert len(set(label)) == 3
    label = connected_clusters(points, 0.03, np.array([0, 1, 0, 2]))
    assert label[0] == label[1] == label[2] != label[3]
    assert len(connected_clusters(np.zeros((0, 3)), 0.03)) == 0


@given(st.integers(0, 120), st.floats(0.02, 0.3), st.integers(0, 9999))
def test_clusters_are_the_components_of_the_graph_of_near_points(count, tolerance, seed):
    points = np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 3))
    near = np.linalg.norm(points[:, None] - points, axis=-1) <= tolerance
    expected = connected_components(near, directed=False)[1] if count else np.zeros(0)
    np.testing.assert_array_equal(connected_clusters(points, tolerance), expected)


@given(st.sampled_from([0, 1, 300, 30_000]), st.sampled_from([1, 50, 30_000]), st.integers(0, 9))
def test_keys_are_numbered_by_first_appearance(count, kinds, seed):
    keys = np.random.default_rng(seed).integers(0, kinds, count) * (1 << 21)
    different, which, _ = filed(keys)
    np.testing.assert_array_equal(different[which], keys)
    assert len(np.unique(different)) == len(different)
    assert (np.diff(np.unique(which, return_index=True)[1]) > 0).all()


def join(background: float, label_behind: int) -> np.ndarray:
    """Two strips 4 cm apart at 1 m, with something at `background` in the gap."""
    strip = np.stack(np.meshgrid(np.arange(5) * 0.01, np.arange(5) * 0.01, [1.0]), -1)
    strip = strip.reshape(-1, 3)
    left, right = strip - np.array([0.06, 0, 0]), strip + np.array([0.02, 0, 0])
    depth, pixel_label = np.full(SIZE, background), np.full(SIZE[0] * SIZE[1], label_behind)
    points = np.concatenate([left, right])
    label = np.repeat([0, 1], 25)
    pixel = pixel_at(points, SIZE, K)
    depth.ravel()[pixel], pixel_label[pixel] = 1.0, label
    shown = np.flatnonzero(pixel_label >= 0)
    return joined_across_unseen(
        points,
        label,
        [(shown, pixel_label[shown], View.of(depth, K, np.eye(4)))],
        0.06,
        0.01,
        10,
    )


def test_a_gap_through_which_the_table_shows_separates():
    assert len(set(join(1.2, -1))) == 2
    assert len(set(join(np.inf, -1))) == 2


def test_a_gap_without_depth_or_with_the_clusters_themselves_behind_joins():
    assert len(set(join(np.nan, -1))) == 1
    assert len(set(join(1.2, 1))) == 1
    assert len(set(join(0.5, -1))) == 1


@given(st.integers(1, 300), st.integers(0, 9999))
def test_points_are_averaged_by_voxel_and_collected_by_group(count, seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.1, 0.1, (count, 3))
    means, voxel_of, size = voxel_means(points, 0.05)
    keys = voxel_keys(points, 0.05)
    assert len(means) == len(np.unique(keys))
    for voxel, key in enumerate(np.unique(keys)):
        np.testing.assert_array_equal(voxel_of == voxel, keys == key)
        np.testing.assert_allclose(means[voxel], points[keys == key].mean(axis=0), atol=1e-12)
    np.testing.assert_array_equal(size, np.bincount(voxel_of))
    group, index = rng.integers(-1, 3, len(means)), rng.permutation(count)
    numbers, begin = points_of_groups(group, voxel_of, index, 3)
    for g in range(3):
        expected = index[group[voxel_of] == g]
        np.testing.assert_array_equal(numbers[begin[g] : begin[g + 1]], expected)
