"""Output of command-line programs: exit statuses, error messages, tables and progress bars."""

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
"""Exit statuses of commands: failure, invalid input, interruption by SIGINT, and termination by
SIGTERM."""

_MAX_LINE_LENGTH = 2000
"""Length above which a line of an error message is truncated [characters]."""
_TABLE_WIDTH = 100_000
"""Width of the virtual console on which tables are laid out, so that no line wraps [characters]."""


def complain(message: str) -> None:
    """Prints an error message on stderr, with lines over `_MAX_LINE_LENGTH` truncated."""
    lines = [
        textwrap.shorten(line, _MAX_LINE_LENGTH, placeholder=" ...")
        for line in message.splitlines()
    ]
    print("drake-oa: error: " + "\n  ".join(lines), file=sys.stderr)


def is_interrupt(error: BaseException | None) -> bool:
    """Checks whether Ctrl-C caused an exception, directly or through the chain of its causes.

    Compiled modules may raise another exception in place of KeyboardInterrupt.
    """
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


@cache
def announce_first_use(work: str) -> None:
    """Prints a line on stderr about slow work that is necessary only at the first use.

    The function that calls this one stores the result of the work for later uses.

    Args:
        work: description of the work, with which the line begins. Later calls with the same text in
            the same process print nothing.
    """
    print(f"{work} (first use only) ...", file=sys.stderr)


class Column(NamedTuple):
    """Specification of a column of a `TextTable`.

    Attributes:
        key: key of the column's values in the rows of the table.
        heading: quantity and unit; None: the key is the heading.
        form: format string of numbers, such as "{:.3f}"; texts are printed as they are.
        scale: factor by which numbers are multiplied before they are formatted.
        side: alignment; None: "left" in the first column, "right" in others.
    """

    key: str
    heading: str | None = None
    form: str = "{}"
    scale: float = 1
    side: Literal["left", "right"] | None = None

    def cell(self, row: Mapping[str, Any]) -> str:
        """Returns the text of the table cell in this column and a row; "-" if the value is missing
        or not finite.

        Args:
            row: values of the row by key.
        """
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
        columns: specification of each column. A column whose key is in no row is omitted. The line
            of headings is omitted if all headings are empty.
        rows: values of each row by key.
        notes: lines of text below the table.
        transposed: whether each row of values is printed as a column.
    """

    columns: Sequence[Column]
    rows: Sequence[Mapping[str, Any]]
    notes: Sequence[str] = ()
    transposed: bool = False

    def __str__(self) -> str:
        """Returns the table and its notes as aligned text, as wide as the columns require."""
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
    """Shows a progress bar with the remaining time on stderr, if stderr is a terminal.

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
    """Suppresses the messages of all Python loggers up to level WARNING in a `with` block."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)
