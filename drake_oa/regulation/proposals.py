"""Candidates of the search for a motion: their genes, and the ones that the chain proposes.

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
from drake_oa.regulation.regressor import ChainWeights
from drake_oa.regulation.rollout import SceneArrays, SpatialScenes
from drake_oa.regulation.rollout_kernels import point_distance

N_GENES = 7
ANGLE, PLACE, ASIDE, KAPPA, PSI, ALPHA, TAU = range(N_GENES)
LOWER = np.array([-np.inf, 0.01, -0.3, math.log(0.1), math.log(0.15), math.log(0.1), math.log(0.6)])
UPPER = np.array([np.inf, 0.99, 0.0, math.log(3e3), math.log(5.0), 30.0, math.log(2.5)])
GENE_RANGE = np.stack([LOWER, UPPER], axis=1)
"""(7, 2) least and largest value of each gene."""

STRIDE = np.array([0.4, 0.08, 0.03, 0.6, 0.25, 0.8, 0.15])
"""Standard deviation of a full step of the search, gene by gene."""
ELITES = 8
_CLOSER = 0.4
"""By so much each round's strengths lie closer,"""
_CLOSEST = 0.02
"""and this close at last, in ln alpha."""
_N_ANGLES = 24
_OFFSETS = np.array([0, 1, -1, 3, -3, 6, -6, 12])
"""Sides that proposals are made for, of `_N_ANGLES`, counted from the lowest one."""
_GAINS = np.array([-3.0, -1.5, -0.5, 0.5, 1.5, 3.0, 5.0, 8.0])
"""What proposals add to the chain's ln alpha."""


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


@dataclass(frozen=True)
class ChainProposals:
    """The regressor chain proposes, on the lowest sides, with several strengths.

    Attributes:
        weights: the chain, of four inputs.
    """

    weights: ChainWeights
    spacing: float = 1.5

    def propose(
        self, scenes: SpatialScenes, duration: float, count: int, price: FloatArray = NO_PRICE
    ) -> tuple[FloatArray, BoolArray]:
        """Candidates, see `Proposer`."""
        angles = np.linspace(0.0, 2.0 * np.pi, _N_ANGLES, endpoint=False)
        found = shadows_of(scenes, duration, angles)
        height = found[:, :, ACROSS] + price_at(price, angles)
        side = (height.argmin(axis=1)[:, None] + _OFFSETS) % _N_ANGLES
        shadow = np.take_along_axis(found, side[:, :, None], axis=1)
        genes, in_range = answers(self.weights, shadow, angles[side])
        rank, share = ladder(count, len(_OFFSETS))
        genes = genes[:, rank]
        genes[:, :, ALPHA] += np.interp(share, np.linspace(0.0, 1.0, len(_GAINS)), _GAINS)
        # The lowest side's.
        return genes, in_range[:, 0] | (found[:, 0, ASKED] == 0.0)

    def weigh(self, scenes: SpatialScenes, duration: float) -> dict[str, FloatArray]:
        """How high the obstacles rise on each side, see `Proposer`."""
        angles = np.linspace(0.0, 2.0 * np.pi, _N_ANGLES, endpoint=False)
        return {"height": np.minimum(shadows_of(scenes, duration, angles)[:, :, ACROSS], 1.0)}


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


