"""The training set: which coupling parameters pass which ellipse at which clearance.

Many (kappa, psi, alpha) keep a clearance. To make the regression a function instead
of an average over them, each input gets one choice:

1. Roll out a grid of parameters for every ellipse of a lattice, its centre on the
   baseline, so that the motion heads straight at it.
2. For an asked clearance and each (kappa, psi) take the weakest alpha that keeps it.
   Of these candidates the shortest path is best, with a price on the goal error and
   small ones on ln alpha and on the distance of (ln kappa, ln psi) from a fixed pair.
   Since many are nearly as good, take their mean, weighted by exp(-cost / temperature):
   it varies smoothly with the input where the single best jumps between equals.
3. Fit a polynomial of the inputs to (ln kappa, ln psi); its values are the choice. The
   network has then a smooth function to learn, and what the mean lacks is made up for by
   alpha.
4. Solve for the alpha which keeps exactly the clearance there, and at (kappa, psi)
   around it: so Y3 learns to make up for what Y1 and Y2 get wrong.

Inputs that no candidate can keep, or only by missing the goal, are left out; the
largest clearance that was kept is recorded for every ellipse.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_oa.common.messages import BoolArray, FloatArray, Frozen
from drake_oa.policy.dmp import ALPHA_X, Dmp
from drake_oa.regulation.regressor import ClearanceLimit
from drake_oa.training.checkpoint import Checkpoint, Report
from drake_oa.training.rollouts import planar_rollouts, straight_dmp

_CHUNK = 16
"""Ellipses explored between two writes of the checkpoint."""
_ROWS = 512
"""Rows whose alpha is solved for together."""
_REFINEMENTS, _BETWEEN = 4, 8
"""How often the interval that holds alpha is divided, and into how many parts."""


def _axis(first: float, last: float, number: int, *, geometric: bool = False) -> FloatArray:
    space = np.geomspace if geometric else np.linspace
    return np.asarray(space(first, last, number))


@dataclass(frozen=True, eq=False)
class Exploration(Frozen):
    """What to explore and how to choose; lengths in baselines, alpha in 1/T.

    Attributes:
        lambda1: half-extents along the baseline.
        lambda2: half-extents across it.
        clearances: asked clearances Delta.
        positions: places of the centre along the baseline.
        kappa: candidates for kappa L^2.
        psi: candidates for psi [rad].
        alpha: candidates for alpha, increasing.
        margin: what the chosen parameters keep on top of the asked clearance.
        end: s at the end of the roll-outs.
        goal_tolerance: largest goal error at the end that counts as arriving.
        alpha_x: spring constant of the action level that the chain is for; critically
            damped.
        fade: the coupling fades within this many baselines of the goal, as in
            `drake_oa.policy.action`.
        degree: of the polynomial that smooths the choices.
        goal_price: cost of the goal error at the end, as a length a length.
        temperature: of the weights over candidates, as a length.
        effort: cost of one unit of ln alpha, as a length.
        anchor: (kappa, psi) that the choice is pulled to.
        pull: cost of one unit of squared log distance from it, as a length.
        scatter: standard deviation of ln kappa and ln psi around the choice in the
            additional rows for Y3.
        copies: how many such rows for each choice.
        grid_steps: steps a unit of s of the roll-outs on the grid.
    """

    lambda1: FloatArray = field(default_factory=lambda: _axis(0.02, 0.47, 10))
    lambda2: FloatArray = field(default_factory=lambda: _axis(0.02, 0.5, 11))
    clearances: FloatArray = field(default_factory=lambda: _axis(0.02, 0.44, 22))
    positions: FloatArray = field(default_factory=lambda: _axis(0.2, 0.8, 9))
    kappa: FloatArray = field(default_factory=lambda: _axis(0.3, 80.0, 13, geometric=True))
    psi: FloatArray = field(default_factory=lambda: _axis(0.8, 3.2, 6, geometric=True))
    alpha: FloatArray = field(default_factory=lambda: _axis(10.0, 1e6, 30, geometric=True))
    margin: float = 0.004
    end: float = 1.25
    goal_tolerance: float = 0.001
    alpha_x: float = ALPHA_X
    fade: float = 0.3
    degree: int = 3
    goal_price: float = 4.0
    temperature: float = 0.004
    effort: float = 0.004
    anchor: tuple[float, float] = (3.0, 1.4)
    pull: float = 0.002
    scatter: float = 0.25
    copies: int = 2
    grid_steps: int = 500

    @property
    def dmp(self) -> Dmp:
        """The primitive of the roll-outs: straight and of minimum jerk."""
        return straight_dmp(self.alpha_x)

    def settings(self) -> dict[str, Any]:
        """All of it, as JSON would hold it."""
        return {
            name: value.tolist() if isinstance(value, np.ndarray) else value
            for name, value in vars(self).items()
        }


@dataclass(frozen=True, eq=False)
class TrainingSet(Frozen):
    """Rows (lambda1', lambda2', Delta, position) -> (kappa, psi, alpha), normalised.

    Attributes:
        inputs: (N, 4) lambda1'/L, lambda2'/L, Delta/L, position/L.
        targets: (N, 3) kappa L^2, psi, alpha.
        chosen: (N,) True for the choice itself, which Y1 and Y2 learn; False for the
            rows around it, for Y3 only.
        limit: largest clearance that was kept, for every ellipse.
        rollouts: number of trajectories that it took.
    """

    inputs: FloatArray
    targets: FloatArray
    chosen: BoolArray
    limit: ClearanceLimit
    rollouts: int


def build_training_set(
    exploration: Exploration,
    seed: int,
    report: Report | None = None,
    checkpoint: Checkpoint | None = None,
) -> TrainingSet:
    """Explores, chooses, smooths and solves.

    Args:
        exploration: what to explore.
        seed: of the scatter around the choices.
        report: told how far it is.
        checkpoint: where to keep what was computed, and to go on from.

    Returns:
        The rows, shuffled.

    Raises:
        ValueError: if no input can be kept.
    """
    report = report or (lambda stage, fraction: None)
    done = checkpoint.load("set") if checkpoint else None
    if done is None:
        done = _build(exploration, seed, report, checkpoint)
        if checkpoint is not None:
            checkpoint.save("set", **done)
    axes = (exploration.lambda1, exploration.lambda2, exploration.positions)
    limit = ClearanceLimit(*axes, done["limit"])
    return TrainingSet(
        done["inputs"], done["targets"], done["chosen"], limit, int(done["rollouts"])
    )


def _build(
    exploration: Exploration, seed: int, report: Report, checkpoint: Checkpoint | None
) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    rows, pairs, n_rollouts = _choices(exploration, report, checkpoint)
    if not len(rows):
        raise ValueError("no input of the exploration can be kept by any candidate")
    pairs = _smoothed(exploration, rows, pairs)
    chosen = np.arange(len(rows) * (1 + exploration.copies)) < len(rows)
    rows, pairs = (np.tile(a, (1 + exploration.copies, 1)) for a in (rows, pairs))
    noise = exploration.scatter * rng.standard_normal(pairs.shape)
    pairs = pairs * np.exp(np.where(chosen[:, None], 0.0, noise))
    alpha, kept, n = _solve_alpha(exploration, rows, pairs, report)
    if not (kept & chosen).any():
        raise ValueError("no input of the exploration can be kept by its choice")
    order = rng.permutation(np.flatnonzero(kept))
    return {
        "inputs": rows[order],
        "targets": np.column_stack((pairs, alpha))[order],
        "chosen": chosen[order],
        "limit": _limit(exploration, rows[kept & chosen]),
        "rollouts": n_rollouts + n,
    }


def _choices(
    exploration: Exploration, report: Report, checkpoint: Checkpoint | None
) -> tuple[FloatArray, FloatArray, int]:
    """(N, 4) inputs that some candidate keeps, (N, 2) kappa and psi of each, roll-outs."""
    nearest = exploration.clearances[0] + exploration.margin
    ellipses = [
        (float(a), float(b), float(x))
        for a in exploration.lambda1
        for b in exploration.lambda2
        for x in exploration.positions
        if a + nearest < min(x, 1.0 - x)
    ]
    found, begin, n_rollouts = np.zeros((0, 6)), 0, 0
    stored = checkpoint.load("explored") if checkpoint else None
    if stored is not None:
        found, begin = stored["found"], int(stored["ellipses"])
        n_rollouts = int(stored["rollouts"])
    while begin < len(ellipses):
        new = []
        some = ellipses[begin : begin + _CHUNK]
        grids = _explore(exploration, np.array(some))
        n_rollouts += grids[:, 0].size
        for grid, (lambda1, lambda2, position) in zip(grids, some, strict=True):
            for clearance in exploration.clearances.tolist():
                # Nobody keeps more than what start and goal have themselves.
                if lambda1 + clearance + exploration.margin >= min(position, 1.0 - position):
                    continue
                choice = _choose(exploration, grid, clearance + exploration.margin)
                if choice is not None:
                    new.append((lambda1, lambda2, clearance, position, *choice))
        found = np.vstack((found, np.array(new).reshape(-1, 6)))
        begin = min(begin + _CHUNK, len(ellipses))
        if checkpoint is not None:
            checkpoint.save("explored", found=found, ellipses=begin, rollouts=n_rollouts)
        report("explore", begin / len(ellipses))
    return found[:, :4], found[:, 4:], n_rollouts


def _smoothed(exploration: Exploration, inputs: FloatArray, pairs: FloatArray) -> FloatArray:
    """(N, 2) kappa and psi on the polynomial fitted to their logarithms."""
    low, high = inputs.min(axis=0), inputs.max(axis=0)
    scaled = 2.0 * (inputs - low) / np.where(high > low, high - low, 1.0) - 1.0
    terms = [np.ones(len(inputs))]
    for degree in range(1, exploration.degree + 1):
        for chosen in combinations_with_replacement(range(4), degree):
            terms.append(np.prod(scaled[:, list(chosen)], axis=1))
    features = np.column_stack(terms)
    # A little ridge: small lattices have fewer rows than terms.
    gram = features.T @ features + 1e-3 * np.eye(features.shape[1])
    smooth = np.exp(features @ np.linalg.solve(gram, features.T @ np.log(pairs)))
    bounds = np.array([(exploration.kappa[[0, -1]]), (exploration.psi[[0, -1]])])
    return np.clip(smooth, bounds[:, 0], bounds[:, 1])


def _explore(exploration: Exploration, ellipses: FloatArray) -> FloatArray:
    """(N, 3, kappa, psi, alpha) clearance, goal error and path length for each ellipse.

    An ellipse is a row lambda1', lambda2', position.
    """
    kappa, psi, alpha = np.meshgrid(
        exploration.kappa, exploration.psi, exploration.alpha, indexing="ij"
    )
    parameters = np.column_stack((alpha.ravel(), psi.ravel(), kappa.ravel()))
    outcome = planar_rollouts(
        ellipses[:, :2],
        np.column_stack((ellipses[:, 2], np.zeros(len(ellipses)))),
        np.tile(parameters, (len(ellipses), 1, 1)),
        dmp=exploration.dmp,
        steps=exploration.grid_steps,
        end=exploration.end,
        fade=exploration.fade,
    )
    values = np.stack((outcome.clearance, outcome.goal_error, outcome.path_length), axis=1)
    return values.reshape(len(ellipses), 3, *alpha.shape)


def _choose(
    exploration: Exploration, grid: FloatArray, clearance: float
) -> tuple[float, float] | None:
    """(kappa, psi) for a clearance, or None where nothing keeps it and arrives."""
    kept, goal_error, length = grid
    keeps = kept >= clearance
    # The weakest alpha that keeps it, and the share of the way to it from the one before.
    index = keeps.argmax(axis=2)[..., None]
    before = np.maximum(index - 1, 0)

    def pick(values: FloatArray, at: NDArray[np.intp]) -> FloatArray:
        return np.take_along_axis(values, at, axis=2)[..., 0]

    low, high = pick(kept, before), pick(kept, index)
    shorter, longer = pick(length, before), pick(length, index)
    touched = np.isinf(shorter)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(touched | (high <= low), 1.0, (clearance - low) / (high - low))
        shorter = np.where(touched, longer, shorter)
        share = np.clip(share, 0.0, 1.0)
        log_alpha = np.log(exploration.alpha)
        log_alpha = log_alpha[before[..., 0]] * (1.0 - share) + log_alpha[index[..., 0]] * share
        cost = shorter + share * (longer - shorter) + exploration.effort * log_alpha
    goal_error = pick(goal_error, index)
    arrives = keeps.any(axis=2) & (goal_error <= exploration.goal_tolerance)
    if not arrives.any():
        return None
    log_kappa, log_psi = np.meshgrid(
        np.log(exploration.kappa), np.log(exploration.psi), indexing="ij"
    )
    away = (log_kappa - np.log(exploration.anchor[0])) ** 2
    away += (log_psi - np.log(exploration.anchor[1])) ** 2
    cost = cost + exploration.pull * away
    cost = np.where(arrives, cost + exploration.goal_price * goal_error, np.inf)
    weight = np.exp(-(cost - cost.min()) / exploration.temperature)
    weight /= weight.sum()
    return float(np.exp((weight * log_kappa).sum())), float(np.exp((weight * log_psi).sum()))


def _solve_alpha(
    exploration: Exploration, inputs: FloatArray, pairs: FloatArray, report: Report
) -> tuple[FloatArray, BoolArray, int]:
    """The weakest alpha that keeps the clearance plus margin at given (kappa, psi).

    Returns:
        (N,) alpha, (N,) whether it keeps the clearance and arrives, and the number of
        roll-outs.
    """
    alpha, arrives = np.full(len(inputs), np.nan), np.zeros(len(inputs), dtype=bool)
    n_rollouts = 0
    for begin in range(0, len(inputs), _ROWS):
        rows = np.arange(begin, min(begin + _ROWS, len(inputs)))
        low = np.full(len(rows), exploration.alpha[0])
        candidates = np.tile(exploration.alpha, (len(rows), 1))
        for _ in range(1 + _REFINEMENTS):
            shape = candidates.shape
            kappa, psi = (np.broadcast_to(column[:, None], shape) for column in pairs[rows].T)
            outcome = planar_rollouts(
                inputs[rows, :2],
                np.column_stack((inputs[rows, 3], np.zeros(len(rows)))),
                np.stack((candidates, psi, kappa), axis=2),
                dmp=exploration.dmp,
                end=exploration.end,
                fade=exploration.fade,
            )
            n_rollouts += candidates.size
            keeps = outcome.clearance >= inputs[rows, 2:3] + exploration.margin
            each = np.flatnonzero(keeps.any(axis=1))
            first, rows = keeps.argmax(axis=1)[each], rows[each]
            alpha[rows] = high = candidates[each, first]
            arrives[rows] = outcome.goal_error[each, first] <= exploration.goal_tolerance
            # It lies between the last that does not keep it and the first that does.
            low = np.where(first > 0, candidates[each, first - 1], low[each])
            candidates = np.geomspace(low, high, _BETWEEN + 1, axis=1)[:, 1:]
        report("solve", min(begin + _ROWS, len(inputs)) / len(inputs))
    return alpha, arrives, n_rollouts


def _limit(exploration: Exploration, inputs: FloatArray) -> FloatArray:
    """Per ellipse the end of the unbroken run of clearances that were kept."""
    axes = (exploration.lambda1, exploration.lambda2, exploration.positions)
    kept = {tuple(row) for row in inputs[:, [0, 1, 3, 2]].tolist()}
    table = np.zeros([axis.size for axis in axes])
    for cell in np.ndindex(table.shape):
        ellipse = [float(axis[k]) for axis, k in zip(axes, cell, strict=True)]
        for clearance in exploration.clearances.tolist():
            if (*ellipse, clearance) not in kept:
                break
            table[cell] = clearance
    return table
