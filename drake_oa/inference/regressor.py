"""Regressor chain: networks that map the section of an obstacle to parameters of a coupling term.

Three small networks are evaluated in sequence (section IV-C of Pairet et al., RA-L 2019)::

    Y1: h               -> kappa
    Y2: (h, kappa)      -> psi
    Y3: (h, kappa, psi) -> alpha

The plane of motion is spanned by the velocity of the tool point and the direction from the tool
point to the obstacle's center. The input is h = (lambda1', lambda2', Delta): lambda1' and lambda2'
are the half-extents of the obstacle's section by this plane, along and across the line from start
to goal, and Delta is the requested clearance. A chain of two inputs omits Delta. The outputs are
the parameters of the turning rate alpha sign(theta) exp(-theta^2 / psi^2) exp(-kappa d^2). theta is
the angle between the heading and the direction to the obstacle's center, and d the distance of the
tool point from this center.

The coupling term is scale invariant: with lengths divided by the baseline L (distance from start to
goal), h/L -> (kappa L^2, psi, alpha) is one map for every L. The unit of alpha is 1/T, with the
demonstrated duration T.
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
"""Deviation from the trained range up to which a regressor chain's input counts as in range [-].

Such deviations are rounding errors. Inputs are lengths divided by the distance from start to goal.
"""

_NARROWEST = 1e-3
"""Lower bound of a regressor chain's output psi, the angular width of a coupling term [rad]."""

_PARALLEL = 1e-6
"""Sine of the angle between two directions below which they do not span a plane [-]."""


TARGETS = ("kappa", "psi", "alpha")
"""Names of the coupling parameters in the order in which a regressor chain computes them.

They are the decay with the squared distance, the angular width, and the strength of a coupling term
(turning rate)."""


@dataclass(frozen=True, eq=False)
class Network(Frozen):
    """Multilayer perceptron with tanh layers, one linear output and min-max scaling.

    The first layer receives the scaled input ``(x - in_offset) * in_gain - 1``. The result of the
    network is ``(y + 1) / out_gain + out_offset``, with the output y of the last layer.

    Attributes:
        weights: (n_out, n_in) weight matrix of each layer.
        biases: (n_out,) bias vector of each layer.
        in_offset: (d,) minima of the d inputs in the training set.
        in_gain: (d,) factors that scale the inputs to [-1, 1].
        out_offset: minimum of the output in the training set.
        out_gain: factor that scales the output to [-1, 1].
    """

    weights: tuple[FloatArray, ...]
    biases: tuple[FloatArray, ...]
    in_offset: FloatArray
    in_gain: FloatArray
    out_offset: float
    out_gain: float

    def evaluate(self, x: FloatArray) -> FloatArray:
        """Evaluates the network at N inputs (N, d), and returns N outputs (N,)."""
        y = (x - self.in_offset) * self.in_gain - 1.0
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            y = np.tanh(y @ weight.T + bias)
        y = y @ self.weights[-1][0] + self.biases[-1]
        return np.asarray((y + 1.0) / self.out_gain + self.out_offset)


_SCALING = ("in_offset", "in_gain", "out_offset", "out_gain")
"""Fields of `Network` for the scaling: two with one element per input, then two scalars."""


