"""Candidates of the search for a motion: their genes, and how a round of the search varies them.

A candidate is one avoidance term (eq. 8) that acts about a point on or beside the
baseline in the plane of the baseline and a side omega. Its genes, in which the search moves::

    angle of omega in the local YZ plane, place of the point along the baseline / L and
    aside of it toward omega / L (at most 0), ln kappa L^2, ln psi, ln alpha, ln tau

The first candidates are proposed by a set network (M. Zaheer et al., NeurIPS 2017), which
evaluates a motion from one side of the baseline at a time. Obstacles and the present state are
described in the frame L turned about its x axis until its y axis is that side omega, in baselines,
so that a scene that is turned about its baseline is the same scene. Each obstacle passes through
the same layers, the results are summed and their maximum is taken, and further layers compute

    genes of the best motion on that side, ln(its length / L), and the probability of the requested
    clearance

Sides are ranked by length and by this probability; the best are tried with several strengths of
the term. `drake_oa.training.proposals` trains the network on results of the search.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_oa.common.messages import (
    SIDE,
    BoolArray,
    CouplingParameters,
    FloatArray,
    Frozen,
    IntArray,
)
from drake_oa.policy.coupling import ALPHA as ALPHA_COLUMN
from drake_oa.policy.coupling import KAPPA as KAPPA_COLUMN
from drake_oa.policy.coupling import N_COLUMNS, NORMAL
from drake_oa.policy.rollout import Scene
from drake_oa.regulation.weights_file import array_of, read_weights, write_weights
from drake_oa.route.cost_rings import side_costs

N_GENES = 7
ANGLE, PLACE, ASIDE, KAPPA, PSI, ALPHA, TAU = range(N_GENES)
LOWER = np.array([-np.inf, 0.01, -0.3, math.log(0.1), math.log(0.15), math.log(0.1), math.log(0.6)])
UPPER = np.array([np.inf, 0.99, 0.0, math.log(3e3), math.log(5.0), 30.0, math.log(2.5)])
STRIDE = np.array([0.4, 0.08, 0.03, 0.6, 0.25, 0.8, 0.15])
"""Standard deviation of a full step of the search, gene by gene."""
ELITES = 8
SPACING = 0.6
"""Distance between the strengths that are proposed on a side, about, in ln alpha."""
_CLOSER = 0.4
"""By so much each round's strengths lie closer,"""
_CLOSEST = 0.02
"""and this close at last, in ln alpha."""


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


def genes_of(scene: Scene, terms: FloatArray, scaling: ArrayLike = 1.0) -> FloatArray:
    """Returns the candidates (N, 7) of coupling terms (N, 13): the inverse of `avoidance_terms`.

    Args:
        scene: the scene.
        terms: (N, 13) terms; the part of a point that is not in the plane of its normal and the
            baseline is lost.
        scaling: () or (N,) temporal scalings.
    """
    x, y, z = scene.R_WL.T
    normal, along = terms[:, NORMAL : NORMAL + 3], (terms[:, :3] - scene.p_WG) / scene.baseline
    genes = np.empty((len(terms), N_GENES))
    genes[:, ANGLE] = np.arctan2(-normal @ y, normal @ z)
    omega = np.cos(genes[:, ANGLE, None]) * y + np.sin(genes[:, ANGLE, None]) * z
    genes[:, PLACE], genes[:, ASIDE] = 1.0 + along @ x, (along * omega).sum(axis=1)
    strength = terms[:, ALPHA_COLUMN : KAPPA_COLUMN + 1] * [1.0, 1.0, scene.baseline**2]
    genes[:, [ALPHA, PSI, KAPPA]] = np.log(np.maximum(strength, 1e-300))
    genes[:, TAU] = np.log(scaling)
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


