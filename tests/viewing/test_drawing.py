"""Geometry of what the viewer shows."""

import numpy as np
import pytest
from pydrake.systems.sensors import CameraInfo

from drake_oa.viewing import drawing


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
    edges = drawing.frustum_edges(CameraInfo(640, 480, 500.0, 510.0, 320.0, 240.0), 0.8, 3.5)
    far = edges[:4, 1]
    assert far[:, 2] == pytest.approx(np.full(4, 1.1))
    pixels = far[:, :2] / far[:, 2:] * (500.0, 510.0) + (320.0, 240.0)
    assert pixels == pytest.approx(np.array([[0, 0], [640, 0], [640, 480], [0, 480]]))
    assert edges[4:8, :, 2] == pytest.approx(np.full((4, 2), 0.8))
