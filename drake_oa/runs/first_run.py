"""The first run after installing: part of its kernels is compiled in a process beside it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from drake_oa.perception.config import CameraSource, GroundTruth
from drake_oa.scenario.loading import parse_scenario, scenario_text
from drake_oa.scenario.scenario import Scenario

_LONG_ENOUGH = 0.05
"""Simulated time in which every layer has had its turn [s]."""


@contextmanager
def compiled_beside(scenario: Scenario) -> Iterator[None]:
    """When a kernel has to be compiled in here, a second process begins with those that decide.

    This one comes to them after those of perception, and by then reads them from the cache.
    Nothing happens where perception compiles nothing, or everything is compiled already.
    """
    # Not at the top: see drake_oa.common.numba_tools.
    from numba.core import event

    beside: list[subprocess.Popen[str]] = []

    class Start(event.Listener):
        def on_start(self, event: event.Event) -> None:
            if not beside:
                beside.append(_start(scenario))

        def on_end(self, event: event.Event) -> None:
            pass

    if not isinstance(scenario.perception, CameraSource):
        yield
        return
    try:
        with event.install_listener("numba:compile", Start()):
            yield
    finally:
        for process in beside:
            process.kill()
            process.wait()


def _start(scenario: Scenario) -> subprocess.Popen[str]:
    text = scenario_text(replace(scenario, perception=GroundTruth(), faults=[]))
    process = subprocess.Popen(
        [sys.executable, "-m", "drake_oa.runs.first_run"],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    if process.stdin is not None:
        process.stdin.write(text)
        process.stdin.close()
    return process


if __name__ == "__main__":
    from drake_oa.runs.simulation import simulate

    simulate(parse_scenario(sys.stdin.read()), duration=_LONG_ENOUGH)
