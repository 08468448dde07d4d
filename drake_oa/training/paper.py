"""The paper's recipe: its training set, and RC(lambda') and RC(lambda', Delta) trained on it.

The set, as recovered from the released network (sec. V-A): a lattice of ellipses in the middle of a
1 m baseline, a lattice of parameters; a row for each motion of the released code's action level, or
of the running system's, that keeps 1 cm.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from drake_oa.common.files import provenance
from drake_oa.common.messages import FloatArray
from drake_oa.inference.regressor import TARGETS, ChainWeights, Network
from drake_oa.training.lattice import ActionLevelName, PaperLattice, roll_out_lattice
from drake_oa.training.networks import (
    DECAY,
    HIDDEN,
    TRAIN_SHARE,
    Round,
    nmse,
    train_network,
)
from drake_oa.training.released_law import STEPS

CHAINS = ("RC(lambda')", "RC(lambda', Delta)")
"""The two chains of Table I."""

MIN_CLEARANCE = 0.01
"""Minimum clearance of a row [m]."""

NEAR_GOAL = 1.3
"""Maximum distance to the goal at the end of a motion that is a row to learn [m]."""

SATURATED = 5e-4
"""Difference to the start's own clearance up to which a clearance says no more than that [m]."""

ACTION_LEVELS = {
    "released": ("released code: tau^2 on the spring, 1000 steps of 3 ms", "rad/s"),
    "running": ("the running system's: exact turns, 1000 steps", "1/T"),
}
"""Action level -> its description, and the unit of alpha."""


class PaperSet(NamedTuple):
    """N motions that keep the minimum clearance.

    Attributes:
        values: (N, 5) lambda1', lambda2', kappa, psi and alpha.
        clearance: (N,) Delta [m].
        goal_error: (N,) distance to the goal at the end [m].
        rollouts: number of motions of the lattice.
    """

    values: FloatArray
    clearance: FloatArray
    goal_error: FloatArray
    rollouts: int


def build_paper_set(lattice: PaperLattice, action_level: ActionLevelName) -> PaperSet:
    """Rolls out the lattice.

    Args:
        lattice: motions to roll out.
        action_level: law of motion; alpha is in its unit, see `ACTION_LEVELS`.

    Returns:
        The rows, in the lattice's order.

    Raises:
        ValueError: if no motion keeps the minimum clearance.
    """
    # Rows run over lambda', alpha, psi and kappa, the last the fastest.
    clearance, goal_error = (
        values.transpose(0, 1, 4, 3, 2) for values in roll_out_lattice(lattice, action_level)
    )
    is_row = clearance >= MIN_CLEARANCE
    if not is_row.any():
        raise ValueError("no motion of the lattice keeps the least clearance")
    i, j, *place = np.nonzero(is_row)
    index = (i, j, *place[::-1])
    values = np.column_stack([axis[i] for axis, i in zip(lattice, index, strict=True)])
    return PaperSet(values, clearance[is_row], goal_error[is_row], is_row.size)


