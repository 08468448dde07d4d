"""What commands print: exit statuses, errors, tables and progress; plain when piped."""

from __future__ import annotations

import io
import math
import sys
import textwrap
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

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
    """Prints an error as one line on stderr; of a very long one, the first `_LONGEST` letters."""
    line = textwrap.shorten(message, _LONGEST, placeholder=" ...")
    print(f"drake-oa: error: {line}", file=sys.stderr)


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


@dataclass(frozen=True)
class TextTable:
    """A table with notes below it: ruled and coloured on a terminal, aligned text elsewhere.

    On a terminal too narrow for it, rows and columns change places where that fits.

    Attributes:
        header: a heading a column; empty for none.
        rows: of each row its cells, as many as there are columns.
        sides: a letter a column: "l" for the left, "r" for the right.
        notes: lines below.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    sides: str
    notes: Sequence[str] = ()

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        ruled = console.is_terminal and bool(self.header)
        header = list(self.header) or [""] * len(self.sides)
        if ruled and self._width(header) > options.max_width:
            columns = list(zip(*self.rows, strict=True))
            turned = TextTable(
                [header[0], *columns[0]],
                list(zip(header[1:], *zip(*columns[1:], strict=True), strict=True)),
                "l" + "r" * len(self.rows),
                self.notes,
            )
            header = [_folded(*of) for of in zip(header, columns, strict=True)]
            if self._width(header) > options.max_width >= turned._width(turned.header):
                yield turned
                return
        table = Table(
            box=box.SIMPLE_HEAD if ruled else None,
            show_header=bool(self.header),
            header_style="bold" if ruled else "",
            pad_edge=False,
            padding=(0, 1 if ruled else 2, 0, 0),
        )
        for number, (heading, side) in enumerate(zip(header, self.sides, strict=True)):
            # Text, as a cell's brackets are no markup.
            table.add_column(
                Text(heading),
                justify="right" if side == "r" else "left",
                style="cyan" if console.is_terminal and number == 0 else "",
                overflow="fold",
            )
        for row in self.rows:
            table.add_row(*map(Text, row))
        yield table
        for note in self.notes:
            yield Text(note, style="yellow" if note.startswith("warning") else "")

    def _width(self, header: Sequence[str]) -> int:
        """Columns of a terminal that it takes with these headings."""
        columns = zip(header, *self.rows, strict=True)
        return sum(
            2 + max(len(line) for of in column for line in of.split("\n")) for column in columns
        )

    def __str__(self) -> str:
        """As text without colours, as wide as it needs."""
        console = Console(file=io.StringIO(), width=_WIDE, color_system=None, force_terminal=False)
        with console.capture() as captured:
            console.print(self)
        return "\n".join(line.rstrip() for line in captured.get().rstrip("\n").splitlines())


def _folded(heading: str, cells: Sequence[str]) -> str:
    """A heading in lines that are no longer than its column's cells, or than a word of it."""
    return textwrap.fill(heading, max(map(len, [*heading.split(), *cells, " "])))


def show(*tables: TextTable) -> None:
    """Prints on stdout, a blank line between: as the terminal can show it, or as plain text."""
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
