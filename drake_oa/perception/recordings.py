"""Files of recorded depth images and point clouds.

Each file is one frame:

- ``.npz`` with ``depth`` (H, W) [m] and ``K`` = [fx, fy, cx, cy] [pixel], or with ``points`` (N, 3)
  in the camera frame [m]; both optionally with ``X_WC`` (4, 4), the pose of the camera in the
  world, ``stamp`` [s], and ``robot_state`` [q, v], by which points on the robot are removed;
- ``.pcd`` or ``.ply``: a point cloud in the camera frame [m];
- ``.png``: a 16-bit depth image with its intrinsics in a file of the same folder: for ``scene.png``
  ``scene.json``, ``intrinsics.json`` or ``camera_info.json`` (or ``.yaml``, ``.yml``). That file
  contains ``fx, fy, cx, cy``, or a 3 x 3 camera matrix, row by row or column by column, with the
  name ``K``, ``k``, ``camera_matrix`` (ROS: with ``data``) or ``intrinsic_matrix``. Optionally it
  contains ``depth_scale`` [m per unit].

The stamp of a file without one is the number at the end of its name in seconds, if that has a
decimal point (``cloud_000.066.pcd``). Otherwise it is the file's index in the folder, sorted by
name, times the period.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_oa.common.config import read_yaml
from drake_oa.common.files import read_arrays
from drake_oa.common.messages import FloatArray

SUFFIXES = (".npz", ".pcd", ".ply", ".png")
"""Suffixes of files that can be read as recorded frames (depth images or point clouds)."""

_SIDE_SUFFIXES = (".json", ".yaml", ".yml")
"""Suffixes of files that contain the camera intrinsics of recorded .png depth images."""

_MATRIX_NAMES = ("K", "k", "camera_matrix", "intrinsic_matrix")
"""Names under which an intrinsics file may contain a 3 x 3 camera matrix."""

_SHAPES: dict[str, tuple[int | None, ...]] = {
    "depth": (None, None),
    "points": (None, 3),
    "K": (4,),
    "X_WC": (4, 4),
    "stamp": (),
    "robot_state": (None,),
}
"""Shapes of the arrays that a recorded .npz file may contain, by name; None: any length."""

_HEADER = re.compile(rb"^(?:POINTS|element vertex)\s+(\d+)", re.MULTILINE)
"""Pattern of the number of points in the header of a .pcd or .ply file."""

_POINTS_PER_BYTE = 88
"""Upper bound of the number of points per byte of a cloud file: the best ratio of LZF compression.
A header with more points shows a damaged file."""

_DAMAGED = (
    "'{}' is truncated or contains no cloud: the number of points in its header must equal the "
    "number of points that follow; write it again as .pcd or .ply with fields x, y and z"
)
"""Error message for a point cloud file that cannot be read; {}: path of the file."""

_STAMP = re.compile(r"(?:^|[^0-9.])([0-9]+\.[0-9]+)$")
"""Pattern of a stamp [s] with a decimal point at the end of a file name without suffix."""


@dataclass(frozen=True, eq=False)
class RecordedFrame:
    """One recorded frame, read from a file: a depth image with its intrinsics K, or a point cloud.

    Attributes:
        path: path of the file.
        stamp: time of the frame [s].
        depth: (H, W) depth along the optical axis [m], or None.
        K: (4,) fx, fy, cx, cy [pixel], or None.
        points: (N, 3) points in the camera frame [m], not finite where missing, or None.
        X_WC: (4, 4) pose of the camera in the world; None: not in the file.
        robot_state: (num_states,) state [q, v] of the robot at the time of the frame [rad, m and
            per s], or None.
    """

    path: Path
    stamp: float
    depth: NDArray[np.floating] | None = None
    K: FloatArray | None = None
    points: NDArray[np.floating] | None = None
    X_WC: FloatArray | None = None
    robot_state: FloatArray | None = None


def read_recording(folder: str | Path, period: float = 1.0 / 15.0) -> tuple[RecordedFrame, ...]:
    """Reads all recorded frames (depth images or point clouds) of a folder, sorted by stamp.

    Hidden files, intrinsics files (.json, .yaml, .yml) and subfolders are ignored.

    Args:
        folder: folder of the recording.
        period: time between files without a stamp [s].

    Raises:
        FileNotFoundError: if the folder does not exist or is empty.
        ValueError: for an unknown suffix, an unreadable file, missing or malformed arrays, or two
            files with the same stamp; the message names the file.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"recording: no folder '{folder}'")
    paths = frame_files(folder)
    if not paths:
        raise FileNotFoundError(
            f"recording: folder '{folder}' is empty; valid files are {', '.join(SUFFIXES)}"
        )
    try:
        frames = [read_frame(path, index * period) for index, path in enumerate(paths)]
    except ValueError as error:
        raise ValueError(f"recording: {error}") from None
    frames.sort(key=lambda frame: frame.stamp)
    for first, second in itertools.pairwise(frames):
        if first.stamp == second.stamp:
            raise ValueError(
                f"recording: '{first.path}' and '{second.path.name}' have the same stamp "
                f"{first.stamp} s; each frame requires a different stamp"
            )
    return tuple(frames)


