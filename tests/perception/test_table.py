import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_oa.perception.table import band_moments, fit_plane

UP = np.array([0.0, 0.0, 1.0])


def patch(rng, normal, offset, count, size=1.0, noise=0.0):
    """Random points of a plane within a square, with noise along its normal."""
    first = np.cross(normal, [0.3, 0.9, 0.1])
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    a, b = rng.uniform(-size, size, (2, count))
    height = offset + noise * rng.normal(size=count)
    return a[:, None] * first + b[:, None] * second + height[:, None] * normal


def fit(points, **options):
    options = {"max_tilt": np.deg2rad(10.0)} | options
    return fit_plane(points, UP, options.pop("max_tilt"), np.full(len(points), 0.01), **options)


@settings(max_examples=30, deadline=None)
@given(
    tilt=st.floats(0.0, 0.15),
    azimuth=st.floats(0.0, 6.28),
    offset=st.floats(-2.0, 2.0),
    seed=st.integers(0, 99),
)
def test_a_plane_in_clutter_is_recovered(tilt, azimuth, offset, seed):
    rng = np.random.default_rng(seed)
    normal = np.array(
        [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)]
    )
    clutter = rng.uniform(-1.5, 1.5, (1500, 3)) + offset * normal
    plane = fit(np.concatenate([patch(rng, normal, offset, 2000, noise=0.002), clutter]))
    assert plane is not None
    assert np.arccos(min(1.0, plane.normal @ normal)) < 2e-3
    assert abs(plane.offset - offset) < 2e-3
    assert plane.rms < 5e-3


def test_the_normal_points_up_and_inliers_are_marked():
    rng = np.random.default_rng(0)
    points = np.concatenate([patch(rng, UP, 0.3, 500), patch(rng, UP, 0.6, 100)])
    assert fit(points, height=0.1) is None
    plane = fit(points)
    assert plane.normal[2] > 0.0
    np.testing.assert_array_equal(np.flatnonzero(plane.inliers), np.arange(500))


def test_without_a_plane_there_is_none():
    rng = np.random.default_rng(0)
    assert fit(patch(rng, np.array([1.0, 0.0, 0.0]), 1.0, 1000)) is None
    assert fit(np.zeros((0, 3))) is None
    assert fit(np.zeros((100, 3))) is None
    assert fit(np.linspace(0, 1, 300)[:, None] * [1.0, 0.0, 0.0]) is None


def seen_from_above(rng, levels):
    """Points of horizontal squares (height, half size, count) below the origin."""
    parts = []
    for height, half, count in levels:
        xy = rng.uniform(-half, half, (count, 2))
        parts.append(np.column_stack([xy, rng.normal(height, 0.002, count)]))
    return np.concatenate(parts)


@pytest.mark.parametrize(
    ("levels", "options", "offset"),
    [
        # A small table over the floor, a box on the floor, and the top of a large box on a table.
        ([(-1.5, 1.5, 6000), (-0.8, 0.3, 2500)], {"origin_above": True}, -0.8),
        ([(-1.5, 1.5, 4000), (-1.2, 0.3, 1500)], {"origin_above": True}, -1.5),
        ([(-1.0, 0.6, 2500), (-0.75, 0.25, 5000)], {"origin_above": True}, -1.0),
        ([(-1.0, 0.6, 2500), (-0.75, 0.25, 5000)], {"height": -0.75}, -0.75),
    ],
)
def test_the_table_is_chosen_among_parallel_planes(levels, options, offset):
    points = seen_from_above(np.random.default_rng(0), levels)
    assert abs(fit(points, **options).offset - offset) < 2e-3


def test_an_expected_plane_is_refined_to_the_one_that_a_search_finds():
    rng = np.random.default_rng(0)
    tilted = np.array([0.002, -0.003, 1.0]) / np.linalg.norm([0.002, -0.003, 1.0])
    table = patch(rng, tilted, -1.0, 8000, 0.5, noise=0.001)
    box = np.column_stack([rng.uniform(-0.1, 0.1, (500, 2)), rng.uniform(-1.0, -0.8, 500)])
    points = np.concatenate([table, box])
    # From 3 cm off a search is needed.
    for height in (-1.0, -1.03):
        plane = fit(points, height=height)
        assert plane.normal @ tilted > np.cos(1e-3)
        assert abs(plane.offset + 1.0) < 3e-4


def test_moments_keep_their_precision_far_from_the_origin():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(100, 3)) * [1.0, 1.0, 0.0] + [1e4, -1e4, 5.0]
    moments, plane = np.empty((4, 4)), np.array([0.0, 0.0, 1.0, 5.0])
    first = band_moments(points, np.full(100, 0.5), plane, 1.0, moments)
    local = np.column_stack([points - points[first], np.ones(100)])
    np.testing.assert_allclose(moments, 4.0 * local.T @ local, rtol=1e-12, atol=1e-12)
    plane[3] = 7.0
    assert band_moments(points, np.full(100, 0.5), plane, 1.0, moments) == -1
