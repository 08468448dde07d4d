"""What leads the search, compared on a few scenes."""

import json
from pathlib import Path

import pytest

from drake_oa.app.main import main
from drake_oa.studies.proposals import LED, compare, proposals_table

NAMES = ["full, trained", "full, chain", "trained", "chain", "constant", "random", "none"]


def test_few_roll_outs_led_by_the_network_do_what_the_full_search_does() -> None:
    found = compare("hit", 24, 3)
    assert list(found) == NAMES == [led.name for led in LED]
    full, trained, constant = (found[name] for name in ("full, trained", "trained", "constant"))
    assert full["kept_of_full"] == full["path_ratio"] == full["times_cheaper"] == 1.0
    assert trained["kept_of_full"] == 1.0
    assert trained["path_ratio"] < 1.03
    assert trained["rollouts"] <= 32.0
    assert constant["path_ratio"] > trained["path_ratio"]
    assert found["none"]["kept"] < trained["kept"]
    assert trained["decision_ms"] < full["decision_ms"]


def test_the_arm_decides_on_what_it_keeps_of_true_solids() -> None:
    found = compare("tabletop", 1, 0)
    assert list(found) == NAMES
    assert found["trained"]["rollouts"] is None
    assert "tabletop" in proposals_table("tabletop", found).header


def test_the_command_writes_its_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "figures.json"
    assert (
        main(["evaluate", "proposals", "--suite", "posed", "--scenes", "4", "--json", str(file)])
        == 0
    )
    written = json.loads(file.read_text())
    assert list(written["suites"]["posed"]) == NAMES
    assert "full, trained" in capsys.readouterr().out


def test_what_is_no_suite_is_named() -> None:
    with pytest.raises(ValueError, match="unknown suite 'moving'; proposals has: novel"):
        compare("moving", 3, 0)
    with pytest.raises(ValueError, match="--scenes must be at least 1, not 0"):
        compare("hit", 0, 0)
