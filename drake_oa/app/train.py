"""The command `drake-oa train`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from drake_oa.app.scenarios import Count, Seed
from drake_oa.common.console import show
from drake_oa.common.files import check_outputs, import_extra


def train(
    *,
    recipe: Literal["paper", "paper_running"] = "paper_running",
    out: Path = Path("weights"),
    seed: Seed = 0,
    iterations: Count | None = None,
) -> None:
    """Train a network and write its weights.

    Without a recipe, train the chain of the default scenario. The training data are simulated
    motions; no file is needed.

      paper          the regressor chains of the paper, on the paper's training set, with its
                     Table I: paper_chain.safetensors, RC(lambda', Delta), and
                     paper_chain_unconstrained.safetensors, RC(lambda')
      paper_running  the same chain RC(lambda', Delta), trained on the motions of this program:
                     paper_chain_running.safetensors

    For example:

        drake-oa train --out weights
        drake-oa train --iterations 500 --out trial
        drake-oa train --recipe paper --out weights --seed 1

    Args:
        recipe: which network.
        out: folder of the weights.
        seed: random seed of the data and of the initial weights.
        iterations: limit for a shorter trial: optimization steps of each network.
    """
    # SciPy and torch take a second to import, which `drake-oa --help` need not wait for.
    paper = import_extra("drake_oa.training.paper", "train")
    from drake_oa.evaluation.paper_tables import error_table, published_errors
    from drake_oa.inference.regressor import save_chain

    files = {name: out / file for name, file in paper.FILES[recipe].items()}
    check_outputs(*files.values())
    rows, chains, errors = paper.train_paper(paper.paper_recipe(recipe, iterations), seed)
    print(f"{rows.rollouts:,} roll-outs, {len(rows.values):,} rows, seed {seed}\n")
    for name, chain in chains.items():
        networks = {t: e | published_errors(name, t) for t, e in errors[name].items()}
        save_chain(chain, files[name])
        show(error_table(name, networks, [f"written: {files[name]}"]))
