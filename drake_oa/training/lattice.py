"""Roll-outs over a lattice of motions around one ellipse, on two action levels.

From rest at (0, 0) to (1, 0) around an ellipse at (0.5, 0), as in the paper's training set (sec.
V-A): on the action level of the released code (`released_law`), or the running system's.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.console import progress_bar
from drake_oa.common.messages import FloatArray
from drake_oa.geometry.ellipsoid_kernels import to_ellipsoid
from drake_oa.policy.config import Policy
from drake_oa.policy.coupling import (
    ALPHA,
    KAPPA,
    N_COLUMNS,
    NORMAL,
    PSI,
    Triple,
    mixed,
    norm,
    triple,
)
from drake_oa.policy.dmp import imitate, minimum_jerk
from drake_oa.policy.rollout import Scene, roll_out_tool
from drake_oa.training.released_law import STEPS, ReleasedMotions

ActionLevelName = Literal["released", "running"]

_BATCH, _COARSE = 512, 20
"""Number of motions rolled out together, and of steps between those that are measured first."""
_CENTER = 0.5
"""Place of the ellipse's center on the baseline [m]."""
_GOAL = np.array([1.0, 0.0, 0.0])


class PaperLattice(NamedTuple):
    """A lattice of motions, by default that of the paper.

    Attributes:
        lambda1: semi-axes along the baseline [m].
        lambda2: semi-axes across it [m].
        kappa: [1/m^2].
        psi: [rad].
        alpha: [rad/s].
    """

    lambda1: FloatArray = np.linspace(0.025, 0.25, 10)
    lambda2: FloatArray = np.linspace(0.025, 0.25, 10)
    kappa: FloatArray = np.linspace(0.0, 1000.0, 50)
    psi: FloatArray = np.linspace(0.1, 1.0, 50)
    alpha: FloatArray = np.linspace(0.01, 30000.0, 50)


def roll_out_lattice(
    lattice: PaperLattice, action_level: ActionLevelName
) -> tuple[FloatArray, FloatArray]:
    """Rolls out every motion of a lattice.

    Args:
        lattice: of A, B, C, D and E values; of alpha in 1/T on the running action level.
        action_level: the law of motion.

    Returns:
        (A, B, C, D, E), as the lattice's axes go: the least distance to the ellipse at the steps
        [m], 0 on contact; and the distance to the goal after the last step [m], inf on contact or
        if the motion diverged.
    """
    kappa, psi, alpha = (axis.ravel() for axis in np.meshgrid(*lattice[2:], indexing="ij"))
    parameters = np.column_stack([alpha, psi, kappa])
    counts = [len(axis) for axis in lattice]
    least, error = np.empty((2, *counts[:2], len(alpha)))
    with progress_bar(len(alpha)) as report:
        for first in range(0, len(alpha), _BATCH):
            report("roll out", first)
            rows = slice(first, first + _BATCH)
            path = np.empty(0)
            for j, lambda2 in enumerate(lattice.lambda2):
                # The motion depends on the shape by tau alone.
                if action_level == "released":
                    path = released_paths(parameters[rows], lattice.lambda1.min(), lambda2)
                elif j == 0:
                    path = running_paths(parameters[rows])
                missing = np.linalg.norm(path[:, -1] - _GOAL, axis=1)
                for i, lambda1 in enumerate(lattice.lambda1):
                    axes = (lambda1, lambda2, max(lambda1, lambda2))
                    distance = least[i, j, rows]
                    _least_distances(path, axes, distance)
                    error[i, j, rows] = np.where(distance <= 0.0, np.inf, missing)
    return least.reshape(counts), error.reshape(counts)


@compiled
def _least_distances(path: FloatArray, axes: Triple, least: FloatArray) -> None:
    """Writes the least distances (N,) of paths (N, T, 3) to the ellipsoid [m], 0 on contact."""
    for n in range(len(path)):
        least[n], last, distance = np.inf, triple(path[n], 0), 0.0
        # Most motions are in contact: some steps are measured first.
        for stride in (_COARSE, 1):
            for t in range(path.shape[1] - 1, -1, -stride):
                p = triple(path[n], t)
                # The distance changes by at most the way: what cannot be less is not computed.
                way = norm(mixed(1.0, p, -1.0, last))
                if least[n] > 0.0 and not way < distance - least[n]:
                    last, distance = p, to_ellipsoid(p[0] - _CENTER, p[1], p[2], axes)
                    least[n] = max(min(least[n], distance), 0.0)


def released_paths(parameters: FloatArray, lambda1: float, lambda2: float) -> FloatArray:
    """Rolls out motions about the middle of the baseline on the released code's action level.

    Args:
        parameters: (N, 3) alpha [rad/s], psi [rad] and kappa [1/m^2].
        lambda1: semi-axis of the ellipse along the baseline [m]; a motion inside ends there.
        lambda2: semi-axis across it [m].

    Returns:
        (N, 1001, 3) positions [m]; infinite at the end of a motion that ended or diverged.
    """
    count = len(parameters)
    center = np.tile((_CENTER, 0.0, 0.0), (count, 1))
    tau = np.full(count, np.sqrt(1.0 + 4.0 * lambda2**2) + 0.1)
    motions = ReleasedMotions(np.ones(count), center, tau, end=(lambda1, lambda2, 1.0))
    path = motions.advance(parameters, STEPS.number)
    path[motions.is_over, -1] = np.inf
    return path


def running_paths(parameters: FloatArray) -> FloatArray:
    """Rolls out motions about the middle of the baseline on the running system's action level.

    Lengths are in baselines, and time in units of the demonstration's: the path depends on neither.
    With four times as many steps a path that converges keeps 0.4 mm a meter more (median).

    Args:
        parameters: (N, 3) alpha [1/T], psi [rad] and kappa [1/L^2].

    Returns:
        (N, 1001, 3) positions [L].
    """
    terms = np.zeros((len(parameters), 1, N_COLUMNS))
    terms[..., 0], terms[..., NORMAL + 2] = 0.5, 1.0
    terms[:, 0, [ALPHA, PSI, KAPPA]] = parameters
    dmp = imitate(*minimum_jerk(np.zeros(3), _GOAL))
    policy = Policy(period=1.0 / STEPS.number, fade=0.0)
    still = Scene(np.zeros(3), np.zeros(3), _GOAL, np.eye(3), 1.0)
    return roll_out_tool(still, terms, dmp=dmp, policy=policy, latest=1.0).path
