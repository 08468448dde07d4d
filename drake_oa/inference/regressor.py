"""The regressor chain: from the shape of an obstacle to coupling parameters.

Three small networks are evaluated one after the other (section IV-C of the paper)::

    Y1: h               -> kappa
    Y2: (h, kappa)      -> psi
    Y3: (h, kappa, psi) -> alpha

The input is h = (lambda1', lambda2', Delta), or h = (lambda1', lambda2') for the chain
that knows of no clearance.

Lengths are divided by the baseline L, since the coupling law is scale free:
h/L -> (kappa L^2, psi, alpha) is one map for every L. alpha is counted per
demonstrated duration T: the turning rate in units of 1/T.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drake_oa.common.messages import CouplingParameters, EllipsoidSet, FloatArray, Frozen
from drake_oa.geometry.ellipsoid import section_matrix
from drake_oa.inference.weights_file import array_of, read_weights, write_weights

_ROUNDING = 1e-12
"""By how much of L a query may be moved and still count as inside."""

_NARROWEST = 1e-3
"""Least psi [rad]."""

_PARALLEL = 1e-6
"""Sine of the angle below which two directions do not span a plane."""


TARGETS = ("kappa", "psi", "alpha")
"""The order of the chain."""


@dataclass(frozen=True, eq=False)
class Network(Frozen):
    """A perceptron with tanh layers, a linear output and min-max scaling.

    With x the input, the layers see ``(x - in_offset) * in_gain - 1``, and their
    answer y becomes ``(y + 1) / out_gain + out_offset``.

    Attributes:
        weights: one (n_out, n_in) matrix a layer.
        biases: one (n_out,) vector a layer.
        in_offset: (d,) smallest inputs.
        in_gain: (d,) scale of the inputs.
        out_offset: smallest target.
        out_gain: scale of the target.
    """

    weights: tuple[FloatArray, ...]
    biases: tuple[FloatArray, ...]
    in_offset: FloatArray
    in_gain: FloatArray
    out_offset: float
    out_gain: float

    def evaluate(self, x: FloatArray) -> FloatArray:
        """Evaluates the network at N inputs: (N, d) -> (N,)."""
        y = (x - self.in_offset) * self.in_gain - 1.0
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            y = np.tanh(y @ weight.T + bias)
        y = y @ self.weights[-1][0] + self.biases[-1]
        return np.asarray((y + 1.0) / self.out_gain + self.out_offset)


_SCALING = ("in_offset", "in_gain", "out_offset", "out_gain")
"""Fields of a `Network` with a row each input, two, and its scalar ones."""


def network_of(path: Path, arrays: Mapping[str, Any], name: str, n_inputs: int) -> Network:
    """The network of that name in a file's arrays.

    Raises:
        ValueError: naming file and array, if one is missing, misshapen or not finite.
    """
    n_layers = sum(key.startswith(f"{name}_W") for key in arrays)
    n_in, weights, biases = n_inputs, [], []
    for layer in range(1, n_layers + 1):
        n_out = 1 if layer == n_layers else None
        weight = array_of(path, arrays, f"{name}_W{layer}", (n_out, n_in))
        n_in = len(weight)
        weights.append(weight)
        biases.append(array_of(path, arrays, f"{name}_b{layer}", (n_in,)))
    offset, gain = (array_of(path, arrays, f"{name}_{key}", (n_inputs,)) for key in _SCALING[:2])
    scalars = [float(array_of(path, arrays, f"{name}_{key}", ())) for key in _SCALING[2:]]
    return Network(tuple(weights), tuple(biases), offset, gain, *scalars)


@dataclass(frozen=True, eq=False)
class ChainWeights(Frozen):
    """The three networks of the chain, the range of their inputs, and their provenance.

    Attributes:
        networks: the networks by target name, see `TARGETS`.
        lower: (d,) least lambda1'/L, lambda2'/L and, if d = 3, Delta/L of the training set.
        upper: (d,) the greatest of them.
        metadata: units, ranges, recipe, configuration, seed, NMSE, version, date, source digest.
    """

    networks: Mapping[str, Network]
    lower: FloatArray
    upper: FloatArray
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def evaluate(self, inputs: FloatArray) -> FloatArray:
        """The bare chain, without any check of its range.

        Args:
            inputs: (N, d) lambda1'/L, lambda2'/L and, if d = 3, Delta/L.

        Returns:
            (N, 3) alpha, psi, kappa L^2.
        """
        known = inputs
        for target in TARGETS:
            known = np.column_stack([known, self.networks[target].evaluate(known)])
        return known[:, :-4:-1]

    def parameters(
        self, extents: FloatArray, clearance: float, baseline: float
    ) -> CouplingParameters:
        """Coupling parameters for obstacles of given section, in physical units.

        A query outside the trained range is evaluated at the nearest input inside and flagged.

        Args:
            extents: (M, 2) lambda' along and across the baseline [m], see
                `section_extents`.
            clearance: requested clearance Delta [m]. A chain of two inputs knows nothing of it.
            baseline: distance L from start to goal [m].

        Returns:
            One row an obstacle.
        """
        query = np.column_stack([extents, np.full(len(extents), clearance)]) / baseline
        query = query[:, : len(self.lower)]
        inside = np.clip(query, self.lower, self.upper)
        in_range = np.abs(query - inside).max(axis=1) <= _ROUNDING
        # A linear output may leave the range of its targets (the print has a log-sigmoid).
        alpha, psi, kappa = np.maximum(self.evaluate(inside), (0.0, _NARROWEST, 0.0)).T
        return CouplingParameters(alpha, psi, kappa / baseline**2, in_range)


def plane_axes(baseline: FloatArray, to_O: FloatArray, normal: FloatArray) -> FloatArray:
    """Returns the directions in which the sections of M obstacles by planes are measured.

    Args:
        baseline: (3,) direction from start to goal.
        to_O: (M, 3) vectors to the obstacles, in the planes.
        normal: (M, 3) unit normals of the planes.

    Returns:
        (M, 2, 3) unit vectors along the projection of the baseline, and across it.
    """
    along = baseline - (normal @ baseline)[:, None] * normal
    # A plane square to the baseline is measured along the direction to the obstacle.
    square = np.linalg.norm(along, axis=1) <= _PARALLEL
    along[square] = to_O[square]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return np.stack([along, np.cross(normal, along)], axis=1)


def section_extents(
    p_WE: FloatArray, z_W: FloatArray, R_WL: FloatArray, shapes: EllipsoidSet
) -> FloatArray:
    """lambda': half-extents of the shapes' sections by the plane of actuation.

    The P-plane of an obstacle is spanned by ``p_WO - p_WE`` and the scaled velocity ``z_W``; where
    these do not span a plane, it is spanned by the local frame's x and z axes. With U = [u1, u2] of
    `plane_axes`, the section is ``{a : a^T S a <= 1}``, ``S = U^T A U``,
    ``A = R diag(1/l^2) R^T``, and its half-extents are the support function
    ``sqrt(u^T S^-1 u)`` along u1 and u2. They vary continuously when an obstacle
    turns, which principal semi-axes matched to directions would not.

    Args:
        p_WE: (3,) position of the end effector [m].
        z_W: (3,) scaled velocity [m].
        R_WL: (3, 3) local frame, x from start to goal, z up.
        shapes: the M obstacles.

    Returns:
        (M, 2) half-extents along and across the baseline [m].
    """
    to_O = shapes.p_WO - p_WE
    normal = np.cross(to_O, z_W)
    limit = _PARALLEL * np.linalg.norm(to_O, axis=1) * np.linalg.norm(z_W)
    normal[np.linalg.norm(normal, axis=1) <= limit] = R_WL[:, 1]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    plane = plane_axes(R_WL[:, 0], to_O, normal)
    S = section_matrix(shapes.R_WO, shapes.semi_axes, plane)
    diagonal = np.stack([S[:, 1, 1], S[:, 0, 0]], axis=1)
    return np.asarray(np.sqrt(diagonal / np.linalg.det(S)[:, None]))


def save_chain(chain: ChainWeights, path: str | Path) -> None:
    """Writes a chain as .safetensors, its metadata inside.

    Raises:
        ValueError: for any other file name extension.
    """
    arrays = {"lower": chain.lower, "upper": chain.upper}
    for name, network in chain.networks.items():
        for i, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True), 1):
            arrays |= {f"{name}_W{i}": weight, f"{name}_b{i}": bias}
        arrays |= {f"{name}_{key}": np.asarray(getattr(network, key)) for key in _SCALING}
    write_weights(path, arrays, chain.metadata, _FORMAT)


def check_action_level(weights: ChainWeights, path: str | Path) -> None:
    """Raises ValueError for a chain that was trained for another action level than runs here."""
    unit = weights.metadata.get("units", {}).get("alpha", "1/T")
    if unit != "1/T":
        raise ValueError(
            f"{path} counts alpha in {unit}, for the released code's action level; the policy "
            "needs a chain of `drake-oa train --recipe paper_running`"
        )


def load_chain(path: str | Path) -> ChainWeights:
    """Reads a chain written by `save_chain`, of two or three inputs.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not such a file, or an array is missing, misshapen or not finite; the
            message names it.
    """
    path = Path(path)
    arrays, metadata = read_weights(path, _FORMAT)
    lower = array_of(path, arrays, "lower", (None,))
    upper = array_of(path, arrays, "upper", lower.shape)
    networks = {
        name: network_of(path, arrays, name, lower.size + i) for i, name in enumerate(TARGETS)
    }
    return ChainWeights(networks, lower, upper, metadata)


_FORMAT = "drake_oa regressor chain 1"
