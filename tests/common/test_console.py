"""Tables and progress as a terminal shows them, and plain elsewhere."""

import io
import sys

import pytest
from rich.console import Console

from drake_oa.common.console import TextTable, progress_bar, show

TABLE = TextTable(
    ["method", "goal error [mm]", "scenes"],
    [["paper", "0.4", "12"], ["verified", "10.4", "[7]"]],
    "lrr",
    ["note: all"],
)


def on_terminal(table: TextTable, width: int) -> list[str]:
    """Lines of a table, without colours and blank ones."""
    screen = Console(file=io.StringIO(), width=width, force_terminal=True, color_system=None)
    with screen.capture() as captured:
        screen.print(table)
    return [line.strip() for line in captured.get().splitlines() if line.strip()]


def test_elsewhere_a_table_is_aligned_text(capsys: pytest.CaptureFixture[str]) -> None:
    show(TABLE, TextTable((), [["[and]", "b"], ["cc", "d"]], "ll"))
    assert capsys.readouterr().out.splitlines() == [
        "method    goal error [mm]  scenes",
        "paper                 0.4      12",
        "verified             10.4     [7]",
        "note: all",
        "",
        "[and]  b",
        "cc     d",
    ]


def test_a_line_is_as_long_as_it_is() -> None:
    assert len(str(TextTable((), [["x " * 500]], "l"))) == 999


def test_on_a_terminal_it_is_ruled() -> None:
    heading, rule, *rows, note = on_terminal(TABLE, 60)
    assert heading.split() == ["method", "goal", "error", "[mm]", "scenes"]
    assert set(rule) == {"─"}
    assert [row.split()[0] for row in rows] == ["paper", "verified"]
    assert note == "note: all"


def test_on_a_narrow_one_headings_are_folded() -> None:
    *above, last, _, first, second, _ = on_terminal(TABLE, 28)
    assert above == ["goal", "error"]
    assert last.split() == ["method", "[mm]", "scenes"]
    assert first.split() == ["paper", "0.4", "12"]
    assert second.split() == ["verified", "10.4", "[7]"]


def test_on_a_narrower_one_rows_and_columns_change_places() -> None:
    rows = [[name, *[value] * 8] for name, value in (("one", "1.23"), ("two", "4.56"))]
    heading, _, *turned = on_terminal(TextTable(["", *"abcdefgh"], rows, "l" + "r" * 8), 40)
    assert heading.split() == ["one", "two"]
    assert [line.split() for line in turned] == [[of, "1.23", "4.56"] for of in "abcdefgh"]


def test_progress_is_for_terminals(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with progress_bar(4.0) as update:
        update("half", 2.0)
    assert capsys.readouterr().err == ""

    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    with progress_bar(4.0) as update:
        update("half", 2.0)
    assert "half" in screen.getvalue()
    assert "50%" in screen.getvalue()
