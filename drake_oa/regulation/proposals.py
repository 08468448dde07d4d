"""Candidates of the search for a motion: their genes, and how a round of the search varies them.

A candidate is one avoidance term (eq. 8) that acts about a point on or beside the
baseline in the plane of the baseline and a side omega. Its genes, in which the search moves::

    angle of omega in the local YZ plane, place of the point along the baseline / L and
    aside of it toward omega / L (at most 0), ln kappa L^2, ln psi, ln alpha, ln tau
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import BoolArray, FloatArray, IntArray
from drake_oa.policy.coupling import ALPHA as ALPHA_COLUMN
from drake_oa.policy.coupling import KAPPA as KAPPA_COLUMN
from drake_oa.policy.coupling import N_COLUMNS, NORMAL
from drake_oa.policy.coupling import PSI as PSI_COLUMN
from drake_oa.regulation.rollout import SceneArrays, SpatialScenes

N_GENES = 7
ANGLE, PLACE, ASIDE, KAPPA, PSI, ALPHA, TAU = range(N_GENES)
LOWER = np.array([-np.inf, 0.01, -0.3, math.log(0.1), math.log(0.15), math.log(0.1), math.log(0.6)])
UPPER = np.array([np.inf, 0.99, 0.0, math.log(3e3), math.log(5.0), 30.0, math.log(2.5)])
STRIDE = np.array([0.4, 0.08, 0.03, 0.6, 0.25, 0.8, 0.15])
"""Standard deviation of a full step of the search, gene by gene."""
ELITES = 8
_CLOSER = 0.4
"""By so much each round's strengths lie closer,"""
_CLOSEST = 0.02
"""and this close at last, in ln alpha."""


def avoidance_terms(scenes: SpatialScenes, scene: IntArray, genes: FloatArray) -> FloatArray:
    """The terms (N, 13) of candidates (N, 7) in their scenes (N,)."""
    terms = np.zeros((len(genes), N_COLUMNS))
    _write_terms(scenes.arrays, scene, np.ascontiguousarray(genes), terms)
    return terms


@compiled
def _write_terms(
    scenes: SceneArrays, scene: IntArray, genes: FloatArray, terms: FloatArray
) -> None:
    """Writes the columns that are not 0 of terms (N, 13)."""
    for row in range(len(genes)):
        k, gene, term = scene[row], genes[row], terms[row]
        L, cos, sin = scenes.baseline[k], math.cos(gene[ANGLE]), math.sin(gene[ANGLE])
        for i in range(3):
            x, y, z = scenes.R_WL[k, i, 0], scenes.R_WL[k, i, 1], scenes.R_WL[k, i, 2]
            omega = cos * y + sin * z
            # From the goal, as the baseline ends there; it begins L before.
            along = (gene[PLACE] - 1.0) * x + gene[ASIDE] * omega
            term[i] = scenes.p_WG[k, i] + L * along
            # x_L x omega: a turn about it goes from the baseline to the side.
            term[NORMAL + i] = cos * z - sin * y
        term[ALPHA_COLUMN] = math.exp(gene[ALPHA])
        term[PSI_COLUMN] = math.exp(gene[PSI])
        term[KAPPA_COLUMN] = math.exp(gene[KAPPA]) / (L * L)


NO_PRICE: FloatArray = np.zeros(0)


class Proposer(Protocol):
    """What proposes the candidates that a search begins with."""

    @property
    def spacing(self) -> float:
        """About how far apart in ln alpha they are on one side."""

    def propose(
        self, scenes: SpatialScenes, duration: float, count: int, price: FloatArray = NO_PRICE
    ) -> tuple[FloatArray, BoolArray]:
        """Candidates of S scenes.

        Args:
            scenes: S scenes.
            duration: tau T [s].
            count: how many a scene.
            price: (K,) what sides cost besides, in baselines; see `price_at`.

        Returns:
            (S, count, 7) genes, and (S,) whether it was asked for what it was trained for.
        """

    def weigh(self, scenes: SpatialScenes, duration: float) -> dict[str, FloatArray]:
        """By what it ranks the sides: rings of costs in [0, 1] (S, K), K evenly spread sides."""


def price_at(price: FloatArray, angle: FloatArray) -> FloatArray:
    """What sides at angles (...) cost besides: of K evenly spread prices the nearest; 0 of none."""
    if not len(price):
        return np.zeros(np.shape(angle))
    return price[np.rint(angle * len(price) / (2.0 * np.pi)).astype(int) % len(price)]


@lru_cache(maxsize=64)
def ladder(count: int, sides: int) -> tuple[IntArray, FloatArray]:
    """Ranks of sides (count,), and shares of a range of strengths (count,): the first sides more.

    Each side is tried about 0.6 times as often as the one before.
    """
    numbers: list[int] = []
    while (left := count - sum(numbers)) > 0 and len(numbers) < sides:
        numbers.append(min(left, max(1, round(0.4 * count * 0.6 ** len(numbers)))))
    numbers[0] += left
    shares = [np.linspace(0.0, 1.0, n) if n > 1 else np.full(1, 0.4) for n in numbers]
    return np.repeat(np.arange(len(numbers)), numbers), np.concatenate(shares)


@dataclass(frozen=True, eq=False)
class Draws:
    """The random numbers of a round of n candidates."""

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


def strengths(genes: FloatArray, kept: BoolArray, spacing: float, count: int) -> FloatArray:
    """Candidates (A, count, 7) of others (A, 7) that differ in alpha only.

    The least that keeps the clearance is shortest: below those that keep it (A,), as far as the
    next weaker one that may not have, and above those that do not.
    """
    share = np.arange(1, count + 1) / (count + 1)
    line = np.repeat(genes[:, None], count, axis=1)
    line[:, :, ALPHA] += spacing * np.where(kept[:, None], share - 1.0, 2.5 * share)
    return line


def closer(spacing: float, number: int) -> float:
    """How far apart strengths lie in a round, from what it is among the proposals."""
    return max(spacing * _CLOSER**number, _CLOSEST)
