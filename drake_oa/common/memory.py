"""How much memory there is, to refuse too much before it is taken."""

from __future__ import annotations

import math
import os
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np


class ArrayHeader(NamedTuple):
    """What an array of an archive is."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]


def available_memory() -> int | None:
    """Memory that can be taken [bytes], the container's limit included; None: unknown."""
    found = [value for value in (_of_machine(), _of_container()) if value is not None]
    return min(found) if found else None


def check_memory(what: str, size: int) -> None:
    """Raises ValueError when `size` bytes for `what` are more than there are."""
    there = available_memory()
    if there is not None and size > there:
        raise ValueError(
            f"{what}: would take about {size / 1e9:.3g} GB of memory; {there / 1e9:.3g} GB "
            f"are available"
        )


def archive_headers(path: Path) -> dict[str, ArrayHeader]:
    """Name -> header of an .npz archive's arrays, without reading them.

    Raises:
        OSError, ValueError, zipfile.BadZipFile: if it cannot be read.
    """
    found: dict[str, ArrayHeader] = {}
    with zipfile.ZipFile(path) as archive:
        for entry in archive.namelist():
            if not entry.endswith(".npy"):
                continue
            with archive.open(entry) as file:
                version = np.lib.format.read_magic(file)
                reader = (
                    np.lib.format.read_array_header_1_0
                    if version == (1, 0)
                    else np.lib.format.read_array_header_2_0
                )
                shape, _, dtype = reader(file)
            found[entry.removesuffix(".npy")] = ArrayHeader(shape, dtype)
    return found


def check_archive(path: Path) -> None:
    """Raises ValueError where the arrays of an .npz archive claim more memory than there is.

    Raises also what `archive_headers` does.
    """
    sizes = [math.prod(item.shape) * item.dtype.itemsize for item in archive_headers(path).values()]
    check_memory("its arrays", sum(sizes))


def _of_machine() -> int | None:
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return 1024 * int(line.split()[1])
    except OSError:
        pass
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return None


def _of_container() -> int | None:
    folder = Path("/sys/fs/cgroup")
    try:
        limit = int((folder / "memory.max").read_text())
        used = int((folder / "memory.current").read_text())
        lines = (folder / "memory.stat").read_text().splitlines()
        stat = dict(line.split(" ", 1) for line in lines)
        # The cache of files gives way.
        cache = int(stat["active_file"]) + int(stat["inactive_file"])
    except (KeyError, OSError, ValueError):
        return None
    return max(limit - used + cache, 0)
