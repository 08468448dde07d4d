"""Geometry of what the viewer shows."""

import numpy as np
import pytest

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
