"""The paper's recipe: its training set, and RC(lambda') and RC(lambda', Delta) trained on it.

The set, as recovered from the released network (sec. V-A): a lattice of ellipses in the middle of a
1 m baseline, a lattice of parameters; a row for each motion of the released code's action level, or
of the running system's, that keeps 1 cm.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from drake_oa.common.console import Column, TextTable
from drake_oa.common.files import provenance
from drake_oa.common.messages import BoolArray, FloatArray, IntArray
from drake_oa.regulation.regressor import TARGETS, ChainWeights, Network
from drake_oa.training.lattice import ActionLevelName, PaperLattice, roll_out_lattice
from drake_oa.training.networks import (
    DECAY,
    HIDDEN,
    TRAIN_SHARE,
    Report,
    Round,
    nmse,
    train_network,
)
from drake_oa.training.released_law import STEPS

CHAINS = ("RC(lambda')", "RC(lambda', Delta)")
"""The two chains of Table I."""

TABLE_ONE = {
    CHAINS[0]: {"kappa": (0.539, 0.543), "psi": (0.802, 0.802), "alpha": (0.893, 0.897)},
    CHAINS[1]: {"kappa": (0.251, 0.253), "psi": (0.244, 0.243), "alpha": (1.6e-4, 1.7e-4)},
}
"""Table I of the paper (tab:nn_training): NMSE on the train and on the test rows."""

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
        places: (N, 5) places of lambda1', lambda2', kappa, psi and alpha in the lattice.
        values: (N, 5) values there.
        clearance: (N,) Delta [m].
        goal_error: (N,) distance to the goal at the end [m].
        rollouts: number of motions of the lattice.
    """

    places: IntArray
    values: FloatArray
    clearance: FloatArray
    goal_error: FloatArray
    rollouts: int


def build_paper_set(
    lattice: PaperLattice, report: Report, action_level: ActionLevelName
) -> PaperSet:
    """Rolls out the lattice.

    Args:
        lattice: motions to roll out.
        report: receives the completed fraction.
        action_level: law of motion; alpha is in its unit, see `ACTION_LEVELS`.

    Returns:
        The rows, in the lattice's order.

    Raises:
        ValueError: if no motion keeps the minimum clearance.
    """
    # Rows run over lambda', alpha, psi and kappa, the last the fastest.
    clearance, goal_error = (
        values.transpose(0, 1, 4, 3, 2)
        for values in roll_out_lattice(lattice, action_level, report)
    )
    is_row = clearance >= MIN_CLEARANCE
    i, j, *place = np.nonzero(is_row)
    index = np.column_stack((i, j, *place[::-1]))
    if not len(index):
        raise ValueError("no motion of the lattice keeps the least clearance")
    values = np.column_stack([axis[i] for axis, i in zip(lattice, index.T, strict=True)])
    count = math.prod(map(len, lattice))
    return PaperSet(index, values, clearance[is_row], goal_error[is_row], count)


