"""Results of evaluations: computed in parallel, stored one by one.

- `carry_out`: calls of one function carried out here, in processes, or on a Dask cluster.
- `resumed`: the same with results on disk, each in a small file of its own, so that an evaluation
  can resume. A file holds its content and a key: a digest of everything that the content follows
  from, the package's own source and models among it. A file whose key is another's is not taken.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from threadpoolctl import threadpool_limits

from drake_oa.common.files import check_outputs, replace_json, source_digest

CONNECT_TIMEOUT = 10.0
"""Time within which a cluster must answer [s]."""

Call = tuple[Any, ...]
"""The positional arguments of a call."""


def carry_out(
    function: Callable[..., Any],
    calls: Sequence[Call],
    *,
    jobs: int = 1,
    scheduler: str | None = None,
) -> Iterator[tuple[int, Any]]:
    """Carries out `function(*call)` for each call, and yields place and result as each is done.

    Exceptions pass through; what has not been started is then dropped.

    Args:
        function: picklable.
        calls: the arguments, picklable.
        jobs: processes at once; 1: in this process.
        scheduler: address of a Dask scheduler, which replaces `jobs`.

    Raises:
        ValueError: if there is no such scheduler, or the package for it is missing.
    """
    if scheduler is None and (jobs == 1 or len(calls) <= 1):
        for place, call in enumerate(calls):
            yield place, function(*call)
        return
    from joblib import Parallel, delayed, parallel_config

    with contextlib.ExitStack() as stack:
        if scheduler is None:
            backend: dict[str, Any] = {"backend": "loky", "n_jobs": jobs}
        else:
            backend = {"backend": "dask", "client": stack.enter_context(_client(scheduler))}
        stack.enter_context(parallel_config(**backend))
        # Long calls: handed out one by one. A cluster may grow, and receives all at once.
        ahead = jobs if scheduler is None else "all"
        pool = Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch=ahead)
        yield from pool(delayed(_placed)(function, *item) for item in enumerate(calls))


def _placed(function: Callable[..., Any], place: int, call: Call) -> tuple[int, Any]:
    """Carries out a call in a worker, which leaves the interrupt of a terminal to its parent."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Many small matrices: more BLAS threads only wait for each other.
    with threadpool_limits(limits=1):
        return place, function(*call)


def _client(scheduler: str) -> Any:
    try:
        from distributed import Client
        from distributed.comm import resolve_address
    except ModuleNotFoundError:
        raise ValueError(
            "a scheduler needs the package distributed: pip install 'drake_oa[cluster]'"
        ) from None
    try:
        # First: a client that refuses an address hangs for a while when it is disposed of.
        resolve_address(scheduler)
        return Client(scheduler, timeout=CONNECT_TIMEOUT, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ValueError(f"cannot reach a Dask scheduler at {scheduler}: {error}") from None


_Place = TypeVar("_Place")


def content_key(*parts: object) -> str:
    """Computes a digest of plain data, `source_digest`, and versions of Drake and compilers."""
    versions = [version(name) for name in ("drake", "numba", "numpy", "scipy")]
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
        check_outputs(folder / ".writable")

    def load(self, name: str, key: str) -> Any:
        """Returns the content of a name, or None where there is none of this key.

        A file that cannot be read is warned of and counts as none.
        """
        path = self.path / f"{name}.json"
        try:
            found = json.loads(path.read_text())
            return found["content"] if found["key"] == key else None
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError) as error:
            logging.getLogger("drake_oa").warning("%s is unreadable, repeated: %r", path, error)
            return None

    def save(self, name: str, key: str, content: Any) -> None:
        """Writes a content in one piece."""
        replace_json(self.path / f"{name}.json", {"key": key, "content": content})


class Task(NamedTuple):
    """A call, and where its result is stored.

    Attributes:
        name: of the result in its folder.
        key: see `content_key`.
        call: arguments of the function.
        file: another file that the function writes; without it the call is repeated.
    """

    name: str
    key: str
    call: Call
    file: Path | None = None


def resumed(
    function: Callable[..., Any],
    tasks: Mapping[_Place, Task],
    folder: ResultFolder | None,
    *,
    jobs: int = 1,
    scheduler: str | None = None,
) -> Iterator[tuple[_Place, Any, bool]]:
    """Carries out what is not on disk yet, and writes each result as soon as it is done.

    Args:
        function: returns plain data.
        tasks: place -> task.
        folder: of the results; None: nothing is stored.
        jobs: see `carry_out`.
        scheduler: see `carry_out`.

    Yields:
        Place, result, and whether it was on disk: those first.
    """
    todo = []
    for place, task in tasks.items():
        known = folder.load(task.name, task.key) if folder else None
        if known is not None and (task.file is None or task.file.exists()):
            yield place, known, True
        else:
            todo.append(place)
    calls = [tasks[place].call for place in todo]
    for number, content in carry_out(function, calls, jobs=jobs, scheduler=scheduler):
        task = tasks[todo[number]]
        if folder:
            folder.save(task.name, task.key, content)
        yield todo[number], content, False
