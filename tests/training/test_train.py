"""Tests of `drake-oa train`: weights files, printed errors, and invalid arguments."""

import pytest

from drake_oa.app.main import main
from drake_oa.inference.regressor import load_chain
from drake_oa.training import paper
from drake_oa.training.lattice import PaperLattice

FILES = {
    "paper": {"paper_chain": 3, "paper_chain_unconstrained": 2},
    "paper_running": {"paper_chain_running": 3},
}


@pytest.mark.parametrize("recipe", FILES)
def test_recipe_writes_its_chains(recipe, tmp_path, capsys, monkeypatch):
    full = PaperLattice()
    lattice = PaperLattice(*(axis[[1, -1]] for axis in full[:2]), *(a[1::12] for a in full[2:]))
    monkeypatch.setattr(paper, "PaperLattice", lambda: lattice)
    command = ["train", "--recipe", recipe, "--iterations", "2"]
    assert main([*command, "--out", str(tmp_path)]) == 0
    for file, inputs in FILES[recipe].items():
        assert load_chain(tmp_path / f"{file}.safetensors").lower.size == inputs
    assert "RC(lambda', Delta)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["--iterations", "0"], "Must be >= 1"), (["--seed", "-1"], "Must be >= 0")],
)
def test_invalid_arguments_are_named(arguments, message, tmp_path, capsys):
    assert main(["train", "--out", str(tmp_path), *arguments]) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
