"""Tests of the cache of compiled kernels, its messages, and the processor target."""

import os
import subprocess
import sys
from pathlib import Path

import numba
import pytest

from drake_oa.common.numba_tools import pin_processor_target

CALLEE = """
from drake_oa.common.compiled import compiled

FACTOR = 2

@compiled
def twice(x):
    return FACTOR * x
"""
CALLER = """
import sys
from drake_oa.common.compiled import compiled
from drake_oa.common.numba_tools import announced_compilation
from drake_oa.callee import FACTOR, twice

@compiled
def thrice(x):
    return x + twice(x) + 0 * FACTOR

if __name__ == "drake_oa.caller":
    with announced_compilation():
        print(thrice(2))
"""


def run(folder: Path, **environment: str) -> tuple[str, bool]:
    """Runs the kernels of a folder; returns their output, and whether they were compiled."""
    extend = f"import drake_oa; drake_oa.__path__.append({str(folder)!r}); import drake_oa.caller"
    command, env = [sys.executable, "-c", extend], os.environ | environment
    process = subprocess.run(command, capture_output=True, text=True, check=True, env=env)
    messages = process.stderr
    assert ("kernels compiled in" in messages) == ("compiling kernels, once ..." in messages)
    return process.stdout.strip(), "compiling kernels" in messages


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="nothing is compiled")
def test_kernels_are_recompiled_after_a_change_of_them_or_their_callees(tmp_path: Path) -> None:
    (tmp_path / "caller.py").write_text(CALLER)
    callee = tmp_path / "callee.py"
    callee.write_text(CALLEE)
    assert run(tmp_path) == ("6", True)
    callee.touch()
    assert run(tmp_path) == ("6", False)
    callee.write_text(CALLEE.replace("FACTOR = 2", "FACTOR = 10"))
    assert run(tmp_path) == ("22", True)
    # If the folder of the source is read-only, compiled code is stored in the user's cache.
    cache, read_only = tmp_path / "cache", tmp_path / "read_only"
    read_only.mkdir()
    for file in ("caller.py", "callee.py"):
        (read_only / file).write_text((tmp_path / file).read_text())
    (read_only / "__pycache__").touch()
    assert run(read_only, XDG_CACHE_HOME=str(cache)) == ("22", True)
    assert run(read_only, XDG_CACHE_HOME=str(cache)) == ("22", False)
    assert run(read_only, XDG_CACHE_HOME=os.devnull) == ("22", True)


def test_the_processor_target_is_used_on_all_processors_that_support_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cpuinfo = tmp_path / "cpuinfo"
    for name in ("NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES"):
        # Set and deleted, so that pytest restores the variables that the function sets.
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    for older in ("flags\t\t: fpu sse4_2 avx\n", "Features\t: fp asimd\n"):
        cpuinfo.write_text("processor : 0\n" + older)
        pin_processor_target(cpuinfo)
        assert "NUMBA_CPU_NAME" not in os.environ
    v3 = "fma movbe xsave avx f16c abm bmi1 avx2 bmi2 avx512f"
    cpuinfo.write_text(f"flags\t\t: {v3}\nbugs\t: none\n")
    pin_processor_target(cpuinfo)
    assert (os.environ["NUMBA_CPU_NAME"], os.environ["NUMBA_CPU_FEATURES"]) == ("x86-64-v3", "")
    monkeypatch.setenv("NUMBA_CPU_NAME", "generic")
    pin_processor_target(cpuinfo)
    assert os.environ["NUMBA_CPU_NAME"] == "generic"
