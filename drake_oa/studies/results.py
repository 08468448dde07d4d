"""Results on disk, each in a small file of its own, so that an evaluation can resume.

A file holds its content and a key: a digest of everything that the content follows from,
the package's own source and models among it. A file whose key is another's is not taken.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

from drake_oa.common.files import replace_text, source_digest
from drake_oa.studies.parallel import Call, carry_out

_Place = TypeVar("_Place")
_logger = logging.getLogger("drake_oa")

_PACKAGES = ("drake", "numba", "numpy", "scipy")


def content_key(*parts: object) -> str:
    """Digest of plain data, of `source_digest`, and of the versions of Drake and compilers."""
    versions = [version(name) for name in _PACKAGES]
    text = json.dumps([source_digest(), versions, *parts], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


class ResultFolder:
    """Named results in a folder."""

    def __init__(self, folder: Path) -> None:
        """Makes the folder.

        Raises:
            ValueError: if it cannot be made or written to.
        """
        self.path = folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
            trial = folder / ".writable"
            trial.write_text("")
            trial.unlink()
        except OSError as error:
            raise ValueError(f"cannot write results to {folder}: {error.strerror}") from None

    def load(self, name: str, key: str) -> Any:
        """The content of a name, or None where there is none of this key.

        A file that cannot be read is warned of and counts as none.
        """
        path = self.path / f"{name}.json"
        try:
            found = json.loads(path.read_text())
            return found["content"] if found["key"] == key else None
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError) as error:
            _logger.warning("%s cannot be read and is made anew: %r", path, error)
            return None

    def save(self, name: str, key: str, content: Any) -> None:
        """Writes a content in one piece."""
        text = json.dumps({"key": key, "content": content}, indent=1, allow_nan=False)
        replace_text(self.path / f"{name}.json", text + "\n")


@dataclass(frozen=True)
class Task:
    """A call, and where its result is kept.

    Attributes:
        name: of the result in its folder.
        key: see `content_key`.
        call: arguments of the function.
        files: that it is to leave besides, or it is done anew.
    """

    name: str
    key: str
    call: Call
    files: tuple[Path, ...] = ()


def resumed(
    function: Callable[..., tuple[Any, Any]],
    tasks: Mapping[_Place, Task],
    folder: ResultFolder | None,
    *,
    jobs: int = 1,
    scheduler: str | None = None,
    prepare: Callable[[Sequence[Call]], None] | None = None,
) -> Iterator[tuple[_Place, Any, Any, bool]]:
    """Carries out what is not on disk yet, and writes each result as soon as it is done.

    Args:
        function: gives the result to keep and something that is not kept.
        tasks: place -> task.
        folder: of the results; None: nothing is kept.
        jobs: see `carry_out`.
        scheduler: see `carry_out`.
        prepare: called with the arguments of what is to be done, before processes share it.

    Yields:
        Place, result, what is not kept, and whether the result was on disk: those first.
    """
    todo = []
    for place, task in tasks.items():
        known = folder.load(task.name, task.key) if folder else None
        if isinstance(known, dict) and all(file.exists() for file in task.files):
            yield place, known, None, True
        else:
            todo.append(place)
    calls = [tasks[place].call for place in todo]
    if prepare is not None and jobs > 1 and scheduler is None and len(calls) > 1:
        prepare(calls)
    for number, (content, rest) in carry_out(function, calls, jobs=jobs, scheduler=scheduler):
        task = tasks[todo[number]]
        if folder:
            folder.save(task.name, task.key, content)
        yield todo[number], content, rest, False
