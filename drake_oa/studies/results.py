"""Results of evaluations: computed in parallel, stored one by one, counted.

- `Tally`: how many candidates the generators of scenes looked at, and why they dropped them.
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
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

from drake_oa.common.files import check_outputs, replace_json, source_digest

Counts = Mapping[str, Mapping[str, int]]
"""What was looked at -> why it was dropped, "" for what was taken -> how often."""


class Tally:
    """Counts what is dropped while a scene is drawn, each candidate for its first reason."""

    def __init__(self) -> None:
        """Nothing counted."""
        self._counts: dict[str, Counter[str]] = {}

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        """Plain data, see `Counts`."""
        return {what: dict(found) for what, found in self._counts.items()}

    def takes(self, what: str, reason: str) -> bool:
        """Counts a candidate; whether it is taken.

        Args:
            what: it is a candidate for, in the plural: "scenes".
            reason: why it is dropped, in a few plain words; "": it is taken.
        """
        self._counts.setdefault(what, Counter())[reason] += 1
        return not reason


def drawn_figures(counts: Iterable[Counts]) -> dict[str, dict[str, Any]]:
    """What -> {"looked_at", "dropped": {reason: share, the greatest first}} of all scenes."""
    total: dict[str, Counter[str]] = {}
    for of_scene in counts:
        for what, found in of_scene.items():
            total.setdefault(what, Counter()).update(found)
    return {
        what: {
            "looked_at": found.total(),
            "dropped": {
                reason: count / found.total() for reason, count in found.most_common() if reason
            },
        }
        for what, found in total.items()
    }


def drawn_lines(drawn: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The same in words, a line each."""
    return [
        f"{what} looked at: {of['looked_at']}; dropped: "
        + (", ".join(f"{share:.1%} ({why})" for why, share in of["dropped"].items()) or "none")
        for what, of in drawn.items()
    ]


CONNECT_TIMEOUT = 10.0
"""How long a cluster may take to answer [s]."""

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

    # A worker that has grown is renewed, and no call is lost by it.
    warnings.filterwarnings("ignore", message="A worker stopped while some jobs")
    with contextlib.ExitStack() as stack:
        ahead: int | str = min(jobs, len(calls))
        if scheduler is None:
            stack.enter_context(parallel_config("loky", n_jobs=ahead, inner_max_num_threads=1))
        else:
            # A cluster may grow on the way: it is told of all calls at once.
            ahead = "all"
            stack.enter_context(
                parallel_config("dask", client=stack.enter_context(_client(scheduler)))
            )
        # Long calls: handed out one by one, and no more of them than there are processes.
        pool = Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch=ahead)
        results = pool(delayed(_placed)(function, place, call) for place, call in enumerate(calls))
        try:
            yield from results
        except BaseException:
            if scheduler is None:
                from joblib.externals.loky import get_reusable_executor

                get_reusable_executor().shutdown(wait=False, kill_workers=True)
            raise
        finally:
            # What has ended it is raised already.
            with contextlib.suppress(Exception):
                results.close()


def _placed(function: Callable[..., Any], place: int, call: Call) -> tuple[int, Any]:
    """What a worker does: the interrupt of a terminal is the parent's business."""
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
        check_outputs(folder / ".writable")

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
        replace_json(self.path / f"{name}.json", {"key": key, "content": content})


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
