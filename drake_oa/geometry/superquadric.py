"""Superquadrics and their least-squares fit (Pairet et al. 2019, eq. 10 and 11).

In its own frame a superquadric of semi-axes lambda_1..3 and exponents lambda_4,
lambda_5 is the set F <= 1 of

    F(x, y, z) = ((x/lambda_1)^(2/lambda_5) + (y/lambda_2)^(2/lambda_5))^(lambda_5/lambda_4)
                 + (z/lambda_3)^(2/lambda_4)                               (eq. 10)

with absolute values in the powers' bases: 1 and 1 is an ellipsoid, 0.1 nearly a box,
2 a double cone. F^(lambda_4/2) is homogeneous of degree one: a gauge, like a norm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import FloatArray, Frozen
from drake_oa.geometry.ellipsoid import LEAST_SEMI_AXIS, checked_points, right_handed

EXPONENT_RANGE = (0.1, 2.0)
"""Range of lambda_4 and lambda_5: the convex superquadrics, short of singular ones."""


@dataclass(frozen=True, eq=False)
class Superquadric(Frozen):
    """One superquadric in the world frame.

    Attributes:
        center: (3,) centre p_WO [m].
        R: (3, 3) rotation R_WO; the columns are the axes x, y, z of eq. 10.
        semi_axes: (3,) lambda_1, lambda_2, lambda_3 [m].
        exponents: (2,) lambda_4, lambda_5.
    """

    center: FloatArray
    R: FloatArray
    semi_axes: FloatArray
    exponents: FloatArray


def log_inside_outside(p_O: ArrayLike, semi_axes: ArrayLike, exponents: ArrayLike) -> FloatArray:
    """ln F (eq. 10); finite wherever the point is not the centre, there -inf.

    With lambda_5 = 0.1 a point at 20 semi-axes already has a term of 20^20; sums
    of logarithms neither overflow nor lose the smaller term.

    Args:
        p_O: (..., 3) points in the superquadric's frame [m].
        semi_axes: (3,) lambda_1..3 > 0 [m].
        exponents: (2,) lambda_4, lambda_5 > 0.
    """
    l4, l5 = np.asarray(exponents, dtype=float)
    with np.errstate(divide="ignore"):
        log = np.log(np.abs(np.asarray(p_O, dtype=float)) / np.asarray(semi_axes, dtype=float))
    across = np.logaddexp(2.0 / l5 * log[..., 0], 2.0 / l5 * log[..., 1]) * (l5 / l4)
    return np.asarray(np.logaddexp(across, 2.0 / l4 * log[..., 2]))


def fit_superquadric(points: ArrayLike, *, prior: float | None = None) -> Superquadric:
    """Fits a superquadric to a (dilated) cloud by least squares.

    The print of eq. 11 has no square: its sum is unbounded below, and grows more
    negative with every larger superquadric. Here, after Solina and Bajcsy (1990),

        min  sum_i r_i^2,   r_i = sqrt(lambda_1 lambda_2 lambda_3) (F_i^lambda_4 - 1),

    as F^lambda_4 grows with the square of the distance whatever the exponents.
    Centre, rotation, semi-axes and, where they are free, exponents are sought together
    from the cloud's principal axes; with free exponents once for each choice of
    the z axis, which eq. 10 treats apart.

    Args:
        points: (N, 3) points in W [m].
        prior: how strongly free exponents, of `EXPONENT_RANGE`, are drawn to 1: one unit of their
            logarithm costs as much as a residual of sqrt(prior) times the root of the cloud's
            half extents' product at every point. None: they are 1.

    Raises:
        ValueError: if points are empty, not (N, 3) or not finite.
    """
    cloud = checked_points(points, "points")
    mean = cloud.mean(axis=0)
    _, V = np.linalg.eigh((cloud - mean).T @ (cloud - mean))
    R = right_handed(V[:, ::-1])
    local = (cloud - mean) @ R
    middle = 0.5 * (local.max(axis=0) + local.min(axis=0))
    half = np.maximum(0.5 * np.ptp(local, axis=0), LEAST_SEMI_AXIS)
    pull = math.sqrt((prior or 0.0) * len(cloud) * np.prod(half))

    def shape(
        x: FloatArray, order: list[int]
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Centre, rotation, semi-axes and exponents of the unknowns.

        These are the centre in half extents, a rotation vector, logarithms of the semi-axes over
        the half extents, and free exponents.
        """
        rotation = Rotation.from_rotvec(x[3:6]).as_matrix()[np.argsort(order)]
        exponents = np.ones(2) if prior is None else x[9:]
        return middle + half * x[:3], rotation, half[order] * np.exp(x[6:9]), exponents

    def residuals(x: FloatArray, order: list[int]) -> FloatArray:
        center, rotation, semi_axes, exponents = shape(x, order)
        log = log_inside_outside((local - center) @ rotation, semi_axes, exponents)
        # The ceiling keeps a trial step far off finite; no solution is near it.
        power = np.exp(np.minimum(exponents[0] * log, 200.0))
        found = np.sqrt(np.prod(semi_axes)) * (power - 1.0)
        return np.concatenate([found, pull * np.log(exponents)])

    fits = []
    for turn in ((0, 1, 2), (1, 2, 0), (2, 0, 1))[: 1 if prior is None else 3]:
        order = list(turn)
        least = np.log(np.minimum(LEAST_SEMI_AXIS / half[order], 0.999))
        lower, start = np.concatenate([[-3.0] * 3, [-np.inf] * 3, least]), np.zeros(9)
        # Far beyond what a good fit needs, but short of shapes without end.
        upper = np.repeat([3.0, np.inf, math.log(10.0)], 3)
        if prior is not None:
            lower, upper = (
                np.append(bound, [exponent] * 2)
                for bound, exponent in zip((lower, upper), EXPONENT_RANGE, strict=True)
            )
            start = np.append(start, np.ones(2))
        found = least_squares(residuals, start, bounds=(lower, upper), max_nfev=200, args=(order,))
        fits.append((float(found.cost), shape(found.x, order)))
    _, (center, turn_R, semi_axes, exponents) = min(fits, key=lambda fit: fit[0])
    semi_axes = np.maximum(semi_axes, LEAST_SEMI_AXIS)
    return Superquadric(mean + R @ center, R @ turn_R, semi_axes, exponents)
