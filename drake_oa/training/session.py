"""What `drake-oa train` does: explores, trains, tells how good it is, writes the weights."""

from __future__ import annotations

import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from drake_oa.common.console import INTERRUPTED, progress_bar
from drake_oa.common.files import check_outputs, source_commit
from drake_oa.regulation.regressor import ChainWeights, save_chain
from drake_oa.training.chain import score_table, train_chain
from drake_oa.training.checkpoint import Checkpoint, Report
from drake_oa.training.dataset import Exploration, build_training_set
from drake_oa.training.levenberg_marquardt import Schedule
from drake_oa.training.networks import choose_device
from drake_oa.training.paper import PaperRecipe, table_one, train_paper
from drake_oa.training.validation import validate, validation_table

PAPER_FILES = {
    "RC(lambda')": "paper_chain_unconstrained.safetensors",
    "RC(lambda', Delta)": "paper_chain.safetensors",
}
"""Weights file of each chain of the paper."""

PROJECT_FILE = "regressor_chain.safetensors"
"""Weights file of the project's chain."""


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
    trained = (_Paper if recipe == "paper" else _Project)(seed, iterations)
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
        save_chain(chain, out / name)
        print(f"written: {out / name}")
    kept.remove()
    return 0


class _Paper:
    files = tuple(PAPER_FILES.values())

    def __init__(self, seed: int, iterations: int | None) -> None:
        self._seed = seed
        self._recipe = PaperRecipe()
        if iterations is not None:
            self._recipe = self._recipe.limited(iterations)

    def settings(self) -> dict[str, Any]:
        return self._recipe.settings()

    def train(
        self, device: str, checkpoint: Checkpoint, bar: Report
    ) -> tuple[dict[str, ChainWeights], str]:
        rows, chains, scores = train_paper(
            self._recipe,
            self._seed,
            device=device,
            commit=source_commit(),
            checkpoint=checkpoint,
            report=bar,
        )
        head = f"{rows.rollouts:,} roll-outs, {len(rows):,} rows\n\n"
        files = {PAPER_FILES[name]: chain for name, chain in chains.items()}
        return files, head + table_one(scores)


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
    ) -> tuple[dict[str, ChainWeights], str]:
        rows = build_training_set(self._exploration, self._seed, bar, checkpoint)
        chain, scores = train_chain(
            rows,
            self._exploration,
            self._seed,
            self._schedule,
            device=device,
            commit=source_commit(),
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
