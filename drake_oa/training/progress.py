"""A progress bar a stage, with an estimate of the time left."""

from __future__ import annotations

import sys
from typing import Any

from tqdm import tqdm


class StageBar:
    """Shows one bar after the other on a terminal; nothing elsewhere.

    To be used as a context, and called with the stage and the fraction of it done.
    """

    def __init__(self) -> None:
        self._bar: Any = None
        self._stage = ""

    def __enter__(self) -> StageBar:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def __call__(self, stage: str, fraction: float) -> None:
        """Moves the bar of a stage, or begins one, in place of that of another stage."""
        if stage != self._stage or self._bar is None:
            self._close()
            self._stage = stage
            # What an earlier run has done does not count for the estimate.
            self._bar = tqdm(
                total=100.0,
                initial=100.0 * fraction,
                desc=stage,
                disable=not sys.stderr.isatty(),
                bar_format="{desc:12} {percentage:3.0f}% |{bar}| {elapsed}, {remaining} left",
            )
        else:
            self._bar.update(100.0 * fraction - self._bar.n)

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None
