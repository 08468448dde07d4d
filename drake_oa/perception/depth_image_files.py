"""Depth images in files of other tools: 16-bit .png images, and their intrinsics.

The intrinsics of ``scene.png`` are looked for beside it, in ``scene.json``,
``scene.yaml``, ``intrinsics.json``, ``camera_info.yaml`` and so on (see
`INTRINSICS_NAMES`). Such a file holds ``fx, fy, cx, cy``, or a row-major 3 x 3 matrix
``K``, ``k``, ``camera_matrix`` (ROS: with ``data``) or ``intrinsic_matrix``, and
optionally ``depth_scale`` [m a unit].
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_oa.common.messages import FloatArray
from drake_oa.common.schema_check import read_yaml

INTRINSICS_NAMES = (
    "{stem}.json", "{stem}.yaml", "{stem}.yml", "intrinsics.json", "intrinsics.yaml",
    "intrinsics.yml", "camera_info.json", "camera_info.yaml", "camera_info.yml",
)  # fmt: skip
"""Where the intrinsics of an image are looked for, in this order, in the image's folder."""

_MATRIX_NAMES = ("K", "k", "camera_matrix", "intrinsic_matrix")


@dataclass(frozen=True, eq=False)
class DepthCoding:
    """What a depth image's file does not say itself.

    Attributes:
        K: (4,) fx, fy, cx, cy [pixel], or None when unknown.
        depth_scale: metres a unit of the image, or None when unknown.
    """

    K: FloatArray | None = None
    depth_scale: float | None = None


def read_depth_png(
    path: Path, coding: DepthCoding | None = None
) -> tuple[NDArray[np.float32], FloatArray]:
    """Depth (H, W) [m] of a 16-bit image, NaN where it holds 0, and K (4,) [pixel].

    Args:
        path: the image.
        coding: K and scale; what it leaves open comes from a file beside the image,
            and the scale, if that does not name it, is 0.001 (millimetres).

    Raises:
        ValueError: naming the file, when it is no 16-bit image of one channel, or
            when its intrinsics are not known or make no sense.
    """
    coding = coding or DepthCoding()
    values = _read_image(path)
    beside = DepthCoding() if coding.K is not None else _coding_beside(path)
    K = coding.K if coding.K is not None else beside.K
    if K is None:
        names = ", ".join(name.format(stem=path.stem) for name in INTRINSICS_NAMES)
        raise ValueError(
            f"'{path}' needs intrinsics: give fx fy cx cy (--intrinsics), or a file beside it "
            f"named one of {names}"
        )
    scale = coding.depth_scale or beside.depth_scale or 0.001
    depth = values.astype(np.float32) * np.float32(scale)
    depth[values == 0] = np.nan
    return depth, K


def checked_intrinsics(values: Any, where: str) -> FloatArray:
    """K = [fx, fy, cx, cy], also from a 3 x 3 camera matrix.

    Args:
        values: 4 numbers, or 9 row by row.
        where: what an error names.

    Raises:
        ValueError: for other sizes, values that are not finite, or a focal length that
            is not positive.
    """
    try:
        array = np.asarray(values, dtype=float).ravel()
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.size == 9:
        array = array[[0, 4, 2, 5]]
    if array.size != 4 or not np.isfinite(array).all() or (array[:2] <= 0.0).any():
        raise ValueError(
            f"{where}: intrinsics must be fx, fy, cx, cy [pixel] or a 3 x 3 camera matrix, "
            f"with positive focal lengths, not {values}"
        )
    return array


def _read_image(path: Path) -> NDArray[np.uint16]:
    import open3d

    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        values = np.asarray(open3d.io.read_image(path))
    if values.dtype != np.uint16 or values.ndim != 2:
        if not values.shape:
            raise ValueError(f"'{path}' cannot be read as a .png image")
        channels = 1 if values.ndim == 2 else values.shape[2]
        raise ValueError(
            f"'{path}' must be a 16-bit image of one channel (depth); it has "
            f"{channels} of {values.dtype.itemsize * 8} bit"
        )
    return values


def _coding_beside(path: Path) -> DepthCoding:
    for name in INTRINSICS_NAMES:
        beside = path.with_name(name.format(stem=path.stem))
        if beside.is_file():
            return _read_coding(beside)
    return DepthCoding()


def _read_coding(path: Path) -> DepthCoding:
    try:
        text = path.read_text()
        data = json.loads(text) if path.suffix == ".json" else read_yaml(text)
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"'{path}' cannot be read: {error}") from None
    if not isinstance(data, Mapping):
        raise ValueError(f"'{path}' must hold fx, fy, cx, cy or a camera matrix by name")
    scale = data.get("depth_scale")
    number = isinstance(scale, int | float) and not isinstance(scale, bool)
    if scale is not None and not (number and 0.0 < scale < np.inf):
        raise ValueError(f"'{path}': depth_scale must be positive [m a unit], not {scale!r}")
    if all(name in data for name in ("fx", "fy", "cx", "cy")):
        K = checked_intrinsics([data[name] for name in ("fx", "fy", "cx", "cy")], f"'{path}'")
        return DepthCoding(K, scale)
    for name in _MATRIX_NAMES:
        matrix = data.get(name)
        if isinstance(matrix, Mapping):
            matrix = matrix.get("data")
        if matrix is not None:
            return DepthCoding(checked_intrinsics(matrix, f"'{path}': {name}"), scale)
    raise ValueError(
        f"'{path}' must hold fx, fy, cx, cy or one of {', '.join(_MATRIX_NAMES)}; it holds "
        f"{', '.join(map(str, data)) or 'nothing'}"
    )
