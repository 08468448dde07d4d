"""Folders of recorded depth images and clouds, read into frames in order of time.

A file is one frame:

- ``.npz`` with ``depth`` (H, W) [m] and ``K`` = [fx, fy, cx, cy], or with ``points``
  (N, 3) [m]; in either case optionally ``X_WC`` (4, 4), ``stamp`` [s] and
  ``robot_state`` [q, v], by which the robot is taken out of the frame;
- ``.pcd`` or ``.ply``: a cloud. One with the rows and columns of a depth image (a
  .pcd file's HEIGHT above 1) is read as that image, its K being fitted to the points;
- ``.png``: a 16-bit depth image whose K stands in a file beside it: for ``scene.png`` in
  ``scene.json``, ``scene.yaml``, ``intrinsics.json``, ``camera_info.yaml`` and so on (see
  `INTRINSICS_NAMES`). It holds ``fx, fy, cx, cy``, or a row-major 3 x 3 matrix ``K``, ``k``,
  ``camera_matrix`` (ROS: with ``data``) or ``intrinsic_matrix``, and optionally
  ``depth_scale`` [m a unit].

Where a file holds no stamp, the number at the end of its name is the stamp in
seconds if it has a decimal point (``cloud_000.066.pcd``); otherwise the stamp is the
file's place in the folder, in order of name, times the period.

Open3D reads the clouds; of a file that is cut short it hands out what the memory held before, so
that a file is first held against what its header promises.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import re
import sys
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_oa.common.config import read_yaml
from drake_oa.common.files import check_archive
from drake_oa.common.messages import FloatArray

_LINES, _LINE = 1000, 65536
"""Most lines of a header, and most bytes that are taken for one of them."""
_LZF = 88
"""At most this many times as long does data become that .pcd files hold compressed."""
_PLY_BYTES = {
    name: size
    for size, names in {
        1: "char uchar int8 uint8",
        2: "short ushort int16 uint16",
        4: "int uint float int32 uint32 float32",
        8: "double float64",
    }.items()
    for name in names.split()
}


class _Element(NamedTuple):
    name: str
    rows: int
    properties: list[list[int]]
    """Bytes of each: of the number, or of a list's length and of its numbers."""


def read_cloud_file(path: Path) -> tuple[FloatArray, tuple[int, int]]:
    """Reads one cloud.

    Args:
        path: a .pcd or .ply file.

    Returns:
        (N, 3) points [m], not finite where missing, and the columns and rows of the
        depth image that they were; (0, 0) where the file does not say.

    Raises:
        ValueError: naming the file, where it cannot be read, holds no point, or fewer
            points than its header promises.
    """
    with path.open("rb") as file:
        size = _check_pcd(path, file) if path.suffix.lower() == ".pcd" else _check_ply(path, file)
    import open3d

    # Open3D only warns, on standard output, about a file it cannot read.
    warnings = io.StringIO()
    try:
        with (
            contextlib.redirect_stdout(warnings),
            open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Warning),
        ):
            points = np.array(open3d.io.read_point_cloud(path).points, dtype=float)
    except MemoryError:
        raise ValueError(f"'{path}': not enough memory for its points") from None
    if warnings.getvalue():
        kind = path.suffix.lower()
        said = re.sub(r"\x1b\[[0-9;]*m|\[Open3D WARNING\]", "", warnings.getvalue())
        raise ValueError(f"'{path}' cannot be read as {kind}: {' '.join(said.split())}")
    if not np.isfinite(points).all(axis=1).any():
        raise ValueError(f"'{path}' holds no readable point")
    return points, size


