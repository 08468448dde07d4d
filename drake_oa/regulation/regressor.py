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

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_oa.common.messages import (
    CouplingParameters,
    EllipsoidSet,
    FloatArray,
    Frozen,
)
from drake_oa.geometry.ellipsoid import section_matrix
from drake_oa.geometry.superquadric import log_inside_outside
from drake_oa.regulation.weights_file import array_of, read_arrays, write_arrays

_ROUNDING = 1e-12
"""By how much of L a query may be moved and still count as inside."""

_NARROWEST = 1e-3
"""Least psi [rad]."""

_OUTLINE = 90
"""Directions in which the section of a superquadric is looked at, half way round."""

_PARALLEL = 1e-6
"""Sine of the angle below which two directions do not span a plane."""


TARGETS = ("kappa", "psi", "alpha")
"""The order of the chain."""


@dataclass(frozen=True, eq=False)
class Network(Frozen):
    """A perceptron with tanh layers, a linear output and min-max scaling.

    With x the input, the layers see ``(x - in_offset) * in_gain + in_min``, and their
    answer y becomes ``(y - out_min) / out_gain + out_offset``.

    Attributes:
        weights: one (n_out, n_in) matrix a layer.
        biases: one (n_out,) vector a layer.
        in_offset: (d,) smallest inputs.
        in_gain: (d,) scale of the inputs.
        out_offset: smallest target.
        out_gain: scale of the target.
        in_min: where in_offset is mapped to.
        out_min: where out_offset is mapped from.
    """

    weights: tuple[FloatArray, ...]
    biases: tuple[FloatArray, ...]
    in_offset: FloatArray
    in_gain: FloatArray
    out_offset: float
    out_gain: float
    in_min: float = -1.0
    out_min: float = -1.0

    def evaluate(self, x: FloatArray) -> FloatArray:
        """Evaluates the network at N inputs: (N, d) -> (N,)."""
        y = (x - self.in_offset) * self.in_gain + self.in_min
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            y = np.tanh(y @ weight.T + bias)
        y = y @ self.weights[-1][0] + self.biases[-1]
        return np.asarray((y - self.out_min) / self.out_gain + self.out_offset)


_SCALING = ("in_offset", "in_gain", "in_min", "out_offset", "out_gain", "out_min")


def network_arrays(name: str, network: Network) -> dict[str, FloatArray]:
    """The arrays of a network as its file holds them, each name beginning with its own."""
    arrays: dict[str, FloatArray] = {}
    for i, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True), 1):
        arrays[f"{name}_W{i}"] = weight
        arrays[f"{name}_b{i}"] = bias
    for key in _SCALING:
        arrays[f"{name}_{key}"] = np.asarray(getattr(network, key), dtype=float)
    return arrays


def network_of(path: Path, arrays: Mapping[str, Any], name: str, n_inputs: int) -> Network:
    """The network of that name in a file's arrays.

    Raises:
        ValueError: naming file and array, if one is missing, misshapen or not finite, or a scale
            is zero.
    """
    n_layers = 1
    while f"{name}_W{n_layers + 1}" in arrays:
        n_layers += 1
    n_in, weights, biases = n_inputs, [], []
    for layer in range(1, n_layers + 1):
        n_out = 1 if layer == n_layers else None
        weight = array_of(path, arrays, f"{name}_W{layer}", (n_out, n_in))
        n_in = len(weight)
        weights.append(weight)
        biases.append(array_of(path, arrays, f"{name}_b{layer}", (n_in,)))
    offset, gain = (array_of(path, arrays, f"{name}_{key}", (n_inputs,)) for key in _SCALING[:2])
    scalars = {
        key: float(array_of(path, arrays, f"{name}_{key}", ()))
        for key in ("in_min", "out_offset", "out_gain", "out_min")
    }
    if scalars["out_gain"] == 0.0 or not gain.all():
        raise ValueError(f"{path}: a scale of '{name}' (in_gain, out_gain) is zero")
    return Network(tuple(weights), tuple(biases), offset, gain, **scalars)


