"""How well a stated probability agrees with what happens."""

import json
from pathlib import Path

import numpy as np
import pytest

from drake_oa.app.main import main
from drake_oa.studies.confidence import MEASURED, SUITES, as_measured, in_a_suite, reliability
from drake_oa.studies.scenes.paper_method import paper_chain


@pytest.fixture(scope="module")
def chain():
    return paper_chain(True, "running")


def test_the_shipped_confidence_is_calibrated_inside_and_outside_of_the_range(chain) -> None:
    found = as_measured(chain, 3000, 7)
    assert found["confidence"]["error"] < 0.02
    for part in ("confidence, inside", "confidence, outside"):
        assert found[part]["error"] < 0.03
        assert found[part]["brier"] < 0.06
    assert found["in_range"]["brier"] > 0.2


def test_among_ellipsoids_it_tells_more_than_the_bare_range(chain) -> None:
    found = in_a_suite(chain, "novel", 200, 7)
    assert found["confidence"]["brier"] < 0.5 * found["in_range"]["brier"]
    inside, outside = (found[f"confidence, {part}"]["scenes"] for part in ("inside", "outside"))
    assert inside + outside == found["confidence"]["scenes"] == 200


def test_a_part_without_scenes_has_no_figures() -> None:
    kept = np.array([True, False])
    found = reliability(np.array([0.9, 0.2]), np.ones(2, dtype=bool), kept)
    assert found["confidence, outside"] is None
    assert found["confidence"]["kept"] == 0.5
    assert found["in_range"]["brier"] == 0.5


def test_a_chain_that_tells_none_is_refused() -> None:
    with pytest.raises(ValueError, match="--recipe"):
        as_measured(paper_chain(True), 10, 0)


def test_the_command_prints_writes_and_draws(tmp_path: Path, capsys) -> None:
    file, plot = tmp_path / "found.json", tmp_path / "found.png"
    options = ["--scenes", "300", "--suite-scenes", "40", "--trials", "0", "--seed", "3"]
    command = ["evaluate", "confidence", *options, "--json", str(file), "--plot", str(plot)]
    assert main(command) == 0
    assert "confidence, outside" in capsys.readouterr().out
    told = json.loads(file.read_text())
    assert set(told["scenes"]) == {MEASURED, *SUITES}
    assert told["seed"] == 3
    assert plot.stat().st_size > 10_000


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--scenes", "0"], "--scenes and --suite-scenes must be at least 1"),
        (["--plot", "found.txt"], "--plot must end in"),
        (["--plot", "a.png", "--json", "a.png"], "must name different files"),
    ],
)
def test_wrong_arguments_are_named(options, message, capsys) -> None:
    assert main(["evaluate", "confidence", *options]) == 2
    assert message in capsys.readouterr().err
