"""A step aside, point by point."""

import numpy as np

from drake_oa.posture.stepping_aside import Aside
from drake_oa.posture.waypoint_tree import LegTree


def test_it_leads_from_point_to_point_and_ends() -> None:
    points = np.arange(9.0).reshape(3, 3)
    aside = Aside().by(points, [1.0, 2.0, 3.0])
    for row in range(3):
        np.testing.assert_array_equal(aside.p_WV, points[row])
        np.testing.assert_array_equal(aside.further, points[row + 1 :])
        np.testing.assert_array_equal(aside.p_WG, [1.0, 2.0, 3.0])
        aside = aside.reached()
    assert (len(aside.p_WV), len(aside.p_WG)) == (0, 0)


def test_given_up_what_has_been_tried_is_kept() -> None:
    tree = LegTree.at(np.zeros(3), np.zeros(7), np.ones(3), np.ones(3))
    aside = Aside(tree=tree).by(np.ones((2, 3)), np.ones(3)).given_up()
    assert (len(aside.p_WV), len(aside.further), len(aside.p_WG)) == (0, 0, 0)
    assert aside.tree is tree
