"""Decorators of compiled functions, the place of their code, and threads for all cores."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numba import njit
from numba.core.caching import CacheImpl, InTreeCacheLocator
from numba.core.dispatcher import Dispatcher
from numpy.typing import ArrayLike, NDArray

from drake_oa.common.files import user_cache

CORES = max(len(os.sched_getaffinity(0)), 1)
"""Number of cores that this process may use."""


class KernelCacheLocator(InTreeCacheLocator):
    """Place and stamp of the compiled code of the package's kernels.

    The place is beside the source; where that cannot be written, the user's cache, with a copy of
    the code beside the source; else a temporary folder. Numba's stamp covers the file of a kernel
    alone, and it would run former code of the kernels that it calls: this one covers those, too,
    and the constants that it uses.
    """

    def __init__(self, py_func: Callable[..., Any], py_file: str) -> None:
        """Finds the place of a kernel's code."""
        super().__init__(py_func, py_file)
        self._used = [py_func.__globals__.get(name) for name in py_func.__code__.co_names]
        self._cache_path = _kernel_folder(super().get_cache_path())

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> KernelCacheLocator | None:
        """Returns a locator; None for functions of other packages, or if the user names a place."""
        is_own = py_func.__module__.startswith(f"{__package__.partition('.')[0]}.")
        return cls(py_func, py_file) if is_own and not numba.config.CACHE_DIR else None

    def get_disambiguator(self) -> str:
        """Returns a part of the file name, so that code of another source is never unpickled.

        Numba compares stamps after it has unpickled the types of arguments, which fails where one
        of them has been renamed.
        """
        return self.get_source_stamp()[:16]

    def get_source_stamp(self) -> str:
        """Computes a digest of the source that the compiled code depends on."""
        stamps = [super().get_source_stamp()]
        for value in self._used:
            if isinstance(value, Dispatcher) and hasattr(value._cache, "_cache_file"):
                stamps.append(value._cache._cache_file._source_stamp)
            elif isinstance(value, int | float | np.ndarray):
                stamps.append(np.asarray(value).tobytes())
        return hashlib.sha256(repr(stamps).encode()).hexdigest()


@cache
def _kernel_folder(beside: str) -> str:
    """Returns the folder for the compiled code of modules whose own folder for it is given."""
    user = user_cache("kernels") / hashlib.sha256(beside.encode()).hexdigest()[:16]
    with suppress(OSError):
        Path(beside).mkdir(exist_ok=True)
        tempfile.TemporaryFile(dir=beside).close()
        return beside
    with suppress(OSError):
        user.parent.mkdir(parents=True, exist_ok=True)
        if not user.is_dir():
            # Renamed when it is complete: another process may be starting, too.
            made = tempfile.mkdtemp(dir=user.parent)
            if os.path.isdir(beside):
                shutil.copytree(beside, made, dirs_exist_ok=True)
            Path(made).rename(user)
        return str(user)
    # Not a fixed name in a shared folder: compiled code is read back without checks.
    return tempfile.mkdtemp(prefix="drake_oa-kernels-")


numba.config.CACHE_LOCATOR_CLASSES = ",".join(
    f"{locator.__module__}.{locator.__name__}"
    for locator in (KernelCacheLocator, *CacheImpl._locator_classes)
)

# Said for each: one that says nothing of fastmath takes its caller's, if that is the first to
# have it compiled, and the cache then hands it to everyone, where 0 * inf may be anything.
compiled = njit(cache=True, error_model="numpy", fastmath=False, _nrt=True)
"""Decorator like `numba.njit`: kept on disk, division by zero as in NumPy, strict arithmetic."""

leaf = njit(cache=True, error_model="numpy", fastmath=False, _nrt=False)
"""Decorator like `compiled` for functions that allocate nothing: no counts of references.

Counting them takes 10 ns an array and call, more than a short kernel that is given many.
"""

parted = njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
"""Decorator like `compiled` for the parts that `on_cores` runs in parallel."""


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
