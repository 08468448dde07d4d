"""A network of the regressor chain, and the file that networks are kept in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from drake_oa.common.files import replace_file
from drake_oa.common.messages import FloatArray, Frozen


def write_arrays(path: Path, arrays: Mapping[str, FloatArray], header: str) -> None:
    """Writes the arrays and the header.

    Args:
        path: the file, .safetensors.
        arrays: by name.
        header: text that goes with them.

    Raises:
        ValueError: for another extension.
    """
    if path.suffix != ".safetensors":
        raise ValueError(f"weights are written as .safetensors, not {path.name!r}")
    ordered = {key: np.array(value, order="C") for key, value in arrays.items()}
    replace_file(path, lambda beside: save_file(ordered, beside, {"metadata": header}))


def read_arrays(path: Path) -> tuple[dict[str, Any], str | None]:
    """Reads the arrays, and the header where there is one.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it cannot be read.
    """
    if not path.is_file():
        raise FileNotFoundError(
            f"no weights file {path}: train one with `drake-oa train --out {path.parent}`, "
            "or name a shipped one, package://drake_oa/weights/proposals.safetensors or "
            "paper_chain_running.safetensors"
        )
    try:
        with safe_open(path, "numpy") as file:
            header = (file.metadata() or {}).get("metadata")
            return {key: file.get_tensor(key) for key in file.keys()}, header  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path} cannot be read as .safetensors: {error}") from error


def array_of(
    path: Path, arrays: Mapping[str, Any], key: str, shape: tuple[int | None, ...]
) -> FloatArray:
    """One of the arrays, of the given shape (None: any length) and finite.

    Raises:
        ValueError: naming file and array, if it is missing, misshapen or not finite.
    """
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
