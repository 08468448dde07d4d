"""`drake-oa train`: what it writes, prints, refuses, and keeps when interrupted."""

import numpy as np
import pytest
import torch

from drake_oa.app.main import main
from drake_oa.regulation.regressor import load_chain
from drake_oa.scenario.shipped import package_file
from drake_oa.training import session
from drake_oa.training.chain import train_chain
from drake_oa.training.confidence import ConfidenceRecipe
from drake_oa.training.dataset import Exploration
from drake_oa.training.networks import Round
from drake_oa.training.paper import PaperRecipe
from drake_oa.training.paper_set import CHAINS
from drake_oa.training.released_method import PaperLattice
from drake_oa.training.validation import validate

SMALL = Exploration(
    lambda1=np.array([0.05, 0.15]),
    lambda2=np.array([0.05, 0.15]),
    clearances=np.array([0.05, 0.1]),
    positions=np.array([0.4, 0.6]),
    kappa=np.geomspace(0.5, 20.0, 4),
    psi=np.geomspace(1.0, 2.2, 3),
    alpha=np.geomspace(30.0, 1e4, 8),
    copies=1,
    grid_steps=200,
    degree=1,
)


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(session, "Exploration", lambda: SMALL)
    monkeypatch.setattr(session, "validate", lambda chain, **_: validate(chain, scenes=10))
    full = PaperLattice()
    lattice = PaperLattice(*(axis[[1, -1]] for axis in full[:2]), *(a[1::12] for a in full[2:]))
    rounds = {name: ((Round(2, 50),),) * 3 for name in CHAINS}
    monkeypatch.setattr(session, "PaperRecipe", lambda: PaperRecipe(lattice, rounds))
    few = ConfidenceRecipe(scenes=200, held_out=200, epochs=2, batch=50)
    monkeypatch.setattr(session, "ConfidenceRecipe", lambda: few)


def test_the_project_recipe_writes_a_file_that_loads(small, tmp_path, capsys):
    out = tmp_path / "new"
    assert main(["train", "--out", str(out), "--seed", "4", "--iterations", "2"]) == 0
    metadata = load_chain(out / "regressor_chain.safetensors").metadata
    assert (metadata["recipe"], metadata["seed"]) == ("project", 4)
    assert metadata["training"]["iterations"] == 2
    printed = capsys.readouterr().out
    assert "| ln alpha |" in printed
    assert "| on the baseline |" in printed
    assert [path.name for path in out.iterdir()] == ["regressor_chain.safetensors"]


def test_the_paper_recipe_writes_two(small, tmp_path, capsys):
    assert main(["train", "--recipe", "paper", "--out", str(tmp_path), "--device", "cpu"]) == 0
    assert load_chain(tmp_path / "paper_chain.safetensors").lower.size == 3
    assert load_chain(tmp_path / "paper_chain_unconstrained.safetensors").lower.size == 2
    assert "| RC(lambda', Delta) | alpha |" in capsys.readouterr().out


def test_the_confidence_is_added_to_the_shipped_chain(small, tmp_path, capsys):
    command = ["train", "--recipe", "confidence", "--out", str(tmp_path), "--seed", "5"]
    assert main([*command, "--iterations", "1"]) == 0
    found = load_chain(tmp_path / session.RUNNING_FILE)
    shipped = load_chain(package_file(f"package://drake_oa/weights/{session.RUNNING_FILE}"))
    told = found.metadata["confidence"]
    assert (told["seed"], told["epochs"]) == (5, 1)
    inputs = np.random.default_rng(0).uniform(shipped.lower, shipped.upper)[None]
    np.testing.assert_array_equal(found.evaluate(inputs), shipped.evaluate(inputs))
    assert capsys.readouterr().out.count("| in_range |") == 1


def test_an_interrupted_training_says_how_to_go_on_and_does(small, tmp_path, monkeypatch, capsys):
    command = ["train", "--iterations", "3", "--out", str(tmp_path / "cut")]

    def interrupted(*arguments, report, **options):
        def stop(stage, fraction):
            if (stage, fraction) == ("psi", 2 / 3):
                raise KeyboardInterrupt

        return train_chain(*arguments, report=stop, **options)

    with monkeypatch.context() as cut:
        cut.setattr(session, "train_chain", interrupted)
        assert main(command) == 130
    assert "the same command goes on from there" in capsys.readouterr().err
    assert (tmp_path / "cut" / "project.checkpoint" / "psi.safetensors").is_file()
    assert main(command) == 0
    assert "going on from" in capsys.readouterr().err
    assert main([*command[:-1], str(tmp_path / "whole")]) == 0
    cut, whole = (load_chain(tmp_path / name / session.PROJECT_FILE) for name in ("cut", "whole"))
    inputs = np.random.default_rng(0).uniform(whole.lower, whole.upper, (20, 4))
    np.testing.assert_array_equal(cut.evaluate(inputs), whole.evaluate(inputs))


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


def test_a_checkpoint_of_another_seed_is_refused(small, tmp_path, capsys):
    checkpoint = tmp_path / "project.checkpoint"
    checkpoint.mkdir()
    (checkpoint / "settings.json").write_text('{"seed": 8}')
    assert main(["train", "--out", str(tmp_path), "--iterations", "1"]) == 2
    assert "--restart" in capsys.readouterr().err
    restarted = ["train", "--out", str(tmp_path), "--iterations", "1", "--restart"]
    assert main(restarted) == 0
