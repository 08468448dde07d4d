"""Tests of distance fields of clouds, and of the fill of occluded space."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from drake_oa.common.messages import TablePlane
from drake_oa.geometry.collision_scene import cloud_geometry, geometries_of, geometry_distance
from drake_oa.geometry.distance_field import field_of

RNG = np.random.default_rng(2)


def surface(size, center, spacing=0.005):
    """Returns points (N, 3) on all faces of a box [m], and their outward normals (N, 3)."""
    half, points, normals = np.array(size) / 2.0, [], []
    for axis in range(3):
        lines = [np.linspace(-h, h, round(2.0 * h / spacing) + 1) for h in np.delete(half, axis)]
        flat = np.stack(np.meshgrid(*lines), -1).reshape(-1, 2)
        for sign in (-1.0, 1.0):
            points.append(np.insert(flat, axis, sign * half[axis], axis=1))
            normals.append(np.tile(sign * np.eye(3)[axis], (len(flat), 1)))
    return np.concatenate(points) + center, np.concatenate(normals)


def distances(field, points):
    """Computes the distances of points to a field, as in a collision scene [m]."""
    scene = geometries_of([cloud_geometry(field)])
    return np.array([geometry_distance(scene, 0, *p, 0.0) for p in points])


def around(points, past, count=1500):
    """Returns random points within a distance of the bounding box of points [m]."""
    return RNG.uniform(points.min(axis=0) - past, points.max(axis=0) + past, (count, 3))


@pytest.mark.parametrize("count", [1, 8, 300, 4000])
def test_distances_are_within_a_voxel_of_those_to_the_points(count):
    cloud = RNG.uniform(-1.0, 1.0, (count, 3)) * [0.05, 0.1, 0.15] + [0.5, 0.0, 0.3]
    field = field_of(cloud)
    # Outside and among the points, inside the grid and beyond it.
    for past in (0.0, 0.2):
        points = around(cloud, past)
        error = (distances(field, points) - cKDTree(cloud).query(points)[0]) / field.voxel
        assert error.max() <= 1.0
        outside = ((points < cloud.min(axis=0)) | (points > cloud.max(axis=0))).any(axis=1)
        assert error[outside].min(initial=0.0) >= -1.0
        # The distance has a crease between two points.
        assert (error[~outside].min(initial=0.0) >= -2.0) or count == 4000
    points = around(cloud, 1.0)
    exact = cKDTree(cloud).query(points)[0]
    beyond = distances(field, points)
    assert (beyond <= exact + field.voxel).all()
    assert np.isnan(distances(field, [[np.nan] * 3])[0])
    # Beyond the grid, the distance is at least that to the box of the cloud.
    assert (beyond >= 0.75 * exact - field.voxel).all()


VIEWS = [[-0.5, 0.1, 0.9], [1.2, 0.9, 0.5], [0.4, 1.5, 1.0], [0.5, 0.12, 1.5], [1.5, 0.1, 0.1]]


@pytest.mark.parametrize("viewpoint", VIEWS)
@pytest.mark.parametrize("size", [[0.08, 0.12, 0.2], [0.08, 0.08, 0.3]])
@pytest.mark.parametrize("spacing", [0.004, 0.01])
def test_the_self_occluded_space_of_a_box_is_filled_and_little_more(viewpoint, size, spacing):
    table, viewpoint = TablePlane(offset=0.0), np.array(viewpoint)
    center, half = np.array([0.5, 0.1, size[2] / 2.0]), np.array(size) / 2.0
    away = (center - viewpoint)[:2] / np.linalg.norm((center - viewpoint)[:2])
    # Depth of the box along the view.
    deep = 2.0 * float(np.abs(away) @ half[:2])
    cloud, normals = surface(size, center, spacing)
    cloud = cloud[np.einsum("ij,ij->i", viewpoint - cloud, normals) > 0.0]
    field = field_of(cloud, viewpoints_W=[viewpoint], table=table, deepest=deep)
    inside = center + RNG.uniform(-1.0, 1.0, (800, 3)) * half
    assert distances(field, inside).max() <= field.voxel
    # Outside the box only space behind it is filled, up to the assumed depth.
    outside = center + RNG.uniform(-1.0, 1.0, (800, 3)) * (half + 0.15)
    exact = np.linalg.norm(np.maximum(np.abs(outside - center) - half, 0.0), axis=1)
    error = distances(field, outside) - exact
    assert error.max() <= field.voxel
    assert error.min() >= -deep - field.voxel
    before = (outside - center)[:, :2] @ away < -deep / 2.0
    assert error[before | (outside[:, 2] > size[2] + 0.02)].min() >= -2.0 * field.voxel


def test_without_a_viewpoint_nothing_is_filled():
    cloud, _ = surface([0.1, 0.1, 0.1], np.zeros(3), 0.01)
    assert distances(field_of(cloud), [[0.0, 0.0, 0.0]]) > 0.03
    filled = field_of(cloud, viewpoints_W=np.array([1.0, 0.0, 0.5]))
    assert distances(filled, [[0.0, 0.0, 0.0]]) < -0.02
    # For a viewpoint inside the cloud nothing is filled.
    within = field_of(cloud, viewpoints_W=np.zeros(3))
    assert np.array_equal(within.values, field_of(cloud).values)


def test_a_large_cloud_gets_coarser_voxels():
    cloud = RNG.uniform(-1.0, 1.0, (500_000, 3)) * [2.0, 2.0, 1.0]
    field = field_of(cloud)
    assert field.values.size <= 1 << 20
    assert 0.03 < field.voxel < 0.06
    # Voxels larger than the margin, and a cloud on a line.
    for large in (1000.0 * cloud[:100], cloud[:100] * [4000.0, 0.0, 0.0]):
        coarse = field_of(large)
        exact = cKDTree(large).query(large + 0.5)[0]
        assert (distances(coarse, large + 0.5) <= exact + 0.01).all()
    points = around(cloud, 0.3, 300)
    exact = cKDTree(cloud).query(points)[0]
    result = distances(field, points)
    assert (result <= exact + 0.01).all()
    assert (result >= exact - 3.0 * field.voxel).all()