def frame_files(folder: Path) -> list[Path]:
    """Lists the files of a recording's folder by name, except hidden files and intrinsics files."""
    return sorted(
        path
        for path in folder.iterdir()
        if path.is_file() and not path.name.startswith(".") and path.suffix not in _SIDE_SUFFIXES
    )


def read_frame(
    path: Path,
    default_stamp: float = 0.0,
    K: FloatArray | None = None,
    depth_scale: float | None = None,
) -> RecordedFrame:
    """Reads a recorded frame (depth image or point cloud) from a .npz, .pcd, .ply or .png file.

    Args:
        path: path of the file.
        default_stamp: stamp if neither the file nor its name has one [s].
        K: (4,) fx, fy, cx, cy of a .png image [pixel]; None: from its intrinsics file.
        depth_scale: scale of a .png image [m per unit]; None: from the intrinsics file, else 0.001.

    Raises:
        ValueError: for an unknown suffix, an unreadable or truncated file, or missing or malformed
            arrays; the message names the file.
    """
    match = _STAMP.search(path.stem)
    stamp = float(match.group(1)) if match else default_stamp
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return _read_npz(path, stamp)
    if suffix in (".pcd", ".ply"):
        return _read_cloud(path, stamp)
    if suffix == ".png":
        return _read_depth_png(path, stamp, K, depth_scale)
    raise ValueError(
        f"'{path}' has the unknown suffix '{path.suffix}'; valid are {', '.join(SUFFIXES)}"
    )


def _read_npz(path: Path, stamp: float) -> RecordedFrame:
    """Reads and checks a recorded frame in a .npz file; the argument `stamp` [s] is used if the
    file contains none.

    Raises:
        ValueError: for missing or malformed arrays; the message names the file.
    """
    data = {name: array for name, array in read_arrays(path).items() if name in _SHAPES}
    if ("depth" in data) == ("points" in data) or ("depth" in data and "K" not in data):
        raise ValueError(f"'{path}' must contain either 'depth' and 'K' or 'points'")
    for name, array in data.items():
        shape, is_float = _SHAPES[name], name in ("depth", "points")
        sizes = tuple(want or size for want, size in zip(shape, array.shape, strict=False))
        kinds = "f" if is_float else "fiu"
        is_valid = array.dtype.kind in kinds and array.shape == sizes and array.ndim == len(shape)
        if not (is_valid and (array.size if is_float else np.isfinite(array).all())):
            raise ValueError(
                f"'{name}' in '{path}' must be {'floats [m]' if is_float else 'finite numbers'} "
                f"of shape {shape}, not {array.dtype} {array.shape}"
            )
        data[name] = array if is_float else array.astype(float)
    if "K" in data:
        checked_intrinsics(data["K"], f"'{path}': 'K'")
    if "X_WC" in data:
        R = data["X_WC"][:3, :3]
        if np.abs(R @ R.T - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0.0:
            raise ValueError(f"'X_WC' in '{path}': its upper left 3 x 3 block must be a rotation")
    return RecordedFrame(path, float(data.pop("stamp", stamp)), **data)


def _read_cloud(path: Path, stamp: float) -> RecordedFrame:
    """Reads a recorded frame from a .pcd or .ply file with a point cloud, and gives it the stamp
    `stamp` [s].

    Raises:
        ValueError: if the file is truncated or contains no finite point.
    """
    import open3d

    # Open3D allocates memory for all points of the header, and returns uninitialized memory for
    # missing lines of a .pcd file.
    data = path.read_bytes()
    header_count = int((_HEADER.findall(data[:65536]) or [b"0"])[0])
    lines = data.partition(b"DATA ascii\n")[2] if path.suffix.lower() == ".pcd" else b""
    max_count = len(lines.splitlines()) if lines else len(data) * _POINTS_PER_BYTE
    if not 0 < header_count <= max_count:
        raise ValueError(_DAMAGED.format(path))
    # Open3D raises no error for an unreadable file, but prints a warning to standard output.
    warnings = io.StringIO()
    with (
        contextlib.redirect_stdout(warnings),
        open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Warning),
    ):
        points = np.array(open3d.io.read_point_cloud(path).points, dtype=float)
    if warnings.getvalue() or not np.isfinite(points).all(axis=1).any():
        raise ValueError(_DAMAGED.format(path))
    return RecordedFrame(path, stamp, points=points)


