"""Output of commands: exit statuses, errors, tables and progress."""

from __future__ import annotations

import io
import logging
import math
import sys
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal, NamedTuple

from rich.console import Console
from rich.table import Table
from rich.text import Text

FAILED, BAD_INPUT, INTERRUPTED, TERMINATED = 1, 2, 130, 143
"""Exit statuses other than 0."""

_LONGEST = 2000
_WIDE = 100_000


def complain(message: str) -> None:
    """Prints an error on stderr; of very long lines, the first `_LONGEST` characters."""
    lines = [textwrap.shorten(line, _LONGEST, placeholder=" ...") for line in message.splitlines()]
    print("drake-oa: error: " + "\n  ".join(lines), file=sys.stderr)


@cache
def announce_first_use(work: str) -> None:
    """Prints a line on stderr about work whose result is kept; once a process for the same work."""
    print(f"{work} (first use only) ...", file=sys.stderr)


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
    """Table with notes below it, printed as aligned text.

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

    def __str__(self) -> str:
        """Returns the table as aligned text, as wide as its columns."""
        known = [of for of in self.columns if any(of.key in row for row in self.rows)]
        columns = [
            [of.key if of.heading is None else of.heading, *map(of.cell, self.rows)] for of in known
        ]
        header, *cells = columns if self.transposed else list(zip(*columns, strict=True)) or [()]
        table = Table(box=None, show_header=any(header), pad_edge=False, padding=(0, 2, 0, 0))
        for number, heading in enumerate(header):
            side = None if self.transposed else known[number].side
            # Text, as a cell's brackets are no markup.
            table.add_column(Text(heading), justify=side or ("right" if number else "left"))
        for row in cells:
            table.add_row(*map(Text, row))
        console = Console(file=io.StringIO(), width=_WIDE, color_system=None, force_terminal=False)
        with console.capture() as captured:
            console.print(*[table] * bool(header), *map(Text, self.notes), sep="\n")
        return "\n".join(line.rstrip() for line in captured.get().rstrip("\n").splitlines())


def show(*tables: TextTable) -> None:
    """Prints tables on stdout with a blank line between them."""
    print(*tables, sep="\n\n")


@contextmanager
def progress_bar(total: float) -> Iterator[Callable[[str, float], None]]:
    """A bar with an estimate of the time left on a terminal's stderr; nothing elsewhere.

    Args:
        total: of the work.

    Yields:
        What to call with a few words and how much of the work is done.
    """
    # Not at the top: `drake-oa --help` shows none.
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
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
