"""Where the tool steps aside to, and the way there."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from drake_oa.stepping_aside import points_aside, straight_motion

POINT = arrays(float, 3, elements=st.floats(-1.0, 1.0))


@given(POINT, POINT)
def test_points_are_all_round_the_far_ones_first(p_WE: np.ndarray, p_WO: np.ndarray) -> None:
    points = points_aside(p_WE, p_WO)
    away = np.linalg.norm(points - p_WE, axis=1)
    np.testing.assert_allclose(away, np.repeat([0.2, 0.1], 26))
    assert len(np.unique(points.round(9), axis=0)) == 52


def test_the_first_lead_away_from_the_obstacle_and_up() -> None:
    first = points_aside(np.zeros(3), np.array([0.0, -0.3, 0.0]))[0]
    np.testing.assert_allclose(first, [0.0, 0.2 / np.sqrt(2.0), 0.2 / np.sqrt(2.0)])


@pytest.mark.parametrize("length", [0.0, 0.01, 0.2, 0.21])
def test_the_way_is_straight_and_closely_sampled(length: float) -> None:
    p_WE = np.array([0.4, 0.1, 0.3])
    motion = straight_motion(p_WE, p_WE + [0.0, length, 0.0])
    np.testing.assert_array_equal(motion.p_WE[0], p_WE)
    np.testing.assert_allclose(motion.p_WE[-1], p_WE + [0.0, length, 0.0])
    assert (motion.s[0], motion.s[-1]) == (0.0, 1.0)
    assert np.linalg.norm(np.diff(motion.p_WE, axis=0), axis=1).max() <= 0.025
