"""Where an arm can hold its tool, by inverse kinematics.

The points that the tool reaches in one orientation are found on a grid, growing from
neighbour to neighbour: the arm's positions at one point are the seed at the next, so
that few Newton steps do. Where the edges of the grid leave that set is found by bisection,
and the margin at a grid point is the distance to the nearest of those places; between
grid points it is interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from drake_oa.common.kernel_arrays import kernel_arrays
from drake_oa.common.messages import FloatArray, Frozen
from drake_oa.robot import reachability_kernels as kernels
from drake_oa.robot.arm_kernels import poses
from drake_oa.robot.arm_motion import ArmModel
from drake_oa.robot.pose_kernels import follow

SPACING = 0.05
"""Of the grid [m]."""
JOINT_MARGIN = 0.1
"""Distance that the joints keep from their limits where there is room [rad]."""
_SEEDS = 16
"""Random positions to grow from, besides the arm's posture."""
_STEP, _JUMP = 0.03, 1.0
"""Steps of the tool along a way [m], and what a joint may turn in one [rad]."""


@dataclass(frozen=True, eq=False)
class Reachability(Frozen):
    """Margins of tool points to the edge of what the arm reaches.

    Attributes:
        origin: (3,) first grid point in the world [m].
        spacing: of the grid [m].
        within_limits: (a, b, c) signed distance of its points to the edge of what is reached
            within the joint limits [m], positive inside.
        with_margin: (a, b, c) the same for what is reached with a margin to the limits.
        arm: (X_PJ, R_WE, posture, lower, upper) of the arm.
    """

    origin: FloatArray
    spacing: float
    within_limits: FloatArray
    with_margin: FloatArray
    arm: tuple[FloatArray, ...]

    def reach_margin(self, p_WQ: FloatArray) -> FloatArray:
        """Signed margin [m] of points (..., 3) to what is reached within the joint limits.

        NaN for a point that is not finite.

        Raises:
            ValueError: if the points are not (..., 3).
        """
        return self._at(p_WQ, self.within_limits)

    def joint_margin(self, p_WQ: FloatArray) -> FloatArray:
        """The same for what is reached with the joints off their limits."""
        return self._at(p_WQ, self.with_margin)

    def followed(self, path: FloatArray) -> int:
        """How far the arm follows a way of its tool without changing its configuration.

        That two places are reached does not mean that a motion leads from one to the other:
        behind the base the arm comes to a limit of its first joint from either side. The way is
        begun from the arm's posture, and followed by small steps within the joint limits.

        Args:
            path: (P, 3) corners of the way [m].

        Returns:
            The first corner that is not got to; P where all are, and where the arm does not
            come to the first one from its posture, so that nothing is known.
        """
        X_PJ, R_WE, posture, lower, upper = kernel_arrays(*self.arm)
        X_WB = np.empty((len(posture) + 1, 4, 4))
        poses(posture, X_PJ, X_WB)
        way = np.vstack([X_WB[-1, :3, 3], np.asarray(path, dtype=float)])
        corner = follow(posture, way, R_WE, lower, upper, X_PJ, _STEP, _JUMP)
        return len(path) if corner < 2 else corner - 1

    def _at(self, p_WQ: FloatArray, grid: FloatArray) -> FloatArray:
        p_WQ = np.asarray(p_WQ, dtype=float)
        if p_WQ.shape[-1:] != (3,):
            raise ValueError(f"p_WQ has shape {p_WQ.shape}; it must be (..., 3)")
        margin = np.empty(p_WQ.size // 3)
        (origin,) = kernel_arrays(self.origin)
        flat = np.ascontiguousarray(p_WQ.reshape(-1, 3))
        kernels.interpolate(*kernel_arrays(flat), origin, self.spacing, grid, margin)
        return margin.reshape(p_WQ.shape[:-1])


def reachability(
    arm: ArmModel, *, spacing: float = SPACING, joint_margin: float = JOINT_MARGIN
) -> Reachability:
    """Maps what an arm reaches with its tool held as it is in the model.

    It takes about a second; the same arm is mapped once a process.

    Args:
        arm: the arm, and its tool's orientation.
        spacing: of the grid [m].
        joint_margin: distance to the joint limits that `Reachability.joint_margin` asks
            for [rad]; of a joint whose range is narrow, at most a quarter of it.

    Raises:
        ValueError: if the spacing is not positive or the joint margin negative, or no
            point was found in reach.
    """
    if not 0.0 < spacing < np.inf:
        raise ValueError(f"spacing must be finite and positive [m], not {spacing}")
    if not 0.0 <= joint_margin < np.inf:
        raise ValueError(f"joint_margin must be finite and not negative [rad], not {joint_margin}")
    arrays = (arm.X_PJ, arm.R_WE, arm.posture, arm.lower, arm.upper)
    data = tuple(np.ascontiguousarray(a, dtype=float).tobytes() for a in arrays)
    return _mapped(data, float(spacing), float(joint_margin))


@lru_cache(maxsize=8)
def _mapped(data: tuple[bytes, ...], spacing: float, joint_margin: float) -> Reachability:
    X_PJ, R_WE, posture, lower, upper = (np.frombuffer(a) for a in data)
    n = len(posture)
    X_PJ, R_WE = X_PJ.reshape(n + 1, 4, 4).copy(), R_WE.reshape(3, 3).copy()
    lower, upper = np.maximum(lower, -1e3), np.minimum(upper, 1e3)
    narrow = np.minimum(joint_margin, 0.25 * (upper - lower))
    reach = float(np.linalg.norm(X_PJ[1:, :3, 3], axis=1).sum())
    count = int(np.ceil(reach / spacing)) + 2
    origin = X_PJ[0, :3, 3] - count * spacing
    shape = (2 * count + 1,) * 3
    state = np.zeros(shape, dtype=np.int64)
    found = np.zeros((*shape, n))
    turn = np.maximum(lower, -np.pi), np.minimum(upper, np.pi)
    seeds = np.vstack([posture, np.random.default_rng(0).uniform(*turn, (_SEEDS, n))])
    limits = {kernels.REACHED: narrow, kernels.STRAINED: np.zeros(n)}
    for kind, off in limits.items():
        kernels.flood(
            origin, spacing, seeds, R_WE, lower + off, upper - off, X_PJ, kind, state, found
        )
    if not state.any():
        raise ValueError("no point was found where the arm can hold its tool in this orientation")

    places = np.argwhere(state)
    low, high = places.min(axis=0) - 2, places.max(axis=0) + 3
    low = np.maximum(low, 0)
    cut = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    origin = origin + spacing * low
    state, found = np.ascontiguousarray(state[cut]), np.ascontiguousarray(found[cut])
    nodes = origin + spacing * np.moveaxis(np.indices(state.shape), 0, -1)
    margins = {}
    for least, off in limits.items():
        edge = np.empty((6 * int((state >= least).sum()), 3))
        at = kernels.surface(
            origin, spacing, R_WE, lower + off, upper - off, X_PJ, least, state, found, edge
        )
        distance = np.full(state.shape, np.inf)
        if at:
            distance = cKDTree(edge[:at]).query(nodes)[0]
        margins[least] = np.where(state >= least, distance, -distance)
    return Reachability(
        origin,
        spacing,
        margins[kernels.STRAINED],
        margins[kernels.REACHED],
        (X_PJ, R_WE, posture, lower, upper),
    )
