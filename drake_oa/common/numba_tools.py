"""Processor target of numba-compiled functions (kernels), and a message while they are compiled.

`drake_oa` imports this module at every start, before numba: it must not import slow modules.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_TARGET = "x86-64-v3"
"""Processor level for which numba compiles, supported by Intel processors since 2013 and by AMD
since 2015."""
_TARGET_FLAGS = frozenset(["avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "xsave"])
"""Flags in /proc/cpuinfo that a processor must have to support the level x86-64-v3 (System V ABI,
AMD64 supplement)."""


def pin_processor_target(cpuinfo: Path = Path("/proc/cpuinfo")) -> None:
    """Makes numba compile for `x86-64-v3` if the processor supports it, else for the native target.

    Equal instructions on all machines give bit-identical trajectories, and functions compiled on
    one machine load on another. Must be called before numba is imported. Does nothing if the
    environment variable NUMBA_CPU_NAME is set.

    Args:
        cpuinfo: file in which the Linux kernel lists the flags of the processor.
    """
    if os.environ.get("NUMBA_CPU_NAME"):
        return
    try:
        flags = cpuinfo.read_text().partition("flags")[2].partition("\n")[0].split()
    except OSError:
        return
    if _TARGET_FLAGS.issubset(flags):
        os.environ["NUMBA_CPU_NAME"] = _TARGET
        # An empty value selects the features of the target; unset, numba adds the machine's.
        os.environ.setdefault("NUMBA_CPU_FEATURES", "")


@contextmanager
def announced_compilation() -> Iterator[None]:
    """Prints a line on stderr when numba begins to compile functions in the `with` block, and the
    duration of the compilation at the end of the block.

    Numba compiles at the first use in a checkout, and after an update of numba or drake_oa.
    Otherwise it loads the machine code from files, and nothing is printed.
    """
    # Imported here because it is slow, see the module docstring.
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
