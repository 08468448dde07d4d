"""The command `drake-oa train`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal


def train(
    *,
    recipe: Literal["paper", "paper_running"] = "paper_running",
    out: Path = Path("weights"),
    seed: int = 0,
    iterations: int | None = None,
    device: Literal["auto", "cpu", "cuda"] = "auto",
) -> int:
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
