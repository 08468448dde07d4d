"""Runs of `drake-oa train`: rolls out, trains, prints the errors and writes the weights."""

from __future__ import annotations

import sys
import time
from pathlib import Path

from drake_oa.common.console import INTERRUPTED, progress_bar
from drake_oa.common.files import check_outputs
from drake_oa.regulation.regressor import save_chain
from drake_oa.training.networks import choose_device
from drake_oa.training.paper import CHAINS, error_table, paper_recipe, printed_errors, train_paper

FILES = {
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
    begin = time.perf_counter()
    try:
        with progress_bar(1.0) as bar:
            rows, chains, errors = train_paper(
                paper_recipe(recipe, iterations), seed, device=device, report=bar
            )
    except KeyboardInterrupt:
        print("\ninterrupted: nothing was written", file=sys.stderr)
        return INTERRUPTED
    for name, chain in chains.items():
        save_chain(chain, files[name])
    print(f"{rows.rollouts:,} roll-outs, {len(rows.places):,} rows\n")
    tables = [
        error_table(name, {t: e | printed_errors(name, t) for t, e in of.items()})
        for name, of in errors.items()
    ]
    print(*tables, f"seed {seed}, {device}, {time.perf_counter() - begin:.0f} s", sep="\n\n")
    for file in files.values():
        print(f"written: {file}")
    return 0
