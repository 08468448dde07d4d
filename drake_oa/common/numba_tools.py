"""Where compiled kernels are kept, a word when they have to be compiled.

`drake_oa` imports this before numba, and at every start: nothing slow is imported at the top.
Numba keeps compiled kernels beside the source, or else in the user's cache folder, and refuses to
load where it can write to neither: a read-only installation without a home.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import tempfile


_TARGET = "x86-64-v3"
"""Processor that kernels are compiled for: those since 2013 (Intel) and 2015 (AMD) have it."""
_TARGET_FLAGS = frozenset(["avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "xsave"])
"""Flags of /proc/cpuinfo of a processor that has `_TARGET` (System V ABI, AMD64 supplement)."""
_WORTH_TELLING = 2.0
"""A kernel that takes so long to compile is named [s]."""
_FOR_NOW = "DRAKE_OA_KERNELS_FOR_NOW"
_NOT_KEPT = "; for this run only, as no folder can be written: NUMBA_CACHE_DIR names one"


def provide_kernel_cache(package: Path) -> tempfile.TemporaryDirectory[str] | None:
    """Sees to it that compiled kernels have a place, and that those that are there are used.

    Kernels that were compiled into a read-only package are copied to the user's cache, as numba
    looks for them in one place only. Where nothing can be written, a temporary folder is named.
    To be called before numba is imported. Does nothing where `NUMBA_CACHE_DIR` is set.

    Args:
        package: folder of the kernels' source.

    Returns:
        The temporary folder, to be kept as long as the process lives; None where
        numba has a place of its own.
    """
    if os.environ.get("NUMBA_CACHE_DIR"):
        return None
    if is_writable(package / "__pycache__"):
        remove_outdated_kernels(package)
        return None
    user = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) / "numba"
    if is_writable(user):
        _copy_kernels(package, user)
        return None
    import tempfile

    # Not a fixed name in a shared folder: compiled code is read back without checks.
    folder = tempfile.TemporaryDirectory(prefix="drake_oa-kernels-")
    _copy_kernels(package, Path(folder.name))
    os.environ["NUMBA_CACHE_DIR"] = folder.name
    os.environ[_FOR_NOW] = folder.name
    return folder


def pin_processor_target(cpuinfo: Path = Path("/proc/cpuinfo")) -> None:
    """Makes numba compile for `x86-64-v3` where the processor has it, else for the native one.

    The same instructions on each machine give the same trajectory to the last bit, and kernels
    compiled on one machine load on another. Must be called before numba is imported. Does nothing
    where `NUMBA_CPU_NAME` is set.

    Args:
        cpuinfo: description of the processor by the Linux kernel.
    """
    if os.environ.get("NUMBA_CPU_NAME"):
        return
    try:
        flags = cpuinfo.read_text().partition("flags")[2].partition("\n")[0].split()
    except OSError:
        return
    if _TARGET_FLAGS.issubset(flags):
        os.environ["NUMBA_CPU_NAME"] = _TARGET
        # Empty: those that the name implies. Unset, numba takes those of this machine.
        os.environ.setdefault("NUMBA_CPU_FEATURES", "")


def remove_outdated_kernels(package: Path) -> None:
    """Removes compiled kernels of modules that call kernels whose source has changed.

    Numba compares a kernel's own file only, and would run the former code of the kernels that it
    calls. `__pycache__/kernels.json` has the digest of each module's source, joined with the
    source of the kernels that it imports.

    Args:
        package: folder of the kernels' source.
    """
    import json

    stamp = package / "__pycache__" / "kernels.json"
    known = json.loads(stamp.read_text()) if stamp.is_file() else {}
    states = {str(file.relative_to(package)): file.stat() for file in package.rglob("*.py")}
    found = {name: [state.st_mtime_ns, state.st_size] for name, state in states.items()}
    if known.get("files") == found:
        return
    modules = _kernel_modules(package)
    for file, digest in modules.items():
        if known.get("modules", {}).get(file) != digest:
            path = package / file
            for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*.nb[ic]"):
                compiled.unlink(missing_ok=True)
    # In one piece: another process may be starting, too.
    beside = stamp.with_name(f"kernels.{os.getpid()}")
    beside.write_text(json.dumps({"files": found, "modules": modules}))
    beside.replace(stamp)


_DECORATORS = ("@compiled", "@leaf", "@parted", "@njit")
"""Beginnings of the lines above a kernel."""


def _kernel_modules(package: Path) -> dict[str, str]:
    """Returns modules with kernels -> digest of their source and that of the kernels they call."""
    import hashlib

    texts = {file: file.read_text() for file in sorted(package.rglob("*.py"))}
    sources = {file: t for file, t in texts.items() if any(word in t for word in _DECORATORS)}
    calls = {file: {file} for file in sources}
    for other in sources:
        parts = (package.name, *other.relative_to(package).with_suffix("").parts)
        names = f"{'.'.join(parts)} import", f"{'.'.join(parts[:-1])} import {parts[-1]}"
        for file, text in sources.items():
            if any(name in text for name in names):
                calls[file].add(other)
    for _ in sources:
        for file, others in calls.items():
            calls[file] = others.union(*(calls[other] for other in others))
    digests = {}
    for file, others in calls.items():
        text = "".join(sources[other] for other in sorted(others))
        digests[str(file.relative_to(package))] = hashlib.sha256(text.encode()).hexdigest()
    return digests


def _copy_kernels(package: Path, cache: Path) -> None:
    """Copies what numba compiled beside the source, by the names that it has in a cache."""
    import hashlib
    import shutil
    import tempfile

    for compiled in package.rglob("__pycache__"):
        found = [*compiled.glob("*.nbc"), *compiled.glob("*.nbi")]
        source = str(compiled.parent.absolute())
        digest = hashlib.sha1(source.encode(), usedforsecurity=False).hexdigest()
        folder = cache / f"{compiled.parent.name}_{digest}"
        if not found or folder.exists():
            continue
        # In one piece: another process may be starting, too.
        beside = Path(tempfile.mkdtemp(dir=cache))
        for file in found:
            shutil.copy2(file, beside)
        try:
            beside.rename(folder)
        except OSError:
            shutil.rmtree(beside, ignore_errors=True)


def is_writable(folder: Path) -> bool:
    """Makes a folder where there is none; whether files can be written to it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK | os.X_OK)


