"""The command `drake-oa train`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal


def train(
    *,
    recipe: Literal["project", "paper", "paper_running", "proposals", "confidence"] = "project",
    out: Path = Path("weights"),
    seed: int = 0,
    iterations: int | None = None,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    checkpoint: Path | None = None,
    restart: bool = False,
) -> int:
    """Train the networks.

    Trains a regressor chain, or the network that leads the search, on roll-outs of the action
    level, and writes its weights.

      proposals the network that `regulation: !Verified` is led by: proposals.safetensors

      project   a chain that can lead it too: regressor_chain.safetensors
      paper     the paper's two chains on the paper's own training set, with its Table I:
                paper_chain.safetensors, RC(lambda', Delta), and
                paper_chain_unconstrained.safetensors, RC(lambda')

      paper_running  the paper's lattice and networks on the running system's action level,
                which `regulation: !Paper` uses: paper_chain_running.safetensors

      confidence  how likely the shipped paper_chain_running.safetensors keeps what is asked: the
                same file, its networks as they are. paper_running ends with it, too.

    What was computed is kept in a folder, OUT/RECIPE.checkpoint, until the end. After an
    interruption the same command goes on from there, to the same result.

    For example:

        drake-oa train --out weights
        drake-oa train --recipe paper --out weights --seed 1

    Args:
        recipe: which network.
        out: folder of the weights.
        seed: of split, scatter and first weights.
        iterations: steps a network at most; of proposals, scenes a round; of confidence, passes
            over its scenes (a shorter trial).
        device: where the networks are trained; auto: CUDA where torch finds it, else CPU.
        checkpoint: another folder for what was computed.
        restart: discard what an interrupted training has kept.
    """
    # Numba and SciPy take a second to import, which `drake-oa --help` need not wait for.
    try:
        from drake_oa.training import session
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        raise ValueError("training takes torch: pip install 'drake_oa[train]'") from None

    return session.train(
        recipe,
        out,
        seed=seed,
        iterations=iterations,
        device=device,
        checkpoint=checkpoint,
        restart=restart,
    )
