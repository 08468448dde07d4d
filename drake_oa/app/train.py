"""The command `drake-oa train`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal


def train(
    *,
    recipe: Literal["project", "paper"] = "project",
    out: Path = Path("weights"),
    seed: int = 0,
    iterations: int | None = None,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    checkpoint: Path | None = None,
    restart: bool = False,
) -> int:
    """Train the regressor chain.

    Trains the regressor chain on roll-outs of the action level and writes its weights.

      project   the chain that is shipped: regressor_chain.safetensors
      paper     the paper's two chains on the paper's own training set, with its Table I:
                paper_chain.safetensors, RC(lambda', Delta), and
                paper_chain_unconstrained.safetensors, RC(lambda')

    What was computed is kept in a folder, OUT/RECIPE.checkpoint, until the end. After an
    interruption the same command goes on from there, to the same result.

    For example:

        drake-oa train --out weights
        drake-oa train --recipe paper --out weights --seed 1

    Args:
        recipe: which chain.
        out: folder of the weights.
        seed: of split, scatter and first weights.
        iterations: steps a network at most (a shorter trial).
        device: where the networks are trained; auto: CUDA where torch finds it, else CPU.
        checkpoint: another folder for what was computed.
        restart: discard what an interrupted training has kept.
    """
    # Numba and SciPy take a second to import, which `drake-oa --help` need not wait for.
    from drake_oa.training import session

    return session.train(
        recipe,
        out,
        seed=seed,
        iterations=iterations,
        device=device,
        checkpoint=checkpoint,
        restart=restart,
    )
