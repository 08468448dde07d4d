"""Evaluation results that are computed in parallel and stored as one file each.

A call is a function with its arguments, for example the run of a method in a scene.

- `carry_out`: carries out calls in this process, in worker processes, or on a Dask cluster.
- `resumed`: carries out calls that have no stored result, so that an interrupted evaluation can
  resume. A file holds a result and its key: a digest of the call, the package's source and model
  files, and the versions of libraries. A file with another key is ignored.
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
"""Timeout of the connection to a Dask scheduler, which distributes calls to a cluster [s]."""


def carry_out(
    calls: Sequence[Callable[[], Any]], workers: int | str = 1
) -> Iterator[tuple[int, Any]]:
    """Carries out function calls in parallel and yields (index, result) in order of completion.

    An exception of a call is raised here, and calls that have not started are canceled.

    Args:
        calls: picklable functions, called without arguments.
        workers: number of worker processes (1: this process), or the address of a Dask scheduler.

    Raises:
        ValueError: if the scheduler cannot be reached or the package `distributed` is missing.
    """
    if not isinstance(workers, str) and min(workers, len(calls)) <= 1:
        yield from ((place, call()) for place, call in enumerate(calls))
        return
    from joblib import Parallel, delayed, parallel_config

    with contextlib.ExitStack() as stack:
        if isinstance(workers, str):
            client = stack.enter_context(_client(workers))
            stack.enter_context(parallel_config("dask", client=client))
        else:
            stack.enter_context(parallel_config("loky", n_jobs=workers))
        # Calls are long, hence they are dispatched one by one.
        pool = Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch="all")
        yield from pool(delayed(_placed)(*item) for item in enumerate(calls))


def _placed(place: int, call: Callable[[], Any]) -> tuple[int, Any]:
    """Carries out a function call in a worker process and returns its index and result.

    The worker ignores SIGINT, so that only the parent process handles an interrupt.

    Args:
        place: index of the call in the arguments of `carry_out`.
        call: function, called without arguments.
    """
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    # With small matrices, additional BLAS threads would only wait for each other.
    with threadpool_limits(limits=1):
        return place, call()


def _client(scheduler: str) -> Any:
    """Connects to a Dask scheduler and returns the client.

    Args:
        scheduler: address of the scheduler, for example tcp://host:8786.

    Raises:
        ValueError: if the scheduler cannot be reached, or the package `distributed` is missing.
    """
    distributed = import_extra("distributed", "cluster")
    try:
        # Check the address first: a client with an invalid address blocks for a while at exit.
        distributed.comm.resolve_address(scheduler)
        return distributed.Client(scheduler, timeout=CONNECT_TIMEOUT, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ValueError(f"cannot reach a Dask scheduler at {scheduler}: {error}") from None


_Place = TypeVar("_Place")
"""Type variable of the keys that identify the tasks (calls) in an argument of `resumed`."""


class Task(NamedTuple):
    """Function call whose result is stored on disk.

    Attributes:
        name: name of the result's file, without suffix.
        call: function with its arguments; the result, JSON data, depends only on the arguments.
    """

    name: str
    call: partial[Any]

    def key(self) -> str:
        """Computes the key of the stored result, which changes if the result may change.

        The key is the SHA-256 digest of the call (name of the function and positional arguments),
        this package's source and model files, and the versions of Drake, Numba, NumPy and SciPy.
        """
        versions = [version(name) for name in ("drake", "numba", "numpy", "scipy")]
        text = repr((source_digest(), versions, self.call.func.__name__, self.call.args))
        return hashlib.sha256(text.encode()).hexdigest()

    def load(self, folder: Path) -> Any:
        """Returns the stored result, or None if no readable file in the folder has the task's key.

        Args:
            folder: folder of the results.
        """
        path = folder / f"{self.name}.json"
        if not path.exists():
            return None
        try:
            stored = json.loads(path.read_text())
            return stored["content"] if stored["key"] == self.key() else None
        except (OSError, ValueError, KeyError, TypeError) as error:
            logging.getLogger("drake_oa").warning(
                "result %s is unreadable, computing it again: %r", path, error
            )
            return None


def resumed(
    tasks: Mapping[_Place, Task], folder: Path | None, workers: int | str = 1
) -> tuple[dict[_Place, Any], int]:
    """Carries out the tasks without a stored result, and stores each result on completion.

    Args:
        tasks: any identifier -> task (call with a file name for its result).
        folder: folder of the results; None: results are not stored.
        workers: number of worker processes (1: this process), or the address of a Dask scheduler.

    Returns:
        Identifier -> result in the order of the tasks, and the number of results that were on disk.
    """
    results = {place: task.load(folder) if folder else None for place, task in tasks.items()}
    pending = [place for place, content in results.items() if content is None]
    stored_count = len(tasks) - len(pending)
    with progress_bar(len(tasks)) as update:
        completed = carry_out([tasks[place].call for place in pending], workers)
        for count, (number, content) in enumerate(completed, stored_count + 1):
            task = tasks[pending[number]]
            results[pending[number]] = content
            update(f"{task.name} {count}/{len(tasks)}", count)
            if folder:
                replace_json(folder / f"{task.name}.json", {"key": task.key(), "content": content})
    return results, stored_count