def answers(
    weights: ChainWeights, shadow: FloatArray, angle: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """What the chain says of shadows (S, k, 4) on sides at angles (S, k).

    Returns:
        (S, k, 7) genes, and (S, k) whether it was asked in its range.
    """
    flat = shadow.reshape(-1, 4)
    found = weights.parameters(
        flat[:, [ALONG, ACROSS]], np.maximum(flat[:, ASKED], 1e-6), 1.0, flat[:, CENTER]
    )
    genes = np.zeros((len(flat), N_GENES))
    genes[:, ANGLE] = angle.reshape(-1)
    genes[:, PLACE] = flat[:, CENTER]
    genes[:, KAPPA] = np.log(np.maximum(found.kappa, 1e-9))
    genes[:, PSI] = np.log(found.psi)
    genes[:, ALPHA] = np.log(np.maximum(found.alpha, 1e-9))
    return genes.reshape(*angle.shape, N_GENES), found.in_range.reshape(angle.shape)


def shadows_of(scenes: SpatialScenes, duration: float, angles: FloatArray) -> FloatArray:
    """(S, A, 4) what of the obstacles in the way rises on sides (A,), see `shadows`."""
    found = np.empty((len(scenes), len(angles), 4))
    shadows(scenes.arrays, scenes.s, duration, angles, found)
    return found


_SAMPLES = 41

ALONG, ACROSS, CENTER, ASKED = range(4)
"""Columns of a shadow: extents lambda', place of the centre, clearance; all over L."""


@compiled
def _planned(s: float) -> float:
    """Share of the baseline that a minimum-jerk motion has covered at s."""
    s = min(max(s, 0.0), 1.0)
    return s * s * s * (10.0 + s * (6.0 * s - 15.0))


@compiled
def shadows(
    scenes: SceneArrays, s_now: float, seconds: float, angles: FloatArray, out: FloatArray
) -> None:
    """What of the obstacles in the way rises above the baseline on each side.

    In the way is what comes nearer to the planned motion than the asked clearance, where
    it is then. Of all of those together the half ellipse centred on the baseline takes the
    extent along the baseline and the height on that side.

    Args:
        scenes: the scenes.
        s_now: normalised time now.
        seconds: tau T [s].
        angles: (A,) of the sides omega in the local YZ plane.
        out: (S, A, 4) takes `ALONG`, `ACROSS`, `CENTER`, `ASKED`; `ASKED` is 0 where
            nothing is in the way.
    """
    p_WG, R_WL, baseline = scenes.p_WG, scenes.R_WL, scenes.baseline
    p_WO, R_WO, v_WO = scenes.p_WO, scenes.R_WO, scenes.v_WO
    semi_axes, asked_clearance = scenes.semi_axes, scenes.asked_clearance
    M = p_WO.shape[1]
    for s in range(len(baseline)):
        L = baseline[s]
        x0, x1, x2 = R_WL[s, 0, 0], R_WL[s, 1, 0], R_WL[s, 2, 0]
        nearest = np.full(M, np.inf)
        when = np.zeros(M)
        for j in range(M):
            if math.isnan(p_WO[s, j, 0]):
                continue
            t = 0.0
            for i in range(_SAMPLES):
                at = s_now + max(1.0 - s_now, 0.0) * i / (_SAMPLES - 1)
                time = (at - s_now) * seconds
                left = L * (_planned(at) - 1.0)
                d, t = point_distance(
                    p_WG[s, 0] + left * x0 - p_WO[s, j, 0] - time * v_WO[s, j, 0],
                    p_WG[s, 1] + left * x1 - p_WO[s, j, 1] - time * v_WO[s, j, 1],
                    p_WG[s, 2] + left * x2 - p_WO[s, j, 2] - time * v_WO[s, j, 2],
                    R_WO,
                    semi_axes,
                    s,
                    j,
                    t,
                )
                if d < nearest[j]:
                    nearest[j], when[j] = d, time
        for a in range(len(angles)):
            cos, sin = math.cos(angles[a]), math.sin(angles[a])
            low, high, top, asked = np.inf, -np.inf, -np.inf, 0.0
            for j in range(M):
                if not nearest[j] < asked_clearance[s, j]:
                    continue
                # Matrix of the shadow in the plane of x and omega, and its centre there.
                q11, q12, q22, cx, cy = 0.0, 0.0, 0.0, 0.0, 0.0
                for k in range(3):
                    u, w = 0.0, 0.0
                    for i in range(3):
                        omega = cos * R_WL[s, i, 1] + sin * R_WL[s, i, 2]
                        u += R_WL[s, i, 0] * R_WO[s, j, i, k]
                        w += omega * R_WO[s, j, i, k]
                    square = semi_axes[s, j, k] ** 2
                    q11 += u * u * square
                    q12 += u * w * square
                    q22 += w * w * square
                for i in range(3):
                    omega = cos * R_WL[s, i, 1] + sin * R_WL[s, i, 2]
                    e = p_WO[s, j, i] + when[j] * v_WO[s, j, i] - p_WG[s, i]
                    cx += e * R_WL[s, i, 0]
                    cy += e * omega
                cx += L
                height = math.sqrt(q22)
                level = min(max(-cy, -height), height)
                half = math.sqrt(max((q11 - q12 * q12 / q22) * (1.0 - level * level / q22), 0.0))
                middle = q12 / q22 * level
                reach = math.sqrt(q11)
                right = reach if q12 / reach >= level else middle + half
                left_end = -reach if -q12 / reach >= level else middle - half
                low, high = min(low, cx + left_end), max(high, cx + right)
                top = max(top, cy + height)
                asked = max(asked, asked_clearance[s, j] + min(cy + height, 0.0))
            if asked == 0.0:
                low, high, top = 0.5 * L, 0.5 * L, 0.0
            out[s, a, ALONG] = max(0.5 * (high - low) / L, 0.02)
            out[s, a, ACROSS] = max(top / L, 0.02)
            out[s, a, CENTER] = min(max(0.5 * (low + high) / L, 0.02), 0.98)
            out[s, a, ASKED] = asked / L


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