def _check_pcd(path: Path, file: BinaryIO) -> tuple[int, int]:
    """Holds a .pcd file against its header; WIDTH and HEIGHT."""
    header: dict[str, list[str]] = {}
    for words in _header_lines(file):
        header[words[0]] = words[1:]
        if words[0] == "DATA":
            break
    try:
        sizes = [int(word) for word in header["SIZE"]]
        counts = [int(word) for word in header.get("COUNT", ["1"] * len(sizes))]
        row = sum(size * count for size, count in zip(sizes, counts, strict=True))
        promised, kind = int(header["POINTS"][0]), header["DATA"][0]
        width, height = (int(header[key][0]) if key in header else 0 for key in ("WIDTH", "HEIGHT"))
    except (KeyError, IndexError, ValueError):
        row = 0
    if row <= 0:
        raise ValueError(
            f"'{path}' cannot be read as .pcd: its header must give SIZE, POINTS and DATA, and "
            "whole numbers in SIZE, COUNT, WIDTH, HEIGHT and POINTS"
        )
    rest = path.stat().st_size - file.tell()
    if kind == "binary":
        _check_count(path, promised, rest // row)
    elif kind == "binary_compressed":
        packed, unpacked = np.frombuffer(file.read(8).ljust(8, b"\0"), dtype="<u4").tolist()
        if packed > rest - 8:
            raise ValueError(
                f"'{path}' is cut short: it promises {promised} points in {packed} compressed "
                f"bytes and holds {max(rest - 8, 0)}"
            )
        _check_count(path, promised, min(unpacked, _LZF * packed) // row)
    else:
        _check_count(path, promised, _whole_lines(file, promised, sum(counts)))
    return width, height


def _check_ply(path: Path, file: BinaryIO) -> tuple[int, int]:
    """Holds the vertices of a .ply file against its header; it says no width and height."""
    elements: list[_Element] = []
    kind, words = "", [""]
    try:
        for words in _header_lines(file):
            if words[0] == "format":
                kind = words[1]
            elif words[0] == "element":
                elements.append(_Element(words[1], int(words[2]), []))
            elif words[0] == "property":
                types = [words[2], words[3]] if words[1] == "list" else [words[1]]
                elements[-1].properties.append([_PLY_BYTES[name] for name in types])
            elif words[0] == "end_header":
                break
    except (IndexError, KeyError, ValueError):
        raise ValueError(
            f"'{path}' cannot be read as .ply: its header has '{' '.join(words)}'"
        ) from None
    if words[0] != "end_header" or "vertex" not in [element.name for element in elements]:
        raise ValueError(
            f"'{path}' cannot be read as .ply: its header has no element vertex, or no end"
        )
    end = path.stat().st_size
    for element in elements:
        if kind == "ascii":
            held = _whole_lines(file, element.rows, len(element.properties))
        else:
            held = _whole_rows(file, element, kind == "binary_big_endian", end)
        if element.name == "vertex":
            _check_count(path, element.rows, held)
            break
    return 0, 0


def _header_lines(file: BinaryIO) -> Iterator[list[str]]:
    """Words of each line, without empty ones and comments."""
    for _ in range(_LINES):
        line = file.readline(_LINE)
        if not line:
            return
        words = line.decode("ascii", errors="replace").split()
        if words and words[0] not in ("comment", "obj_info") and not words[0].startswith("#"):
            yield words


def _whole_lines(file: BinaryIO, count: int, columns: int) -> int:
    """How many of the next `count` lines that are not empty have all their columns."""
    lines = itertools.islice(filter(None, map(bytes.split, file)), min(max(count, 0), sys.maxsize))
    return sum(len(words) >= columns for words in lines)


def _whole_rows(file: BinaryIO, element: _Element, big_endian: bool, end: int) -> int:
    """How many of an element's binary rows are there; leaves the file behind them."""
    if all(len(item) == 1 for item in element.properties):
        row = sum(item[0] for item in element.properties)
        held = min(element.rows, (end - file.tell()) // max(row, 1))
        file.seek(held * row, io.SEEK_CUR)
        return held
    order: Literal["big", "little"] = "big" if big_endian else "little"
    for held in range(element.rows):
        for length, *each in element.properties:
            number = file.read(length)
            if len(number) < length:
                return held
            if each:
                file.seek(int.from_bytes(number, order) * each[0], io.SEEK_CUR)
        if file.tell() > end:
            return held
    return element.rows


def _check_count(path: Path, promised: int, held: int) -> None:
    if held < promised:
        raise ValueError(
            f"'{path}' is cut short: its header promises {promised} points, it holds {held}"
        )


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


SUFFIXES = (".npz", ".pcd", ".ply", ".png")

_PINHOLE_TOLERANCE = 0.5  # rms error [pixel] up to which a cloud is a depth image

_STAMP = re.compile(r"(?:^|[^0-9.])([0-9]+\.[0-9]+)$")


@dataclass(frozen=True, eq=False)
class RecordedFrame:
    """One recorded frame: a depth image with K, or points.

    Attributes:
        path: the file.
        stamp: its time [s].
        depth: (H, W) [m], or None.
        K: (4,) fx, fy, cx, cy [pixel], or None.
        points: (N, 3) in the camera frame [m], not finite where missing, or None.
        X_WC: (4, 4) pose of the camera, or None when the file does not know it.
        robot_state: [q, v] of a robot in view, or None.
    """

    path: Path
    stamp: float
    depth: NDArray[np.floating] | None = None
    K: FloatArray | None = None
    points: NDArray[np.floating] | None = None
    X_WC: FloatArray | None = None
    robot_state: FloatArray | None = None


def read_recording(folder: str | Path, period: float = 1.0 / 15.0) -> tuple[RecordedFrame, ...]:
    """Reads all frames of a folder, sorted by stamp.

    Hidden files, intrinsics files (.json, .yaml) and subfolders are ignored.

    Args:
        folder: the folder.
        period: time between files that carry no stamp [s].

    Raises:
        FileNotFoundError: if the folder does not exist or holds no file.
        ValueError: naming the file, for an unknown suffix, an unreadable file,
            missing or malformed arrays, or a stamp that two files share.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"recording: there is no folder '{folder}'")
    paths = frame_files(folder)
    if not paths:
        raise FileNotFoundError(
            f"recording: the folder '{folder}' holds no file; valid are {', '.join(SUFFIXES)}"
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
                f"{first.stamp} s; each frame needs its own"
            )
    return tuple(frames)


def frame_files(folder: Path) -> list[Path]:
    """The files of a folder in order of name, without hidden ones and intrinsics files."""
    return sorted(
        path
        for path in folder.iterdir()
        if path.is_file()
        and not path.name.startswith(".")
        and path.suffix not in (".json", ".yaml", ".yml")
    )


def read_frame(
    path: Path, default_stamp: float = 0.0, coding: DepthCoding | None = None
) -> RecordedFrame:
    """Reads one file.

    Args:
        path: the file.
        default_stamp: its time where neither file nor name holds one [s].
        coding: intrinsics and scale of a .png image; None: from a file beside it.

    Raises:
        ValueError: naming the file, for an unknown suffix, an unreadable file, or
            missing or malformed arrays.
    """
    match = _STAMP.search(path.stem)
    stamp = float(match.group(1)) if match else default_stamp
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return _read_npz(path, stamp)
    if suffix in (".pcd", ".ply"):
        return _read_cloud(path, stamp)
    if suffix == ".png":
        depth, K = read_depth_png(path, coding)
        return RecordedFrame(path, stamp, depth, K)
    raise ValueError(
        f"'{path}' has the unknown suffix '{path.suffix}'; valid are {', '.join(SUFFIXES)}"
    )


def _read_npz(path: Path, stamp: float) -> RecordedFrame:
    # NumPy takes anything else for pickled objects, or for a single array.
    if not zipfile.is_zipfile(path):
        raise ValueError(f"'{path}' cannot be read as .npz: it is no archive of arrays")
    try:
        check_archive(path)
        with np.load(path, allow_pickle=False) as archive:
            data = {name: np.asarray(archive[name]) for name in archive.files}
    except Exception as error:
        # What is damaged fails in the archive, its decompression, or the arrays' headers.
        raise ValueError(f"'{path}' cannot be read as .npz: {error}") from None
    depth, points = data.get("depth"), data.get("points")
    if (depth is None) == (points is None):
        raise ValueError(
            f"'{path}' must hold either 'depth' (with 'K') or 'points'; "
            f"it holds {', '.join(sorted(data)) or 'nothing'}"
        )
    K = None
    if depth is not None:
        _check_floats(path, "depth", depth, depth.ndim == 2 and depth.size > 0, "(H, W)")
        K = _numbers(path, data, "K", (4,))
        if K is None or (K[:2] <= 0.0).any():
            raise ValueError(f"'{path}' needs 'K' = [fx, fy, cx, cy] with its depth")
    if points is not None:
        shape_fits = points.ndim == 2 and points.shape[1] == 3
        _check_floats(path, "points", points, shape_fits, "(N, 3)")
    own_stamp = _numbers(path, data, "stamp", ())
    if own_stamp is not None:
        stamp = float(own_stamp)
    X_WC = _numbers(path, data, "X_WC", (4, 4))
    if X_WC is not None and not _is_rotation(X_WC[:3, :3]):
        raise ValueError(f"'X_WC' in '{path}' must hold a rotation; its first 3 x 3 is none")
    state_shape = np.shape(data.get("robot_state", ()))[:1]
    return RecordedFrame(
        path,
        stamp,
        depth,
        K,
        points,
        X_WC,
        _numbers(path, data, "robot_state", state_shape),
    )


def _check_floats(
    path: Path, name: str, array: NDArray[np.generic], fits: bool, shape: str
) -> None:
    if not fits or not np.issubdtype(array.dtype, np.floating):
        raise ValueError(
            f"'{name}' in '{path}' must be {shape} floats [m], not {array.dtype} {array.shape}"
        )


def _numbers(
    path: Path, data: Mapping[str, NDArray[np.generic]], name: str, shape: tuple[int, ...]
) -> FloatArray | None:
    if name not in data:
        return None
    array = data[name]
    number = np.issubdtype(array.dtype, np.floating) or np.issubdtype(array.dtype, np.integer)
    if not number or array.shape != shape or not np.isfinite(array.astype(float)).all():
        raise ValueError(
            f"'{name}' in '{path}' must be finite numbers of shape {shape}, "
            f"not {array.dtype} {array.shape}"
        )
    return array.astype(float)


def _is_rotation(R: FloatArray) -> bool:
    return bool(np.abs(R @ R.T - np.eye(3)).max() <= 1e-6 and np.linalg.det(R) > 0.0)


def _read_cloud(path: Path, stamp: float) -> RecordedFrame:
    points, (width, height) = read_cloud_file(path)
    if height > 1 and width * height == len(points):
        image = _as_depth_image(points.reshape(height, width, 3))
        if image is not None:
            return RecordedFrame(path, stamp, *image)
    return RecordedFrame(path, stamp, points=points)


def _as_depth_image(points: FloatArray) -> tuple[NDArray[np.float32], FloatArray] | None:
    """Depth and K of a cloud (H, W, 3) in the camera's frame; None when it is in another.

    A pinhole camera sees a point in column u = fx x / z + cx and row v = fy y / z + cy.
    """
    z = points[..., 2]
    seen = np.isfinite(points).all(axis=2) & (z > 1e-3)
    if np.count_nonzero(seen) < 10:
        return None
    K = np.zeros(4)
    rows, columns = np.nonzero(seen)
    for k, pixel in enumerate((columns, rows)):
        ratio = points[rows, columns, k] / z[seen]
        spread = ratio - ratio.mean()
        K[k] = spread @ (pixel - pixel.mean()) / max(float(spread @ spread), 1e-12)
        K[2 + k] = pixel.mean() - K[k] * ratio.mean()
        error = K[k] * ratio + K[2 + k] - pixel
        if K[k] <= 1.0 or np.sqrt(np.mean(error**2)) > _PINHOLE_TOLERANCE:
            return None
    return np.where(seen, z, np.nan).astype(np.float32), K
