"""Whole-arm roll-outs: from motions of the tool to the least clearance of everything, compiled.

A candidate is a path of the tool point, an orientation along it and a posture that its null space
is drawn to. Its joints follow (`drake_oa.robot.arm`); at each sample, at its time, every
sphere of the robot is measured against every solid and the other spheres
(`drake_oa.planning.arm_world`), and the joints against their limits and speeds. Candidates are
rolled out on all cores.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from drake_oa.common.compiled import CORES, compiled, on_cores, parted
from drake_oa.common.messages import FloatArray, Frozen, IntArray
from drake_oa.common.thinking import count
from drake_oa.geometry.solids import Solids
from drake_oa.planning.arm_world import (
    FAR,
    ArmWorld,
    Asked,
    lower_excess,
)
from drake_oa.robot.arm import PULL, Chain, Spheres, follow, scratch

ERROR, HURRY, ENDED, WHEN = 3, 4, 5, 6
N_COLUMNS = 7
"""Of what a candidate comes to: after `TOOL`, `LINKS` and `SELF` of `arm_world`."""
_EACH = 8
"""Candidates for which another thread pays."""


@dataclass(frozen=True, eq=False)
class ToolPaths(Frozen):
    """N motions of the tool as they are rolled out, at T normalised times.

    Attributes:
        s: (T,) rising; the first one is now.
        p_WE: (N, T, 3) the tool point [m]; NaN from where a motion has arrived.
        R_WE: (C, T, 9) orientations, row by row.
        turn: (N,) which of those each motion has.
        posture: (D, T, n) postures that the null space is drawn to [rad].
        drawn: (N,) to which of those each motion is.
        seconds: (N,) seconds a unit of s.
    """

    s: FloatArray
    p_WE: FloatArray
    R_WE: FloatArray
    turn: IntArray
    posture: FloatArray
    drawn: IntArray
    seconds: FloatArray


@dataclass(frozen=True, eq=False)
class ArmRollouts(Frozen):
    """What N candidates come to.

    Attributes:
        excess: (N, 3) what the tool, the links, and all among each other keep beyond what is
            asked at least, at most `FAR` [m].
        error: (N,) by how much the arm misses the tool's pose at most [m, rad].
        hurry: (N,) greatest speed of a joint, in shares of what it can do.
        samples: (N,) how many samples were looked at; fewer than there are where it was enough.
        when: (N,) at which sample they keep least.
        q: (N, T, n) the joints [rad].
    """

    excess: FloatArray
    error: FloatArray
    hurry: FloatArray
    samples: IntArray
    when: IntArray
    q: FloatArray

    @property
    def least(self) -> FloatArray:
        """(N,) the least of `excess`."""
        return np.asarray(self.excess.min(axis=1))


def roll_out_arm(
    world: ArmWorld, q: FloatArray, paths: ToolPaths, enough: ArrayLike = -math.inf
) -> ArmRollouts:
    """Rolls out N candidates.

    Args:
        world: the arm among what.
        q: (n,) its joints now [rad].
        paths: the candidates.
        enough: () or (N,) one that keeps less than this beyond what is asked is not followed
            further [m].
    """
    N, T, _ = paths.p_WE.shape
    table, joints = np.empty((N, N_COLUMNS)), np.empty((N, T, len(q)))
    stop = np.broadcast_to(np.asarray(enough, dtype=float), (N,))
    arrays = {item.name: np.array(getattr(paths, item.name), order="C") for item in fields(paths)}
    bundle = _Paths(**arrays, enough=np.array(stop))
    threads = min(CORES, N // _EACH + 1)
    on_cores(_roll_some, threads, *world, np.array(q, dtype=float), bundle, table, joints)
    samples, when = table[:, ENDED].astype(np.int64), table[:, WHEN].astype(np.int64)
    count(configurations=int(samples.sum()))
    return ArmRollouts(table[:, :3], table[:, ERROR], table[:, HURRY], samples, when, joints)


class _Paths(NamedTuple):
    """`ToolPaths` as the kernels take them, and (N,) what is enough of each."""

    s: FloatArray
    p_WE: FloatArray
    R_WE: FloatArray
    turn: IntArray
    posture: FloatArray
    drawn: IntArray
    seconds: FloatArray
    enough: FloatArray


@compiled
def _roll_one(
    i: int, chain: Chain, spheres: Spheres, solids: Solids, asked: Asked, now: float,
    q0: FloatArray, paths: _Paths, out: FloatArray, Q: FloatArray,
) -> None:  # fmt: skip
    """Candidate i, into out (N, N_COLUMNS) and Q (N, T, n)."""
    T, n = Q.shape[1:]
    s, p, guide, enough = paths.s, paths.p_WE[i], paths.posture[paths.drawn[i]], paths.enough[i]
    room, target, q = scratch(n), np.empty(12), q0.copy()
    center, least = np.empty((len(spheres.group_joint), 3)), np.full(3, FAR)
    error, hurry, done, when, kept = 0.0, 0.0, 0, 0, FAR
    for row in range(T):
        if math.isnan(p[row, 0]):
            break
        target[:9], target[9:] = paths.R_WE[paths.turn[i], row], p[row]
        pull = 1.0 - math.exp(PULL * (s[row - 1] - s[row])) if row > 0 else 0.0
        missed = follow(q, target, guide, row, pull, chain, room)
        Q[i, row] = q
        done = row + 1
        if row > 0:
            # Where it is now it is.
            error = max(error, missed)
            dt = paths.seconds[i] * (s[row] - s[row - 1])
            for joint in range(n):
                moved = abs(q[joint] - Q[i, row - 1, joint])
                hurry = max(hurry, moved / (chain.speed[joint] * dt))
        t = now + paths.seconds[i] * (s[row] - s[0])
        lower_excess(room.X, t, spheres, solids, asked, center, least, enough)
        if min(least[0], min(least[1], least[2])) < kept:
            kept, when = min(least[0], min(least[1], least[2])), row
            if kept < enough:
                break
    for row in range(done, T):
        Q[i, row] = q
    out[i, :3], out[i, ERROR], out[i, HURRY], out[i, ENDED] = least, error, hurry, done
    out[i, WHEN] = when


@parted
def _roll_some(
    part: int, parts: int, chain: Chain, spheres: Spheres, solids: Solids, asked: Asked,
    now: float, q0: FloatArray, paths: _Paths, out: FloatArray, Q: FloatArray,
) -> None:  # fmt: skip
    """Every so many candidates."""
    for i in range(part, len(paths.p_WE), parts):
        _roll_one(i, chain, spheres, solids, asked, now, q0, paths, out, Q)
