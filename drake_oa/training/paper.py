"""The paper's recipe: its training set, and RC(lambda') and RC(lambda', Delta) trained on it.

The set, as recovered from the released network (sec. V-A): a lattice of ellipses in the middle of a
1 m baseline, a lattice of parameters; a row for each motion of the released code's action level, or
of the running system's, that keeps 1 cm.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from drake_oa.common.console import Column, TextTable
from drake_oa.common.files import provenance
from drake_oa.common.messages import BoolArray, FloatArray, Frozen, IntArray
from drake_oa.regulation.regressor import TARGETS, ChainWeights, Network
from drake_oa.training.checkpoint import Checkpoint, Report
from drake_oa.training.lattice import ActionLevelName, PaperLattice, roll_out_lattice
from drake_oa.training.networks import (
    HIDDEN,
    TRAIN_SHARE,
    Round,
    Schedule,
    Score,
    nmse,
    predict,
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

KEPT = 0.01
"""Least clearance of a row [m]."""

NEAR_GOAL = 1.3
"""Where a motion must end, as a distance to the goal [m], to be a row to learn."""

SATURATED = 5e-4
"""How near a clearance is to the start's own distance where it says no more than that [m]."""


ACTION_LEVELS = {
    "released": "released code: tau^2 on the spring, 1000 steps of 3 ms",
    "running": "the running system's: exact turns, 1000 steps",
}
"""What moves through the lattice."""

ALPHA_UNITS = {"released": "rad/s", "running": "1/T"}


@dataclass(frozen=True, eq=False)
class PaperSet(Frozen):
    """N motions that keep the least clearance.

    Attributes:
        index: (N, 5) place of lambda1', lambda2', kappa, psi and alpha in the lattice.
        values: (N, 5) what stands there.
        clearance: (N,) Delta [m].
        goal_error: (N,) distance to the goal at the end [m].
        rollouts: number of trajectories that it took.
    """

    index: IntArray
    values: FloatArray
    clearance: FloatArray
    goal_error: FloatArray
    rollouts: int

    def __len__(self) -> int:
        return len(self.index)

    @property
    def near_goal(self) -> BoolArray:
        """(N,) rows to learn: those that end near the goal."""
        return self.goal_error <= NEAR_GOAL

    @property
    def unsaturated(self) -> BoolArray:
        """(N,) rows whose clearance tells of the motion: less than the start's own."""
        return self.clearance < 0.5 - self.values[:, 0] - SATURATED


def build_paper_set(
    lattice: PaperLattice,
    report: Report,
    action_level: ActionLevelName,
) -> PaperSet:
    """Rolls out the lattice.

    Args:
        lattice: what to explore.
        report: told how far it is.
        action_level: what moves through it; alpha is in its `ALPHA_UNITS`.

    Returns:
        The rows, in the lattice's order.

    Raises:
        ValueError: if no motion keeps the least clearance.
    """
    # Rows run over lambda', alpha, psi and kappa, the last the fastest.
    clearance, goal_error = (
        values.transpose(0, 1, 4, 3, 2)
        for values in roll_out_lattice(lattice, action_level, report)
    )
    kept = clearance >= KEPT
    i, j, *place = np.nonzero(kept)
    index = np.column_stack((i, j, *place[::-1]))
    if not len(index):
        raise ValueError("no motion of the lattice keeps the least clearance")
    values = np.column_stack([axis[i] for axis, i in zip(lattice, index.T, strict=True)])
    return PaperSet(index, values, clearance[kept], goal_error[kept], math.prod(map(len, lattice)))


def group_means(
    index: IntArray, y: FloatArray, rows: BoolArray
) -> tuple[IntArray, FloatArray, FloatArray, IntArray]:
    """Rows of equal inputs as one: least squares on the means, weighted, is the same.

    Args:
        index: (N, k) inputs as places in a lattice.
        y: (N,) targets.
        rows: (N,) those to take.

    Returns:
        (G, k) distinct inputs, (G,) mean target and (G,) number of rows of each; and the number
        of the group of each of the rows.
    """
    groups, group = np.unique(index[rows], axis=0, return_inverse=True)
    group = group.ravel()
    count = np.bincount(group, minlength=len(groups)).astype(float)
    return groups, np.bincount(group, y[rows], len(groups)) / count, count, group


def floor_of_means(index: IntArray, y: FloatArray, rows: BoolArray) -> float:
    """NMSE of the means over rows of equal inputs."""
    _, mean, _, group = group_means(index, y, rows)
    return nmse(y[rows], mean[group])


