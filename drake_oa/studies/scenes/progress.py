"""The progress bar of an evaluation."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def progress_bar(total: int) -> Iterator[Callable[[str, int], None]]:
    """A progress bar with an estimate on a terminal; nothing when piped.

    Args:
        total: how many scenes, times cases and methods.

    Yields:
        What to call with a name and how many of them were done.
    """
    from tqdm import tqdm

    with tqdm(
        total=total,
        unit="scene",
        disable=not sys.stderr.isatty(),
        leave=False,
        bar_format="{desc:20} {percentage:3.0f}% |{bar}| {n_fmt}/{total_fmt}, {remaining} left",
    ) as bar:

        def show(name: str, count: int) -> None:
            bar.set_description_str(name, refresh=False)
            bar.update(count)

        yield show
