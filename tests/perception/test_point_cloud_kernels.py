import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_oa.geometry import cluster_kernels, voxel_kernels
from drake_oa.geometry.self_filter import RobotShapes
from drake_oa.perception import point_cloud_kernels as kernels
from drake_oa.perception import surface_kernels, table_kernels
from drake_oa.perception.point_cloud import SegmentationConfig, segment_depth, segment_points
from drake_oa.perception.tracking import ObstacleMemory, fuse


@given(st.integers(0, 300), st.integers(1, 50), st.integers(0, 9999))
def test_keys_are_numbered_by_first_appearance(count, kinds, seed):
    keys = np.random.default_rng(seed).integers(0, kinds, count) * (1 << 21)
    different, which = voxel_kernels.numbered(keys)
    np.testing.assert_array_equal(different[which], keys)
    assert len(np.unique(different)) == len(different)
    assert (np.diff(np.unique(which, return_index=True)[1]) > 0).all()


@pytest.mark.parametrize("count", [4096, 4097, 30_000])
def test_many_different_keys_are_told_apart(count):
    keys = np.arange(count) * (1 << 21)
    different, which = voxel_kernels.numbered(np.concatenate([keys, keys]))
    np.testing.assert_array_equal(different, keys)
    np.testing.assert_array_equal(which, np.tile(np.arange(count), 2))


@settings(max_examples=30)
@given(st.integers(1, 9), st.integers(1, 9), st.integers(1, 4), st.integers(0, 9999))
def test_a_coarser_image_names_its_pixels_in_the_finer_one(height, width, stride, seed):
    rng = np.random.default_rng(seed)
    z = rng.choice([0.0, 0.5, 1.0, 3.0, np.inf, np.nan], (height, width)).astype(np.float32)
    coarse, fine = kernels.sampled(z, stride, 0.4, 2.0)
    grid = z[::stride, ::stride].ravel()
    np.testing.assert_array_equal(coarse, np.flatnonzero((grid >= 0.4) & (grid <= 2.0)))
    np.testing.assert_array_equal(z.ravel()[fine], grid[coarse])


def test_pixels_between_heights_are_those_a_plain_formula_gives():
    rng = np.random.default_rng(0)
    z = rng.uniform(0.0, 3.0, (50, 70)).astype(np.float32)
    z[rng.random(z.shape) < 0.2] = np.nan
    z[rng.random(z.shape) < 0.1] = np.inf
    u, v = (rng.normal(size=n).astype(np.float32) for n in (70, 50))
    near, far, low, noise, high = limits = np.array([0.3, 2.5, -0.4, 0.1, 1.2], dtype=np.float32)
    raised = z * (u + v[:, None])
    with np.errstate(invalid="ignore"):
        highest = raised + noise * z
    inside = (z >= near) & (z <= far) & (raised > low) & (highest < high)
    found = kernels.pixels_between(z, u, v, limits)
    np.testing.assert_array_equal(found, np.flatnonzero(inside))
    K = np.array([60.0, 50.0, 34.5, 24.5])
    p_CQ = kernels.back_projected(z, found, K)
    row, column = np.divmod(found, 70)
    np.testing.assert_allclose(p_CQ[:, 0] / p_CQ[:, 2] * K[0] + K[2], column, atol=1e-5)
    np.testing.assert_allclose(p_CQ[:, 1] / p_CQ[:, 2] * K[1] + K[3], row, atol=1e-5)
    np.testing.assert_array_equal(p_CQ[:, 2], z.ravel()[found])


def test_moments_keep_their_precision_far_from_the_origin():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(100, 3)) * [1.0, 1.0, 0.0] + [1e4, -1e4, 5.0]
    moments, plane = np.empty((4, 4)), np.array([0.0, 0.0, 1.0, 5.0])
    first = kernels.band_moments(points, np.full(100, 0.5), plane, 1.0, moments)
    local = np.column_stack([points - points[first], np.ones(100)])
    np.testing.assert_allclose(moments, 4.0 * local.T @ local, rtol=1e-12, atol=1e-12)
    plane[3] = 7.0
    assert kernels.band_moments(points, np.full(100, 0.5), plane, 1.0, moments) == -1


def test_each_kernel_is_compiled_once():
    K, X_WC = np.array([60.0, 60.0, 39.5, 29.5]), np.diag([1.0, -1.0, -1.0, 1.0])
    X_WC[2, 3] = 1.0
    depth = np.ones((60, 80))
    depth[20:40, 20:30], depth[20:40, 32:60] = 0.9, 0.8
    robot = RobotShapes(np.array([0]), np.eye(4)[None], np.full((1, 3), 0.05), np.zeros(1))
    posed = robot.posed(np.eye(4)[None])
    v, u = np.mgrid[:60, :80]
    points = np.stack([(u - K[2]) / K[0] * depth, (v - K[3]) / K[1] * depth, depth], axis=-1)
    known, stamp = ObstacleMemory(), 0.0
    for config in (SegmentationConfig(min_occupancy=1), SegmentationConfig(table_height=0.0)):
        for pose in (X_WC, X_WC.astype(np.float32), None):
            frame = segment_depth(depth, K, pose, config, posed)
            stamp += 0.1
            known = fuse(known, frame, depth, K, stamp, config, posed)
            for pixels in frame.pixels:
                kernels.row_hulls(depth.astype(np.float32), pixels)
            segment_points(points.reshape(-1, 3), pose, config, posed)
    modules = (kernels, voxel_kernels, cluster_kernels, table_kernels, surface_kernels)
    compiled = {
        name: item
        for module in modules
        for name, item in vars(module).items()
        if hasattr(item, "signatures")
    }
    assert len(compiled) > 30
    for name, kernel in compiled.items():
        assert len(kernel.signatures) <= 1, (name, kernel.signatures)
