"""Candidates of the search for a motion: their genes, and how a round of the search varies them.

A candidate is one avoidance term (eq. 8) that acts about a point on or beside the
baseline in the plane of the baseline and a side omega. Its genes, in which the search moves::

    angle of omega in the local YZ plane, place of the point along the baseline / L and
    aside of it toward omega / L (at most 0), ln kappa L^2, ln psi, ln alpha, ln tau
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from drake_oa.common.messages import BoolArray, CouplingParameters, FloatArray, IntArray
from drake_oa.policy.coupling import ALPHA as ALPHA_COLUMN
from drake_oa.policy.coupling import KAPPA as KAPPA_COLUMN
from drake_oa.policy.coupling import N_COLUMNS, NORMAL
from drake_oa.policy.rollout import Scene

N_GENES = 7
ANGLE, PLACE, ASIDE, KAPPA, PSI, ALPHA, TAU = range(N_GENES)
LOWER = np.array([-np.inf, 0.01, -0.3, math.log(0.1), math.log(0.15), math.log(0.1), math.log(0.6)])
UPPER = np.array([np.inf, 0.99, 0.0, math.log(3e3), math.log(5.0), 30.0, math.log(2.5)])
STRIDE = np.array([0.4, 0.08, 0.03, 0.6, 0.25, 0.8, 0.15])
"""Standard deviation of a full step of the search, gene by gene."""
ELITES = 8
SPACING = 0.6
"""Spacing of the strengths of a first candidate, in ln alpha."""
_CLOSER = 0.4
"""Ratio of the spacings of two successive rounds."""
_CLOSEST = 0.02
"""Minimum spacing, in ln alpha."""


def avoidance_terms(scene: Scene, genes: FloatArray) -> FloatArray:
    """Returns the coupling terms (N, 13) of candidates (N, 7) in a scene, see `turn_step`."""
    x, y, z = scene.R_WL.T
    cos, sin = np.cos(genes[:, ANGLE, None]), np.sin(genes[:, ANGLE, None])
    omega = cos * y + sin * z
    along = (genes[:, PLACE, None] - 1.0) * x + genes[:, ASIDE, None] * omega
    terms = np.zeros((len(genes), N_COLUMNS))
    # The baseline ends at the goal, and begins L before it.
    terms[:, :3] = scene.p_WG + scene.baseline * along
    # x_L x omega: a turn about it goes from the baseline to the side.
    terms[:, NORMAL : NORMAL + 3] = cos * z - sin * y
    terms[:, ALPHA_COLUMN : KAPPA_COLUMN + 1] = np.exp(genes[:, [ALPHA, PSI, KAPPA]])
    terms[:, KAPPA_COLUMN] /= scene.baseline**2
    return terms


def genes_of(scene: Scene, terms: FloatArray) -> FloatArray:
    """Returns the candidates (N, 7) of coupling terms (N, 13): the inverse of `avoidance_terms`.

    Args:
        scene: the scene.
        terms: (N, 13) terms; the part of a point that is not in the plane of its normal and the
            baseline is lost.
    """
    x, y, z = scene.R_WL.T
    normal, along = terms[:, NORMAL : NORMAL + 3], (terms[:, :3] - scene.p_WG) / scene.baseline
    genes = np.zeros((len(terms), N_GENES))
    genes[:, ANGLE] = np.arctan2(-normal @ y, normal @ z)
    omega = np.cos(genes[:, ANGLE, None]) * y + np.sin(genes[:, ANGLE, None]) * z
    genes[:, PLACE], genes[:, ASIDE] = 1.0 + along @ x, (along * omega).sum(axis=1)
    strength = terms[:, ALPHA_COLUMN : KAPPA_COLUMN + 1] * [1.0, 1.0, scene.baseline**2]
    genes[:, [ALPHA, PSI, KAPPA]] = np.log(np.maximum(strength, 1e-300))
    return genes


def terms_of(rows: CouplingParameters) -> FloatArray:
    """Returns coupling terms (M, 13) of rows with centers and normals, see `turn_step`."""
    terms = np.zeros((len(rows), N_COLUMNS))
    terms[:, :3], terms[:, NORMAL : NORMAL + 3] = rows.center_W, rows.normal_W
    terms[:, ALPHA_COLUMN : KAPPA_COLUMN + 1] = rows.as_array()
    return terms


def rows_of(terms: FloatArray) -> CouplingParameters:
    """Returns the rows of coupling terms (M, 13): the inverse of `terms_of`."""
    alpha, psi, kappa = np.ascontiguousarray(terms[:, ALPHA_COLUMN : KAPPA_COLUMN + 1].T)
    return CouplingParameters(
        alpha,
        psi,
        kappa,
        in_range=np.ones(len(terms), dtype=bool),
        center_W=terms[:, :3],
        normal_W=terms[:, NORMAL : NORMAL + 3],
    )


NO_PRICE: FloatArray = np.zeros(0)


def price_at(price: FloatArray, angle: FloatArray) -> FloatArray:
    """Returns the additional costs of sides at angles (...): the nearest of K; 0 of none."""
    if not len(price):
        return np.zeros(np.shape(angle))
    return price[np.rint(angle * len(price) / (2.0 * np.pi)).astype(int) % len(price)]


class Draws(NamedTuple):
    """Random numbers of a round of n candidates."""

    step: FloatArray  # (n, 7)
    first: IntArray  # (n,)
    second: IntArray  # (n,)
    mixing: FloatArray  # (n,)
    fresh: FloatArray  # (n, 7)
    is_fresh: BoolArray  # (n,)


@lru_cache(maxsize=256)
def draws(number: int, n: int) -> Draws:
    rng = np.random.default_rng((number, n))
    low = np.where(np.isfinite(LOWER), LOWER, 0.0)
    high = np.where(np.isfinite(UPPER), UPPER, 2.0 * np.pi)
    return Draws(
        step=rng.standard_normal((n, N_GENES)) * np.exp(rng.uniform(-2.5, 0.0, (n, 1))),
        first=rng.integers(0, ELITES, n),
        second=rng.integers(0, ELITES, n),
        mixing=np.where(rng.uniform(size=n) < 0.5, 0.5, 0.0),
        fresh=low + (high - low) * rng.uniform(size=(n, N_GENES)),
        is_fresh=np.arange(n) >= n - n // 4,
    )


def strengths(genes: FloatArray, kept: bool, spacing: float, count: int) -> FloatArray:
    """Returns candidates (count, 7) that differ from one (7,) in alpha only.

    The least alpha that keeps the clearance gives the shortest path: they are weaker, as far as
    the next weaker one that may not keep it, if the candidate keeps it, else stronger.
    """
    share = np.arange(1, count + 1) / (count + 1)
    line = np.repeat(genes[None], count, axis=0)
    line[:, ALPHA] += spacing * (share - 1.0 if kept else 2.5 * share)
    return line


def closer(number: int) -> float:
    """Returns the spacing of the strengths of a round, in ln alpha."""
    return max(SPACING * _CLOSER**number, _CLOSEST)
