"""Runs of `drake-oa train`: rolls out, trains, prints the scores and writes the weights."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from drake_oa.common.console import INTERRUPTED, progress_bar
from drake_oa.common.files import check_outputs
from drake_oa.regulation.proposals import ProposalNetwork, save_proposals
from drake_oa.regulation.regressor import ChainWeights, save_chain
from drake_oa.training.checkpoint import Checkpoint
from drake_oa.training.networks import choose_device
from drake_oa.training.paper import CHAINS, PaperRecipe, error_table, printed_errors, train_paper
from drake_oa.training.proposals import ProposalRecipe, proposal_table, train_proposals

FILES = {
    "proposals": {"proposals": "proposals.safetensors"},
    "paper": {
        CHAINS[0]: "paper_chain_unconstrained.safetensors",
        CHAINS[1]: "paper_chain.safetensors",
    },
    "paper_running": {CHAINS[1]: "paper_chain_running.safetensors"},
}
"""Weights file of each network of a recipe."""

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
    plan: ProposalRecipe | PaperRecipe
    if recipe == "proposals":
        plan = ProposalRecipe()
    else:
        plan = PaperRecipe.running() if recipe == "paper_running" else PaperRecipe()
    if iterations is not None:
        plan = plan.limited(iterations)
    files = FILES[recipe]
    check_outputs(*(out / name for name in files.values()))
    folder = checkpoint or out / f"{recipe}.checkpoint"
    settings = {"recipe": recipe, "seed": seed, "device": device, **plan.settings()}
    kept = Checkpoint(folder, settings, restart=restart)
    if kept.resumed:
        print(f"going on from {folder}", file=sys.stderr)
    begin = time.perf_counter()
    try:
        with progress_bar(1.0) as bar:
            networks, told = _train(plan, seed, files, device=device, checkpoint=kept, report=bar)
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


def _train(
    plan: ProposalRecipe | PaperRecipe, seed: int, files: Mapping[str, str], **options: Any
) -> tuple[dict[str, Written], str]:
    """Trains; returns the networks by the name of their file, and the scores in words."""
    if isinstance(plan, ProposalRecipe):
        network, rounds = train_proposals(plan, seed, **options)
        return {files["proposals"]: network}, str(proposal_table(rounds))
    rows, chains, scores = train_paper(plan, seed, **options)
    tables = [
        error_table(name, {s.target: asdict(s) | printed_errors(name, s.target) for s in networks})
        for name, networks in scores.items()
    ]
    head = f"{rows.rollouts:,} roll-outs, {len(rows):,} rows"
    return {files[name]: chain for name, chain in chains.items()}, "\n\n".join(
        [head, *map(str, tables)]
    )