def side_rows(
    scene: Scene, genes: FloatArray, length: FloatArray, likely: FloatArray
) -> CouplingParameters:
    """Returns the rows of proposed sides, see `CouplingParameters`.

    Args:
        scene: the scene.
        genes: (N, 7) one candidate a side.
        length: (N,) expected path lengths over the baseline.
        likely: (N,) probabilities that the requested clearance is achieved.
    """
    return replace(
        rows_of(avoidance_terms(scene, genes)),
        kind=np.full(len(genes), SIDE),
        length=length,
        likely=likely,
        scaling=np.exp(genes[:, TAU]),
    )


_STRENGTHS = (-0.4, 1.3)
"""Range of the strengths that are rolled out on a side, relative to the proposed ln alpha."""


def tried(genes: FloatArray, count: int) -> FloatArray:
    """Returns candidates (count, 7) of ranked sides (S, 7): the first ones with more strengths."""
    if not len(genes):
        return genes
    rank, share = ladder(count, len(genes))
    found = genes[rank]
    found[:, ALPHA] += _STRENGTHS[0] + (_STRENGTHS[1] - _STRENGTHS[0]) * share
    return found


NO_PRICE: FloatArray = np.zeros(0)


def price_at(price: FloatArray, angle: FloatArray) -> FloatArray:
    """Returns the additional costs of sides at angles (...): the nearest of K; 0 of none."""
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
    """How far apart strengths lie in a round, from what it is among the proposals."""
    return max(SPACING * _CLOSER**number, _CLOSEST)


N_SIDES = 16
"""Sides that a scene is looked at from, all round the baseline."""
HALF = math.pi / N_SIDES
"""Farthest that a motion's plane is from its side [rad]."""
SIDES = np.linspace(0.0, 2.0 * np.pi, N_SIDES, endpoint=False)
"""(16,) their angles in the local YZ plane [rad]."""
N_OBSTACLE, N_STATE = 13, 7
"""Length of what describes an obstacle (centre from the start, root of its matrix, asked
clearance, velocity times T), and the state (s, position from the start, z); over L, in the side's
frame."""
N_OUTPUTS = N_GENES + 2
"""Scaled genes, ln of the length over L, logit of the probability that what is asked is kept."""
GENE_MEAN = np.array([0.0, 0.5, -0.05, 1.0, 0.3, 4.0, 0.0])
GENE_SCALE = np.array([0.2, 0.25, 0.1, 2.0, 0.8, 2.0, 0.3])
"""Of the genes that the network gives, the angle counted from its side."""

LAYERS = ("each_1", "each_2", "all_1", "all_2", "out")
_FORMAT = "drake_oa proposal network 1"

Floats32 = NDArray[np.float32]


Layers = tuple[Floats32, ...]
"""Matrix (n_in, n_out) and bias (n_out,) of each of `LAYERS`."""
_NAMES = tuple(f"{layer}{part}" for layer in LAYERS for part in ("", "_bias"))


