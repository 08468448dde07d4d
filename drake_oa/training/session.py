"""Runs of `drake-oa train`: rolls out, trains, prints the scores and writes the weights."""

from __future__ import annotations

import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar

from drake_oa.common.console import INTERRUPTED, progress_bar
from drake_oa.common.files import check_outputs
from drake_oa.regulation.proposal_network import ProposalNetwork, save_proposals
from drake_oa.regulation.regressor import ChainWeights, save_chain
from drake_oa.training.checkpoint import Checkpoint, Report
from drake_oa.training.networks import choose_device
from drake_oa.training.paper import CHAINS, PaperRecipe, table_one, train_paper
from drake_oa.training.proposals import ProposalRecipe, proposal_table, train_proposals

PAPER_FILES = {
    "RC(lambda')": "paper_chain_unconstrained.safetensors",
    "RC(lambda', Delta)": "paper_chain.safetensors",
}
"""Weights file of each chain of the paper."""

RUNNING_FILE = "paper_chain_running.safetensors"
"""Weights file of RC(lambda', Delta) for the running system."""

PROPOSALS_FILE = "proposals.safetensors"
"""Weights file of the network that seeds the search."""

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

    def recipe(self) -> PaperRecipe:
        return PaperRecipe.running()


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
            device=device,
            checkpoint=checkpoint,
            report=bar,
        )
        return {PROPOSALS_FILE: network}, str(proposal_table(scores))


_RECIPES: dict[str, type[_Paper | _Proposals]] = {
    "proposals": _Proposals,
    "paper": _Paper,
    "paper_running": _PaperRunning,
}
