"""Command `drake-oa train`: trains the networks that compute coupling terms (regressor chains)."""

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
    """Train a regressor chain on simulated motions, and write its weights.

    A regressor chain consists of three networks that compute the parameters of a coupling term. Its
    inputs are the semi-axes lambda' of an obstacle's section and, for RC(lambda', Delta), the
    requested clearance Delta. The paper is Pairet et al., RA-L 2019. The recipes are:

      paper          the paper's regressor chains on the paper's training set:
                     paper_chain.safetensors with RC(lambda', Delta), and
                     paper_chain_unconstrained.safetensors with RC(lambda')
      paper_running  RC(lambda', Delta) on motions of this program, as scenarios use it:
                     paper_chain_running.safetensors

    It prints the errors of the networks in the table of `drake-oa evaluate table1`.

    For example:

        drake-oa train --out weights
        drake-oa train --iterations 20 --out trial
        drake-oa train --recipe paper --out weights --seed 1

    Args:
        recipe: recipe of the training, see above.
        out: folder of the weights.
        seed: random seed of the split into training and test rows, of the order of rows, and of the
            initial weights.
        iterations: maximum number of optimization steps in each round of a network's training, for
            a short trial (default: the recipe's number).
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
