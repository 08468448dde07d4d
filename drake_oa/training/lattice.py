"""Roll-outs (simulations) of the paper's training set: a lattice of motions past one ellipse.

Motions go from rest at (0, 0) to (1, 0) around an ellipse at (0.5, 0) [m], as in section V-A of
Pairet et al., RA-L 2019. The lattice varies the ellipse's semi-axes and the parameters of the
coupling term, which turns the motion. The action level (equations of motion) is that of the
authors' released code (`released_law`) or that of this project (`drake_oa.policy`).
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
"""Name of an action level, that is, of the equations of motion by which motions are simulated.

"released" are those in the released code of Pairet et al., RA-L 2019, and "running" are those of
this project (`drake_oa.policy`)."""

_BATCH = 512
"""Number of motions of the training set that are rolled out (simulated) at once."""
_COARSE = 20
"""Number of time steps between the positions of a motion that are first checked for contact.

This first check finds most contacts with the ellipse. Only if it finds none, the positions between
are checked as well."""
_CENTER = 0.5
"""x coordinate of the ellipse's center, the middle between start and goal of the motions [m]."""
_GOAL = np.array([1.0, 0.0, 0.0])
"""Goal position (3,) of all motions of the training set, which start at the origin [m]."""


class PaperLattice(NamedTuple):
    """Lattice of ellipses and coupling-term parameters, by default that of Pairet et al.

    A coupling term turns the motion away from the ellipse. The training set has one motion past the
    ellipse for each combination of these values. The baseline is the line from start to goal, of
    the length 1 m.

    Attributes:
        lambda1: (A,) semi-axes of the ellipse along the baseline [m].
        lambda2: (B,) semi-axes of the ellipse across the baseline [m].
        kappa: (C,) decay rates of the coupling term over the squared distance from the ellipse's
            center [1/m^2].
        psi: (D,) widths of the coupling term over the angle between the heading and the direction
            of the ellipse's center [rad].
        alpha: (E,) gains of the coupling term [rad/s]; on the action level "running" [1/T], with
            the demonstrated duration T.
    """

    lambda1: FloatArray = np.linspace(0.025, 0.25, 10)
    lambda2: FloatArray = np.linspace(0.025, 0.25, 10)
    kappa: FloatArray = np.linspace(0.0, 1000.0, 50)
    psi: FloatArray = np.linspace(0.1, 1.0, 50)
    alpha: FloatArray = np.linspace(0.01, 30000.0, 50)


def roll_out_lattice(
    lattice: PaperLattice, action_level: ActionLevelName
) -> tuple[FloatArray, FloatArray]:
    """Rolls out (simulates) every motion of a lattice and measures clearances and goal errors.

    Args:
        lattice: lattice with A, B, C, D and E values of lambda1, lambda2, kappa, psi and alpha. For
            "running", alpha is in 1/T, with the demonstrated duration T.
        action_level: equations of motion: "released" (code of Pairet et al.) or "running" (this
            project's).

    Returns:
        Two arrays (A, B, C, D, E) in the order of the lattice's fields: the minimum distance to the
        ellipse over all steps, 0 on contact [m]; and the distance to the goal after the last step,
        inf on contact or for a diverged motion [m].
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
                # On the released action level the motion depends on the ellipse only through tau.
                if action_level == "released":
                    path = released_paths(parameters[rows], lattice.lambda1.min(), lambda2)
                elif j == 0:
                    path = running_paths(parameters[rows])
                goal_error = np.linalg.norm(path[:, -1] - _GOAL, axis=1)
                for i, lambda1 in enumerate(lattice.lambda1):
                    axes = (lambda1, lambda2, max(lambda1, lambda2))
                    distance = least[i, j, rows]
                    _least_distances(path, axes, distance)
                    error[i, j, rows] = np.where(distance <= 0.0, np.inf, goal_error)
    return least.reshape(counts), error.reshape(counts)


@compiled
def _least_distances(path: FloatArray, axes: Triple, least: FloatArray) -> None:
    """Computes the minimum distance of each of N paths from the ellipsoid at (0.5, 0, 0) [m].

    Args:
        path: (N, T, 3) positions; the start is the origin, the goal (1, 0, 0) [m].
        axes: semi-axes of the ellipsoid along x, y and z [m].
        least: (N,) minimum distances, 0 on contact [m]; output.
    """
    for n in range(len(path)):
        least[n], last, distance = np.inf, triple(path[n], 0), 0.0
        # Most motions are in contact, which a coarse stride usually detects.
        for stride in (_COARSE, 1):
            for t in range(path.shape[1] - 1, -1, -stride):
                p = triple(path[n], t)
                # The distance changes by at most the displacement; skip it if it cannot be less.
                displacement = norm(mixed(1.0, p, -1.0, last))
                if least[n] > 0.0 and not displacement < distance - least[n]:
                    last, distance = p, to_ellipsoid(p[0] - _CENTER, p[1], p[2], axes)
                    least[n] = max(min(least[n], distance), 0.0)


def released_paths(parameters: FloatArray, lambda1: float, lambda2: float) -> FloatArray:
    """Rolls out (simulates) motions past an ellipse by the equations in the code of Pairet et al.

    The motions go from (0, 0, 0) to (1, 0, 0), with the center of the ellipse at (0.5, 0, 0) [m]. A
    motion ends early if it enters the ellipse, or if it diverges.

    Args:
        parameters: (N, 3) parameters alpha [rad/s], psi [rad] and kappa [1/m^2] of the coupling
            term, which turns the motion away from the center of the ellipse.
        lambda1: semi-axis of the ellipse along the line from start to goal [m].
        lambda2: semi-axis of the ellipse across this line [m]; it determines the temporal scaling.

    Returns:
        (N, 1001, 3) positions [m]. After an early end of a motion, its positions are constant up to
        the last row, which is infinite.
    """
    count = len(parameters)
    center = np.tile((_CENTER, 0.0, 0.0), (count, 1))
    tau = np.full(count, np.sqrt(1.0 + 4.0 * lambda2**2) + 0.1)
    motions = ReleasedMotions(np.ones(count), center, tau, end=(lambda1, lambda2, 1.0))
    path = motions.advance(parameters, STEPS.number)
    path[motions.is_over, -1] = np.inf
    return path


def running_paths(parameters: FloatArray) -> FloatArray:
    """Rolls out (simulates) motions past the ellipse's center by this project's equations.

    These are the equations of motion in `drake_oa.policy`. Lengths are in units of L, the distance
    from start to goal, and times in units of T, the demonstrated duration; the path's shape depends
    on neither. The motions go from (0, 0, 0) to (1, 0, 0), with the center at (0.5, 0, 0). With
    4000 steps instead of the 1000 used, the median clearance is 0.4 mm per meter of L larger.

    Args:
        parameters: (N, 3) parameters alpha [1/T], psi [rad] and kappa [1/L^2] of the coupling term,
            which turns the motion away from the center.

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
