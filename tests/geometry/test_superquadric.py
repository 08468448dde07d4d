"""Superquadrics: eq. 10 and the least-squares fit."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drake_oa.geometry.ellipsoid import unit_directions
from drake_oa.geometry.superquadric import (
    Superquadric,
    fit_superquadric,
    log_inside_outside,
)

exponent = st.floats(0.1, 2.0)
semi_axis = st.floats(0.02, 0.5)
seed = st.integers(0, 10**6)


def inside_outside(shape, p):
    """F (eq. 10): below 1 inside, 1 on the surface; inf where it is no double any more."""
    with np.errstate(over="ignore"):
        local = (p - shape.center) @ shape.R
        return np.exp(log_inside_outside(local, shape.semi_axes, shape.exponents))


def surface_points(shape):
    """(162, 3) points of the surface, one along each stretched direction."""
    rays = unit_directions() * shape.semi_axes
    log = log_inside_outside(rays, shape.semi_axes, shape.exponents)
    local = rays * np.exp(-0.5 * shape.exponents[0] * log)[:, None]
    return shape.center + local @ shape.R.T


def superquadric(seed: int, semi_axes: tuple, exponents: tuple) -> Superquadric:
    rng = np.random.default_rng(seed)
    return Superquadric(
        rng.uniform(-1.0, 1.0, 3),
        Rotation.random(rng=rng).as_matrix(),
        np.array(semi_axes),
        np.array(exponents),
    )


@given(seed, st.tuples(semi_axis, semi_axis, semi_axis), st.tuples(exponent, exponent))
def test_surface_points_have_f_one(seed, semi_axes, exponents):
    shape = superquadric(seed, semi_axes, exponents)
    points = surface_points(shape)
    np.testing.assert_allclose(inside_outside(shape, points), 1.0, atol=1e-9)


def test_points_on_the_axes_and_at_the_centre_are_no_special_case():
    axes = np.array([0.1, 0.2, 0.3])
    for exponents in ([0.1, 2.0], [2.0, 0.1], [1.0, 1.0]):
        shape = Superquadric(np.zeros(3), np.eye(3), axes, np.array(exponents))
        with np.errstate(all="raise"):
            values = inside_outside(shape, np.vstack([np.diag(axes), np.zeros(3)]))
        np.testing.assert_allclose(values, [1.0, 1.0, 1.0, 0.0], atol=1e-12)


@settings(max_examples=10)
@given(seed, st.tuples(semi_axis, semi_axis, semi_axis))
def test_fit_recovers_an_ellipsoid(seed, semi_axes):
    shape = superquadric(seed, semi_axes, (1.0, 1.0))
    fit = fit_superquadric(surface_points(shape))
    np.testing.assert_allclose(np.sort(fit.semi_axes), np.sort(semi_axes), rtol=1e-4)
    np.testing.assert_allclose(fit.center, shape.center, atol=1e-5)
    assert np.linalg.det(fit.R) == pytest.approx(1.0)


@pytest.mark.parametrize("exponents", [(0.3, 1.2), (1.0, 0.2), (1.5, 0.7)])
def test_fit_recovers_free_exponents(exponents):
    shape = superquadric(7, (0.1, 0.2, 0.15), exponents)
    fit = fit_superquadric(surface_points(shape), prior=0.0)
    np.testing.assert_allclose(inside_outside(fit, surface_points(shape)), 1.0, atol=1e-5)


def test_a_prior_draws_the_exponents_to_one():
    points = surface_points(superquadric(7, (0.1, 0.2, 0.15), (0.3, 0.4)))
    fits = [fit_superquadric(points, prior=prior).exponents for prior in (0.0, 1e-2, 1.0, 1e4)]
    off = np.abs(np.log(fits)).max(axis=1)
    assert (np.diff(off) < 0.0).all()
    np.testing.assert_allclose(fits[0], [0.3, 0.4], atol=1e-4)
    np.testing.assert_allclose(fits[-1], 1.0, atol=1e-2)


@pytest.mark.parametrize("prior", [None, 0.0])
@pytest.mark.parametrize("rank", [0, 1, 2])
def test_thin_clouds_have_a_finite_fit(prior, rank):
    points = np.random.default_rng(8).uniform(-0.1, 0.1, (30, 3)) * (np.arange(3) < rank)
    fit = fit_superquadric(points + 0.4, prior=prior)
    assert np.isfinite(fit.semi_axes).all()
    assert (fit.semi_axes >= 1e-3).all()
