"""Geometry of what the viewer shows."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drake_oa.viewing import drawing

seeds = st.integers(0, 2**32 - 1)


def _direction(rng):
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def _obstacles(rng, count):
    return (
        rng.uniform(-1.0, 1.0, (count, 3)),
        Rotation.random(count, random_state=int(rng.integers(2**31))).as_matrix(),
        rng.uniform(0.02, 0.5, (count, 3)),
    )


def _volume(mesh):
    """Signed volume: positive for a closed surface seen counter-clockwise from outside."""
    a, b, c = (mesh.vertices[:, corner] for corner in mesh.faces)
    return float(np.sum(a * np.cross(b, c, axis=0)) / 6.0)


def _is_closed(mesh):
    """Whether each edge is run through once in either direction."""
    f = mesh.faces
    edges = np.concatenate([f[[0, 1]], f[[1, 2]], f[[2, 0]]], axis=1).T.tolist()
    forth = {tuple(e) for e in edges}
    return len(forth) == len(edges) and all((b, a) in forth for a, b in forth)


@settings(deadline=None, max_examples=50)
@given(seeds)
def test_drawn_section_lies_on_the_ellipsoid_and_in_the_plane(seed):
    rng = np.random.default_rng(seed)
    p_WO, R_WO, semi_axes = _obstacles(rng, 3)
    normals = np.array([_direction(rng) for _ in range(3)])
    for i, X in enumerate(drawing.section_transform(p_WO, R_WO, semi_axes, normals)):
        points = drawing.unit_circle(40) @ X[:3, :3].T + X[:3, 3]
        in_axes = (points - p_WO[i]) @ R_WO[i] / semi_axes[i]
        assert np.sum(in_axes**2, axis=1) == pytest.approx(np.ones(40), abs=1e-9)
        assert (points - p_WO[i]) @ normals[i] == pytest.approx(np.zeros(40), abs=1e-9)


@settings(deadline=None, max_examples=50)
@given(seeds)
def test_section_transform_splits_into_a_rotation_and_scales(seed):
    rng = np.random.default_rng(seed)
    X = drawing.section_transform(*_obstacles(rng, 1), _direction(rng)[None])[0]
    R, p, scale = drawing.split_transform(X)
    assert pytest.approx(np.eye(3), abs=1e-9) == R.T @ R
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert np.all(scale > 0.0)
    assert R * scale == pytest.approx(X[:3, :3])
    assert np.array_equal(p, X[:3, 3])


def test_section_of_an_axis_aligned_ellipsoid_has_its_semi_axes():
    X = drawing.section_transform(
        np.zeros((1, 3)), np.eye(3)[None], [[0.1, 0.2, 0.3]], [[0.0, 0.0, 1.0]]
    )
    assert sorted(drawing.split_transform(X[0])[2][:2]) == pytest.approx([0.1, 0.2])


def test_no_obstacle_has_no_section():
    none = np.zeros((0, 3))
    assert drawing.section_transform(none, np.zeros((0, 3, 3)), none, none).shape == (0, 4, 4)


@settings(deadline=None, max_examples=50)
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


@settings(deadline=None, max_examples=50)
@given(seeds, st.integers(2, 12), st.booleans())
def test_tube_is_a_closed_surface_round_its_path(seed, count, closed):
    rng = np.random.default_rng(seed)
    path = rng.normal(size=(max(count, 3), 3))
    mesh = drawing.tube(path, 0.01, sides=7, closed=closed)
    assert _is_closed(mesh)
    rings = mesh.vertices.T.reshape(len(path), 7, 3)
    assert rings.mean(axis=1) == pytest.approx(path, abs=1e-9)
    assert np.linalg.norm(rings - path[:, None], axis=2) == pytest.approx(
        np.full((len(path), 7), 0.01)
    )


@pytest.mark.parametrize(
    "mesh",
    [
        drawing.tube([[0, 0, 0], [0, 0, 0], [0, 0, 1]], 0.1, sides=60),
        drawing.tube(drawing.unit_circle(), 0.05, sides=30, closed=True),
        drawing.unit_sphere(),
    ],
)
def test_meshes_are_closed_and_face_outward(mesh):
    assert _is_closed(mesh)
    assert _volume(mesh) > 0.0


def test_volumes_are_those_of_the_solids():
    straight = drawing.tube([[0, 0, 0], [0, 0, 2]], 0.1, sides=100)
    assert _volume(straight) == pytest.approx(np.pi * 0.01 * 2, rel=1e-2)
    torus = drawing.tube(drawing.unit_circle(200), 0.05, sides=60, closed=True)
    assert _volume(torus) == pytest.approx(2 * np.pi**2 * 0.05**2, rel=1e-2)
    assert _volume(drawing.unit_sphere(60, 120)) == pytest.approx(4 / 3 * np.pi, rel=1e-2)


def test_tube_survives_a_path_that_turns_right_back():
    mesh = drawing.tube([[0, 0, 0], [1, 0, 0], [0.5, 0, 0]], 0.01)
    assert np.isfinite(mesh.vertices).all()


@pytest.mark.parametrize("path", [[[0, 0, 0]], [[1, 2, 3], [1, 2, 3]], np.zeros((0, 3))])
def test_tube_of_a_point_is_refused(path):
    with pytest.raises(ValueError, match="different points"):
        drawing.tube(path, 0.01)


def test_tube_of_a_wrong_shape_is_refused():
    with pytest.raises(ValueError, match=r"\(T, 3\)"):
        drawing.tube(np.zeros((4, 2)), 0.01)


@settings(deadline=None, max_examples=50)
@given(seeds)
def test_frame_is_a_rotation_with_the_given_x_axis(seed):
    d = _direction(np.random.default_rng(seed))
    R = drawing.orthonormal_frame(3.0 * d)
    assert R[:, 0] == pytest.approx(d)
    assert pytest.approx(np.eye(3), abs=1e-12) == R.T @ R
    assert np.linalg.det(R) == pytest.approx(1.0)


@pytest.mark.parametrize("axis", [[0, 0, 0], [np.nan, 0, 1], [np.inf, 0, 0]])
def test_frame_of_no_direction_is_refused(axis):
    with pytest.raises(ValueError, match="x_axis"):
        drawing.orthonormal_frame(axis)


def test_rings_lie_in_the_yz_plane_between_their_radii():
    costs = {"table": np.zeros(36), "length": np.linspace(0, 1, 36), "workspace": np.ones(36)}
    sizes = {"inner_radius": 0.1, "band": 0.02, "gap": 0.005}
    mesh = drawing.ring_mesh(costs, np.arange(36) * np.pi / 18, **sizes)
    assert not mesh.vertices[0].any()
    radii = np.linalg.norm(mesh.vertices, axis=0)
    assert radii.min() == pytest.approx(0.1)
    assert radii.max() == pytest.approx(drawing.ring_radius(3, **sizes))
    assert mesh.faces.max() == mesh.vertices.shape[1] - 1


def test_low_cost_is_green_and_high_cost_red_on_each_ring():
    costs = {"table": np.array([0.0, 1.0, 0.0, 7.0]), "wind": np.array([0.0, 1.0, 0.0, 1.0])}
    colors = drawing.ring_mesh(costs, np.arange(4) * np.pi / 2).colors.T.reshape(8, 6, 3)
    green, red = (np.array(drawing.COST_COLORS[k]) ** 2.2 for k in (0, 2))
    assert green[1] > 2.0 * green[0]
    assert red[0] > 2.0 * red[1]
    for sector, expected in zip(colors, [green, red] * 4, strict=True):
        assert sector == pytest.approx(np.tile(expected, (6, 1)))


def test_no_rings_are_an_empty_mesh():
    assert drawing.ring_mesh({}, np.zeros(0)).vertices.shape == (3, 0)
    assert drawing.ring_radius(0, inner_radius=0.1, band=0.02, gap=0.005) == 0.1


def test_ring_of_a_wrong_length_is_refused():
    with pytest.raises(ValueError, match="ring 'table'"):
        drawing.ring_mesh({"table": [0.0, 1.0]}, [0.0, 1.0, 2.0])


def test_frustum_corners_project_to_the_image_corners():
    edges = drawing.frustum_edges((500.0, 510.0), (320.0, 240.0), (640, 480), (0.8, 3.5))
    assert edges.shape == (12, 2, 3)
    far = edges[:4, 1]
    assert far[:, 2] == pytest.approx(np.full(4, 3.5))
    pixels = far[:, :2] / far[:, 2:] * (500.0, 510.0) + (320.0, 240.0)
    assert pixels == pytest.approx(np.array([[0, 0], [640, 0], [640, 480], [0, 480]]))
    assert edges[4:8, :, 2] == pytest.approx(np.full((4, 2), 0.8))


def test_frustum_of_a_wrong_range_is_refused():
    with pytest.raises(ValueError, match="depth_range"):
        drawing.frustum_edges((500.0, 500.0), (320.0, 240.0), (640, 480), (2.0, 1.0))


@settings(deadline=None, max_examples=50)
@given(seeds, st.integers(0, 3000), st.integers(1, 500))
def test_thinned_cloud_is_finite_small_and_one_a_cube(seed, count, most):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (count, 3))
    points[rng.random(count) < 0.1] = np.nan
    points[rng.random(count) < 0.1] = np.inf
    chosen = drawing.thin_points(points, most=most, spacing=0.1)
    assert chosen.size <= most
    assert np.isfinite(points[chosen]).all()
    assert np.all(np.diff(chosen) > 0)
    cubes = np.floor(points[chosen] / 0.1)
    assert len(np.unique(cubes, axis=0)) == chosen.size


def test_thinning_asks_for_positive_limits():
    with pytest.raises(ValueError, match="positive"):
        drawing.thin_points(np.zeros((1, 3)), most=0, spacing=0.1)


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