def _read_depth_png(
    path: Path, stamp: float, K: FloatArray | None, depth_scale: float | None
) -> RecordedFrame:
    """Reads a recorded frame from a 16-bit .png depth image, in which 0 marks pixels without depth.

    Args:
        path: path of the image.
        stamp: time of the frame [s].
        K: (4,) intrinsics fx, fy, cx, cy [pixel]; None: from the intrinsics file.
        depth_scale: scale of the image [m per unit]; None: from the intrinsics file, else 0.001.

    Raises:
        ValueError: if the image is not complete with 16 bits and one channel, or intrinsics or
            scale are invalid.
    """
    import open3d

    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        values = np.asarray(open3d.io.read_image(path))
    # Open3D does not report a truncated image.
    is_complete = b"IEND" in path.read_bytes()[-64:]
    if values.dtype != np.uint16 or values.ndim != 2 or not is_complete:
        raise ValueError(f"'{path}' must be a complete 16-bit .png image of one channel (depth)")
    default_scale = 0.001
    if K is None:
        K, default_scale = _read_intrinsics(path)
    scale = default_scale if depth_scale is None else depth_scale
    if not 0.0 < scale < np.inf:
        raise ValueError(f"'{path}': depth scale must be positive [m per unit], not {scale}")
    depth = values.astype(np.float32) * np.float32(scale)
    depth[values == 0] = np.nan
    return RecordedFrame(path, stamp, depth, K)


def _read_intrinsics(image: Path) -> tuple[FloatArray, float]:
    """Reads intrinsics K (4,) [pixel] and depth scale [m per unit] from the intrinsics file beside
    an image.

    Raises:
        ValueError: if there is no such file, or its contents are invalid.
    """
    stems = (image.stem, "intrinsics", "camera_info")
    names = [stem + suffix for stem in stems for suffix in _SIDE_SUFFIXES]
    path = next((image.with_name(n) for n in names if image.with_name(n).is_file()), None)
    if path is None:
        raise ValueError(
            f"'{image}' requires intrinsics: use --intrinsics fx fy cx cy, or a file in the same "
            f"folder with one of the names {', '.join(names)}"
        )
    try:
        text = path.read_text()
        data = dict(json.loads(text) if path.suffix == ".json" else read_yaml(text))
        scale = float(data.get("depth_scale", 0.001))
    except (OSError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"'{path}' cannot be read: {error}") from None
    matrices = [data[name] for name in _MATRIX_NAMES if name in data]
    matrix = matrices[0] if matrices else [data.get(name) for name in ("fx", "fy", "cx", "cy")]
    if isinstance(matrix, Mapping):
        matrix = matrix.get("data")
    return checked_intrinsics(matrix, f"'{path}'"), scale


def checked_intrinsics(values: Any, where: str) -> FloatArray:
    """Checks the intrinsics of a camera, and returns them as K = [fx, fy, cx, cy] [pixel].

    Args:
        values: fx, fy, cx, cy, or a 3 x 3 camera matrix, row by row or column by column.
        where: file and field, with which an error message begins.

    Raises:
        ValueError: for other sizes, values that are not finite, or focal lengths that are not
            positive.
    """
    try:
        array = np.asarray(values, dtype=float).ravel()
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.size == 9:
        rows = array.reshape(3, 3)
        # Open3D writes the columns of the matrix one after the other.
        rows = rows.T if rows[0, 2] == rows[1, 2] == 0.0 else rows
        array = rows.ravel()[[0, 4, 2, 5]] if (rows[2] == [0.0, 0.0, 1.0]).all() else array
    if array.size != 4 or not np.isfinite(array).all() or (array[:2] <= 0.0).any():
        raise ValueError(
            f"{where}: intrinsics must be fx, fy, cx, cy [pixel] or a 3 x 3 camera matrix, "
            f"with positive focal lengths, not {values}"
        )
    return array
