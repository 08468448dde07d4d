"""What commands print: exit statuses, errors, tables and progress; plain when piped."""

from __future__ import annotations

import io
import sys
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from rich import box
from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

FAILED, BAD_INPUT, INTERRUPTED, TERMINATED = 1, 2, 130, 143
"""Exit statuses other than 0."""

_LONGEST = 2000
_WIDE = 100_000


def complain(message: str) -> None:
    """Prints an error as one line on stderr; of a very long one, the first `_LONGEST` letters."""
    line = textwrap.shorten(message, _LONGEST, placeholder=" ...")
    print(f"drake-oa: error: {line}", file=sys.stderr)


@dataclass(frozen=True)
class TextTable:
    """A table with notes below it: ruled and coloured on a terminal, aligned text elsewhere.

    Attributes:
        header: a heading a column; empty for none.
        rows: of each row its cells, as many as there are columns.
        sides: a letter a column: "l" for the left, "r" for the right.
        notes: lines below.
        title: line above.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    sides: str
    notes: Sequence[str] = ()
    title: str = ""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        ruled = console.is_terminal
        table = Table(
            box=box.SIMPLE_HEAD if ruled and self.header else None,
            show_header=bool(self.header),
            header_style="bold" if ruled else "",
            pad_edge=False,
            padding=(0, 1 if ruled and self.header else 2, 0, 0),
        )
        header = self.header or [""] * len(self.sides)
        for number, (heading, side) in enumerate(zip(header, self.sides, strict=True)):
            # Text, as a cell's brackets are no markup.
            table.add_column(
                Text(heading),
                justify="right" if side == "r" else "left",
                style="cyan" if ruled and number == 0 else "",
                overflow="fold",
            )
        for row in self.rows:
            table.add_row(*map(Text, row))
        if self.title:
            yield Text(self.title, style="bold" if ruled else "")
        yield table
        for note in self.notes:
            yield Text(note, style="yellow" if note.startswith("warning") else "")

    def __str__(self) -> str:
        return plain(self)


def plain(item: RenderableType) -> str:
    """What is shown, as text without colours and as wide as it needs."""
    console = Console(file=io.StringIO(), width=_WIDE, color_system=None, force_terminal=False)
    with console.capture() as captured:
        console.print(item)
    return "\n".join(line.rstrip() for line in captured.get().rstrip("\n").splitlines())


def show(item: RenderableType) -> None:
    """Prints on stdout, as the terminal can show it; `plain` where it is none."""
    console = Console()
    if console.is_terminal:
        console.print(item)
    else:
        print(plain(item))


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
