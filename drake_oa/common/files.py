"""Files that a command writes: checked before a long computation, replaced whole."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path


def check_outputs(*paths: Path | None) -> None:
    """Makes the folders of files that are to be written; leaves the files as they are.

    Args:
        paths: the files; None for one that is not asked for.

    Raises:
        ValueError: naming the first that cannot be written, and why.
    """
    for path in paths:
        if path is None:
            continue
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ValueError(
                f"cannot write {path}: cannot make the folder {path.parent}: {error.strerror}"
            ) from None
        try:
            known = path.exists()
            with path.open("ab"):
                pass
        except OSError as error:
            raise ValueError(f"cannot write {path}: {error.strerror}") from None
        if not known:
            path.unlink()


def same_file(*paths: Path | None) -> bool:
    """Whether two of the paths, apart from None, lead to the same file."""
    given = [path.resolve() for path in paths if path is not None]
    return len(set(given)) < len(given)


def check_space(path: Path, size: int) -> None:
    """Refuses a file whose disk is about full.

    Args:
        path: the file; its folder exists.
        size: space that must be free [byte].

    Raises:
        ValueError: if less is free; says how much there is.
    """
    free = shutil.disk_usage(path.parent).free
    if free < size:
        raise ValueError(
            f"cannot write {path}: {free / 2**20:.1f} MiB are free on its disk; "
            f"{size / 2**20:.0f} MiB are needed"
        )


def reserve_file(folder: Path, stem: str, suffix: str) -> Path:
    """Makes an empty file `folder/stem-TIME suffix` that no other process has or will get.

    TIME is UTC, to a second; a number follows it where that name is taken.

    Raises:
        ValueError: if the folder or the file cannot be made; names it, and why.
    """
    time = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    number = 1
    try:
        folder.mkdir(parents=True, exist_ok=True)
        while True:
            tail = "" if number == 1 else f"-{number}"
            path = folder / f"{stem}-{time}{tail}{suffix}"
            try:
                path.touch(exist_ok=False)
            except FileExistsError:
                number += 1
            else:
                return path
    except OSError as error:
        raise ValueError(f"cannot write to the folder {folder}: {error.strerror}") from None


def replace_file(path: Path, write: Callable[[Path], object]) -> None:
    """Writes a file in one piece: an earlier one stays whole until the new one is.

    What is no regular file, as /dev/stdout, is written to.

    Args:
        path: the file.
        write: called with the path to write to.
    """
    # Before the link is followed: that of /dev/stdout may lead to no path at all.
    if path.exists() and not path.is_file():
        write(path)
        return
    path = path.resolve()
    # Of this process alone: another may be writing the same file.
    beside = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        write(beside)
        os.replace(beside, path)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise


def replace_text(path: Path, text: str) -> None:
    """Writes a text file in one piece; see `replace_file`."""
    replace_file(path, lambda beside: beside.write_text(text))
