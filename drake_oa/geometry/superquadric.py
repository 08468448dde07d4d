"""Least-squares fit of a superquadric to a point cloud, by (10) and (11) of Pairet et al., RA-L
2019, with exponents of 1.

With exponents of 1, as in section IV-B of the paper, a superquadric with semi-axes lambda_1..3 is
an ellipsoid. In its own frame it is F <= 1, with

    F(x, y, z) = (x/lambda_1)^2 + (y/lambda_2)^2 + (z/lambda_3)^2               (eq. 10)
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.ellipsoid import LEAST_SEMI_AXIS, checked_points, right_handed


def fit_superquadric(points: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Fits a superquadric with exponents of 1, which is an ellipsoid, to a point cloud by least
    squares.

    With F_i = |diag(1/lambda) R^T (p_i - p)|^2 for point p_i, center p, rotation R and semi-axes
    lambda, the fit solves

        min  sum_i r_i^2,   r_i = sqrt(lambda_1 lambda_2 lambda_3) (F_i - 1)

    after Solina and Bajcsy (1990). In (11) of Pairet et al., RA-L 2019, the residuals are not
    squared. The sum of these residuals has no lower bound: it decreases as the superquadric grows.
    Center, rotation and semi-axes are optimized together, starting at the cloud's principal axes.

    Args:
        points: (N, 3) points in W [m].

    Returns:
        Center (3,) in W [m], rotation (3, 3) whose columns are the principal axes in W, and
        semi-axes (3,) along them [m].

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

    def shape(x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Computes center, rotation and semi-axes of the superquadric, in the frame of the cloud's
        principal axes.

        Args:
            x: (9,) optimization variables: displacement of the center in half extents of the cloud,
                rotation vector [rad], and logarithms of the semi-axes over the half extents.
        """
        turn = np.asarray(Rotation.from_rotvec(x[3:6]).as_matrix())
        return middle + half * x[:3], turn, half * np.exp(x[6:])

    def residuals(x: FloatArray) -> FloatArray:
        """Computes the least-squares residuals r_i (N,) of all points for the optimization
        variables x (9,).
        """
        center, turn, semi_axes = shape(x)
        F = (((local - center) @ turn / semi_axes) ** 2).sum(axis=1)
        return np.asarray(np.sqrt(np.prod(semi_axes)) * (F - 1.0))

    least = np.log(np.minimum(LEAST_SEMI_AXIS / half, 0.999))
    lower = np.concatenate([[-3.0] * 3, [-np.inf] * 3, least])
    # Bounds far beyond every good fit that exclude unbounded shapes.
    upper = np.repeat([3.0, np.inf, math.log(10.0)], 3)
    result = least_squares(residuals, np.zeros(9), bounds=(lower, upper), max_nfev=200)
    center, turn, semi_axes = shape(result.x)
    return mean + R @ center, R @ turn, np.maximum(semi_axes, LEAST_SEMI_AXIS)
