"""Regressor chain: networks that map the section of an obstacle to parameters of a coupling term.

Three small networks are evaluated in sequence (section IV-C of Pairet et al., RA-L 2019)::

    Y1: h               -> kappa
    Y2: (h, kappa)      -> psi
    Y3: (h, kappa, psi) -> alpha

The input is h = (lambda1', lambda2', Delta): half-extents lambda' of the obstacle's section by the
plane of motion, and requested clearance Delta. A chain of two inputs omits Delta.

The coupling term is scale invariant: with lengths divided by the baseline L (distance from start to
goal), h/L -> (kappa L^2, psi, alpha) is one map for every L. alpha is a turning rate in units of
1/T, with T the demonstrated duration.
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
"""Distance outside the trained range, in baselines, at which an input still counts as inside."""

_NARROWEST = 1e-3
"""Minimum of psi, the width of a coupling term's response to the heading [rad]."""

_PARALLEL = 1e-6
"""Sine of the angle below which two directions do not span a plane."""


TARGETS = ("kappa", "psi", "alpha")
"""Names of the coupling parameters in the order in which the chain's networks compute them."""


@dataclass(frozen=True, eq=False)
class Network(Frozen):
    """Multilayer perceptron with tanh layers, a linear output and min-max scaling.

    The scaled input of the layers is ``(x - in_offset) * in_gain - 1``, and the result of their
    output y is ``(y + 1) / out_gain + out_offset``.

    Attributes:
        weights: (n_out, n_in) matrix of each layer.
        biases: (n_out,) vector of each layer.
        in_offset: (d,) minima of the training inputs.
        in_gain: (d,) scale of the inputs.
        out_offset: minimum of the training targets.
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
"""Scaling fields of a `Network`: two with one element per input, then two scalars."""


def network_of(path: Path, arrays: Mapping[str, Any], name: str, n_inputs: int) -> Network:
    """Returns a network from the arrays of a weights file.

    Args:
        path: file, for errors.
        arrays: arrays of the file: <name>_W1, <name>_b1, ..., and <name>_<field> for the scaling.
        name: name of the network.
        n_inputs: number of inputs of the network.

    Raises:
        ValueError: if an array is missing, misshapen or not finite; names file and array.
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
    """Networks of a regressor chain, range of their inputs, and provenance.

    Attributes:
        networks: networks by target name, see `TARGETS`.
        lower: (d,) minima of lambda1'/L, lambda2'/L and, if d = 3, Delta/L in the training set.
        upper: (d,) maxima of the same inputs.
        metadata: units, ranges, recipe, configuration, seed, normalized mean squared errors,
            version, date, source digest.
    """

    networks: Mapping[str, Network]
    lower: FloatArray
    upper: FloatArray
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def evaluate(self, inputs: FloatArray) -> FloatArray:
        """Evaluates the three networks in sequence, without clipping inputs to the trained range.

        Args:
            inputs: (N, d) lambda1'/L, lambda2'/L and, if d = 3, Delta/L.

        Returns:
            (N, 3) alpha, psi, kappa L^2.
        """
        columns = inputs
        for target in TARGETS:
            columns = np.column_stack([columns, self.networks[target].evaluate(columns)])
        return columns[:, :-4:-1]

    def parameters(
        self, extents: FloatArray, clearance: float, baseline: float
    ) -> CouplingParameters:
        """Computes the coupling parameters of obstacles from their sections, in physical units.

        An input outside the trained range is clipped to it, and its `in_range` is False.

        Args:
            extents: (M, 2) half-extents lambda' along and across the baseline [m], see
                `section_extents`.
            clearance: requested clearance Delta [m]; no effect on a chain of two inputs.
            baseline: distance L from start to goal [m].

        Returns:
            Parameters with one row per obstacle.
        """
        query = np.column_stack([extents, np.full(len(extents), clearance)]) / baseline
        query = query[:, : len(self.lower)]
        inside = np.clip(query, self.lower, self.upper)
        in_range = np.abs(query - inside).max(axis=1) <= _ROUNDING
        # A linear output may leave the range of its targets (the paper has a log-sigmoid).
        alpha, psi, kappa = np.maximum(self.evaluate(inside), (0.0, _NARROWEST, 0.0)).T
        return CouplingParameters(alpha, psi, kappa / baseline**2, in_range)


def plane_axes(baseline: FloatArray, to_O: FloatArray, normal: FloatArray) -> FloatArray:
    """Computes the axes along which the sections of M obstacles by planes are measured.

    Args:
        baseline: (3,) direction from start to goal.
        to_O: (M, 3) vectors to the obstacles, in the planes.
        normal: (M, 3) unit normals of the planes.

    Returns:
        (M, 2, 3) unit vectors in each plane, along the projection of the baseline and across it.
    """
    along = baseline - (normal @ baseline)[:, None] * normal
    # In a plane orthogonal to the baseline, the direction to the obstacle replaces the projection.
    is_orthogonal = np.linalg.norm(along, axis=1) <= _PARALLEL
    along[is_orthogonal] = to_O[is_orthogonal]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return np.stack([along, np.cross(normal, along)], axis=1)


def section_extents(
    p_WE: FloatArray, z_W: FloatArray, R_WL: FloatArray, shapes: EllipsoidSet
) -> FloatArray:
    """Computes the half-extents lambda' of the obstacles' sections by their planes of motion.

    The plane of motion (P-plane) of an obstacle is spanned by ``p_WO - p_WE`` and the scaled
    velocity ``z_W``; if these are parallel, by the x and z axes of the local frame. With
    U = [u1, u2] of `plane_axes`, the section is ``{a : a^T S a <= 1}``, ``S = U^T A U``,
    ``A = R diag(1/l^2) R^T``, and its half-extents are the support function ``sqrt(u^T S^-1 u)``
    along u1 and u2. Unlike the principal semi-axes of the section, they vary continuously when an
    obstacle rotates.

    Args:
        p_WE: (3,) position of the tool point [m].
        z_W: (3,) scaled velocity [m].
        R_WL: (3, 3) local frame, x from start to goal, z up.
        shapes: M obstacles.

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
    """Writes a chain and its metadata to a .safetensors file.

    Raises:
        ValueError: for another file name extension.
    """
    arrays = {"lower": chain.lower, "upper": chain.upper}
    for name, network in chain.networks.items():
        for i, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True), 1):
            arrays |= {f"{name}_W{i}": weight, f"{name}_b{i}": bias}
        arrays |= {f"{name}_{key}": np.asarray(getattr(network, key)) for key in _SCALING}
    write_weights(path, arrays, chain.metadata, _FORMAT)


def check_action_level(weights: ChainWeights, path: str | Path) -> None:
    """Raises ValueError if a chain was trained for another unit of alpha than the policy's, 1/T.

    Chains of the paper's released code have another unit.
    """
    unit = weights.metadata.get("units", {}).get("alpha", "1/T")
    if unit != "1/T":
        raise ValueError(
            f"{path}: alpha has the unit {unit} of the paper's released code; the policy requires "
            "1/T, as in a chain of `drake-oa train --recipe paper_running`"
        )


def load_chain(path: str | Path) -> ChainWeights:
    """Reads a chain of two or three inputs from a file of `save_chain`.

    Raises:
        FileNotFoundError: if the file does not exist.
        ValueError: if the file has another format, or an array is missing, misshapen or not finite;
            names file and array.
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
"""Format name and version in the metadata of weights files."""