def describe(scene: Scene, duration: float, angles: FloatArray) -> tuple[Floats32, Floats32]:
    """Describes a scene from A sides, in each side's frame and in baselines.

    Args:
        scene: the motion and M obstacles.
        duration: T [s].
        angles: (A,) sides in the local YZ plane [rad].

    Returns:
        (A, M, 20) a row an obstacle, and (A, 7) the state.
    """
    cos, sin = np.cos(angles), np.sin(angles)
    zero, one = np.zeros_like(cos), np.ones_like(cos)
    R_SL = np.array([[one, zero, zero], [zero, cos, sin], [zero, -sin, cos]]).transpose(2, 0, 1)
    R_SW, L, seen = R_SL @ scene.R_WL.T, scene.baseline, scene.ellipsoids
    A, M, first = len(angles), len(seen), np.array([1.0, 0.0, 0.0])
    state = np.empty((A, N_STATE), np.float32)
    state[:, 0] = scene.s
    state[:, 1:4] = R_SW @ (scene.p_WE - scene.p_WG) / L + first
    state[:, 4:] = R_SW @ scene.z_W / L
    each = np.empty((A, M, N_OBSTACLE + N_STATE), np.float32)
    each[:, :, :3] = (seen.p_WO - scene.p_WG) @ R_SW.transpose(0, 2, 1) / L + first
    # The root of the ellipsoid's matrix, the sum of a u u^T over its axes.
    axes = R_SW[:, None] @ seen.R_WO
    root = (axes * seen.semi_axes[None, :, None]) @ axes.transpose(0, 1, 3, 2) / L
    each[:, :, 3:9] = root[:, :, [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    each[:, :, 9] = scene.clearance / L
    each[:, :, 10:13] = seen.v_WO @ R_SW.transpose(0, 2, 1) * (duration / L)
    each[:, :, N_OBSTACLE:] = state[:, None]
    return each, state


@dataclass(frozen=True, eq=False)
class ProposalNetwork(Frozen):
    """Set network that proposes the candidates of a search.

    Attributes:
        layers: its matrices and biases.
        metadata: recipe, seed, scores, version, date, source digest.
    """

    layers: Layers
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def sides(
        self, scene: Scene, duration: float, angles: FloatArray = SIDES
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Evaluates a scene from A sides; without an obstacle there are none.

        Args:
            scene: the motion and the obstacles.
            duration: T [s].
            angles: (A,) sides in the local YZ plane [rad].

        Returns:
            Genes (A, 7), lengths over L (A,), and probabilities that the requested clearance is
            achieved (A,).
        """
        y, state = describe(scene, duration, angles[: len(angles) * bool(len(scene.ellipsoids))])
        layers = list(zip(self.layers[::2], self.layers[1::2], strict=True))
        for matrix, bias in layers[:2]:
            y = np.maximum(y @ matrix + bias, 0.0)
        y = np.concatenate([y.sum(axis=1), y.max(axis=1, initial=0.0), state], axis=1)
        for matrix, bias in layers[2:-1]:
            y = np.maximum(y @ matrix + bias, 0.0)
        out = (y @ layers[-1][0] + layers[-1][1]).astype(float)
        genes = out[:, :N_GENES] * GENE_SCALE + GENE_MEAN
        genes[:, ANGLE] = np.clip(genes[:, ANGLE], -HALF, HALF) + angles[: len(out)]
        length = np.exp(np.clip(out[:, N_GENES], 0.0, 3.0))
        likely = 1.0 / (1.0 + np.exp(-np.clip(out[:, N_GENES + 1], -50.0, 50.0)))
        return genes, length, likely

    def ranked(self, scene: Scene, duration: float) -> FloatArray:
        """Returns the genes (N, 7) of the sides of a scene, the best side first; T [s]."""
        genes, length, likely = self.sides(scene, duration)
        return genes[np.argsort(side_costs(length, likely), kind="stable")]

    def rows(self, scene: Scene, duration: float) -> CouplingParameters:
        """Returns the rows of the N sides, see `CouplingParameters`; T [s]."""
        return side_rows(scene, *self.sides(scene, duration))


def save_proposals(network: ProposalNetwork, path: str | Path) -> None:
    """Writes a network as .safetensors, its metadata inside.

    Raises:
        ValueError: for any other file name extension.
    """
    write_weights(path, dict(zip(_NAMES, network.layers, strict=True)), network.metadata, _FORMAT)


def load_proposals(path: str | Path) -> ProposalNetwork:
    """Reads a network written by `save_proposals`.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not such a file, or an array is missing, misshapen or not finite.
    """
    path = Path(path)
    arrays, metadata = read_weights(path, _FORMAT)
    n_in, found = N_OBSTACLE + N_STATE, []
    for name in LAYERS:
        matrix = array_of(path, arrays, name, (n_in, N_OUTPUTS if name == "out" else None))
        bias = array_of(path, arrays, f"{name}_bias", matrix.shape[1:])
        found += [np.ascontiguousarray(one, np.float32) for one in (matrix, bias)]
        n_in = 2 * len(bias) + N_STATE if name == "each_2" else len(bias)
    return ProposalNetwork(tuple(found), metadata)
