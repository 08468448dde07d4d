"""Processor target of compiled kernels, and a message when they have to be compiled.

`drake_oa` imports this before numba, and at every start: nothing slow is imported at the top.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_TARGET = "x86-64-v3"
"""Processor that kernels are compiled for: those since 2013 (Intel) and 2015 (AMD) have it."""
_TARGET_FLAGS = frozenset(["avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "xsave"])
"""Flags of /proc/cpuinfo of a processor that has `_TARGET` (System V ABI, AMD64 supplement)."""


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


@contextmanager
def announced_compilation() -> Iterator[None]:
    """Prints a line on stderr when kernels are compiled in the block rather than read from files.

    That is so in a checkout, and after an update of the package or of numba.
    """
    # Not at the top: see the module.
    from numba.core import event

    class Announcement(event.TimingListener):
        def on_start(self, event: event.Event) -> None:
            if self._depth == 0 and not self.done:
                print("compiling kernels, once ...", file=sys.stderr)
            super().on_start(event)

    announcement = Announcement()
    with event.install_listener("numba:compile", announcement):
        yield
    if announcement.done:
        print(f"kernels compiled in {announcement.duration:.0f} s", file=sys.stderr)