@dataclass(frozen=True, eq=False)
class ChainWeights(Frozen):
    """The three networks of the chain, what they accept, and where they come from.

    Attributes:
        networks: the networks by target name, see `TARGETS`.
        lower: (d,) least lambda1'/L, lambda2'/L and, if d = 3, Delta/L of the training set.
        upper: (d,) the greatest of them.
        input_scale: (d,) factors on the inputs before the networks (2 on lambda' for a
            chain trained on full widths).
        log_targets: targets that the chain handles (learns, and hands on as inputs)
            as their natural logarithm.
        metadata: units, ranges, recipe, configuration, seed, NMSE, version, date, source digest.
    """

    networks: Mapping[str, Network]
    lower: FloatArray
    upper: FloatArray
    input_scale: FloatArray
    log_targets: frozenset[str] = frozenset()
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def evaluate(self, inputs: FloatArray) -> FloatArray:
        """The bare chain, without any check of its range.

        Args:
            inputs: (N, d) lambda1'/L, lambda2'/L and, if d = 3, Delta/L.

        Returns:
            (N, 3) alpha, psi, kappa L^2.
        """
        known = inputs * self.input_scale
        for target in TARGETS:
            known = np.column_stack([known, self.networks[target].evaluate(known)])
        kappa, psi, alpha = (
            np.exp(column) if target in self.log_targets else column
            for target, column in zip(TARGETS, known[:, -3:].T, strict=True)
        )
        return np.column_stack([alpha, psi, kappa])

    def parameters(
        self, extents: ArrayLike, clearance: ArrayLike, baseline: float
    ) -> CouplingParameters:
        """Coupling parameters for obstacles of given section, in physical units.

        A query outside the trained range is evaluated at the nearest input inside and flagged.

        Args:
            extents: (M, 2) lambda' along and across the baseline [m], see
                `section_extents`.
            clearance: asked clearance Delta, one for all or (M,) [m]. Where it is 0
                no coupling is needed, and alpha is 0. A chain of two inputs knows no more
                of it.
            baseline: distance L from start to goal [m].

        Returns:
            One row an obstacle.

        Raises:
            ValueError: if shapes do not fit, an extent or the baseline is not finite and
                positive, or a clearance is negative or not finite.
        """
        sizes = np.asarray(extents, dtype=float)
        asked = np.broadcast_to(np.asarray(clearance, dtype=float), len(sizes))
        if not 0.0 < baseline < np.inf:
            raise ValueError(f"baseline must be finite and positive [m], not {baseline}")
        # Over a tiny baseline a finite length may overflow.
        with np.errstate(over="ignore"):
            query = np.column_stack([sizes, asked]) / baseline
        good = np.isfinite(query).all(axis=1) & (sizes > 0.0).all(axis=1) & (asked >= 0.0)
        if not good.all():
            row = int(np.argmin(good))
            raise ValueError(
                "extents must be positive, clearances not negative, and both finite [m]; "
                f"row {row} has extents {sizes[row].tolist()}, clearance {asked[row]}"
            )
        query = query[:, : len(self.lower)]
        inside = np.clip(query, self.lower, self.upper)
        needed = asked > 0.0
        in_range = ~needed | (np.abs(query - inside).max(axis=1) <= _ROUNDING)
        # A linear output may leave the range of its targets (the print has a log-sigmoid).
        alpha, psi, kappa = np.maximum(self.evaluate(inside), (0.0, _NARROWEST, 0.0)).T
        return CouplingParameters(alpha * needed, psi, kappa / baseline**2, in_range)