@contextmanager
def announced_compilation(estimate: str | None = None) -> Iterator[None]:
    """Says on stderr when kernels are compiled in here rather than read from the cache, and which.

    That is so in a fresh installation, and after an update of the package or of numba.

    Args:
        estimate: about how long all the kernels that are used take; None: not known.
    """
    # Not at the top: see provide_kernel_cache.
    import time

    from numba.core import event

    class Announcement(event.Listener):
        depth, begun, total = 0, 0.0, 0.0

        def on_start(self, event: event.Event) -> None:
            if self.total == self.depth == 0:
                duration = f" (about {estimate})" if estimate else ""
                kept = "" if os.environ.get(_FOR_NOW) is None else _NOT_KEPT
                print(f"compiling kernels, once{duration}{kept} ...", file=sys.stderr)
            if self.depth == 0:
                self.begun = time.monotonic()
            self.depth += 1

        def on_end(self, event: event.Event) -> None:
            self.depth -= 1
            kernel = event.data["dispatcher"].py_func
            if self.depth:
                # One that another needs counts with that one.
                return
            took = time.monotonic() - self.begun
            self.total += took
            if took >= _WORTH_TELLING:
                where = kernel.__module__.removeprefix("drake_oa.")
                print(f"  {where}.{kernel.__name__}: {took:.0f} s", file=sys.stderr)

    announcement = Announcement()
    with event.install_listener("numba:compile", announcement):
        yield
    if announcement.total >= _WORTH_TELLING:
        print(f"kernels compiled in {announcement.total:.0f} s", file=sys.stderr)
