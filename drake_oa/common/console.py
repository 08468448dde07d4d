"""What commands print: exit statuses, errors, tables and progress; plain when piped."""

from __future__ import annotations

import io
import logging
import math
import sys
import textwrap
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from rich import box
from rich.console import Console, ConsoleOptions, RenderResult
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

FAILED, BAD_INPUT, INTERRUPTED, TERMINATED = 1, 2, 130, 143
"""Exit statuses other than 0."""

_PROGRESS_PERIOD = 2.0
"""Least time between two lines of progress [s]."""
_LONGEST = 2000
_WIDE = 100_000


def complain(message: str) -> None:
    """Prints an error on stderr; of very long lines, the first `_LONGEST` characters."""
    lines = [textwrap.shorten(line, _LONGEST, placeholder=" ...") for line in message.splitlines()]
    print("drake-oa: error: " + "\n  ".join(lines), file=sys.stderr)


def write_all(*writes: Callable[[], object]) -> bool:
    """Calls each function, also after one that failed to write; returns whether none failed."""
    written = True
    for write in writes:
        try:
            write()
        except OSError as error:
            complain(str(error))
            written = False
    return written


class ProgressLines:
    """Lines on stderr about work that is done at first use, on a terminal and elsewhere."""

    def __init__(self, work: str, count: int, *, last: float = -math.inf) -> None:
        """Prints nothing yet.

        Args:
            work: what is done.
            count: number of its parts.
            last: time of `time.monotonic` from which on the first line waits its turn [s].
        """
        self._work, self._count, self._last = work, count, last

    def update(self, row: int) -> None:
        """Prints that a part, counted from 1, begins; nothing soon after another line."""
        now = time.monotonic()
        if now >= self._last + _PROGRESS_PERIOD:
            self._last = now
            print(f"{self._work} (first use only): {row} of {self._count}", file=sys.stderr)


class Column(NamedTuple):
    """Specification of a column of a table.

    Attributes:
        key: key of the values in the rows.
        heading: quantity and unit; None: the key.
        form: format of the values, texts excepted.
        scale: factor of the values before they are formatted.
        side: alignment; None: "left" in the first column, "right" in others.
    """

    key: str
    heading: str | None = None
    form: str = "{}"
    scale: float = 1
    side: Literal["left", "right"] | None = None

    def cell(self, row: Mapping[str, Any]) -> str:
        """Returns the text of a row's value; "-" for a value that is missing or not finite."""
        value = row.get(self.key)
        if isinstance(value, str):
            return value
        if value is None or not math.isfinite(value):
            return "-"
        return self.form.format(value * self.scale)


@dataclass(frozen=True)
class TextTable:
    """Table with notes below it: ruled and colored on a terminal, aligned text elsewhere.

    On a terminal that is too narrow for the table, rows and columns are exchanged where that fits.

    Attributes:
        columns: specification of each column; a column whose key no row has is omitted, and the
            headings if all are empty.
        rows: values of each row by key.
        notes: lines below.
        transposed: whether each row of values is printed as a column.
    """

    columns: Sequence[Column]
    rows: Sequence[Mapping[str, Any]]
    notes: Sequence[str] = ()
    transposed: bool = False

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        known = [of for of in self.columns if any(of.key in row for row in self.rows)]
        columns = [
            [of.key if of.heading is None else of.heading, *map(of.cell, self.rows)] for of in known
        ]
        grid: _Grid = columns if self.transposed else list(zip(*columns, strict=True))
        header, *cells = grid or [()]
        ruled = console.is_terminal and any(header)
        turned = self.transposed
        if ruled and _width(grid) > options.max_width:
            other: _Grid = list(zip(*grid, strict=True))
            header = [_folded(*column) for column in other]
            if _width([header, *cells]) > options.max_width >= _width(other):
                header, *cells = other
                turned = not turned
        table = Table(
            box=box.SIMPLE_HEAD if ruled else None,
            show_header=any(header),
            header_style="bold" if ruled else "",
            pad_edge=False,
            padding=(0, 1 if ruled else 2, 0, 0),
        )
        for number, heading in enumerate(header):
            side = None if turned else known[number].side
            # Text, as a cell's brackets are no markup.
            table.add_column(
                Text(heading),
                justify=side or ("right" if number else "left"),
                style="cyan" if console.is_terminal and number == 0 else "",
                overflow="fold",
            )
        for row in cells:
            table.add_row(*map(Text, row))
        if grid:
            yield table
        for note in self.notes:
            yield Text(note, style="yellow" if note.startswith("warning") else "")

    def __str__(self) -> str:
        """Returns plain text without colors, as wide as the table."""
        console = Console(file=io.StringIO(), width=_WIDE, color_system=None, force_terminal=False)
        with console.capture() as captured:
            console.print(self)
        return "\n".join(line.rstrip() for line in captured.get().rstrip("\n").splitlines())


_Grid = Sequence[Sequence[str]]
"""Headings, and the cells of each row."""


def _width(grid: _Grid) -> int:
    """Returns the width of a table on a terminal [character]."""
    columns = zip(*grid, strict=True)
    return sum(2 + max(len(line) for of in column for line in of.split("\n")) for column in columns)


def _folded(heading: str, *cells: str) -> str:
    """Returns a heading in lines no longer than the cells below it, or than its longest word."""
    return textwrap.fill(heading, max(map(len, [*heading.split(), *cells, " "])))


def show(*tables: TextTable) -> None:
    """Prints tables on stdout with a blank line between them; plain text when piped."""
    console = Console()
    for number, table in enumerate(tables):
        if number:
            print()
        if console.is_terminal:
            console.print(table)
        else:
            print(table)


@contextmanager
def progress_bar(total: float) -> Iterator[Callable[[str, float], None]]:
    """A bar with an estimate of the time left on a terminal's stderr; nothing elsewhere.

    Args:
        total: of the work.

    Yields:
        What to call with a few words and how much of the work is done.
    """
    console = Console(stderr=True)
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        refresh_per_second=4,
        disable=not console.is_terminal,
    ) as progress:
        task = progress.add_task("", total=total)

        def update(words: str, done: float) -> None:
            progress.update(task, description=words, completed=done)

        yield update


@contextmanager
def quiet() -> Iterator[None]:
    """Suppresses log messages up to warnings, where others tell the same."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)
