"""Files that a command writes: checked before a long computation, replaced whole."""

from __future__ import annotations

import os
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


def replace_text(path: Path, text: str) -> None:
    """Writes a text file in one piece: an earlier one stays whole until the new one is.

    What is no regular file, as /dev/stdout, is written to.
    """
    # Before the link is followed: that of /dev/stdout may lead to no path at all.
    if path.exists() and not path.is_file():
        path.write_text(text)
        return
    path = path.resolve()
    beside = path.with_name(f"{path.name}.part")
    beside.write_text(text)
    os.replace(beside, path)
