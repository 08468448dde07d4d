"""The annulus about a vertical axis, and the sector of it."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drake_oa.geometry.annulus import ANYWHERE, Annulus, annulus_margin, sector_margin

ANNULUS = Annulus(np.array([[0.0, 0.4, 0.8], [0.2, 0.3, 0.1], [0.7, 0.8, 0.5]]))
MOST = 2.9


@given(st.tuples(*[st.floats(-1.5, 1.5)] * 3))
def test_it_stands_at_its_axis(point: tuple[float, ...]) -> None:
    p, shift = np.array(point), np.array([0.3, -0.2, 0.5])
    there = Annulus(ANNULUS.radii + [[shift[2]], [0.0], [0.0]], (shift[0], shift[1]))
    here = annulus_margin(p, ANNULUS)
    assert annulus_margin(p + shift, there) == pytest.approx(here, abs=1e-12)


def test_the_margin_is_a_distance_across_the_annulus() -> None:
    p = np.array([[0.4, 0, 0.4], [0.7, 0, 0.4], [0.2, 0, 0.4], [0.9, 0, 0.4], [0.35, 0, 0.2]])
    np.testing.assert_allclose(sector_margin(p, ANNULUS, MOST), [0.1, 0.1, -0.1, -0.1, 0.1])
    assert annulus_margin(p[0], ANYWHERE) == math.inf


def test_behind_the_base_above_and_below_are_outside() -> None:
    outside = np.array([[-0.5, 0.0, 0.3], [0.3, 0.0, 0.9], [0.5, 0.0, -0.1], [0.0, 0.0, 0.3]])
    assert np.all(sector_margin(outside, ANNULUS, MOST) < 0.0)


def test_points_that_are_not_finite_or_not_points() -> None:
    assert np.isnan(sector_margin(np.array([np.nan, 0.0, 0.3]), ANNULUS, MOST))
    assert sector_margin(np.zeros((0, 3)), ANNULUS, MOST).shape == (0,)
