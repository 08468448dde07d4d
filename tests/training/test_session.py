"""`drake-oa train`: what it writes, prints, refuses, and keeps when interrupted."""

from pathlib import Path

import pytest
import torch

from drake_oa.app.main import main
from drake_oa.regulation.proposals import load_proposals
from drake_oa.regulation.regressor import load_chain
from drake_oa.scenario.loading import load_scenario
from drake_oa.training import session
from drake_oa.training.lattice import PaperLattice
from drake_oa.training.networks import Round
from drake_oa.training.paper import CHAINS, PaperRecipe


@pytest.fixture
def small(monkeypatch):
    full = PaperLattice()
    lattice = PaperLattice(*(axis[[1, -1]] for axis in full[:2]), *(a[1::12] for a in full[2:]))
    rounds = {name: ((Round(2, 50),),) * 3 for name in CHAINS}
    monkeypatch.setattr(session, "PaperRecipe", lambda: PaperRecipe(lattice, rounds))


def test_the_paper_recipe_writes_two(small, tmp_path, capsys):
    assert main(["train", "--recipe", "paper", "--out", str(tmp_path), "--device", "cpu"]) == 0
    assert load_chain(tmp_path / "paper_chain.safetensors").lower.size == 3
    assert load_chain(tmp_path / "paper_chain_unconstrained.safetensors").lower.size == 2
    assert "RC(lambda', Delta)" in capsys.readouterr().out


def test_an_interrupted_training_says_how_it_resumes(small, tmp_path, monkeypatch, capsys):
    def interrupted(*arguments, **options):
        raise KeyboardInterrupt

    command = ["train", "--recipe", "paper", "--out", str(tmp_path)]
    with monkeypatch.context() as cut:
        cut.setattr(session, "train_paper", interrupted)
        assert main(command) == 130
    assert "the same command goes on from there" in capsys.readouterr().err
    assert main(command) == 0
    assert "going on from" in capsys.readouterr().err


def test_without_a_recipe_the_network_of_the_default_scenario_is_trained(tmp_path):
    assert main(["train", "--iterations", "30", "--out", str(tmp_path)]) == 0
    (written,) = tmp_path.iterdir()
    assert written.name == Path(load_scenario("tabletop_box").regulation.proposals).name
    assert load_proposals(written).metadata["recipe"] == "proposals"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--iterations", "0"], "--iterations must be at least 1"),
        (["--seed", "-1"], "--seed must not be negative"),
        (["--device", "cuda"], "device cuda"),
    ],
)
def test_wrong_arguments_are_named(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert main(["train", "--out", str(tmp_path), *arguments]) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
