"""Geometry of what the viewer shows."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.systems.sensors import CameraInfo
from scipy.spatial.transform import Rotation

from drake_oa.viewing import drawing

seeds = st.integers(0, 2**32 - 1)


def _volume(mesh):
    """Signed volume: positive for a closed surface seen counter-clockwise from outside."""
    a, b, c = (mesh.vertices[:, corner] for corner in mesh.faces)
    return float(np.sum(a * np.cross(b, c, axis=0)) / 6.0)


@given(seeds)
def test_drawn_section_lies_on_the_ellipsoid_and_in_the_plane(seed):
    rng = np.random.default_rng(seed)
    R_WO = Rotation.random(3, random_state=seed).as_matrix()
    semi_axes = rng.uniform(0.02, 0.5, (3, 3))
    normals = rng.normal(size=(3, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    frames = drawing.section_frames(R_WO, semi_axes, normals)
    for i, (R, scale) in enumerate(zip(*frames, strict=True)):
        assert np.linalg.inv(R) == pytest.approx(R.T, abs=1e-9)
        points = (drawing.unit_circle(40) * scale) @ R.T
        in_axes = points @ R_WO[i] / semi_axes[i]
        assert np.sum(in_axes**2, axis=1) == pytest.approx(np.ones(42), abs=1e-9)
        assert points @ normals[i] == pytest.approx(np.zeros(42), abs=1e-9)


@given(seeds)
def test_plane_holds_the_heading_and_the_way_to_the_obstacle(seed):
    rng = np.random.default_rng(seed)
    p_WE, z_W, p_WO = rng.normal(size=3), rng.normal(size=3), rng.normal(size=(4, 3))
    normals = drawing.plane_normals(p_WE, z_W, p_WO, np.tile([0.0, 0.0, 1.0], (4, 1)))
    assert np.linalg.norm(normals, axis=1) == pytest.approx(np.ones(4))
    assert normals @ z_W == pytest.approx(np.zeros(4), abs=1e-9)
    assert np.sum(normals * (p_WO - p_WE), axis=1) == pytest.approx(np.zeros(4), abs=1e-9)


@pytest.mark.parametrize(
    ("z_W", "p_WO"), [([0, 0, 0], [1, 0, 0]), ([1, 0, 0], [2, 0, 0]), ([1, 0, 0], [0, 0, 0])]
)
def test_plane_takes_the_fallback_where_nothing_spans_it(z_W, p_WO):
    fallback = np.array([[0.0, 1.0, 0.0]])
    found = drawing.plane_normals(
        np.zeros(3), np.array(z_W, dtype=float), np.array([p_WO], dtype=float), fallback
    )
    assert np.array_equal(found, fallback)


@given(seeds, st.integers(2, 12))
def test_tube_has_circles_round_the_points_of_its_path(seed, count):
    path = np.random.default_rng(seed).normal(size=(count, 3))
    rings = drawing.tube(np.repeat(path, 2, axis=0), 0.01, sides=7).vertices.T.reshape(-1, 7, 3)
    assert rings[1:-1].mean(axis=1) == pytest.approx(path, abs=1e-9)
    apart = np.linalg.norm(rings[1:-1] - path[:, None], axis=2)
    assert apart == pytest.approx(np.full((count, 7), 0.01))


def test_meshes_have_the_volumes_of_the_solids_and_face_outward():
    for mesh, volume in (
        (drawing.tube([[0, 0, 0], [0, 0, 2]], 0.1, sides=100), np.pi * 0.01 * 2),
        (drawing.tube(drawing.unit_circle(200), 0.05, sides=60), 2 * np.pi**2 * 0.05**2),
        (drawing.unit_sphere(60, 120), 4 / 3 * np.pi),
    ):
        assert _volume(mesh) == pytest.approx(volume, rel=1e-2)


def test_rings_lie_between_their_radii_and_have_the_colors_of_their_costs():
    costs = {"table": np.array([0.0, 1.0, 0.0, 7.0]), "wind": np.array([0.0, 1.0, 0.0, 1.0])}
    mesh, colors = drawing.ring_mesh(costs, np.arange(4) * np.pi / 2)
    assert not mesh.vertices[0].any()
    radii = np.linalg.norm(mesh.vertices, axis=0)
    assert radii.min() == pytest.approx(drawing.INNER_RADIUS)
    assert radii.max() == pytest.approx(drawing.ring_radius(2))
    assert mesh.faces.max() == mesh.vertices.shape[1] - 1
    green, red = (np.array(drawing.COST_COLORS[k]) ** 2.2 for k in (0, 2))
    assert pytest.approx(np.repeat([green, red] * 4, 6, axis=0)) == colors.T


def test_frustum_corners_project_to_the_image_corners():
    camera = CameraInfo(640, 480, 500.0, 510.0, 320.0, 240.0)
    edges = drawing.frustum_edges(camera, 0.8, 3.5)
    assert edges.shape == (12, 2, 3)
    far = edges[:4, 1]
    assert far[:, 2] == pytest.approx(np.full(4, 1.1))
    pixels = far[:, :2] / far[:, 2:] * (500.0, 510.0) + (320.0, 240.0)
    assert pixels == pytest.approx(np.array([[0, 0], [640, 0], [640, 480], [0, 480]]))
    assert edges[4:8, :, 2] == pytest.approx(np.full((4, 2), 0.8))


@given(seeds, st.integers(0, 3000), st.integers(1, 500))
def test_thinned_cloud_is_small_and_has_one_point_a_cube(seed, count, most):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (count, 3))
    chosen = drawing.thin_points(points, most=most, spacing=0.1)
    assert chosen.size <= most
    assert np.all(np.diff(chosen) > 0)
    cubes = np.floor(points[chosen] / 0.1)
    assert len(np.unique(cubes, axis=0)) == chosen.size


def test_baseline_points_stop_at_start_and_goal():
    p_WS, p_WG = np.array([0.0, -1.0, 0.0]), np.array([0.0, 1.0, 0.0])
    R_WL = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    p_WO = np.array([[0.3, 0.5, 0.2], [0.0, 9.0, 0.0], [0.0, -9.0, 1.0]])
    found = drawing.baseline_points(p_WS, p_WG, R_WL, p_WO)
    assert found == pytest.approx(np.array([[0.0, 0.5, 0.0], p_WG, p_WS]))


def test_obstacles_keep_their_places():
    slots = drawing.assign_slots((-1, -1, -1), [4, 7])
    assert slots == (4, 7, -1)
    assert drawing.assign_slots(slots, [7, 9]) == (9, 7, -1)
    assert drawing.assign_slots(slots, [1, 2, 3, 7]) == (1, 7, 2)
    assert drawing.assign_slots(slots, []) == (-1, -1, -1)
