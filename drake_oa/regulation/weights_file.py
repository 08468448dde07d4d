"""Files of trained networks: named arrays and a header, as .safetensors."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from drake_oa.common.files import replace_file
from drake_oa.common.messages import FloatArray


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
