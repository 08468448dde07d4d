"""Points of .pcd and .ply files, where a file holds as many as its header promises.

Open3D reads them; of a file that is cut short it hands out what the memory held before.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Literal, NamedTuple

import numpy as np

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
