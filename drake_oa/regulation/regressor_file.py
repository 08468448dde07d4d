"""Named arrays and a header in one file, .npz or .safetensors."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from drake_oa.common.memory import check_archive
from drake_oa.common.messages import FloatArray


def write_arrays(path: Path, arrays: Mapping[str, FloatArray], header: str) -> None:
    """Writes the arrays and the header.

    Args:
        path: the file; its extension tells the format.
        arrays: by name.
        header: text that goes with them.

    Raises:
        ValueError: for an extension other than .npz and .safetensors.
    """
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


def read_arrays(path: Path) -> tuple[dict[str, Any], str | None]:
    """Reads the arrays, and the header where there is one.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it cannot be read.
    """
    if not path.is_file():
        raise FileNotFoundError(
            f"no weights file {path}: train one with `drake-oa train --out {path.parent}`, "
            "or use package://drake_oa/weights/regressor_chain.npz, which is shipped"
        )
    try:
        if path.suffix == ".safetensors":
            from safetensors import safe_open

            with safe_open(path, "numpy") as file:
                header = (file.metadata() or {}).get("metadata")
                return {key: file.get_tensor(key) for key in file.keys()}, header  # noqa: SIM118
        if not zipfile.is_zipfile(path):
            # NumPy would take it for a pickle, and say how to load that.
            raise ValueError("it is no archive, or not a whole one")
        check_archive(path)
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
    except Exception as error:
        # The readers raise a dozen types between them, some their own.
        raise ValueError(f"{path} cannot be read as .npz or .safetensors: {error}") from error
    header = arrays.pop("metadata", None)
    return arrays, None if header is None else str(header)


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
