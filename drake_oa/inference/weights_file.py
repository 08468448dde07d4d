"""Reading and writing of trained networks: named arrays and metadata in .safetensors files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from drake_oa.common.files import replace_file
from drake_oa.common.messages import FloatArray


def write_weights(
    path: str | Path, arrays: Mapping[str, Any], metadata: Mapping[str, Any], kind: str
) -> None:
    """Writes arrays and metadata to a weights file in the .safetensors format.

    Args:
        path: file to replace.
        arrays: arrays by name.
        metadata: metadata, saved as JSON.
        kind: name and version of the format of arrays and metadata, saved with the metadata.

    Raises:
        ValueError: for another file name extension than .safetensors.
    """
    path = Path(path)
    if path.suffix != ".safetensors":
        raise ValueError(
            f"weights file {path.name!r}: the extension must be .safetensors, not {path.suffix!r}"
        )
    ordered = {key: np.array(value, order="C") for key, value in arrays.items()}
    header = {"metadata": json.dumps({**metadata, "format": kind})}
    replace_file(path, lambda temporary: save_file(ordered, temporary, header))


def read_weights(path: Path, kind: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Reads arrays and metadata of a weights file.

    Args:
        path: .safetensors file written by `write_weights`.
        kind: required name and version of the format of arrays and metadata.

    Returns:
        Arrays by name, and metadata without the format.

    Raises:
        FileNotFoundError: if the file does not exist.
        ValueError: if the file cannot be read, or has another format than `kind`.
    """
    if not path.is_file():
        raise FileNotFoundError(
            f"no weights file {path}: train one with `drake-oa train --recipe paper_running --out "
            f"{path.parent}`, or use package://drake_oa/weights/paper_chain_running.safetensors"
        )
    try:
        with safe_open(path, "numpy") as file:
            metadata = json.loads((file.metadata() or {}).get("metadata", "{}"))
            arrays = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be read as .safetensors: {error}") from error
    file_kind = metadata.pop("format", None)
    if file_kind != kind:
        raise ValueError(f"{path} has the format {file_kind!r}; it must be {kind!r}")
    return arrays, metadata


def array_of(
    path: Path, arrays: Mapping[str, Any], key: str, shape: tuple[int | None, ...]
) -> FloatArray:
    """Returns an array of a weights file and checks its shape and values.

    Args:
        path: weights file, named in errors.
        arrays: arrays of the file by name.
        key: name of the array.
        shape: required shape; an element None permits any length.

    Raises:
        ValueError: if the array is missing, misshapen or not finite; names file and array.
    """
    if key not in arrays:
        raise ValueError(f"{path} lacks the array '{key}'")
    value = np.asarray(arrays[key], dtype=float)
    required = tuple(value.shape[i] if n is None else n for i, n in enumerate(shape[: value.ndim]))
    if value.ndim != len(shape) or value.shape != required:
        raise ValueError(f"{path}: '{key}' has the shape {value.shape}, it must be {shape}")
    if not np.isfinite(value).all():
        raise ValueError(f"{path}: '{key}' must contain only finite numbers")
    return value
