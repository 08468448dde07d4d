"""Runs of `drake-oa train`: rolls out, trains, prints the scores and writes the weights."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Collection
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from drake_oa.common.console import INTERRUPTED, progress_bar
from drake_oa.common.files import check_outputs
from drake_oa.regulation.proposal_network import ProposalNetwork, save_proposals
from drake_oa.regulation.regressor import ChainWeights, save_chain
from drake_oa.training.checkpoint import Checkpoint
from drake_oa.training.networks import choose_device
from drake_oa.training.paper import CHAINS, PaperRecipe, error_table, printed_errors, train_paper
from drake_oa.training.proposals import ProposalRecipe, proposal_table, train_proposals

PAPER_FILES = {
    "RC(lambda')": "paper_chain_unconstrained.safetensors",
    "RC(lambda', Delta)": "paper_chain.safetensors",
}
"""Weights file of each chain of the paper."""

RUNNING_FILES = {CHAINS[1]: "paper_chain_running.safetensors"}
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
    plan = _plan(recipe, iterations)
    check_outputs(*(out / name for name in plan.files))
    folder = checkpoint or out / f"{recipe}.checkpoint"
    settings = {"recipe": recipe, "seed": seed, "device": device, **plan.settings}
    kept = Checkpoint(folder, settings, restart=restart)
    if kept.resumed:
        print(f"going on from {folder}", file=sys.stderr)
    begin = time.perf_counter()
    try:
        with progress_bar(1.0) as bar:
            networks, told = plan.train(seed, device=device, checkpoint=kept, report=bar)
    except KeyboardInterrupt:
        print(
            f"\ninterrupted; what was computed is in {folder}: the same command goes on from there",
            file=sys.stderr,
        )
        return INTERRUPTED
    print(f"{told}\n\nseed {seed}, {device}, {time.perf_counter() - begin:.0f} s")
    for name, network in networks.items():
        if isinstance(network, ProposalNetwork):
            save_proposals(network, out / name)
        else:
            save_chain(network, out / name)
        print(f"written: {out / name}")
    kept.remove()
    return 0


@dataclass(frozen=True)
class _Plan:
    """A training as asked.

    Attributes:
        files: names of the weights.
        settings: of the recipe, as JSON would hold them.
        train: trains with a seed, device, checkpoint and report; returns the networks by file, and
            the scores in words.
    """

    files: Collection[str]
    settings: dict[str, Any]
    train: Callable[..., tuple[dict[str, Written], str]]


def _plan(name: str, iterations: int | None) -> _Plan:
    if name == "proposals":
        return _plan_proposals(iterations)
    running = name == "paper_running"
    recipe = PaperRecipe.running() if running else PaperRecipe()
    if iterations is not None:
        recipe = recipe.limited(iterations)
    files = RUNNING_FILES if running else PAPER_FILES

    def train(seed: int, **options: Any) -> tuple[dict[str, Written], str]:
        rows, chains, scores = train_paper(recipe, seed, **options)
        tables = [
            error_table(
                name, {s.target: asdict(s) | printed_errors(name, s.target) for s in networks}
            )
            for name, networks in scores.items()
        ]
        head = f"{rows.rollouts:,} roll-outs, {len(rows):,} rows"
        told = "\n\n".join([head, *map(str, tables)])
        return {files[name]: chain for name, chain in chains.items()}, told

    return _Plan(files.values(), recipe.settings(), train)


def _plan_proposals(iterations: int | None) -> _Plan:
    recipe = ProposalRecipe()
    if iterations is not None:
        recipe = recipe.limited(iterations)

    def train(seed: int, **options: Any) -> tuple[dict[str, Written], str]:
        network, scores = train_proposals(recipe, seed, **options)
        return {PROPOSALS_FILE: network}, str(proposal_table(scores))

    return _Plan([PROPOSALS_FILE], asdict(recipe), train)
