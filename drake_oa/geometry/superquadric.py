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
from dataclasses import dataclass, field

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

    center: FloatArray = field(default_factory=lambda: np.zeros(3))
    R: FloatArray = field(default_factory=lambda: np.eye(3))
    semi_axes: FloatArray = field(default_factory=lambda: np.ones(3))
    exponents: FloatArray = field(default_factory=lambda: np.ones(2))


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
    problem = _Problem(
        local,
        middle=0.5 * (local.max(axis=0) + local.min(axis=0)),
        half=np.maximum(0.5 * np.ptp(local, axis=0), LEAST_SEMI_AXIS),
        pull=None if prior is None else math.sqrt(prior * len(cloud)),
    )
    turns = [(0, 1, 2)] if prior is None else [(0, 1, 2), (1, 2, 0), (2, 0, 1)]
    solutions = [problem.solve(turn) for turn in turns]
    _, center, turn_R, semi_axes, powers = min(solutions, key=lambda solution: solution[0])
    return Superquadric(mean + R @ center, R @ turn_R, semi_axes, powers)


_Solution = tuple[float, FloatArray, FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class _Problem:
    """The least-squares problem in the cloud's principal axes.

    Unknowns: centre in half extents, rotation vector, logarithms of the semi-axes
    over the half extents, and the exponents where they are drawn (`pull`).
    """

    points: FloatArray
    middle: FloatArray
    half: FloatArray
    pull: float | None = None

    def solve(self, turn: tuple[int, int, int]) -> _Solution:
        """Solves from the axes in the order of `turn`."""
        half = self.half[list(turn)]
        # Far beyond what a good fit needs, but short of shapes without end.
        least = np.log(np.minimum(LEAST_SEMI_AXIS / half, 0.999))
        lower = np.concatenate([np.full(3, -3.0), np.full(3, -np.inf), least])
        upper = np.concatenate([np.full(3, 3.0), np.full(3, np.inf), np.full(3, np.log(10.0))])
        start = np.zeros(9)
        if self.pull is not None:
            lower = np.concatenate([lower, np.full(2, EXPONENT_RANGE[0])])
            upper = np.concatenate([upper, np.full(2, EXPONENT_RANGE[1])])
            start = np.concatenate([start, [1.0, 1.0]])
        found = least_squares(
            self.residuals,
            start,
            self.jacobian,
            bounds=(lower, upper),
            max_nfev=200,
            kwargs={"turn": turn},
        )
        center, rotation, semi_axes, powers = self._read(found.x, turn)
        return float(found.cost), center, rotation, np.maximum(semi_axes, LEAST_SEMI_AXIS), powers

    @property
    def _drawn(self) -> FloatArray:
        """(2,) weights of the exponents' logarithms; (0,): nothing draws them."""
        if not self.pull:
            return np.zeros(0)
        return np.full(2, self.pull * math.sqrt(float(np.prod(self.half))))

    def residuals(self, x: FloatArray, turn: tuple[int, int, int] = (0, 1, 2)) -> FloatArray:
        """(N,) residuals of the unknowns x, and (2,) of exponents that are drawn to 1."""
        center, rotation, semi_axes, powers = self._read(x, turn)
        log = log_inside_outside((self.points - center) @ rotation, semi_axes, powers)
        found = np.sqrt(np.prod(semi_axes)) * (self._grown(log, powers) - 1.0)
        drawn = self._drawn
        return np.concatenate([found, drawn * np.log(powers[: len(drawn)])])

    def jacobian(self, x: FloatArray, turn: tuple[int, int, int] = (0, 1, 2)) -> FloatArray:
        """(N, 9 or 11) derivatives of the residuals; N + 2 rows where exponents are drawn to 1."""
        center, rotation, semi_axes, powers = self._read(x, turn)
        local = (self.points - center) @ rotation
        log, by_log, by_powers = _log_derivatives(local, semi_axes, powers)
        size, grown = np.sqrt(np.prod(semi_axes)), self._grown(log, powers)
        slope = size * powers[0] * grown
        gradient = np.divide(by_log, local, out=np.zeros_like(local), where=local != 0.0)
        columns = [
            -slope[:, None] * (gradient @ rotation.T) * self.half,
            slope[:, None] * (np.cross(gradient, local) @ _right_jacobian(x[3:6])),
            0.5 * size * (grown - 1.0)[:, None] - slope[:, None] * by_log,
        ]
        if self.pull is not None:
            columns.append(slope[:, None] * by_powers)
            columns[-1][:, 0] += size * grown * np.where(grown > 0.0, log, 0.0)
        found = np.concatenate(columns, axis=1)
        drawn = np.zeros((len(self._drawn), found.shape[1]))
        if len(drawn):
            drawn[[0, 1], [-2, -1]] = self._drawn / powers
        return np.concatenate([found, drawn])

    def _read(
        self, x: FloatArray, turn: tuple[int, int, int]
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Centre, rotation, semi-axes and exponents of the unknowns x."""
        order = list(turn)
        powers = np.ones(2) if self.pull is None else x[9:]
        rotation = Rotation.from_rotvec(x[3:6]).as_matrix()[np.argsort(order)]
        return self.middle + self.half * x[:3], rotation, self.half[order] * np.exp(x[6:9]), powers

    def _grown(self, log: FloatArray, powers: FloatArray) -> FloatArray:
        # The ceiling keeps a trial step far off finite; no solution is near it.
        return np.exp(np.minimum(powers[0] * log, 200.0))


def _log_derivatives(
    p_O: FloatArray, semi_axes: FloatArray, exponents: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """ln F (N,); its derivatives by ln |p_i| (N, 3) and by lambda_4, lambda_5 (N, 2)."""
    l4, l5 = exponents
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = 2.0 / l5 * np.log(np.abs(p_O) / semi_axes)
        across = np.logaddexp(terms[:, 0], terms[:, 1])
        parts = np.stack([across, terms[:, 2]], axis=1) * (l5 / l4)
        log = np.logaddexp(parts[:, 0], parts[:, 1])
        # A share of nothing (on the z axis, at the centre) is zero, not a NaN.
        share = np.nan_to_num(np.exp(parts - log[:, None]))
        inner = np.nan_to_num(np.exp(terms[:, :2] - across[:, None]))
        weighted = np.where(share > 0.0, share * parts, 0.0).sum(axis=1)
        spread = across - np.where(inner > 0.0, inner * terms[:, :2], 0.0).sum(axis=1)
        by_l5 = np.where(share[:, 0] > 0.0, share[:, 0] * spread, 0.0) / l4
    by_log = 2.0 / l4 * np.concatenate([share[:, :1] * inner, share[:, 1:]], axis=1)
    return log, by_log, np.stack([-weighted / l4, by_l5], axis=1)


def _right_jacobian(r: FloatArray) -> FloatArray:
    """J with exp(r + d) = exp(r) exp(J d) to first order in d, for rotation vectors."""
    angle = float(np.linalg.norm(r))
    skew = np.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])
    if angle < 1e-4:
        return np.eye(3) - 0.5 * skew + skew @ skew / 6.0
    return np.asarray(
        np.eye(3)
        - (1.0 - np.cos(angle)) / angle**2 * skew
        + (angle - np.sin(angle)) / angle**3 * skew @ skew
    )
