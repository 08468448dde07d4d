"""Tests of voxel means and clusters."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components

from drake_oa.geometry.voxels import connected_clusters, voxel_means


@given(st.integers(0, 120), st.floats(0.02, 0.3), st.booleans(), st.integers(0, 9999))
def test_clusters_are_the_components_of_the_graph_of_near_points(count, tolerance, grouped, seed):
    rng = np.random.default_rng(seed)
    points, groups = rng.uniform(-0.5, 0.5, (count, 3)), None
    near = np.linalg.norm(points[:, None] - points, axis=-1) <= tolerance
    if grouped:
        groups = rng.integers(0, max(count, 1), count)
        near |= groups[:, None] == groups
    expected = connected_components(near, directed=False)[1] if count else np.zeros(0)
    label = connected_clusters(points, tolerance, groups)
    np.testing.assert_array_equal(label[:, None] == label, expected[:, None] == expected)
    assert set(label) == set(range(len(set(label))))


@given(st.integers(1, 300), st.integers(0, 9999))
def test_points_are_averaged_by_voxel(count, seed):
    points = np.random.default_rng(seed).uniform(-0.1, 0.1, (count, 3))
    means, voxel_of, size = voxel_means(points, 0.05)
    cells = np.floor(points / 0.05)
    assert len(means) == len(np.unique(cells, axis=0))
    for voxel in range(len(means)):
        is_same_voxel = (cells == cells[voxel_of == voxel][0]).all(axis=1)
        np.testing.assert_array_equal(voxel_of == voxel, is_same_voxel)
        np.testing.assert_allclose(means[voxel], points[is_same_voxel].mean(axis=0), atol=1e-12)
        assert size[voxel] == is_same_voxel.sum()
