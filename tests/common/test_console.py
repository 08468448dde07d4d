"""Tests of the tables of the commands."""

import pytest

from drake_oa.common.console import Column, TextTable, show

TABLE = TextTable(
    [
        Column("method"),
        Column("error", "goal error [mm]", "{:.1f}", 1e3),
        Column("scenes"),
        Column("note", side="left"),
    ],
    [
        {"method": "paper", "error": 0.4e-3, "scenes": 12},
        {"method": "verified", "error": float("inf"), "scenes": "[7]", "note": "x"},
    ],
    ["note: all"],
)


def test_a_table_is_aligned_text(capsys: pytest.CaptureFixture[str]) -> None:
    columns = [Column("first", ""), Column("second", "")]
    show(TABLE, TextTable(columns, [{"first": "x " * 500, "second": 1}], transposed=True))
    table, long = capsys.readouterr().out.split("\n\n")
    assert table.splitlines() == [
        "method    goal error [mm]  scenes  note",
        "paper                 0.4      12  -",
        "verified                -     [7]  x",
        "note: all",
    ]
    assert [line.strip() for line in long.splitlines()] == [("x " * 500).strip(), "1"]
