"""A step aside, point by point."""

import numpy as np

from drake_oa.stepping_aside import Aside


def test_it_leads_from_point_to_point_and_ends() -> None:
    points = np.arange(9.0).reshape(3, 3)
    aside = Aside().by(points, [1.0, 2.0, 3.0])
    for row in range(3):
        np.testing.assert_array_equal(aside.p_WV, points[row])
        np.testing.assert_array_equal(aside.further, points[row + 1 :])
        np.testing.assert_array_equal(aside.p_WG, [1.0, 2.0, 3.0])
        aside = aside.reached()
    assert (len(aside.p_WV), len(aside.p_WG), len(aside.tree)) == (0, 0, 0)