def actuation_planes(
    p_WE: FloatArray, z_W: FloatArray, R_WL: FloatArray, p_WO: FloatArray
) -> FloatArray:
    """Returns orthonormal vectors in the obstacles' P-planes.

    The P-plane of an obstacle is spanned by ``p_WO - p_WE`` and the scaled velocity ``z_W``; where
    these do not span a plane, it is spanned by the local frame's x and z axes.

    Args:
        p_WE: (3,) position of the end effector [m].
        z_W: (3,) scaled velocity [m].
        R_WL: (3, 3) local frame, x from start to goal, z up.
        p_WO: (M, 3) centers of the obstacles [m].

    Returns:
        (M, 2, 3) vectors along the projection of the baseline, and across it.
    """
    baseline, to_O = R_WL[:, 0], p_WO - p_WE
    normal = np.cross(to_O, z_W)
    limit = _PARALLEL * np.linalg.norm(to_O, axis=1) * np.linalg.norm(z_W)
    normal[np.linalg.norm(normal, axis=1) <= limit] = R_WL[:, 1]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
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

    With U = [u1, u2] of `actuation_planes`, the section is ``{a : a^T S a <= 1}``, ``S = U^T A U``,
    ``A = R diag(1/l^2) R^T``, and its half-extents are the support function
    ``sqrt(u^T S^-1 u)`` along u1 and u2. They vary continuously when an obstacle
    turns, which principal semi-axes matched to directions would not. Of a superquadric with
    exponents other than 1 the outline is looked at in `_OUTLINE` directions.

    Args:
        p_WE: (3,) position of the end effector [m].
        z_W: (3,) scaled velocity [m].
        R_WL: (3, 3) local frame, x from start to goal, z up.
        shapes: the M obstacles.

    Returns:
        (M, 2) half-extents along and across the baseline [m].
    """
    plane = actuation_planes(p_WE, z_W, R_WL, shapes.p_WO)
    S = section_matrix(shapes.R_WO, shapes.semi_axes, plane)
    diagonal = np.stack([S[:, 1, 1], S[:, 0, 0]], axis=1)
    extents = np.sqrt(diagonal / np.linalg.det(S)[:, None])
    if len(shapes.exponents):
        angle = np.linspace(0.0, np.pi, _OUTLINE, endpoint=False)
        circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        for row in np.flatnonzero((shapes.exponents != 1.0).any(axis=1)):
            ray = circle @ plane[row] @ shapes.R_WO[row]
            log = log_inside_outside(ray, shapes.semi_axes[row], shapes.exponents[row])
            # F^(lambda_4 / 2) is a gauge: it is 1 where the ray leaves the shape.
            reach = np.exp(-0.5 * shapes.exponents[row, 0] * log)
            extents[row] = np.abs(reach[:, None] * circle).max(axis=0)
    return extents


def save_chain(chain: ChainWeights, path: str | Path) -> None:
    """Writes a chain as .safetensors, its metadata inside.

    Raises:
        ValueError: for any other file name extension.
    """
    path = Path(path)
    arrays: dict[str, FloatArray] = {}
    for name, network in chain.networks.items():
        arrays |= network_arrays(name, network)
    arrays |= {key: getattr(chain, key) for key in ("lower", "upper", "input_scale")}
    own = {"format": _FORMAT, "log_targets": sorted(chain.log_targets)}
    header = json.dumps({**chain.metadata, **own})
    write_arrays(path, arrays, header)


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
        ValueError: if it is not such a file, or an array or a metadata entry is
            missing, misshapen or not finite; the message names it.
    """
    path = Path(path)
    arrays, header = read_arrays(path)
    if header is None:
        raise ValueError(f"{path} has no metadata: it is no weights file of `save_chain`")
    try:
        metadata = json.loads(header)
        written = metadata.pop("format", None)
        log_targets = frozenset(metadata.pop("log_targets") if written in (None, _FORMAT) else ())
    except (ValueError, KeyError, AttributeError, TypeError) as error:
        raise ValueError(f"{path}: the metadata are damaged or lack 'log_targets'") from error
    if written != _FORMAT:
        raise ValueError(f"{path} is of the format {written!r}, this version reads {_FORMAT!r}")
    if not log_targets <= set(TARGETS):
        raise ValueError(f"{path}: log_targets holds {sorted(log_targets)}, valid are {TARGETS}")
    lower = array_of(path, arrays, "lower", (None,))
    if lower.size not in (2, 3):
        raise ValueError(f"{path}: 'lower' has {lower.size} entries, it must have 2 or 3")
    upper, scale = (array_of(path, arrays, key, lower.shape) for key in ("upper", "input_scale"))
    if not ((lower < upper).all() and (scale != 0.0).all()):
        raise ValueError(f"{path}: 'upper' must exceed 'lower', and 'input_scale' not be zero")
    networks = {
        name: network_of(path, arrays, name, lower.size + i) for i, name in enumerate(TARGETS)
    }
    return ChainWeights(networks, lower, upper, scale, log_targets, metadata)


_FORMAT = "drake_oa regressor chain 1"
