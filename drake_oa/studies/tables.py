"""Figures, plain data by their names: statistics over what is known, and one text table."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from drake_oa.common.console import TextTable

Column = tuple[str, str, str, float]
"""A figure's key, its heading, its format and what it is multiplied by before."""


def over(statistic: Callable[..., Any], values: Iterable[float | None]) -> float | None:
    """A statistic over what is not None; None where nothing is left."""
    known = [value for value in values if value is not None]
    return float(statistic(known)) if known else None


def text_table(
    title: str,
    rows: Sequence[tuple[str, Mapping[str, Any]]],
    columns: Sequence[Column],
    notes: Sequence[str] = (),
) -> TextTable:
    """A table; a figure that is not there shows as "-".

    Args:
        title: of the first column.
        rows: name and figures each.
        columns: key, heading, format and factor each.
        notes: lines below.
    """
    cells = []
    for name, figures in rows:
        row = [name]
        for key, _, form, factor in columns:
            value = figures.get(key)
            if value is None:
                row.append("-")
            else:
                row.append(form.format(value if isinstance(value, int) else value * factor))
        cells.append(row)
    header = [title, *(heading for _, heading, _, _ in columns)]
    return TextTable(header, cells, "l" + "r" * len(columns), notes)
