"""The command `drake-oa train`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from drake_oa.app.command_line import add_verbose

_DESCRIPTION = """\
Trains the regressor chain on roll-outs of the action level and writes its weights.

  project   the chain that is shipped: regressor_chain.npz
  paper     the paper's two chains on the paper's own training set, with its Table I:
            paper_chain.npz, RC(lambda', Delta), and
            paper_chain_unconstrained.npz, RC(lambda')

What was computed is kept in a folder, OUT/RECIPE.checkpoint, until the end. After an interruption
the same command goes on from there, to the same result.
"""

_EXAMPLES = """\
examples:
  drake-oa train --out weights
  drake-oa train --recipe paper --out weights --seed 1
"""


def add_parser(commands: Any) -> None:
    """Adds the subcommand to those of `drake-oa`."""
    parser = commands.add_parser(
        "train",
        help="train the regressor chain",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--recipe", choices=("project", "paper"), default="project")
    parser.add_argument(
        "--out", type=Path, default=Path("weights"), metavar="DIR", help="default: weights"
    )
    parser.add_argument("--seed", type=int, default=0, help="of split, scatter and first weights")
    parser.add_argument(
        "--iterations", type=int, metavar="N", help="steps a network at most (a shorter trial)"
    )
    parser.add_argument(
        "--device",
        choices=("auto", "cpu", "cuda"),
        default="auto",
        help="where the networks are trained; auto: CUDA where torch finds it, else CPU",
    )
    parser.add_argument(
        "--checkpoint", type=Path, metavar="DIR", help="another folder for what was computed"
    )
    parser.add_argument(
        "--restart", action="store_true", help="discard what an interrupted training has kept"
    )
    add_verbose(parser)
    parser.set_defaults(action=_run)


def _run(options: argparse.Namespace) -> int:
    # Numba and SciPy take a second to import, which `drake-oa --help` need not wait for.
    from drake_oa.training.session import train

    return train(options)
