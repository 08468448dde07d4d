"""The command `drake-oa train`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal


def train(
    *,
    recipe: Literal["proposals", "paper", "paper_running"] = "proposals",
    out: Path = Path("weights"),
    seed: int = 0,
    iterations: int | None = None,
    device: Literal["auto", "cpu", "cuda"] = "auto",
) -> int:
    """Train a network and write its weights.

    Without a recipe, train the network of the default scenario. The training data are simulated
    motions; no file is needed.

      proposals      the network that seeds the search of `regulation: !Verified`:
                     proposals.safetensors
      paper          the regressor chains of the paper, on the paper's training set, with its
                     Table I: paper_chain.safetensors, RC(lambda', Delta), and
                     paper_chain_unconstrained.safetensors, RC(lambda')
      paper_running  the same chain RC(lambda', Delta), trained on the motions of this program,
                     for `regulation: !Paper`: paper_chain_running.safetensors

    The searches of `proposals` are stored in a folder, OUT/proposals.checkpoint, until the training
    ends. After an interruption the same command resumes there and gives the same result.

    For example:

        drake-oa train --out weights
        drake-oa train --iterations 500 --out trial
        drake-oa train --recipe paper --out weights --seed 1

    Args:
        recipe: which network.
        out: folder of the weights.
        seed: random seed of the data and of the initial weights.
        iterations: limit for a shorter trial: optimization steps of each network; with the
            recipe proposals, scenes of each round.
        device: where the networks are trained; auto: CUDA if torch finds it, else the CPU.
    """
    # Numba and SciPy take a second to import, which `drake-oa --help` need not wait for.
    try:
        from drake_oa.training import session
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        raise ValueError("training requires torch: pip install 'drake_oa[train]'") from None

    return session.train(recipe, out, seed=seed, iterations=iterations, device=device)
