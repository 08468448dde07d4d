"""Decorators of functions that numba compiles (kernels), the cache of their machine code, and
threads that run them on all cores.
"""

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
"""Number of processor cores that this process may use, for parallel calls of compiled functions."""


class KernelCacheLocator(InTreeCacheLocator):
    """Cache locator for numba: determines the folder of the cached machine code of a kernel
    (compiled function), and the stamp (here a hash) of its source.

    The folder is `__pycache__` beside the source, or, if that is read-only, a copy of it in the
    user's cache, or else a temporary folder. Numba uses cached code only if the stamp that was
    saved with the code equals the present stamp. Numba's own stamp covers only the file of the
    kernel, so that outdated code of called kernels would be used. This stamp also covers the called
    kernels and the constants that the kernel uses.
    """

    def __init__(self, py_func: Callable[..., Any], py_file: str) -> None:
        """Determines the cache folder of a kernel, and the kernels and constants that it uses.

        Args:
            py_func: Python function of the kernel.
            py_file: file of its source.
        """
        super().__init__(py_func, py_file)
        self._used = [py_func.__globals__.get(name) for name in py_func.__code__.co_names]
        self._cache_path = _kernel_folder(super().get_cache_path())

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> KernelCacheLocator | None:
        """Returns the cache locator of a kernel (compiled function); None for a kernel of another
        package than drake_oa, or if NUMBA_CACHE_DIR is set.

        Args:
            py_func: Python function of the kernel.
            py_file: file of its source.
        """
        is_own = py_func.__module__.startswith(f"{__package__.partition('.')[0]}.")
        return cls(py_func, py_file) if is_own and not numba.config.CACHE_DIR else None

    def get_disambiguator(self) -> str:
        """Returns the part of the cache file's name that depends on the source of the kernel.

        Numba unpickles the argument types in a cache file before it compares the stamp in the file
        with the present one. Unpickling fails if a type has been renamed. With this part of the
        name, numba never reads a cache file of another source.
        """
        return self.get_source_stamp()[:16]

    def get_source_stamp(self) -> str:
        """Computes the stamp of a kernel: a digest of the sources and constants that determine its
        machine code.

        Numba uses cached machine code only if the stamp that was saved with the code equals the
        result.
        """
        stamps = [super().get_source_stamp()]
        for value in self._used:
            if isinstance(value, Dispatcher) and hasattr(value._cache, "_cache_file"):
                stamps.append(value._cache._cache_file._source_stamp)
            elif isinstance(value, int | float | np.ndarray):
                stamps.append(np.asarray(value).tobytes())
        return hashlib.sha256(repr(stamps).encode()).hexdigest()


@cache
def _kernel_folder(beside: str) -> str:
    """Returns a writable cache folder for the machine code of numba-compiled functions (kernels).

    Args:
        beside: preferred folder, beside the source. If it is not writable, the result is a copy of
            this folder in the user's cache, or else a temporary folder.
    """
    with suppress(OSError):
        Path(beside).mkdir(exist_ok=True)
        tempfile.TemporaryFile(dir=beside).close()
        return beside
    # Without a home directory, the user has no cache: RuntimeError.
    with suppress(OSError, RuntimeError):
        user = user_cache("kernels") / hashlib.sha256(beside.encode()).hexdigest()[:16]
        user.parent.mkdir(parents=True, exist_ok=True)
        if not user.is_dir():
            # The complete copy is renamed, because another process may create it, too.
            copy = tempfile.mkdtemp(dir=user.parent)
            if os.path.isdir(beside):
                shutil.copytree(beside, copy, dirs_exist_ok=True)
            Path(copy).rename(user)
        return str(user)
    # A fixed name in a shared folder would be unsafe: compiled code is loaded without checks.
    return tempfile.mkdtemp(prefix="drake_oa-kernels-")


numba.config.CACHE_LOCATOR_CLASSES = ",".join(
    f"{locator.__module__}.{locator.__name__}"
    for locator in (KernelCacheLocator, *CacheImpl._locator_classes)
)

# Each decorator sets fastmath explicitly. Otherwise a kernel would be compiled with the setting of
# its first caller, and cached for all callers; with fastmath, 0 * inf is undefined.
compiled = njit(cache=True, error_model="numpy", fastmath=False, _nrt=True)
"""Decorator of a kernel (function that numba compiles): `numba.njit` with a cache on disk, division
by zero as in NumPy, and without fastmath."""

leaf = njit(cache=True, error_model="numpy", fastmath=False, _nrt=False)
"""Decorator of a short kernel (function that numba compiles) that allocates no arrays.

It is `numba.njit` as in the decorator `compiled` (cache on disk, division by zero as in NumPy,
without fastmath), but without reference counting of arrays. Reference counting costs 10 ns per
array and call, more than the computation in a short kernel with many arrays.
"""

parted = njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
"""Decorator of a kernel (function that numba compiles) that `on_cores` runs in parallel threads.

It is `numba.njit` as in the decorator `compiled` (cache on disk, division by zero as in NumPy,
without fastmath), and the kernel releases Python's global interpreter lock."""


@cache
def _pool() -> ThreadPoolExecutor:
    """Returns the pool of threads in which `on_cores` runs the parts of a numba-compiled function
    in parallel; the pool is created once per process.
    """
    return ThreadPoolExecutor(max(CORES - 1, 1), "on_cores")


def on_cores(kernel: Callable[..., None], parts: int, *arguments: Any) -> None:
    """Runs `kernel(part, parts, *arguments)` for part = 0, ..., parts - 1 in parallel threads.

    The threads of numba are not used, because they wait for the next call in a busy loop, which
    costs 6 ms of processor time per call.

    Args:
        kernel: numba-compiled function with the decorator `parted`, which computes one part of a
            result and writes it to arrays among `arguments`.
        parts: number of parts.
        arguments: other arguments of the kernel.
    """
    others = [_pool().submit(kernel, part, parts, *arguments) for part in range(1, parts)]
    kernel(0, parts, *arguments)
    for other in others:
        other.result()


def kernel_arrays(*arrays: ArrayLike) -> list[NDArray[np.float64]]:
    """Returns writable, C-contiguous float64 copies of arrays, as arguments for numba-compiled
    functions (kernels).

    Numba would compile each kernel again for the read-only arrays of messages (frozen dataclasses).
    """
    return [np.array(array, dtype=float, order="C") for array in arrays]
