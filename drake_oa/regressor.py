"""The regressor chain: from the shape of an obstacle to coupling parameters.

Three small networks are evaluated one after the other (sec. "Geometry-conditioned
Parameter Regressor" of the paper)::

    Y1: h               -> kappa
    Y2: (h, kappa)      -> psi
    Y3: (h, kappa, psi) -> alpha

The paper's input is h = (lambda1', lambda2', Delta). The project's own chain has one
more, the place of the obstacle's centre along the baseline: the same parameters that
keep the clearance from an obstacle in the middle fall short of it, or touch, nearer to
the start, where the motion is slow and has little way left to turn.

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

from drake_oa.regressor_kernels import clamp_rows, section_rows
from drake_oa.values import BoolArray, FloatArray, Frozen

TARGETS = ("kappa", "psi", "alpha")
"""The order of the chain."""

_SATURATED = 40.0
"""Where tanh is 1 to the last bit."""


@dataclass(frozen=True, eq=False)
class CouplingParameters(Frozen):
    """Parameters of the dead-zone free term, one row an obstacle.

    Attributes:
        alpha: (M,) strength: turning rate in units of 1/T, T the demonstrated
            duration.
        psi: (M,) width of the response to the heading [rad].
        kappa: (M,) decay with the squared distance [1/m^2].
        in_range: (M,) False where the query lay outside what the chain was trained
            for: it was then evaluated at the nearest input inside.
        center_W: (M, 3) the points the terms act about [m]; (0, 3): the obstacles'
            centres.
    """

    alpha: FloatArray = field(default_factory=lambda: np.zeros(0))
    psi: FloatArray = field(default_factory=lambda: np.zeros(0))
    kappa: FloatArray = field(default_factory=lambda: np.zeros(0))
    in_range: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    center_W: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))

    def __len__(self) -> int:
        return len(self.alpha)

    def as_array(self) -> FloatArray:
        """(M, 3) rows of alpha, psi, kappa."""
        return np.column_stack((self.alpha, self.psi, self.kappa))


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
    _layers: tuple[FloatArray, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        weights, biases = list(self.weights), list(self.biases)
        # The scalings are affine: the first and the last layer take them up.
        biases[0] = biases[0] + weights[0] @ (self.in_min - self.in_offset * self.in_gain)
        weights[0] = weights[0] * self.in_gain
        biases[-1] = (biases[-1] - self.out_min) / self.out_gain + self.out_offset
        weights[-1] = weights[-1] / self.out_gain
        # A last input held at 1 carries the bias, tanh(_SATURATED) = 1 hands it on.
        layers = [np.column_stack(pair) for pair in zip(weights, biases, strict=True)]
        for i, layer in enumerate(layers[:-1]):
            constant = np.append(np.zeros(layer.shape[1] - 1), _SATURATED)
            layers[i] = np.vstack((layer, constant))
        object.__setattr__(self, "_layers", tuple(layers))
        super().__post_init__()

    @property
    def n_inputs(self) -> int:
        """Number d of inputs."""
        return len(self.in_offset)

    def evaluate(self, columns: FloatArray) -> FloatArray:
        """The network at N inputs: (d + 1, N), the last row ones -> (N,)."""
        y = columns
        for layer in self._layers[:-1]:
            y = layer.dot(y)
            np.tanh(y, y)
        return self._layers[-1].dot(y)[0]


@dataclass(frozen=True, eq=False)
class ClearanceLimit(Frozen):
    """The largest clearance that training found attainable, per ellipse.

    Attributes:
        lambda1: (n,) increasing lambda1'/L; empty where nothing was recorded.
        lambda2: (m,) increasing lambda2'/L.
        position: (p,) increasing place of the centre along the baseline, in L.
        clearance: (n, m, p) largest attainable Delta/L.
    """

    lambda1: FloatArray = field(default_factory=lambda: np.zeros(0))
    lambda2: FloatArray = field(default_factory=lambda: np.zeros(0))
    position: FloatArray = field(default_factory=lambda: np.zeros(0))
    clearance: FloatArray = field(default_factory=lambda: np.zeros((0, 0, 0)))


@dataclass(frozen=True, eq=False)
class ChainWeights(Frozen):
    """The three networks of the chain, what they accept, and where they come from.

    Attributes:
        networks: the networks by target name, see `TARGETS`.
        lower: (d,) least lambda1'/L, lambda2'/L, Delta/L and, if d = 4, position/L of
            the training set.
        upper: (d,) the greatest of them.
        input_scale: (d,) factors on the inputs before the networks (2 on lambda' for a
            chain trained on full widths).
        log_targets: targets that the chain handles (learns, and hands on as inputs)
            as their natural logarithm.
        limit: largest attainable clearance.
        metadata: units, ranges, recipe, configuration, seed, NMSE, commit.
    """

    networks: Mapping[str, Network]
    lower: FloatArray
    upper: FloatArray
    input_scale: FloatArray
    log_targets: frozenset[str] = frozenset()
    limit: ClearanceLimit = field(default_factory=ClearanceLimit)
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def evaluate(self, inputs: FloatArray) -> FloatArray:
        """The bare chain, without any check of its range.

        Args:
            inputs: (N, d) lambda1'/L, lambda2'/L, Delta/L and, if d = 4, position/L.

        Returns:
            (N, 3) alpha, psi, kappa L^2.
        """
        columns = np.empty((len(self.lower) + 3, len(inputs)))
        columns[:-3] = inputs.T
        return np.array(self._evaluate_columns(columns)).T

    def _evaluate_columns(self, columns: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """alpha, psi, kappa L^2 at inputs in the first d of d + 3 rows, all overwritten."""
        columns[:-3] *= self.input_scale[:, None]
        columns[-3] = 1.0
        kappa = columns[-3] = self.networks["kappa"].evaluate(columns[:-2])
        columns[-2] = 1.0
        psi = columns[-2] = self.networks["psi"].evaluate(columns[:-1])
        columns[-1] = 1.0
        alpha = self.networks["alpha"].evaluate(columns)
        log = self.log_targets
        return (
            np.exp(alpha) if "alpha" in log else alpha,
            np.exp(psi) if "psi" in log else psi,
            np.exp(kappa) if "kappa" in log else kappa,
        )

    def parameters(
        self,
        extents: ArrayLike,
        clearance: ArrayLike,
        baseline: float,
        position: ArrayLike | None = None,
    ) -> CouplingParameters:
        """Coupling parameters for obstacles of given section, in physical units.

        A query outside the trained range, or for a clearance that training found
        out of reach, is evaluated at the nearest input inside and flagged.

        Args:
            extents: (M, 2) lambda' along and across the baseline [m], see
                `section_extents`.
            clearance: asked clearance Delta, one for all or (M,) [m]. Where it is 0
                no coupling is needed, and alpha is 0.
            baseline: distance L from start to goal [m].
            position: where along the baseline the centres are, from the start, one for
                all or (M,) [m]; None: in the middle. A chain of three inputs does not
                use it.

        Returns:
            One row an obstacle.

        Raises:
            ValueError: if a shape is wrong, an extent or the baseline is not finite and
                positive, a clearance is negative, or a value is not finite.
        """
        extents = np.asarray(extents, dtype=float)
        if extents.ndim != 2 or extents.shape[1] != 2:
            raise ValueError(f"extents must have the shape (M, 2), not {extents.shape}")
        asked = _per_row("clearance", clearance, len(extents))
        if not 0.0 < baseline < np.inf:
            raise ValueError(f"baseline must be finite and positive [m], not {baseline}")
        place = _per_row("position", 0.5 * baseline if position is None else position, len(extents))
        if not len(extents):
            return CouplingParameters()
        columns = np.empty((len(self.lower) + 3, len(extents)))
        table = self.limit
        in_range, needed, valid = clamp_rows(
            extents,
            asked,
            place,
            baseline,
            self.lower,
            self.upper,
            table.lambda1,
            table.lambda2,
            table.position,
            table.clearance,
            columns,
        )
        if not valid:
            raise ValueError(
                "extents must be positive, clearances not negative, and both and positions "
                f"finite [m], not {extents.tolist()}, {asked.tolist()} and {place.tolist()}"
            )
        alpha, psi, kappa = self._evaluate_columns(columns)
        alpha *= needed
        kappa /= baseline * baseline
        return CouplingParameters(alpha, psi, kappa, in_range)


def _per_row(name: str, value: ArrayLike, n_rows: int) -> FloatArray:
    array = np.asarray(value, dtype=float)
    if array.shape == (n_rows,):
        return array
    if array.shape:
        raise ValueError(f"{name} must be one number or ({n_rows},), not {array.shape}")
    return np.full(n_rows, array)


def section_extents(
    p_WE: FloatArray,
    z_W: FloatArray,
    R_WL: FloatArray,
    p_WO: FloatArray,
    R_WO: FloatArray,
    semi_axes: FloatArray,
) -> FloatArray:
    """lambda': half-extents of ellipsoids' sections by the plane of actuation.

    The P-plane of an obstacle is spanned by ``p_WO - p_WE`` and the scaled velocity
    ``z_W``; where these do not span a plane, it is spanned by the local frame's x and
    z axes. With U = [u1, u2] orthonormal in that plane, u1 along the projection of
    the baseline, the section is ``{a : a^T S a <= 1}``, ``S = U^T A U``,
    ``A = R diag(1/l^2) R^T``, and its half-extents are the support function
    ``sqrt(u^T S^-1 u)`` along u1 and u2. They vary continuously when an obstacle
    turns, which principal semi-axes matched to directions would not.

    Args:
        p_WE: (3,) position of the end effector [m].
        z_W: (3,) scaled velocity [m].
        R_WL: (3, 3) local frame, x from start to goal, z up.
        p_WO: (M, 3) centres [m].
        R_WO: (M, 3, 3) rotations, principal axes in the columns.
        semi_axes: (M, 3) semi-axes [m].

    Returns:
        (M, 2) half-extents along and across the baseline [m].
    """
    return section_rows(p_WE, z_W, R_WL, p_WO, R_WO, semi_axes)


def save_chain(chain: ChainWeights, path: str | Path) -> None:
    """Writes a chain as .npz or .safetensors, its metadata inside.

    Raises:
        ValueError: for any other file name extension.
    """
    path = Path(path)
    arrays: dict[str, FloatArray] = {}
    for name, network in chain.networks.items():
        for i, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True), 1):
            arrays[f"{name}_W{i}"] = weight
            arrays[f"{name}_b{i}"] = bias
        for key in _SCALING:
            arrays[f"{name}_{key}"] = np.asarray(getattr(network, key), dtype=float)
    arrays |= {key: getattr(chain, key) for key in ("lower", "upper", "input_scale")}
    if chain.limit.lambda1.size:
        arrays |= {f"limit_{key}": getattr(chain.limit, key) for key in _LIMIT}
    header = json.dumps({"log_targets": sorted(chain.log_targets), **chain.metadata})
    if path.suffix == ".npz":
        np.savez_compressed(path, metadata=np.array(header), **arrays)  # type: ignore[arg-type]
    elif path.suffix == ".safetensors":
        from safetensors.numpy import save_file

        save_file(
            {key: np.array(value, order="C") for key, value in arrays.items()},
            path,
            {"metadata": header},
        )
    else:
        raise ValueError(f"weights are written as .npz or .safetensors, not {path.name!r}")


def load_chain(path: str | Path) -> ChainWeights:
    """Reads a chain written by `save_chain`.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not such a file, or an array or a metadata entry is
            missing, misshapen or not finite; the message names it.
    """
    path = Path(path)
    arrays, header = _read_arrays(path)
    if header is None:
        raise ValueError(
            f"{path} has no metadata: it is no weights file of `save_chain`; for the plain "
            "layout of full widths use `load_width_chain`"
        )
    try:
        metadata = json.loads(header)
        log_targets = frozenset(metadata.pop("log_targets"))
    except (ValueError, KeyError, AttributeError, TypeError) as error:
        raise ValueError(f"{path}: the metadata are damaged or lack 'log_targets'") from error
    if not log_targets <= set(TARGETS):
        raise ValueError(f"{path}: log_targets holds {sorted(log_targets)}, valid are {TARGETS}")
    lower = _array(path, arrays, "lower", (None,))
    if lower.size not in (3, 4):
        raise ValueError(f"{path}: 'lower' has {lower.size} entries, it must have 3 or 4")
    upper, scale = (_array(path, arrays, key, lower.shape) for key in ("upper", "input_scale"))
    limit = ClearanceLimit()
    if any(f"limit_{key}" in arrays for key in _LIMIT):
        axes = [_array(path, arrays, f"limit_{key}", (None,)) for key in _LIMIT[:3]]
        shape = tuple(axis.size for axis in axes)
        if min(shape) < 2 or not all((np.diff(axis) > 0.0).all() for axis in axes):
            raise ValueError(f"{path}: limit_lambda1, _lambda2 and _position must increase")
        if lower.size < 4:
            raise ValueError(f"{path}: a chain of 3 inputs has no 'limit_clearance'")
        table = _array(path, arrays, "limit_clearance", shape)
        limit = ClearanceLimit(axes[0], axes[1], axes[2], table)
    networks = _networks(path, arrays, lower.size)
    return ChainWeights(networks, lower, upper, scale, log_targets, limit, metadata)


def load_width_chain(path: str | Path) -> ChainWeights:
    """Reads a chain in the plain layout: trained on full widths and a 1 m baseline.

    The keys are ``{kappa,psi,alpha}_{W1.., b1.., in_offset, in_gain, in_min,
    out_offset, out_gain, out_min}``; the range is that of the min-max scaling.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if an array is missing, misshapen or not finite.
    """
    path = Path(path)
    arrays, _ = _read_arrays(path)
    networks = _networks(path, arrays, 3)
    first = networks["kappa"]
    scale = np.array([2.0, 2.0, 1.0])
    upper = first.in_offset - 2.0 * first.in_min / first.in_gain
    return ChainWeights(networks, first.in_offset / scale, upper / scale, scale)


_SCALING = ("in_offset", "in_gain", "in_min", "out_offset", "out_gain", "out_min")
_LIMIT = ("lambda1", "lambda2", "position", "clearance")


def _read_arrays(path: Path) -> tuple[dict[str, Any], str | None]:
    if not path.is_file():
        raise FileNotFoundError(
            f"no weights file {path}: train one with `python -m drake_oa.training --out {path}`, "
            "or use package://drake_oa/weights/regressor_chain.npz, which is shipped"
        )
    try:
        if path.suffix == ".safetensors":
            from safetensors import safe_open

            with safe_open(path, "numpy") as file:
                header = (file.metadata() or {}).get("metadata")
                return {key: file.get_tensor(key) for key in file.keys()}, header  # noqa: SIM118
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
    except Exception as error:
        # The readers raise a dozen types between them, some their own.
        raise ValueError(f"{path} cannot be read as .npz or .safetensors: {error}") from error
    header = arrays.pop("metadata", None)
    return arrays, None if header is None else str(header)


def _array(
    path: Path, arrays: Mapping[str, Any], key: str, shape: tuple[int | None, ...]
) -> FloatArray:
    if key not in arrays:
        raise ValueError(f"{path} lacks the array '{key}'")
    value = np.asarray(arrays[key])
    fits = value.ndim == len(shape) and all(
        want in (None, have) for want, have in zip(shape, value.shape, strict=True)
    )
    if not fits:
        wanted = tuple("any" if n is None else n for n in shape)
        raise ValueError(f"{path}: '{key}' has the shape {value.shape}, it must be {wanted}")
    if value.dtype.kind not in "fiu" or not np.isfinite(value).all():
        raise ValueError(f"{path}: '{key}' must hold finite numbers")
    return value.astype(float)


def _networks(path: Path, arrays: Mapping[str, Any], n_inputs: int) -> dict[str, Network]:
    networks = {}
    for i, name in enumerate(TARGETS):
        n_layers = 1
        while f"{name}_W{n_layers + 1}" in arrays:
            n_layers += 1
        n_in, weights, biases = n_inputs + i, [], []
        for layer in range(1, n_layers + 1):
            n_out = 1 if layer == n_layers else None
            weight = _array(path, arrays, f"{name}_W{layer}", (n_out, n_in))
            n_in = len(weight)
            weights.append(weight)
            biases.append(_array(path, arrays, f"{name}_b{layer}", (n_in,)))
        offset, gain = (
            _array(path, arrays, f"{name}_{key}", (n_inputs + i,)) for key in _SCALING[:2]
        )
        scalars = {
            key: float(_array(path, arrays, f"{name}_{key}", ()))
            for key in ("in_min", "out_offset", "out_gain", "out_min")
        }
        if scalars["out_gain"] == 0.0 or not gain.all():
            raise ValueError(f"{path}: a scale of '{name}' (in_gain, out_gain) is zero")
        networks[name] = Network(tuple(weights), tuple(biases), offset, gain, **scalars)
    return networks
