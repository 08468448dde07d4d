"""What `drake-oa train` does: explores, trains, tells how good it is, writes the weights."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, ClassVar

from drake_oa.common.console import INTERRUPTED, progress_bar
from drake_oa.common.files import check_outputs
from drake_oa.regulation.proposal_network import ProposalNetwork, save_proposals
from drake_oa.regulation.regressor import ChainWeights, load_chain, save_chain
from drake_oa.scenario.shipped import package_file
from drake_oa.training.chain import score_table, train_chain
from drake_oa.training.checkpoint import Checkpoint, Report
from drake_oa.training.confidence import ConfidenceRecipe, calibration_table, with_confidence
from drake_oa.training.dataset import Exploration, build_training_set
from drake_oa.training.levenberg_marquardt import Schedule
from drake_oa.training.networks import choose_device
from drake_oa.training.paper import PaperRecipe, table_one, train_paper
from drake_oa.training.paper_set import CHAINS
from drake_oa.training.proposals import ProposalRecipe, proposal_table, train_proposals
from drake_oa.training.validation import validate, validation_table

PAPER_FILES = {
    "RC(lambda')": "paper_chain_unconstrained.safetensors",
    "RC(lambda', Delta)": "paper_chain.safetensors",
}
"""Weights file of each chain of the paper."""

RUNNING_FILE = "paper_chain_running.safetensors"
"""Weights file of RC(lambda', Delta) for the running system."""

PROJECT_FILE = "regressor_chain.safetensors"
"""Weights file of the project's chain."""

PROPOSALS_FILE = "proposals.safetensors"
"""Weights file of the network that leads the search."""

Written = ChainWeights | ProposalNetwork


def train(
    recipe: str,
    out: Path,
    *,
    seed: int = 0,
    iterations: int | None = None,
    device: str = "auto",
    checkpoint: Path | None = None,
    restart: bool = False,
) -> int:
    """Trains as asked, see `drake-oa train`; returns the exit status.

    Raises:
        ValueError: for options that are out of range, a device that is not there, a
            checkpoint of other settings, or weights that cannot be written.
    """
    if iterations is not None and iterations < 1:
        raise ValueError(f"--iterations must be at least 1, not {iterations}")
    if seed < 0:
        raise ValueError(f"--seed must not be negative, not {seed}")
    device = choose_device(device)
    trained = _RECIPES[recipe](seed, iterations)
    check_outputs(*(out / name for name in trained.files))
    folder = checkpoint or out / f"{recipe}.checkpoint"
    settings = {"recipe": recipe, "seed": seed, "device": device, **trained.settings()}
    kept = Checkpoint(folder, settings, restart=restart)
    if kept.resumed:
        print(f"going on from {folder}", file=sys.stderr)
    begin = time.perf_counter()
    try:
        with progress_bar(1.0) as bar:
            chains, tables = trained.train(device, kept, bar)
    except KeyboardInterrupt:
        print(
            f"\ninterrupted; what was computed is in {folder}: the same command goes on from there",
            file=sys.stderr,
        )
        return INTERRUPTED
    print(f"{tables}\n\nseed {seed}, {device}, {time.perf_counter() - begin:.0f} s")
    for name, chain in chains.items():
        if isinstance(chain, ProposalNetwork):
            save_proposals(chain, out / name)
        else:
            save_chain(chain, out / name)
        print(f"written: {out / name}")
    kept.remove()
    return 0


class _Paper:
    names: ClassVar[dict[str, str]] = PAPER_FILES

    def __init__(self, seed: int, iterations: int | None) -> None:
        self._seed = seed
        self.files = tuple(self.names.values())
        self._recipe = self.recipe()
        if iterations is not None:
            self._recipe = self._recipe.limited(iterations)

    def recipe(self) -> PaperRecipe:
        return PaperRecipe()

    def settings(self) -> dict[str, Any]:
        return self._recipe.settings()

    def train(
        self, device: str, checkpoint: Checkpoint, bar: Report
    ) -> tuple[dict[str, Written], str]:
        rows, chains, scores = train_paper(
            self._recipe,
            self._seed,
            device=device,
            checkpoint=checkpoint,
            report=bar,
        )
        head = f"{rows.rollouts:,} roll-outs, {len(rows):,} rows\n\n"
        files: dict[str, Written] = {self.names[name]: chain for name, chain in chains.items()}
        return files, head + table_one(scores)


class _PaperRunning(_Paper):
    names: ClassVar[dict[str, str]] = {CHAINS[1]: RUNNING_FILE}

    def __init__(self, seed: int, iterations: int | None) -> None:
        super().__init__(seed, iterations)
        self._confidence = _Confidence(seed, iterations)

    def recipe(self) -> PaperRecipe:
        return PaperRecipe.running()

    def train(
        self, device: str, checkpoint: Checkpoint, bar: Report
    ) -> tuple[dict[str, Written], str]:
        files, tables = super().train(device, checkpoint, bar)
        told, more = self._confidence.add(files, bar)
        return told, f"{tables}\n\n{more}"


class _Confidence:
    files = (RUNNING_FILE,)

    def __init__(self, seed: int, iterations: int | None) -> None:
        self._seed = seed
        self._recipe = ConfidenceRecipe()
        if iterations is not None:
            self._recipe = replace(self._recipe, epochs=min(self._recipe.epochs, iterations))

    def settings(self) -> dict[str, Any]:
        return asdict(self._recipe)

    def train(
        self, device: str, checkpoint: Checkpoint, bar: Report
    ) -> tuple[dict[str, Written], str]:
        shipped: dict[str, Written] = {name: _shipped(name) for name in self.files}
        return self.add(shipped, bar)

    def add(self, files: Mapping[str, Written], bar: Report) -> tuple[dict[str, Written], str]:
        """The chains with their confidence, and a table of each."""
        told, tables = dict(files), []
        for name, chain in files.items():
            if isinstance(chain, ChainWeights):
                told[name], found = with_confidence(chain, self._recipe, self._seed, bar)
                tables.append(f"confidence of {name}\n\n{calibration_table(found)}")
        return told, "\n\n".join(tables)


def _shipped(name: str) -> ChainWeights:
    return load_chain(package_file(f"package://drake_oa/weights/{name}"))


class _Project:
    files = (PROJECT_FILE,)

    def __init__(self, seed: int, iterations: int | None) -> None:
        self._seed = seed
        self._exploration = Exploration()
        self._schedule = Schedule()
        if iterations is not None:
            self._schedule = Schedule(iterations=iterations)

    def settings(self) -> dict[str, Any]:
        return {"exploration": self._exploration.settings(), "schedule": asdict(self._schedule)}

    def train(
        self, device: str, checkpoint: Checkpoint, bar: Report
    ) -> tuple[dict[str, Written], str]:
        rows = build_training_set(self._exploration, self._seed, bar, checkpoint)
        chain, scores = train_chain(
            rows,
            self._exploration,
            self._seed,
            self._schedule,
            device=device,
            checkpoint=checkpoint,
            report=bar,
        )
        explored = {name: getattr(self._exploration, name) for name in ("alpha_x", "end", "fade")}
        outcomes = {
            "on the baseline": validate(chain, **explored),
            "up to 0.2 L beside it": validate(chain, beside=0.2, **explored),
        }
        head = f"{rows.rollouts:,} roll-outs\n\n"
        tables = f"{score_table(scores)}\n\n{validation_table(outcomes)}"
        return {PROJECT_FILE: chain}, head + tables


class _Proposals:
    files = (PROPOSALS_FILE,)

    def __init__(self, seed: int, iterations: int | None) -> None:
        self._seed = seed
        self._recipe = ProposalRecipe()
        if iterations is not None:
            self._recipe = self._recipe.limited(iterations)

    def settings(self) -> dict[str, Any]:
        return asdict(self._recipe)

    def train(
        self, device: str, checkpoint: Checkpoint, bar: Report
    ) -> tuple[dict[str, Written], str]:
        network, scores = train_proposals(
            self._recipe,
            self._seed,
            _shipped(PROJECT_FILE),
            device=device,
            checkpoint=checkpoint,
            report=bar,
        )
        return {PROPOSALS_FILE: network}, str(proposal_table(scores))


_RECIPES: dict[str, type[_Project | _Paper | _Proposals | _Confidence]] = {
    "project": _Project,
    "proposals": _Proposals,
    "paper": _Paper,
    "paper_running": _PaperRunning,
    "confidence": _Confidence,
}
