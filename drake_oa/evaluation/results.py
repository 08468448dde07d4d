"""Results of evaluations: computed in parallel, stored one by one.

- `carry_out`: calls carried out here, in processes, or on a Dask cluster.
- `resumed`: the same with results on disk, each in a small file of its own, so that an evaluation
  can resume. A file holds its content and a key: a digest of everything that the content follows
  from, the package's own source and models among it. A file with another key is not taken.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from threadpoolctl import threadpool_limits

from drake_oa.common.console import progress_bar
from drake_oa.common.files import import_extra, replace_json, source_digest

CONNECT_TIMEOUT = 10.0
"""Time within which a cluster must answer [s]."""


def carry_out(
    calls: Sequence[Callable[[], Any]], workers: int | str = 1
) -> Iterator[tuple[int, Any]]:
    """Carries out calls, and yields place and result as each is done.

    Exceptions pass through; what has not been started is then dropped.

    Args:
        calls: picklable functions without arguments.
        workers: processes at once, 1: this process; or the address of a Dask scheduler.

    Raises:
        ValueError: if there is no such scheduler, or the package for it is missing.
    """
    if workers == 1 or len(calls) <= 1:
        yield from ((place, call()) for place, call in enumerate(calls))
        return
    from joblib import Parallel, delayed, parallel_config

    with contextlib.ExitStack() as stack:
        if isinstance(workers, str):
            client = stack.enter_context(_client(workers))
            stack.enter_context(parallel_config("dask", client=client))
        else:
            stack.enter_context(parallel_config("loky", n_jobs=workers))
        # Long calls: handed out one by one.
        pool = Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch="all")
        yield from pool(delayed(_placed)(*item) for item in enumerate(calls))


def _placed(place: int, call: Callable[[], Any]) -> tuple[int, Any]:
    """Carries out a call in a worker, which leaves the interrupt of a terminal to its parent."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Many small matrices: more BLAS threads only wait for each other.
    with threadpool_limits(limits=1):
        return place, call()


def _client(scheduler: str) -> Any:
    distributed = import_extra("distributed", "cluster")
    try:
        # First: a client that refuses an address hangs for a while when it is disposed of.
        distributed.comm.resolve_address(scheduler)
        return distributed.Client(scheduler, timeout=CONNECT_TIMEOUT, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ValueError(f"cannot reach a Dask scheduler at {scheduler}: {error}") from None


_Place = TypeVar("_Place")


class Task(NamedTuple):
    """Call whose result is stored.

    Attributes:
        name: of the result in its folder.
        call: returns plain data that depend on its arguments.
    """

    name: str
    call: partial[Any]

    def key(self) -> str:
        """Computes a digest of call, `source_digest`, and versions of Drake and compilers."""
        versions = [version(name) for name in ("drake", "numba", "numpy", "scipy")]
        text = repr((source_digest(), versions, self.call.func.__name__, self.call.args))
        return hashlib.sha256(text.encode()).hexdigest()

    def load(self, folder: Path) -> Any:
        """Returns the stored result; None where there is none of the key, or it is unreadable."""
        path = folder / f"{self.name}.json"
        if not path.exists():
            return None
        try:
            found = json.loads(path.read_text())
            return found["content"] if found["key"] == self.key() else None
        except (OSError, ValueError, KeyError, TypeError) as error:
            logging.getLogger("drake_oa").warning("%s is unreadable, repeated: %r", path, error)
            return None


def resumed(
    tasks: Mapping[_Place, Task], folder: Path | None, workers: int | str = 1
) -> tuple[dict[_Place, Any], int]:
    """Carries out tasks without a result on disk, and writes each result as soon as it is done.

    Args:
        tasks: place -> task.
        folder: of the results; None: nothing is stored.
        workers: see `carry_out`.

    Returns:
        Results in the order of the tasks, and the number of those that were on disk.
    """
    found = {place: task.load(folder) if folder else None for place, task in tasks.items()}
    todo = [place for place, content in found.items() if content is None]
    known = len(tasks) - len(todo)
    with progress_bar(len(tasks)) as update:
        done = carry_out([tasks[place].call for place in todo], workers)
        for count, (number, content) in enumerate(done, known + 1):
            task = tasks[todo[number]]
            found[todo[number]] = content
            update(f"{task.name} {count}/{len(tasks)}", count)
            if folder:
                replace_json(folder / f"{task.name}.json", {"key": task.key(), "content": content})
    return found, known
