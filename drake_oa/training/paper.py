"""Training of the regressor chains RC(lambda') and RC(lambda', Delta) by the paper's recipe.

A regressor chain predicts the parameters of a coupling term, which turns the motion away from an
obstacle, from the obstacle's semi-axes lambda' and the requested clearance Delta. The training set
(section V-A of Pairet et al., RA-L 2019, with values recovered from the authors' released network)
is a lattice of ellipses, in the middle between start and goal 1 m apart, and of coupling-term
parameters. It has a row for each motion with a clearance of at least 1 cm. The action level
(equations of motion) is that of the authors' released code or of this project (`drake_oa.policy`).
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
from drake_oa.training.networks import DECAY, HIDDEN, TRAIN_SHARE, Round, nmse, train_network
from drake_oa.training.released_law import STEPS

CHAINS = ("RC(lambda')", "RC(lambda', Delta)")
"""Names of the two regressor chains in Table I of Pairet et al., RA-L 2019.

A regressor chain predicts the parameters of a coupling term. The inputs of the first chain are the
semi-axes lambda' of an obstacle's section. The second has the requested clearance Delta as well."""

MIN_CLEARANCE = 0.01
"""Minimum distance from the obstacle of a motion that is included in the training set [m]."""

NEAR_GOAL = 1.3
"""Maximum distance from the goal at the end of a motion that is used for training or test [m]."""

SATURATED = 5e-4
"""Tolerance within which the start counts as the point of a motion nearest to the obstacle [m].

The start's distance from the obstacle then exceeds the motion's clearance by at most this value. In
the chain with requested clearance, the network for the strength alpha of the coupling term is
neither trained nor tested on such motions."""

ACTION_LEVELS = {
    "released": ("released code: tau^2 on the spring, 1000 steps of 3 ms", "rad/s"),
    "running": ("the running system's: exact turns, 1000 steps", "1/T"),
}
"""Name of an action level -> its description and the unit of alpha, for a trained chain's file.