def group_means(index: IntArray, y: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Joins rows of equal inputs: weighted least squares on the means is the same.

    Args:
        index: (N, k) inputs as places in a lattice.
        y: (N,) targets.

    Returns:
        (G, k) distinct inputs, (G,) mean target and (G,) number of rows of each.
    """
    groups, group = np.unique(index, axis=0, return_inverse=True)
    count = np.bincount(group.ravel()).astype(float)
    return groups, np.bincount(group.ravel(), y) / count, count


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


Errors = dict[str, dict[str, float]]
"""Target -> NMSE on `train` and `test` rows, and the number of `rows`."""


def train_paper(
    recipe: PaperRecipe,
    seed: int,
    *,
    device: str = "cpu",
    report: Report = lambda stage, done: None,
) -> tuple[PaperSet, dict[str, ChainWeights], dict[str, Errors]]:
    """Rolls out the set and trains the chains, each network on the true values before it.

    Args:
        recipe: parameters.
        seed: of the split, of the rows drawn, and of the first weights.
        device: of torch, "cpu" or "cuda".
        report: receives the stage and its completed fraction.

    Returns:
        The set, and by name the chains and the errors of their networks.
    """
    rows = build_paper_set(recipe.lattice, report, recipe.action_level)
    in_train = np.random.default_rng((seed, 0)).random(len(rows.places)) < TRAIN_SHARE
    near = rows.goal_error <= NEAR_GOAL
    unsaturated = rows.clearance < 0.5 - rows.values[:, 0] - SATURATED
    chains: dict[str, ChainWeights] = {}
    errors: dict[str, Errors] = {}
    for c, name in enumerate(CHAINS):
        if name not in recipe.rounds:
            continue
        networks: dict[str, Network] = {}
        errors[name] = {}
        for t, target in enumerate(TARGETS):
            # The reading by which Table I is reproduced.
            use = near & unsaturated if c == 1 and target == "alpha" else near
            columns = np.column_stack((_inputs(rows, c, t), rows.values[:, 2 + t]))
            x, weight = _fitted_rows(recipe.lattice, rows, use & in_train, columns, (seed, 1, c, t))
            networks[target] = train_network(
                x[:, :-1],
                x[:, -1],
                seed=(seed, 2, c, t),
                rounds=recipe.rounds[name][t],
                weight=weight,
                bounds=(columns[use].min(axis=0), columns[use].max(axis=0)),
                device=device,
            )
            prediction, y = networks[target].evaluate(columns[:, :-1]), columns[:, -1]
            errors[name][target] = {
                "train": nmse(y[use & in_train], prediction[use & in_train]),
                "test": nmse(y[use & ~in_train], prediction[use & ~in_train]),
                "rows": int(use.sum()),
            }
            report(f"{name}: {target}", (t + 1) / len(TARGETS))
        chains[name] = _chain(name, networks, rows, recipe, seed, errors[name])
    return rows, chains, errors


def _inputs(rows: PaperSet, chain: int, target: int) -> FloatArray:
    """Returns (N, d) lambda1', lambda2', for RC(lambda', Delta) Delta, and the targets before."""
    given = [rows.clearance] if chain == 1 else []
    return np.column_stack((rows.values[:, :2], *given, rows.values[:, 2 : 2 + target]))


def _fitted_rows(
    lattice: PaperLattice,
    rows: PaperSet,
    use: BoolArray,
    columns: FloatArray,
    seed: tuple[int, ...],
) -> tuple[FloatArray, FloatArray]:
    """Returns the shuffled inputs and targets to fit, (K, d + 1), and their weights (K,)."""
    rng, (_, _, chain, target) = np.random.default_rng(seed), seed
    if chain == 1:
        drawn = rng.permutation(np.flatnonzero(use))
        return columns[drawn], np.ones(len(drawn))
    groups, mean, count = group_means(rows.places[use, : 2 + target], columns[use, -1])
    drawn = rng.permutation(len(groups))
    x = [axis[i] for axis, i in zip(lattice, groups[drawn].T, strict=False)]
    return np.column_stack([*x, mean[drawn]]), count[drawn]


def _chain(
    name: str,
    networks: dict[str, Network],
    rows: PaperSet,
    recipe: PaperRecipe,
    seed: int,
    errors: Errors,
) -> ChainWeights:
    constrained = name == CHAINS[1]
    explored = _inputs(rows, int(constrained), 0)
    lower, upper = explored.min(axis=0), explored.max(axis=0)
    action_level, alpha_unit = ACTION_LEVELS[recipe.action_level]
    metadata = {
        "inputs": "lambda1'/L, lambda2'/L (semi-axes)" + (", Delta/L" if constrained else ""),
        "units": {"kappa": "1/L^2", "psi": "rad", "alpha": alpha_unit},
        "recipe": "paper",
        "chain": name,
        "action_level": action_level,
        "seed": seed,
        "ranges": {"lower": lower.tolist(), "upper": upper.tolist()},
        "rows": {target: of["rows"] for target, of in errors.items()},
        "rollouts": rows.rollouts,
        "training": {
            "hidden": list(HIDDEN),
            "train_share": TRAIN_SHARE,
            "decay": DECAY,
            "rounds": [[each._asdict() for each in of] for of in recipe.rounds[name]],
        },
        "nmse": {target: {k: of[k] for k in ("train", "test")} for target, of in errors.items()},
        **provenance(),
    }
    return ChainWeights(networks, lower, upper, metadata)


def printed_errors(chain: str, target: str) -> dict[str, float]:
    """Returns the train and test errors of a network as Table I prints them."""
    return dict(zip(("train_printed", "test_printed"), TABLE_ONE[chain][target], strict=True))


def error_table(
    title: str, networks: Mapping[str, Mapping[str, Any]], notes: Sequence[str] = ()
) -> TextTable:
    """Tabulates the errors of a chain's networks beside the printed ones and the set's floor.

    Args:
        title: heading of the targets.
        networks: target -> `train`, `test`, `rows`, and where they are known `printed_errors` and
            `floor`.
        notes: lines below.
    """
    columns = (
        Column("name", title),
        Column("train", form="{:.3g}"),
        Column("train_printed", "print", "{:.3g}"),
        Column("test", form="{:.3g}"),
        Column("test_printed", "print", "{:.3g}"),
        Column("floor", form="{:.3g}"),
        Column("rows", form="{:,d}"),
    )
    return TextTable(columns, [{"name": name, **row} for name, row in networks.items()], notes)
