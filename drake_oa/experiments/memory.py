"""How much memory there is, to refuse too much before it is taken."""

from __future__ import annotations

import os
from pathlib import Path


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
        return max(limit - int((folder / "memory.current").read_text()), 0)
    except (OSError, ValueError):
        return None