An action level is the equations of motion by which the training set is simulated: "released", those
in the code of Pairet et al., or "running", those of this project. alpha is the strength of the
coupling term."""


class PaperSet(NamedTuple):
    """Training set of the regressor chains: N motions with a clearance of at least 1 cm.

    Attributes:
        values: (N, 5) semi-axes lambda1' and lambda2' of the ellipse [m], and parameters kappa
            [1/m^2], psi [rad] and alpha of the coupling term. The unit of alpha is rad/s if the
            motions were simulated by the equations of Pairet et al., and 1 / demonstrated duration
            if by those of this project.
        clearance: (N,) minimum distance of the motion to the ellipse, the chain's input Delta [m].
        goal_error: (N,) distance to the goal at the end of the motion [m].
        rollouts: number of simulated motions, one for each point of a grid of ellipses and
            parameters; N of them have the clearance.
    """

    values: FloatArray
    clearance: FloatArray
    goal_error: FloatArray
    rollouts: int


def build_paper_set(lattice: PaperLattice, action_level: ActionLevelName) -> PaperSet:
    """Rolls out (simulates) a lattice of motions and selects those that keep 1 cm of clearance.

    Args:
        lattice: lattice of ellipses and coupling-term parameters.
        action_level: equations of motion: "released" (code of Pairet et al.; alpha in rad/s) or
            "running" (this project's; alpha in units of 1/T, with the demonstrated duration T).

    Returns:
        The training set. Its rows are sorted by lambda1', lambda2', alpha, psi and kappa.

    Raises:
        ValueError: if no motion has a clearance of at least 1 cm.
    """
    # Rows run over lambda', alpha, psi and kappa, the last the fastest.
    clearance, goal_error = (
        values.transpose(0, 1, 4, 3, 2) for values in roll_out_lattice(lattice, action_level)
    )
    is_row = clearance >= MIN_CLEARANCE
    if not is_row.any():
        raise ValueError(f"no motion of the lattice has a clearance of {MIN_CLEARANCE} m or more")
    i, j, *rest = np.nonzero(is_row)
    index = (i, j, *rest[::-1])
    values = np.column_stack([axis[i] for axis, i in zip(lattice, index, strict=True)])
    return PaperSet(values, clearance[is_row], goal_error[is_row], is_row.size)


def group_means(columns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Averages the targets of training rows with equal inputs, to train on fewer rows.

    Weighted least squares on the means, with the numbers of rows as weights, has the same solution.

    Args:
        columns: (N, d + 1) inputs and target.

    Returns:
        (G, d + 1) distinct inputs with their mean target, and (G,) number of rows of each.
    """
    groups, group = np.unique(columns[:, :-1], axis=0, return_inverse=True)
    count = np.bincount(group.ravel()).astype(float)
    return np.column_stack((groups, np.bincount(group.ravel(), columns[:, -1]) / count)), count


class PaperRecipe(NamedTuple):
    """Recipe of training regressor chains: motions of the training set, and rounds of training.

    A regressor chain predicts the parameters of a coupling term, which avoids an obstacle.

    Attributes:
        lattice: lattice of ellipses and coupling-term parameters, whose motions are simulated.
        rounds: name of a chain -> rounds of training (numbers of iterations and rows) of each of
            its networks for the coupling-term parameters kappa, psi and alpha, in this order.
        action_level: equations of motion by which the motions are simulated: "released" (code of
            Pairet et al.) or "running" (this project's).
    """

    lattice: PaperLattice
    rounds: Mapping[str, Sequence[Sequence[Round]]]
    action_level: ActionLevelName = "released"


_SINGLE_ROUND = (Round(60, 5000),)
"""Rounds of training a network without refinement: 60 iterations on 5,000 rows."""
_REFINED_ROUNDS = (Round(60, 5000), Round(20, 40000))
"""Rounds of training a network with refinement: 60 iterations on 5,000 rows, 20 on 40,000."""
_ROUNDS = {
    CHAINS[0]: ((Round(60, 100),), _SINGLE_ROUND, _REFINED_ROUNDS),
    CHAINS[1]: (_REFINED_ROUNDS, _REFINED_ROUNDS, (Round(300, 5000), Round(100, 40000))),
}
"""Name of a regressor chain -> rounds of training of its networks for kappa, psi and alpha.

A round has a maximum number of iterations and a number of training rows."""


def paper_recipe(name: str, iterations: int | None = None) -> PaperRecipe:
    """Returns a recipe of training regressor chains by name.

    Args:
        name: "paper" for RC(lambda') and RC(lambda', Delta) by the equations of motion in the
            released code of Pairet et al., or "paper_running" for RC(lambda', Delta) by those of
            this project, with alpha in units of 1/T, T being the demonstrated duration.
        iterations: maximum number of iterations of each training round; None: as in the recipe.
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
"""Name of a recipe -> name of a regressor chain -> file name of the trained chain."""


Errors = dict[str, dict[str, float]]
"""Errors of a regressor chain: target -> errors of its network.

The targets are kappa, psi and alpha. The keys of a network are `train` and `test`, the normalized
mean squared errors on training and test rows, and `rows`, the number of both together."""


def train_paper(
    recipe: PaperRecipe, seed: int
) -> tuple[PaperSet, dict[str, ChainWeights], dict[str, Errors]]:
    """Rolls out (simulates) the training set and trains the regressor chains of a recipe.

    The inputs of a chain's second and third network include the parameters that the networks before
    it predict. In training they are the true values of these parameters.

    Args:
        recipe: training set, equations of motion, and rounds of training.
        seed: seed of the train/test split, of the order of rows, and of the initial weights.

    Returns:
        The training set, name -> trained chain, and name -> errors of the chain's networks.
    """
    rows = build_paper_set(recipe.lattice, recipe.action_level)
    in_train = np.random.default_rng((seed, 0)).random(len(rows.values)) < TRAIN_SHARE
    near = rows.goal_error <= NEAR_GOAL
    is_unsaturated = rows.clearance < 0.5 - rows.values[:, 0] - SATURATED
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
            # This selection of rows reproduces Table I; the paper does not state it.
            use = near & is_unsaturated if c == 1 and target == "alpha" else near
            columns = np.column_stack((inputs, rows.values[:, 2 : 3 + t]))
            train, test = columns[use & in_train], columns[use & ~in_train]
            samples, weight = (train, np.ones(len(train))) if c == 1 else group_means(train)
            order = np.random.default_rng((seed, 1, c, t)).permutation(len(samples))
            networks[target] = train_network(
                samples[order, :-1],
                samples[order, -1],
                seed=(seed, 2, c, t),
                rounds=recipe.rounds[name][t],
                weight=weight[order],
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
            "recipe": "paper" if recipe.action_level == "released" else "paper_running",
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
