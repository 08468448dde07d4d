"""Levenberg-Marquardt: damped Gauss-Newton steps, each lower than the one before."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from drake_oa.common.messages import FloatArray, Frozen
from drake_oa.training.normal_equations import LeastSquares


@dataclass(frozen=True)
class Schedule:
    """How long to go on and how the damping moves.

    Attributes:
        iterations: largest number of accepted steps.
        damping: first damping mu.
        decrease: factor on mu after a step that lowers the loss.
        increase: factor on mu after one that does not.
        largest_damping: where to give up.
        decay: weight of the parameters' own squares in the loss, against overfitting.
    """

    iterations: int = 60
    damping: float = 1e-3
    decrease: float = 0.1
    increase: float = 10.0
    largest_damping: float = 1e10
    decay: float = 1e-5


@dataclass(frozen=True, eq=False)
class Progress(Frozen):
    """Where the iteration stands; all that is needed to go on.

    Attributes:
        parameters: (P,) the best found.
        damping: mu of the next step.
        iteration: number of accepted steps.
        stuck: whether no step lowers the loss any more.
    """

    parameters: FloatArray
    damping: float
    iteration: int = 0
    stuck: bool = False


def fit(
    problem: LeastSquares,
    start: Progress,
    schedule: Schedule,
    each: Callable[[Progress, float], None] | None = None,
) -> Progress:
    """Fits by least squares.

    Args:
        problem: the rows and the network.
        start: where to begin, or to go on.
        schedule: how long, and the damping.
        each: told each new state, and the sum of squares before its step.

    Returns:
        The state at the end. Going on from any state that `each` was told gives the
        same, bit for bit.
    """
    state = start
    diagonal = np.diag_indices(problem.n_parameters)
    while state.iteration < schedule.iterations and not state.stuck:
        gram, gradient, squares = problem.normal_equations(state.parameters)
        loss = squares + schedule.decay * (state.parameters @ state.parameters)
        gradient -= schedule.decay * state.parameters
        mu = state.damping
        while True:
            damped = gram.copy()
            damped[diagonal] += mu + schedule.decay
            trial = None
            try:
                factor = cho_factor(damped, lower=True, overwrite_a=True, check_finite=False)
                trial = state.parameters + cho_solve(factor, gradient)
            except LinAlgError:
                pass
            if trial is not None:
                after = problem.squared_error(trial) + schedule.decay * (trial @ trial)
                if after < loss:
                    mu = max(mu * schedule.decrease, 1e-12)
                    state = Progress(trial, mu, state.iteration + 1)
                    break
            mu *= schedule.increase
            if mu > schedule.largest_damping:
                state = replace(state, stuck=True)
                break
        if each is not None:
            each(state, squares)
    return state
