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
"""Exit statuses of a failed command, of invalid input, and of the signals SIGINT and SIGTERM."""

_MAX_LINE_LENGTH = 2000
"""Length at which a line of an error message is truncated [characters]."""
_TABLE_WIDTH = 100_000
"""Width of the virtual console on which tables are laid out, so that no line wraps [characters]."""


def complain(message: str) -> None:
    """Prints an error message on stderr; lines over `_MAX_LINE_LENGTH` are truncated."""
    lines = [
        textwrap.shorten(line, _MAX_LINE_LENGTH, placeholder=" ...")
        for line in message.splitlines()
    ]
    print("drake-oa: error: " + "\n  ".join(lines), file=sys.stderr)


@cache
def announce_first_use(work: str) -> None:
    """Prints a line on stderr about slow work whose result is cached; once per process and work."""
    print(f"{work} (first use only) ...", file=sys.stderr)


class Column(NamedTuple):
    """Specification of a column of a table.

    Attributes:
        key: key of the values in the rows.
        heading: quantity and unit; None: the key.
        form: format of the values; texts are printed as they are.
        scale: factor of the values before they are formatted.
        side: alignment; None: "left" in the first column, "right" in others.
    """

    key: str
    heading: str | None = None
    form: str = "{}"
    scale: float = 1
    side: Literal["left", "right"] | None = None

    def cell(self, row: Mapping[str, Any]) -> str:
        """Returns the formatted value of a row; "-" if it is missing or not finite."""
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
        used = [of for of in self.columns if any(of.key in row for row in self.rows)]
        columns = [
            [of.key if of.heading is None else of.heading, *map(of.cell, self.rows)] for of in used
        ]
        header, *cells = columns if self.transposed else list(zip(*columns, strict=True)) or [()]
        table = Table(box=None, show_header=any(header), pad_edge=False, padding=(0, 2, 0, 0))
        for number, heading in enumerate(header):
            side = None if self.transposed else used[number].side
            # A plain string would have its brackets interpreted as markup.
            table.add_column(Text(heading), justify=side or ("right" if number else "left"))
        for row in cells:
            table.add_row(*map(Text, row))
        console = Console(
            file=io.StringIO(), width=_TABLE_WIDTH, color_system=None, force_terminal=False
        )
        with console.capture() as captured:
            console.print(*[table] * bool(header), *map(Text, self.notes), sep="\n")
        return "\n".join(line.rstrip() for line in captured.get().rstrip("\n").splitlines())


def show(*tables: TextTable) -> None:
    """Prints tables on stdout with a blank line between them."""
    print(*tables, sep="\n\n")


@contextmanager
def progress_bar(total: float) -> Iterator[Callable[[str, float], None]]:
    """Shows a progress bar with the remaining time on stderr, if that is a terminal.

    Args:
        total: total amount of work, in any unit.

    Yields:
        Function that updates the bar: its arguments are a description and the completed amount.
    """
    # Imported here because it would slow down `drake-oa --help`.
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("", total=total)

        def update(description: str, completed: float) -> None:
            progress.update(task, description=description, completed=completed)

        yield update


@contextmanager
def quiet() -> Iterator[None]:
    """Suppresses log messages up to level WARNING in the block."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)
