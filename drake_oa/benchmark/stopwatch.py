"""A stopwatch that shares a stretch of time out to what is nested in it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

_Answer = TypeVar("_Answer")

REST = ""
"""Name of what is outside all sections."""


@dataclass
class Spent:
    """Time spent in a section, without the sections inside it.

    Attributes:
        wall: [s].
        processor: of all threads of the process [s].
    """

    wall: float = 0.0
    processor: float = 0.0


class Stopwatch:
    """Each moment belongs to the innermost section that is open, or to `REST`.

    So the sections add up to the whole, however they call one another.
    """

    def __init__(self) -> None:
        self._open = [REST]
        self.reset()

    def reset(self) -> None:
        """Forgets what was spent; sections that are open go on."""
        self.spent: dict[str, Spent] = {}
        self._since = (time.perf_counter(), time.process_time())

    def stop(self) -> None:
        """Charges the time until now."""
        now = (time.perf_counter(), time.process_time())
        spent = self.spent.setdefault(self._open[-1], Spent())
        spent.wall += now[0] - self._since[0]
        spent.processor += now[1] - self._since[1]
        self._since = now

    @contextmanager
    def section(self, name: str) -> Iterator[None]:
        """Charges what happens inside to `name`."""
        self.stop()
        self._open.append(name)
        try:
            yield
        finally:
            self.stop()
            self._open.pop()

    def watched(self, name: str, call: Callable[..., _Answer]) -> Callable[..., _Answer]:
        """The call, in a section of this name."""

        def in_section(*arguments: object, **named: object) -> _Answer:
            with self.section(name):
                return call(*arguments, **named)

        return in_section