def network_of(path: Path, arrays: Mapping[str, Any], name: str, n_inputs: int) -> Network:
    """Returns a network from the arrays of a weights file.

    Args:
        path: weights file, named in errors.
        arrays: arrays of the file: weights <name>_W1 and biases <name>_b1 of the first layer, ...,
            and for the scaling <name>_in_offset, <name>_in_gain, <name>_out_offset and
            <name>_out_gain.
        name: name of the network: "kappa", "psi" or "alpha".
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
    """Networks of a regressor chain, the trained range of its inputs, and its provenance.

    The inputs are lambda1'/L, lambda2'/L and, if d = 3, Delta/L: half-extents of an obstacle's
    section and requested clearance, divided by the distance L from start to goal.

    Attributes:
        networks: networks by their outputs "kappa", "psi" and "alpha".
        lower: (d,) minima of the inputs in the training set [-].
        upper: (d,) maxima of the inputs in the training set [-].
        metadata: description of the training: among others units of the outputs, recipe (name of
            the training procedure), seed, normalized mean squared errors, version of this package,
            date and source digest (hash of the source files). Only the unit of alpha is evaluated
            (`check_action_level`).
    """

    networks: Mapping[str, Network]
    lower: FloatArray
    upper: FloatArray
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def evaluate(self, inputs: FloatArray) -> FloatArray:
        """Evaluates the three networks in sequence, without clipping inputs to the trained range.

        Args:
            inputs: (N, d) half-extents lambda1'/L, lambda2'/L of the obstacle's section along and
                across the line from start to goal and, if d = 3, requested clearance Delta/L,
                divided by the distance L from start to goal [-].

        Returns:
            (N, 3) coupling parameters: alpha in units of 1/T with the demonstrated duration T,
            psi [rad], kappa L^2 [-].
        """
        columns = inputs
        for target in TARGETS:
            columns = np.column_stack([columns, self.networks[target].evaluate(columns)])
        return columns[:, :-4:-1]

    def parameters(
        self, extents: FloatArray, clearance: float, baseline: float
    ) -> CouplingParameters:
        """Computes the coupling parameters of obstacles from their sections, in physical units.

        Inputs outside the trained range are clipped to this range. The field `in_range` of the
        result is False for an obstacle with such an input.

        Args:
            extents: (M, 2) half-extents lambda' of the obstacles' sections by the plane of motion,
                along and across the line from start to goal [m].
            clearance: requested clearance Delta [m]; no effect on a chain of two inputs.
            baseline: distance L from start to goal [m].

        Returns:
            Coupling parameters with one row per obstacle: alpha in units of 1/T with the
            demonstrated duration T, psi [rad] and kappa [1/m^2].
        """
        query = np.column_stack([extents, np.full(len(extents), clearance)]) / baseline
        query = query[:, : len(self.lower)]
        inside = np.clip(query, self.lower, self.upper)
        in_range = np.abs(query - inside).max(axis=1) <= _ROUNDING
        # A linear output may leave the range of its targets (the paper has a log-sigmoid).
        alpha, psi, kappa = np.maximum(self.evaluate(inside), (0.0, _NARROWEST, 0.0)).T
        return CouplingParameters(alpha, psi, kappa / baseline**2, in_range)


def plane_axes(baseline: FloatArray, to_O: FloatArray, normal: FloatArray) -> FloatArray:
    """Computes the axes along which the half-extents of M planar obstacle sections are measured.

    Args:
        baseline: (3,) unit vector from start to goal in the world frame, the baseline.
        to_O: (M, 3) vectors from the tool point to the centers of the obstacles in the world frame,
            each in the plane of its obstacle; only the directions matter.
        normal: (M, 3) unit normals of the planes in the world frame.

    Returns:
        (M, 2, 3) two orthogonal unit vectors in each plane, in the world frame. The first is the
        direction of the baseline projected onto the plane. If the plane is orthogonal to the
        baseline, the first is the direction to the obstacle's center instead.
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
    """Computes half-extents lambda' of the sections of obstacles by the plane of motion.

    Each obstacle has a plane of motion (P-plane), which is spanned by the scaled velocity ``z_W``
    and the vector ``p_WO - p_WE`` from the tool point to the obstacle's center. If these two are
    parallel, the plane has the x and z directions of the local frame. The obstacle is an ellipsoid
    with the matrix ``A = R diag(1/l^2) R^T``, where R is its rotation and l its semi-axes. Let
    U = [u1, u2] be orthogonal unit vectors in the plane, u1 along the projection of the baseline
    (`plane_axes`). The section by the plane is ``{a : a^T S a <= 1}`` with ``S = U^T A U``. The
    half-extents are the values of the support function ``sqrt(u^T S^-1 u)`` along u1 and u2. Unlike
    the principal semi-axes of the section, the half-extents vary continuously when an obstacle
    rotates.

    Args:
        p_WE: (3,) position of the tool point in the world frame [m].
        z_W: (3,) scaled velocity of the tool point, the derivative of the position by normalized
            time, in the world frame [m].
        R_WL: (3, 3) orientation of the local frame L in the world, x from start to goal, z up.
        shapes: M ellipsoids of the obstacles.

    Returns:
        (M, 2) half-extents along and across the baseline (line from start to goal) [m].
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
    """Writes the networks and metadata of a regressor chain to a .safetensors file.

    Args:
        chain: regressor chain with the trained range of its inputs.
        path: file to replace.

    Raises:
        ValueError: for another file name extension than .safetensors.
    """
    arrays = {"lower": chain.lower, "upper": chain.upper}
    for name, network in chain.networks.items():
        for i, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True), 1):
            arrays |= {f"{name}_W{i}": weight, f"{name}_b{i}": bias}
        arrays |= {f"{name}_{key}": np.asarray(getattr(network, key)) for key in _SCALING}
    write_weights(path, arrays, chain.metadata, _FORMAT)


def check_action_level(weights: ChainWeights, path: str | Path) -> None:
    """Checks that a regressor chain computes the strength alpha of coupling terms in units of 1/T.

    T is the demonstrated duration. The movement primitive requires this unit; chains of the
    released code of Pairet et al., RA-L 2019, have another one.

    Args:
        weights: regressor chain.
        path: weights file of the chain, named in the error.

    Raises:
        ValueError: if the chain has another unit.
    """
    unit = weights.metadata.get("units", {}).get("alpha", "1/T")
    if unit != "1/T":
        raise ValueError(
            f"{path}: alpha has the unit {unit} of the paper's released code; the policy requires "
            "1/T, as in a chain of `drake-oa train --recipe paper_running`"
        )


def load_chain(path: str | Path) -> ChainWeights:
    """Reads a regressor chain of two or three inputs from a file that `save_chain` has written.

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
"""Name and version of the file format, in the metadata of a regressor chain's weights file."""
