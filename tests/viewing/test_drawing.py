"""Geometry of what the viewer shows."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.systems.sensors import CameraInfo
from scipy.spatial.transform import Rotation

from drake_oa.viewing import drawing

seeds = st.integers(0, 2**32 - 1)


@given(seeds)
def test_drawn_section_lies_on_the_ellipsoid_and_in_the_plane(seed):
    rng = np.random.default_rng(seed)
    R_WO = Rotation.random(3, random_state=seed).as_matrix()
    semi_axes = rng.uniform(0.02, 0.5, (3, 3))
    normals = rng.normal(size=(3, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    planes = np.linalg.svd(normals[:, None])[2][:, 1:]
    frames = drawing.section_frames(R_WO, semi_axes, planes)
    angles = np.linspace(0.0, 2.0 * np.pi, 42)
    circle = np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    for i, (R, scale) in enumerate(zip(*frames, strict=True)):
        assert np.linalg.inv(R) == pytest.approx(R.T, abs=1e-9)
        points = (circle * scale) @ R.T
        in_axes = points @ R_WO[i] / semi_axes[i]
        assert np.sum(in_axes**2, axis=1) == pytest.approx(np.ones(42), abs=1e-9)
        assert points @ normals[i] == pytest.approx(np.zeros(42), abs=1e-9)


def test_rings_lie_between_their_radii_and_have_the_colors_of_their_costs():
    costs = {"table": np.array([0.0, 1.0, 0.0, 7.0]), "wind": np.array([0.0, 1.0, 0.0, 1.0])}
    vertices, faces, colors = drawing.ring_mesh(costs, np.arange(4) * np.pi / 2)
    assert not vertices[0].any()
    radii = np.linalg.norm(vertices, axis=0)
    assert radii.min() == pytest.approx(drawing.INNER_RADIUS)
    assert radii.max() == pytest.approx(drawing.ring_radius(2))
    assert faces.max() == vertices.shape[1] - 1
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


def test_obstacles_keep_their_places():
    slots = drawing.assign_slots((-1, -1, -1), [4, 7])
    assert slots == (4, 7, -1)
    assert drawing.assign_slots(slots, [7, 9]) == (9, 7, -1)
    assert drawing.assign_slots(slots, [1, 2, 3, 7]) == (1, 7, 2)
    assert drawing.assign_slots(slots, []) == (-1, -1, -1)
