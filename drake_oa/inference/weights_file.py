"""Files of trained networks: named arrays and metadata, as .safetensors."""

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
    """Writes arrays and metadata; `kind` names the format.

    Raises:
        ValueError: for any other file name extension than .safetensors.
    """
    path = Path(path)
    if path.suffix != ".safetensors":
        raise ValueError(f"weights are written as .safetensors, not {path.name!r}")
    ordered = {key: np.array(value, order="C") for key, value in arrays.items()}
    header = {"metadata": json.dumps({**metadata, "format": kind})}
    replace_file(path, lambda beside: save_file(ordered, beside, header))


def read_weights(path: Path, kind: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Reads arrays and metadata of a format.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it cannot be read, or is of another format.
    """
    if not path.is_file():
        raise FileNotFoundError(
            f"no weights file {path}: train one with `drake-oa train --out {path.parent}`, "
            "or name a shipped one, package://drake_oa/weights/paper_chain.safetensors or "
            "paper_chain_running.safetensors"
        )
    try:
        with safe_open(path, "numpy") as file:
            metadata = json.loads((file.metadata() or {}).get("metadata", "{}"))
            arrays = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be read as .safetensors: {error}") from error
    written = metadata.pop("format", None)
    if written != kind:
        raise ValueError(f"{path} is of the format {written!r}, not {kind!r}")
    return arrays, metadata


def array_of(
    path: Path, arrays: Mapping[str, Any], key: str, shape: tuple[int | None, ...]
) -> FloatArray:
    """Returns one of the arrays, of the given shape (None: any length) and finite.

    Raises:
        ValueError: naming file and array, if it is missing, misshapen or not finite.
    """
    if key not in arrays:
        raise ValueError(f"{path} lacks the array '{key}'")
    value = np.asarray(arrays[key], dtype=float)
    wanted = tuple(value.shape[i] if n is None else n for i, n in enumerate(shape[: value.ndim]))
    if value.ndim != len(shape) or value.shape != wanted:
        raise ValueError(f"{path}: '{key}' has the shape {value.shape}, it must be {shape}")
    if not np.isfinite(value).all():
        raise ValueError(f"{path}: '{key}' must hold finite numbers")
    return value