def floor_of_windows(
    index: IntArray, clearance: FloatArray, y: FloatArray, rows: BoolArray, width: int
) -> float:
    """NMSE about the conditional mean, given discrete inputs and the clearance.

    Among the rows of equal discrete inputs, in the order of their clearance, the noise is
    what a line leaves of each `width` rows in turn.

    Args:
        index: (N, k) discrete inputs as places in a lattice.
        clearance: (N,) the continuous input.
        y: (N,) targets.
        rows: (N,) those to take.
        width: rows a window, at least 3. Neighbours come from different lines of the
            lattice and so differ by more than chance: few rows estimate too much.

    Returns:
        The estimate; NaN where no window is full.
    """
    chosen = np.flatnonzero(rows)
    order = chosen[np.lexsort((clearance[chosen], *index[chosen].T))]
    key = index[order]
    begins = np.flatnonzero(np.append(True, (key[1:] != key[:-1]).any(axis=1)))
    sizes = np.diff(np.append(begins, len(order)))
    place = np.arange(len(order)) - np.repeat(begins, sizes)
    whole = place < np.repeat(sizes // width * width, sizes)
    if not whole.any():
        return float("nan")
    t, v = (column[order][whole].reshape(-1, width) for column in (clearance, y))
    t, rest = t - t.mean(axis=1, keepdims=True), v - v.mean(axis=1, keepdims=True)
    spread = (t**2).sum(axis=1, keepdims=True)
    rest = rest - t * ((t * rest).sum(axis=1, keepdims=True) / np.where(spread > 0.0, spread, 1.0))
    return float((rest**2).sum() / (rest.size / width * (width - 2)) / np.var(y[rows]))


_STAGES = ("free", "asked")


@dataclass(frozen=True)
class PaperRecipe:
    """What the paper's recipe does.

    Attributes:
        lattice: what is explored.
        rounds: for each chain to train, of kappa, psi and alpha; for RC(lambda') the rows are
            distinct inputs.
        schedule: of Levenberg-Marquardt; its iterations are those of the rounds. Without
            decay: alpha needs large weights.
        action_level: what moves through the lattice, see `ACTION_LEVELS`.
    """

    lattice: PaperLattice = field(default_factory=PaperLattice)
    rounds: dict[str, tuple[tuple[Round, ...], ...]] = field(
        default_factory=lambda: {
            CHAINS[0]: ((Round(60, 100),), (Round(60, 5000),), (Round(60, 5000), Round(20, 40000))),
            CHAINS[1]: (
                (Round(60, 5000), Round(20, 40000)),
                (Round(60, 5000), Round(20, 40000)),
                (Round(300, 5000), Round(100, 40000)),
            ),
        }
    )
    schedule: Schedule = field(default_factory=lambda: Schedule(decay=1e-8))
    action_level: ActionLevelName = "released"

    @staticmethod
    def running() -> PaperRecipe:
        """RC(lambda', Delta) for the running system: alpha per demonstrated duration."""
        given = PaperRecipe()
        return replace(
            given,
            lattice=given.lattice._replace(
                alpha=given.lattice.alpha * math.prod(STEPS["training"])
            ),
            rounds={CHAINS[1]: given.rounds[CHAINS[1]]},
            action_level="running",
        )

    def limited(self, iterations: int) -> PaperRecipe:
        """The same with no more than so many iterations a round."""
        return replace(
            self,
            rounds={
                name: tuple(
                    tuple(replace(r, iterations=min(r.iterations, iterations)) for r in rounds)
                    for rounds in networks
                )
                for name, networks in self.rounds.items()
            },
        )

    def settings(self) -> dict[str, Any]:
        """All of it, as JSON would hold it."""
        return {
            "lattice": {name: axis.tolist() for name, axis in self.lattice._asdict().items()},
            "rounds": {
                name: [[asdict(r) for r in rounds] for rounds in networks]
                for name, networks in self.rounds.items()
            },
            "schedule": asdict(self.schedule),
            "action_level": self.action_level,
        }


def train_paper(
    recipe: PaperRecipe,
    seed: int,
    *,
    checkpoint: Checkpoint,
    device: str = "cpu",
    report: Report = lambda stage, done: None,
) -> tuple[PaperSet, dict[str, ChainWeights], dict[str, list[Score]]]:
    """Rolls out the set and trains both chains, each network on the true values before it.

    Args:
        recipe: what to do.
        seed: of the split, of the rows drawn, and of the first weights.
        checkpoint: where to keep what was computed, and to go on from.
        device: of torch, "cpu" or "cuda".
        report: told how far it is.

    Returns:
        The set, and by name the chains and the scores of their networks.
    """
    found = checkpoint.load("set")
    if found is None:
        rows = build_paper_set(recipe.lattice, report, recipe.action_level)
        checkpoint.save("set", **vars(rows))
    else:
        rollouts = int(found.pop("rollouts"))
        rows = PaperSet(**found, rollouts=rollouts)
    in_train = np.random.default_rng((seed, 0)).random(len(rows)) < TRAIN_SHARE
    chains: dict[str, ChainWeights] = {}
    scores: dict[str, list[Score]] = {}
    for c, name in enumerate(CHAINS):
        if name not in recipe.rounds:
            continue
        networks: dict[str, Network] = {}
        scores[name] = []
        for t, target in enumerate(TARGETS):
            use = rows.near_goal
            if c == 1 and target == "alpha":
                # The reading by which Table I is reproduced.
                use = use & rows.unsaturated
            columns = np.column_stack((_inputs(rows, c, t), rows.values[:, 2 + t]))
            x, weight = _fitted_rows(recipe.lattice, rows, use & in_train, columns, c, t, seed)
            networks[target] = train_network(
                f"{_STAGES[c]}-{target}",
                x[:, :-1],
                x[:, -1],
                recipe.schedule,
                seed=(seed, 2, c, t),
                rounds=recipe.rounds[name][t],
                weight=weight,
                bounds=(columns[use].min(axis=0), columns[use].max(axis=0)),
                device=device,
                checkpoint=checkpoint,
                report=report,
            )
            scores[name].append(_score(rows, use, in_train, networks[target], c, t))
        chains[name] = _chain(name, networks, rows, recipe, seed, scores[name])
    return rows, chains, scores


def _inputs(rows: PaperSet, chain: int, target: int) -> FloatArray:
    """(N, d) lambda1', lambda2', for RC(lambda', Delta) Delta, and the targets before."""
    if chain == 0:
        return rows.values[:, : 2 + target]
    return np.column_stack((rows.values[:, :2], rows.clearance, rows.values[:, 2 : 2 + target]))


def _fitted_rows(
    lattice: PaperLattice,
    rows: PaperSet,
    use: BoolArray,
    columns: FloatArray,
    chain: int,
    target: int,
    seed: int,
) -> tuple[FloatArray, FloatArray]:
    """Returns the shuffled inputs and targets to fit, (K, d + 1), and their weights (K,)."""
    rng = np.random.default_rng((seed, 1, chain, target))
    if chain == 1:
        drawn = rng.permutation(np.flatnonzero(use))
        return columns[drawn], np.ones(len(drawn))
    index = rows.index[:, : 2 + target]
    groups, mean, count, _ = group_means(index, columns[:, -1], use)
    drawn = rng.permutation(len(groups))
    places = groups[drawn].T
    x = [axis[i] for axis, i in zip(lattice, places, strict=False)]
    return np.column_stack([*x, mean[drawn]]), count[drawn]


def _score(
    rows: PaperSet, use: BoolArray, in_train: BoolArray, network: Network, chain: int, target: int
) -> Score:
    y, index = rows.values[:, 2 + target], rows.index[:, : 2 + target]
    prediction = predict(network, _inputs(rows, chain, target))
    if chain == 0:
        floor = floor_of_means(index, y, use)
    else:
        # alpha has but a few rows for each of the inputs before it.
        width = 3 if TARGETS[target] == "alpha" else 40
        floor = floor_of_windows(index, rows.clearance, y, use, width)
    return Score(
        TARGETS[target],
        nmse(y, prediction, use & in_train),
        nmse(y, prediction, use & ~in_train),
        int(use.sum()),
        floor,
    )


def _chain(
    name: str,
    networks: dict[str, Network],
    rows: PaperSet,
    recipe: PaperRecipe,
    seed: int,
    scores: list[Score],
) -> ChainWeights:
    constrained = name == CHAINS[1]
    explored = _inputs(rows, int(constrained), 0)
    lower, upper = explored.min(axis=0), explored.max(axis=0)
    metadata = {
        "inputs": "lambda1'/L, lambda2'/L (semi-axes)" + (", Delta/L" if constrained else ""),
        "units": {"kappa": "1/L^2", "psi": "rad", "alpha": ALPHA_UNITS[recipe.action_level]},
        "recipe": "paper",
        "chain": name,
        "action_level": ACTION_LEVELS[recipe.action_level],
        "seed": seed,
        "ranges": {"lower": lower.tolist(), "upper": upper.tolist()},
        "rows": {s.target: s.rows for s in scores},
        "rows_used": {
            "all": f"clearance >= {KEPT} m, goal error at the end <= {NEAR_GOAL} m",
            "alpha": f"also clearance < start's own - {SATURATED} m" if constrained else "",
        },
        "rollouts": rows.rollouts,
        "training": {
            "hidden": list(HIDDEN),
            "train_share": TRAIN_SHARE,
            **asdict(recipe.schedule),
            "rounds": recipe.settings()["rounds"][name],
        },
        "nmse": {s.target: {"train": s.train, "test": s.test, "floor": s.floor} for s in scores},
        **provenance(),
    }
    return ChainWeights(networks, lower, upper, np.ones(len(lower)), frozenset(), metadata=metadata)


def printed_errors(chain: str, target: str) -> dict[str, float]:
    """Returns the train and test errors of a network as Table I prints them."""
    return dict(zip(("train_printed", "test_printed"), TABLE_ONE[chain][target], strict=True))


def error_table(
    title: str, networks: Mapping[str, Mapping[str, Any]], notes: Sequence[str] = ()
) -> TextTable:
    """Tabulates the errors of a chain's networks beside the printed ones and the set's floor.

    Args:
        title: heading of the targets.
        networks: target -> `train`, `test`, `floor`, `rows` and where they are known
            `printed_errors`.
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
