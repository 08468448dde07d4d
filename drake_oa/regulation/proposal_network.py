"""A set network that proposes the candidates of a search: on every side, what to try, and how good.

It looks at a motion from one side of the baseline at a time. Obstacles and the present state are
described in the frame L turned about its x axis until its y axis is that side omega, in baselines,
so that a scene that is turned about its baseline is the same scene. Each obstacle goes through the
same layers, what comes out is summed and the greatest of it taken, and further layers make of that

    genes of the best motion on that side, ln(its length / L), and whether it keeps what is asked

(a deep set: M. Zaheer et al., NeurIPS 2017). Sides are ranked by length, and by how likely they are
to keep what is asked; the best are tried with several strengths of the term.
`drake_oa.training.proposals` trains it on what the search itself finds.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import BoolArray, FloatArray, Frozen
from drake_oa.regulation.network import array_of, read_arrays, write_arrays
from drake_oa.regulation.proposals import (
    ALPHA,
    ANGLE,
    N_GENES,
    NO_PRICE,
    ladder,
    price_at,
)
from drake_oa.regulation.rollout import SceneArrays, SpatialScenes
from drake_oa.route.cost_rings import LEAST_SPREAD

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
_UNLIKELY = 2.0
"""What a side that certainly does not keep what is asked ranks as longer by, in baselines."""
_STRENGTHS = (-0.4, 1.3)
"""Between what is added to the ln alpha that the network gives, on the sides that are tried."""
_FORMAT = "drake_oa proposal network 1"

Floats32 = NDArray[np.float32]


class Layers(NamedTuple):
    """The matrices (n_in, n_out) and biases (n_out,) of `LAYERS`."""

    each_1: Floats32
    each_1_bias: Floats32
    each_2: Floats32
    each_2_bias: Floats32
    all_1: Floats32
    all_1_bias: Floats32
    all_2: Floats32
    all_2_bias: Floats32
    out: Floats32
    out_bias: Floats32


@compiled
def _from_side(R_WL: FloatArray, angle: float, vector: FloatArray, out: FloatArray) -> None:
    """A vector (3,) of the world in the frame L turned about x by the angle of a side."""
    cos, sin = math.cos(angle), math.sin(angle)
    x, y, z = 0.0, 0.0, 0.0
    for w in range(3):
        x += R_WL[w, 0] * vector[w]
        y += R_WL[w, 1] * vector[w]
        z += R_WL[w, 2] * vector[w]
    out[0], out[1], out[2] = x, cos * y + sin * z, cos * z - sin * y


@compiled
def describe(
    scenes: SceneArrays, row: int, s: float, seconds: float, angle: float, each: Floats32
) -> int:
    """One scene from one side; how many obstacles there are.

    Args:
        scenes: the scenes.
        row: which of them.
        s: normalised time now.
        seconds: tau T [s].
        angle: of the side in the local YZ plane.
        each: (M + 1, 20) takes a row an obstacle, and after them one of the state alone.
    """
    R, L = scenes.R_WL[row], scenes.baseline[row]
    state, axes, vector = np.zeros(N_STATE), np.zeros((3, 3)), np.zeros(3)
    state[0] = s
    _from_side(R, angle, scenes.p_WE[row] - scenes.p_WG[row], vector)
    for i in range(3):
        state[1 + i] = vector[i] / L
    state[1] += 1.0
    _from_side(R, angle, scenes.z_W[row], vector)
    for i in range(3):
        state[4 + i] = vector[i] / L
    count = 0
    for j in range(scenes.p_WO.shape[1]):
        if math.isnan(scenes.p_WO[row, j, 0]):
            continue
        out = each[count]
        _from_side(R, angle, scenes.p_WO[row, j] - scenes.p_WG[row], vector)
        for i in range(3):
            out[i] = vector[i] / L
        out[0] += np.float32(1.0)
        for k in range(3):
            _from_side(R, angle, scenes.R_WO[row, j, :, k], axes[k])
        # The root of the ellipsoid's matrix, the sum of a u u^T over its axes.
        for i in range(3):
            for k in range(i, 3):
                value = 0.0
                for axis in range(3):
                    value += scenes.semi_axes[row, j, axis] * axes[axis, i] * axes[axis, k]
                out[3 + (i if k == i else i + k + 2)] = value / L
        out[9] = scenes.asked_clearance[row, j] / L
        _from_side(R, angle, scenes.v_WO[row, j], vector)
        for i in range(3):
            out[10 + i] = vector[i] * seconds / L
        for i in range(N_STATE):
            out[N_OBSTACLE + i] = state[i]
        count += 1
    for i in range(N_STATE):
        each[count, N_OBSTACLE + i] = state[i]
    return count


@compiled
def _evaluate(
    scenes: SceneArrays, s: float, seconds: float, angles: FloatArray, layers: Layers, out: Floats32
) -> None:
    """What the network says of S scenes from A sides, out (S, A, 9)."""
    M, A = scenes.p_WO.shape[1], len(angles)
    h = layers.each_2.shape[1]
    # A row is spare: the state's, which the next side's first obstacle overwrites.
    each = np.zeros((A * M + 1, N_OBSTACLE + N_STATE), np.float32)
    pooled = np.empty((A, 2 * h + N_STATE), np.float32)
    zero = np.float32(0.0)
    for row in range(len(scenes.baseline)):
        first = 0
        count = 0
        for a in range(A):
            count = describe(scenes, row, s, seconds, angles[a], each[first:])
            pooled[a, 2 * h :] = each[first + count, N_OBSTACLE:]
            first += count
        y = np.maximum(np.dot(each[:first], layers.each_1) + layers.each_1_bias, zero)
        y = np.maximum(np.dot(y, layers.each_2) + layers.each_2_bias, zero)
        for a in range(A):
            for i in range(h):
                total, greatest = zero, zero
                for k in range(a * count, (a + 1) * count):
                    total += y[k, i]
                    greatest = max(greatest, y[k, i])
                pooled[a, i], pooled[a, h + i] = total, greatest
        y = np.maximum(np.dot(pooled, layers.all_1) + layers.all_1_bias, zero)
        y = np.maximum(np.dot(y, layers.all_2) + layers.all_2_bias, zero)
        out[row] = np.dot(y, layers.out) + layers.out_bias


@compiled
def _describe_all(
    scenes: SceneArrays, s: float, seconds: float, angles: FloatArray, out: Floats32
) -> None:
    """Each scene from one side of its own: out (S, M + 1, 20), the state in the last row."""
    for row in range(len(angles)):
        count = describe(scenes, row, s, seconds, angles[row], out[row])
        out[row, -1] = out[row, count]
        if count < out.shape[1] - 1:
            out[row, count] = np.nan


def descriptors(scenes: SpatialScenes, duration: float, angles: FloatArray) -> Floats32:
    """What describes S scenes, each from a side of its own (S,).

    Returns:
        (S, M + 1, 20): a row an obstacle, NaN for none, and at last one of the state alone.
    """
    shape = (len(scenes), scenes.p_WO.shape[1] + 1, N_OBSTACLE + N_STATE)
    out = np.full(shape, np.nan, np.float32)
    _describe_all(scenes.arrays, scenes.s, duration, angles, out)
    return out


@dataclass(frozen=True, eq=False)
class ProposalNetwork(Frozen):
    """What proposes the candidates of a search.

    Attributes:
        layers: its matrices and biases.
        metadata: recipe, seed, scores, version, date, source digest.
        spacing: of the strengths that it proposes on a side, about, in ln alpha.
    """

    layers: Layers
    metadata: Mapping[str, Any] = field(default_factory=dict)
    spacing: float = 0.6

    def sides(
        self, scenes: SpatialScenes, duration: float, angles: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """What it says of S scenes from A sides; without an obstacle as if a ball stood midway.

        Args:
            scenes: the scenes.
            duration: T [s].
            angles: (A,) sides in the local YZ plane; None: `N_SIDES`, evenly spread.

        Returns:
            Genes (S, A, 7), lengths over L (S, A), and how likely it is that what is asked is
            kept (S, A).
        """
        angles = SIDES if angles is None else angles
        scenes = _with_stand_ins(scenes)
        out = np.empty((len(scenes), len(angles), N_OUTPUTS), np.float32)
        _evaluate(scenes.arrays, scenes.s, duration, angles, self.layers, out)
        genes = out[:, :, :N_GENES] * GENE_SCALE + GENE_MEAN
        genes[:, :, ANGLE] = np.clip(genes[:, :, ANGLE], -HALF, HALF) + angles
        length = np.exp(np.clip(out[:, :, N_GENES], 0.0, 3.0).astype(float))
        likely = 1.0 / (1.0 + np.exp(-np.clip(out[:, :, N_GENES + 1], -50.0, 50.0).astype(float)))
        return genes, length, likely

    def propose(
        self, scenes: SpatialScenes, duration: float, count: int, price: FloatArray = NO_PRICE
    ) -> tuple[FloatArray, BoolArray]:
        """Candidates of S scenes, the likeliest first.

        Args:
            scenes: the scenes.
            duration: T [s].
            count: candidates a scene.
            price: (K,) what sides cost besides, in baselines.

        Returns:
            (S, count, 7) genes, and (S,) whether it expects to keep what is asked on some side.
        """
        genes, length, likely = self.sides(scenes, duration)
        cost = length + _UNLIKELY * (1.0 - likely) + price_at(price, SIDES)
        order = np.argsort(cost, axis=1, kind="stable")
        rank, share = ladder(count, N_SIDES)
        found = np.take_along_axis(genes, order[:, rank, None], axis=1)
        found[:, :, ALPHA] += _STRENGTHS[0] + (_STRENGTHS[1] - _STRENGTHS[0]) * share
        return found, likely.max(axis=1) > 0.5

    def weigh(self, scenes: SpatialScenes, duration: float) -> dict[str, FloatArray]:
        """How much longer than on the shortest side, and how unlikely to keep what is asked."""
        _, length, likely = self.sides(scenes, duration)
        longer = length - length.min(axis=1, keepdims=True)
        spread = np.maximum(longer.max(axis=1, keepdims=True), LEAST_SPREAD)
        return {"length": longer / spread, "unlikely": 1.0 - likely}


_STAND_IN = (0.15, 0.1)
"""Radius and asked clearance of the ball that stands for what is not known, in baselines."""


def _with_stand_ins(scenes: SpatialScenes) -> SpatialScenes:
    """The scenes with a ball midway in those that have no obstacle.

    Who asks knows of something in the way, or would go straight on.
    """
    lacks = np.asarray(np.isnan(scenes.p_WO[:, :, 0]).all(axis=1))
    if not lacks.any():
        return scenes
    S, L = len(scenes), scenes.baseline
    middle = scenes.p_WG - 0.5 * L[:, None] * scenes.R_WL[:, :, 0]
    radius, asked = (share * L[:, None] for share in _STAND_IN)
    added: dict[str, FloatArray] = {
        "p_WO": np.where(lacks[:, None], middle, np.nan)[:, None],
        "R_WO": np.tile(np.eye(3), (S, 1, 1, 1)),
        "semi_axes": np.repeat(radius[:, None], 3, axis=2),
        "v_WO": np.zeros((S, 1, 3)),
        "asked_clearance": asked,
    }
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(scenes, name), one], axis=1) for name, one in added.items()
    }
    return replace(scenes, **joined)


def save_proposals(network: ProposalNetwork, path: str | Path) -> None:
    """Writes a network as .safetensors, its metadata inside.

    Raises:
        ValueError: for any other file name extension.
    """
    arrays = {name: np.asarray(value) for name, value in network.layers._asdict().items()}
    header = json.dumps({**network.metadata, "format": _FORMAT})
    write_arrays(Path(path), arrays, header)


def load_proposals(path: str | Path) -> ProposalNetwork:
    """Reads a network written by `save_proposals`.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not such a file, or an array is missing, misshapen or not finite.
    """
    path = Path(path)
    arrays, header = read_arrays(path)
    metadata = json.loads(header) if header else {}
    if metadata.get("format") != _FORMAT:
        raise ValueError(
            f"{path} is no proposal network ('{_FORMAT}'): `drake-oa train` writes one, and "
            "package://drake_oa/weights/proposals.safetensors is shipped"
        )
    n_in, found = N_OBSTACLE + N_STATE, []
    for name in LAYERS:
        matrix = array_of(path, arrays, name, (n_in, N_OUTPUTS if name == "out" else None))
        n_out = matrix.shape[1]
        bias = array_of(path, arrays, f"{name}_bias", (n_out,))
        found += [np.ascontiguousarray(one, np.float32) for one in (matrix, bias)]
        n_in = 2 * n_out + N_STATE if name == "each_2" else n_out
    return ProposalNetwork(Layers(*found), metadata)
