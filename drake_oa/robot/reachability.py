"""Where an arm can hold its tool, by inverse kinematics.

The points that the tool reaches in one orientation are found on a grid, growing from
neighbour to neighbour: the arm's positions at one point are the seed at the next, so
that few Newton steps do. Where the edges of the grid leave that set is found by bisection,
and the margin at a grid point is the distance to the nearest of those places; between
grid points it is interpolated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray, Frozen, IntArray
from drake_oa.common.numba_tools import kernel_arrays
from drake_oa.robot.arm import ArmModel
from drake_oa.robot.arm_kernels import poses
from drake_oa.robot.inverse_kinematics import follow, solve_pose

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
        interpolate(*kernel_arrays(flat), origin, self.spacing, grid, margin)
        return margin.reshape(p_WQ.shape[:-1])


def reachability(arm: ArmModel) -> Reachability:
    """Maps what an arm reaches with its tool held as it is in the model.

    It takes about a second; the same arm is mapped once a process.

    Args:
        arm: the arm, and its tool's orientation.

    Raises:
        ValueError: if no point was found in reach.
    """
    arrays = (arm.X_PJ, arm.R_WE, arm.posture, arm.lower, arm.upper)
    return _mapped(tuple(np.ascontiguousarray(a, dtype=float).tobytes() for a in arrays))


@lru_cache(maxsize=8)
def _mapped(data: tuple[bytes, ...]) -> Reachability:
    X_PJ, R_WE, posture, lower, upper = (np.frombuffer(a) for a in data)
    n = len(posture)
    X_PJ, R_WE = X_PJ.reshape(n + 1, 4, 4).copy(), R_WE.reshape(3, 3).copy()
    lower, upper = np.maximum(lower, -1e3), np.minimum(upper, 1e3)
    narrow = np.minimum(JOINT_MARGIN, 0.25 * (upper - lower))
    reach = float(np.linalg.norm(X_PJ[1:, :3, 3], axis=1).sum())
    count = int(np.ceil(reach / SPACING)) + 2
    origin = X_PJ[0, :3, 3] - count * SPACING
    shape = (2 * count + 1,) * 3
    state = np.zeros(shape, dtype=np.int64)
    found = np.zeros((*shape, n))
    turn = np.maximum(lower, -np.pi), np.minimum(upper, np.pi)
    seeds = np.vstack([posture, np.random.default_rng(0).uniform(*turn, (_SEEDS, n))])
    limits = {REACHED: narrow, STRAINED: np.zeros(n)}
    for kind, off in limits.items():
        flood(origin, SPACING, seeds, R_WE, lower + off, upper - off, X_PJ, kind, state, found)
    if not state.any():
        raise ValueError("no point was found where the arm can hold its tool in this orientation")

    places = np.argwhere(state)
    low, high = places.min(axis=0) - 2, places.max(axis=0) + 3
    low = np.maximum(low, 0)
    cut = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    origin = origin + SPACING * low
    state, found = np.ascontiguousarray(state[cut]), np.ascontiguousarray(found[cut])
    nodes = origin + SPACING * np.moveaxis(np.indices(state.shape), 0, -1)
    margins = {}
    for least, off in limits.items():
        edge = np.empty((6 * int((state >= least).sum()), 3))
        at = surface(
            origin, SPACING, R_WE, lower + off, upper - off, X_PJ, least, state, found, edge
        )
        distance = np.full(state.shape, np.inf)
        if at:
            distance = cKDTree(edge[:at]).query(nodes)[0]
        margins[least] = np.where(state >= least, distance, -distance)
    return Reachability(
        origin,
        SPACING,
        margins[STRAINED],
        margins[REACHED],
        (X_PJ, R_WE, posture, lower, upper),
    )


UNREACHED, STRAINED, REACHED = 0, 1, 2
"""What a grid point is: out of reach, reached only near a joint limit, reached."""


_ATTEMPTS = 4
"""Seeds that a point is tried from before it counts as out of reach."""


_HALVINGS = 3


@compiled
def flood(
    origin: FloatArray,
    spacing: float,
    seeds: FloatArray,
    R_WE: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    X_PJ: FloatArray,
    kind: int,
    state: IntArray,
    found: FloatArray,
) -> None:
    """Grows the set of grid points that the tool reaches from neighbour to neighbour.

    Args:
        origin: (3,) first grid point [m].
        spacing: of the grid [m].
        seeds: (S, n) positions to begin from, each at the grid point nearest to its
            tool; then the points that are in `state` already go on.
        R_WE: (3, 3) the tool's orientation.
        lower, upper: (n,) limits to keep [rad].
        X_PJ: (n + 1, 4, 4) the arm.
        kind: what reached points become.
        state: (a, b, c) what the grid points are; changed.
        found: (a, b, c, n) positions there [rad]; changed.
    """
    shape = state.shape
    n = found.shape[3]
    X_WB = np.empty((n + 1, 4, 4))
    queue = np.empty((state.size, 3), dtype=np.int64)
    tried = np.zeros(shape, dtype=np.int64)
    end = 0
    p, q = np.empty(3), np.empty(n)
    at = np.empty(3, dtype=np.int64)
    for i in range(shape[0]):
        for j in range(shape[1]):
            for k in range(shape[2]):
                if state[i, j, k] != UNREACHED:
                    queue[end, 0], queue[end, 1], queue[end, 2] = i, j, k
                    end += 1
    for row in range(len(seeds)):
        q[:] = seeds[row]
        poses(q, X_PJ, X_WB)
        inside = True
        for c in range(3):
            at[c] = round((X_WB[n, c, 3] - origin[c]) / spacing)
            p[c] = origin[c] + spacing * at[c]
            inside &= 0 <= at[c] < shape[c]
        if inside and state[at[0], at[1], at[2]] == UNREACHED:
            for i in range(n):
                q[i] = min(max(q[i], lower[i]), upper[i])
            if solve_pose(q, p, R_WE, lower, upper, X_PJ, X_WB):
                state[at[0], at[1], at[2]] = kind
                found[at[0], at[1], at[2]] = q
                queue[end] = at
                end += 1
    begin = 0
    while begin < end:
        i, j, k = queue[begin]
        begin += 1
        for side in range(6):
            at[0], at[1], at[2] = i, j, k
            at[side // 2] += 2 * (side % 2) - 1
            if not 0 <= at[side // 2] < shape[side // 2]:
                continue
            if state[at[0], at[1], at[2]] != UNREACHED or tried[at[0], at[1], at[2]] >= _ATTEMPTS:
                continue
            for c in range(3):
                p[c] = origin[c] + spacing * at[c]
            q[:] = found[i, j, k]
            if solve_pose(q, p, R_WE, lower, upper, X_PJ, X_WB):
                state[at[0], at[1], at[2]] = kind
                found[at[0], at[1], at[2]] = q
                queue[end] = at
                end += 1
            else:
                tried[at[0], at[1], at[2]] += 1


@compiled
def surface(
    origin: FloatArray,
    spacing: float,
    R_WE: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    X_PJ: FloatArray,
    least: int,
    state: IntArray,
    found: FloatArray,
    points: FloatArray,
) -> int:
    """Where the edges of the grid leave the set of points whose state is `least` or more.

    Args:
        points: (P, 3) receives them [m]; three rows a grid point are enough.
        (the others): as of `flood`; the border of the grid must be out of the set.

    Returns:
        How many there are.
    """
    shape = state.shape
    n = found.shape[3]
    X_WB = np.empty((n + 1, 4, 4))
    p, q = np.empty(3), np.empty(n)
    count = 0
    for i in range(shape[0]):
        for j in range(shape[1]):
            for k in range(shape[2]):
                if state[i, j, k] < least:
                    continue
                for side in range(6):
                    axis, sense = side // 2, 2 * (side % 2) - 1
                    a = i + (sense if axis == 0 else 0)
                    b = j + (sense if axis == 1 else 0)
                    c = k + (sense if axis == 2 else 0)
                    if state[a, b, c] >= least:
                        continue
                    p[0] = origin[0] + spacing * i
                    p[1] = origin[1] + spacing * j
                    p[2] = origin[2] + spacing * k
                    base = p[axis]
                    low, high = 0.0, 1.0
                    for _ in range(_HALVINGS):
                        share = 0.5 * (low + high)
                        p[axis] = base + sense * spacing * share
                        q[:] = found[i, j, k]
                        if solve_pose(q, p, R_WE, lower, upper, X_PJ, X_WB):
                            low = share
                        else:
                            high = share
                    p[axis] = base + sense * spacing * 0.5 * (low + high)
                    points[count] = p
                    count += 1
    return count


@compiled
def interpolate(
    p_WQ: FloatArray, origin: FloatArray, spacing: float, grid: FloatArray, out: FloatArray
) -> None:
    """Trilinear interpolation of a grid (a, b, c) at points p_WQ (N, 3) into out (N,).

    Beyond the grid it is the value at its nearest point less the distance to it; NaN for a
    point that is not finite.
    """
    size = grid.shape
    at = np.empty(3, dtype=np.int64)
    share = np.empty(3)
    for row in range(len(p_WQ)):
        beyond = 0.0
        finite = True
        for c in range(3):
            u = (p_WQ[row, c] - origin[c]) / spacing
            if not math.isfinite(u):
                finite = False
                break
            kept = min(max(u, 0.0), size[c] - 1.0)
            beyond += (u - kept) ** 2
            at[c] = min(int(kept), size[c] - 2)
            share[c] = kept - at[c]
        if not finite:
            out[row] = np.nan
            continue
        total = 0.0
        for corner in range(8):
            a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
            total += (
                grid[at[0] + a, at[1] + b, at[2] + c]
                * (share[0] if a else 1.0 - share[0])
                * (share[1] if b else 1.0 - share[1])
                * (share[2] if c else 1.0 - share[2])
            )
        out[row] = total - spacing * math.sqrt(beyond)
