"""The decorators of compiled functions, and what runs them on all cores."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

CORES = max(len(os.sched_getaffinity(0)), 1)
"""That this process may use."""

# Said for each: one that says nothing of fastmath takes its caller's, if that is the first to
# have it compiled, and the cache then hands it to everyone, where 0 * inf may be anything.
compiled = njit(cache=True, error_model="numpy", fastmath=False, _nrt=True)
"""As `numba.njit`: kept on disk, division by zero as NumPy has it, and no liberties."""

leaf = njit(cache=True, error_model="numpy", fastmath=False, _nrt=False)
"""As `compiled`, for what allocates nothing: references to its arrays are not counted.

Counting them takes 10 ns an array and call, more than a short kernel that is given many.
"""

parted = njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
"""As `compiled`, for the parts that `on_cores` runs beside each other."""


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(CORES - 1, 1), "on_cores")


def on_cores(kernel: Callable[..., None], parts: int, *arguments: Any) -> None:
    """Runs `kernel(part, parts, *arguments)` for each part, each in a thread of its own.

    Numba's own threads wait busily for the next call: 6 ms of processor time a call.
    """
    others = [_pool().submit(kernel, part, parts, *arguments) for part in range(1, parts)]
    kernel(0, parts, *arguments)
    for other in others:
        other.result()


def kernel_arrays(*arrays: ArrayLike) -> list[NDArray[np.float64]]:
    """Copies as float64, C-contiguous and writeable.

    The arrays of frozen values are read-only, for which numba would compile a kernel once
    more.
    """
    return [np.array(array, dtype=float, order="C") for array in arrays]
