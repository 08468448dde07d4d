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

from drake_oa.common.messages import CouplingParameters, EllipsoidSet, FloatArray, Frozen
from drake_oa.policy.rollout import Scene
from drake_oa.regulation.network import array_of, read_arrays, write_arrays
from drake_oa.regulation.proposals import (
    ANGLE,
    N_GENES,
    side_rows,
)
from drake_oa.route.cost_rings import side_costs

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
        """Evaluates a scene from A sides; without an obstacle as if a ball stood midway.

        Args:
            scene: the motion and the obstacles.
            duration: T [s].
            angles: (A,) sides in the local YZ plane [rad].

        Returns:
            Genes (A, 7), lengths over L (A,), and probabilities that the requested clearance is
            achieved (A,).
        """
        each, state = describe(_with_stand_in(scene), duration, angles)
        net = self.layers
        y = np.maximum(each @ net.each_1 + net.each_1_bias, 0.0)
        y = np.maximum(y @ net.each_2 + net.each_2_bias, 0.0)
        y = np.concatenate([y.sum(axis=1), y.max(axis=1), state], axis=1)
        y = np.maximum(y @ net.all_1 + net.all_1_bias, 0.0)
        y = np.maximum(y @ net.all_2 + net.all_2_bias, 0.0)
        out = (y @ net.out + net.out_bias).astype(float)
        genes = out[:, :N_GENES] * GENE_SCALE + GENE_MEAN
        genes[:, ANGLE] = np.clip(genes[:, ANGLE], -HALF, HALF) + angles
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


_STAND_IN = (0.15, 0.1)
"""Radius and asked clearance of the ball that stands for what is not known, in baselines."""


def _with_stand_in(scene: Scene) -> Scene:
    """Returns the scene, with a ball midway if it has no obstacle: something is in the way."""
    if len(scene.ellipsoids):
        return scene
    radius, clearance = (np.full(1, share * scene.baseline) for share in _STAND_IN)
    ball = EllipsoidSet(
        p_WO=(scene.p_WG - 0.5 * scene.baseline * scene.R_WL[:, 0])[None],
        R_WO=np.eye(3)[None],
        semi_axes=np.tile(radius, (1, 3)),
        v_WO=np.zeros((1, 3)),
        ids=np.zeros(1, dtype=np.int64),
    )
    return replace(scene, ellipsoids=ball, clearance=clearance)


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