def group_means(columns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Joins rows of equal inputs: weighted least squares on the means is the same.

    Args:
        columns: (N, d + 1) inputs and target.

    Returns:
        (G, d + 1) distinct inputs with their mean target, and (G,) number of rows of each.
    """
    groups, group = np.unique(columns[:, :-1], axis=0, return_inverse=True)
    count = np.bincount(group.ravel()).astype(float)
    return np.column_stack((groups, np.bincount(group.ravel(), columns[:, -1]) / count)), count


class PaperRecipe(NamedTuple):
    """Parameters of the paper's recipe.

    Attributes:
        lattice: motions to roll out.
        rounds: rounds of kappa, psi and alpha of each chain to train; the rows of RC(lambda') are
            distinct inputs.
        action_level: law of motion.
    """

    lattice: PaperLattice
    rounds: Mapping[str, Sequence[Sequence[Round]]]
    action_level: ActionLevelName = "released"


_FEW, _REFINED = (Round(60, 5000),), (Round(60, 5000), Round(20, 40000))
_ROUNDS = {
    CHAINS[0]: ((Round(60, 100),), _FEW, _REFINED),
    CHAINS[1]: (_REFINED, _REFINED, (Round(300, 5000), Round(100, 40000))),
}


def paper_recipe(name: str, iterations: int | None = None) -> PaperRecipe:
    """Returns a recipe with at most so many iterations a round.

    Args:
        name: "paper", both chains on the released code's action level, or "paper_running",
            RC(lambda', Delta) for the running system, alpha per demonstrated duration.
        iterations: maximum; None: no limit.
    """
    rounds = {
        chain: [
            [Round(min(count, iterations or count), rows) for count, rows in of] for of in networks
        ]
        for chain, networks in _ROUNDS.items()
    }
    lattice = PaperLattice()
    if name == "paper":
        return PaperRecipe(lattice, rounds)
    alpha = lattice.alpha * math.prod(STEPS)
    return PaperRecipe(lattice._replace(alpha=alpha), {CHAINS[1]: rounds[CHAINS[1]]}, "running")


FILES = {
    "paper": {
        CHAINS[0]: "paper_chain_unconstrained.safetensors",
        CHAINS[1]: "paper_chain.safetensors",
    },
    "paper_running": {CHAINS[1]: "paper_chain_running.safetensors"},
}
"""Recipe -> weights file of each chain."""


Errors = dict[str, dict[str, float]]
"""Target -> NMSE on `train` and `test` rows, and the number of `rows`."""


def train_paper(
    recipe: PaperRecipe, seed: int
) -> tuple[PaperSet, dict[str, ChainWeights], dict[str, Errors]]:
    """Rolls out the set and trains the chains, each network on the true values before it.

    Args:
        recipe: parameters.
        seed: of the split, of the rows drawn, and of the first weights.

    Returns:
        The set, and by name the chains and the errors of their networks.
    """
    rows = build_paper_set(recipe.lattice, recipe.action_level)
    in_train = np.random.default_rng((seed, 0)).random(len(rows.values)) < TRAIN_SHARE
    near = rows.goal_error <= NEAR_GOAL
    unsaturated = rows.clearance < 0.5 - rows.values[:, 0] - SATURATED
    chains: dict[str, ChainWeights] = {}
    errors: dict[str, Errors] = {}
    for name in recipe.rounds:
        c = CHAINS.index(name)
        inputs = rows.values[:, :2]
        if c == 1:
            inputs = np.column_stack((inputs, rows.clearance))
        networks: dict[str, Network] = {}
        errors[name] = {}
        for t, target in enumerate(TARGETS):
            # The reading by which Table I is reproduced.
            use = near & unsaturated if c == 1 and target == "alpha" else near
            columns = np.column_stack((inputs, rows.values[:, 2 : 3 + t]))
            train, test = columns[use & in_train], columns[use & ~in_train]
            fitted, weight = (train, np.ones(len(train))) if c == 1 else group_means(train)
            drawn = np.random.default_rng((seed, 1, c, t)).permutation(len(fitted))
            networks[target] = train_network(
                fitted[drawn, :-1],
                fitted[drawn, -1],
                seed=(seed, 2, c, t),
                rounds=recipe.rounds[name][t],
                weight=weight[drawn],
                bounds=(columns[use].min(axis=0), columns[use].max(axis=0)),
            )
            errors[name][target] = {
                part: nmse(of[:, -1], networks[target].evaluate(of[:, :-1]))
                for part, of in (("train", train), ("test", test))
            } | {"rows": int(use.sum())}
        lower, upper = inputs.min(axis=0), inputs.max(axis=0)
        action_level, alpha_unit = ACTION_LEVELS[recipe.action_level]
        more = ", Delta/L" if name == CHAINS[1] else ""
        metadata = {
            "inputs": f"lambda1'/L, lambda2'/L (semi-axes){more}",
            "units": {"kappa": "1/L^2", "psi": "rad", "alpha": alpha_unit},
            "recipe": "paper",
            "chain": name,
            "action_level": action_level,
            "seed": seed,
            "rows": {target: of["rows"] for target, of in errors[name].items()},
            "rollouts": rows.rollouts,
            "training": {
                "hidden": list(HIDDEN),
                "train_share": TRAIN_SHARE,
                "decay": DECAY,
                "rounds": [[each._asdict() for each in of] for of in recipe.rounds[name]],
            },
            "nmse": {
                target: {k: of[k] for k in ("train", "test")} for target, of in errors[name].items()
            },
            **provenance(),
        }
        chains[name] = ChainWeights(networks, lower, upper, metadata)
    return rows, chains, errors
