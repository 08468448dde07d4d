"""Calls of one function carried out here, in processes, or on a Dask cluster."""

from __future__ import annotations

import contextlib
import signal
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from threadpoolctl import threadpool_limits

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
