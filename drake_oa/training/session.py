"""Runs of `drake-oa train`: rolls out, trains, prints the errors and writes the weights."""

from __future__ import annotations

import shutil
import sys
import time
from pathlib import Path

from drake_oa.common.console import INTERRUPTED, progress_bar
from drake_oa.common.files import check_outputs
from drake_oa.regulation.proposals import save_proposals
from drake_oa.regulation.regressor import save_chain
from drake_oa.training.networks import choose_device
from drake_oa.training.paper import CHAINS, error_table, paper_recipe, printed_errors, train_paper
from drake_oa.training.proposals import ProposalRecipe, proposal_table, train_proposals

FILES = {
    "proposals": {"": "proposals.safetensors"},
    "paper": {
        CHAINS[0]: "paper_chain_unconstrained.safetensors",
        CHAINS[1]: "paper_chain.safetensors",
    },
    "paper_running": {CHAINS[1]: "paper_chain_running.safetensors"},
}
"""Weights file of each network of a recipe."""


def train(
    recipe: str,
    out: Path,
    *,
    seed: int = 0,
    iterations: int | None = None,
    device: str = "auto",
) -> int:
    """Trains by a recipe, see `drake-oa train`; returns the exit status.

    Raises:
        ValueError: for options that are out of range, a device that does not exist, or weights that
            cannot be written.
    """
    if iterations is not None and iterations < 1:
        raise ValueError(f"--iterations must be at least 1, not {iterations}")
    if seed < 0:
        raise ValueError(f"--seed must not be negative, not {seed}")
    device = choose_device(device)
    files = {name: out / file for name, file in FILES[recipe].items()}
    check_outputs(*files.values())
    begin, folder = time.perf_counter(), out / f"{recipe}.checkpoint"
    try:
        with progress_bar(1.0) as bar:
            if recipe == "proposals":
                plan = ProposalRecipe() if iterations is None else ProposalRecipe.short(iterations)
                network, scores = train_proposals(plan, seed, folder, device=device, report=bar)
                save_proposals(network, files[""])
                tables = [proposal_table(scores)]
            else:
                rows, chains, errors = train_paper(
                    paper_recipe(recipe, iterations), seed, device=device, report=bar
                )
                for name, chain in chains.items():
                    save_chain(chain, files[name])
                print(f"{rows.rollouts:,} roll-outs, {len(rows.places):,} rows\n")
                tables = [
                    error_table(name, {t: e | printed_errors(name, t) for t, e in of.items()})
                    for name, of in errors.items()
                ]
    except KeyboardInterrupt:
        print("\ninterrupted; the same command resumes the searches of proposals", file=sys.stderr)
        return INTERRUPTED
    shutil.rmtree(folder, ignore_errors=True)
    print(*tables, f"seed {seed}, {device}, {time.perf_counter() - begin:.0f} s", sep="\n\n")
    for file in files.values():
        print(f"written: {file}")
    return 0
