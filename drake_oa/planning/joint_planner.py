"""A path of the whole arm from one configuration to another, where no motion of the tool clears.

RRT-Connect in the joints (J. J. Kuffner and S. M. LaValle, ICRA 2000), compiled, each core its own
pair of trees, and random shortcuts of what is found (R. Geraerts and M. H. Overmars, IJRR 2007). A
way between two configurations is looked at in steps as long as the clearance it keeps allows, and
what is clear of one that is not is gone.

The same world, ends, seed and limit give the same path: the limit counts configurations, and the
cores' trees are compared whenever each has looked at so many.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_oa.common.compiled import CORES, compiled, on_cores, parted
from drake_oa.common.messages import FloatArray, Frozen, IntArray
from drake_oa.common.thinking import count
from drake_oa.geometry.solids import Solids
from drake_oa.planning.arm_world import (
    STRIDE,
    ArmWorld,
    Asked,
    exceeds,
    lower_excess,
    share_clear,
)
from drake_oa.robot.arm import Chain, Spheres, chain_poses

TREES = 2
"""Pairs of trees that grow beside each other."""
_RANGE, _LEAST = 0.8, 0.05
"""Longest and shortest step of the trees [rad]."""
_COARSE, _NEAR = 0.1, 0.03
"""As `STRIDE` while the trees grow, and as `FAR` here [m]: what they grew by is looked at in full
when they meet."""
_BESIDE, _WIDE = 0.8, 1.0
"""Share of the trees' aims that are beside the straight way, and how far, a standard deviation
[rad]."""
_SLICE = 500
"""Configurations that each pair of trees looks at before they are compared."""
_SHORTCUTS = 60
"""That are tried on a path."""


@dataclass(frozen=True, eq=False)
class JointPath(Frozen):
    """What was found.

    Attributes:
        q: (T, n) corners of the path, from start to goal [rad]; (0, n): none was found.
        reason: "" or why none was.
        looked_at: how many configurations were.
    """

    q: FloatArray
    reason: str = ""
    looked_at: int = 0


class _Trees(NamedTuple):
    """R pairs of trees of N nodes at most: of the start, and of the goals.

    Attributes:
        q: (R, 2, N, n) their nodes [rad].
        parent: (R, 2, N) rows; -1: a root.
        used: (R, 2) nodes there are.
        random: (R,) state of the random numbers.
        looked_at: (R,) configurations.
        met: (R, 2) nodes at which a pair met; -1: it has not.
    """

    q: FloatArray
    parent: IntArray
    used: IntArray
    random: NDArray[np.uint64]
    looked_at: IntArray
    met: IntArray


class _Room(NamedTuple):
    """Room that the kernels work in: (n + 2, 12), (G, 3), (3,) and four times (n,)."""

    X: FloatArray
    center: FloatArray
    least: FloatArray
    q: FloatArray
    one: FloatArray
    other: FloatArray
    aim: FloatArray


@compiled
def _room(n: int, groups: int) -> _Room:
    return _Room(
        np.empty((n + 2, 12)), np.empty((groups, 3)), np.empty(3),
        np.empty(n), np.empty(n), np.empty(n), np.empty(n),
    )  # fmt: skip


@compiled
def _uniform(random: NDArray[np.uint64], r: int) -> float:
    """The next of the numbers r in [0, 1) (G. L. Steele et al., SplitMix, OOPSLA 2014)."""
    random[r] += np.uint64(0x9E3779B97F4A7C15)
    z = random[r]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return float((z ^ (z >> np.uint64(31))) >> np.uint64(11)) / 9007199254740992.0


@compiled
def _advance(
    world: ArmWorld, one: FloatArray, other: FloatArray, step: float, room: _Room,
    looked_at: IntArray, r: int,
) -> float:  # fmt: skip
    """As `share_clear`, in steps of at least so much [m] and with clearances up to `_NEAR`."""
    n, bound = len(one), 0.0
    for i in range(n):
        bound += world.chain.reach[i] * abs(other[i] - one[i])
    if bound == 0.0:
        return 1.0
    stride, clear = step / bound, 0.0
    share = min(stride, 1.0)
    while True:
        for i in range(n):
            room.q[i] = one[i] + share * (other[i] - one[i])
        room.least[:] = _NEAR
        chain_poses(room.q, world.chain.X_PJ, room.X)
        lower_excess(
            room.X, world.now, world.spheres, world.solids, world.asked, room.center, room.least,
            0.0,
        )  # fmt: skip
        kept = min(room.least[0], min(room.least[1], room.least[2]))
        looked_at[r] += 1
        if kept < 0.0:
            return clear
        if share == 1.0:
            return 1.0
        clear, share = share, min(share + max(stride, kept / bound), 1.0)


@compiled
def _distance(one: FloatArray, other: FloatArray) -> float:
    square = 0.0
    for i in range(len(one)):
        square += (one[i] - other[i]) ** 2
    return math.sqrt(square)


@compiled
def _nearest(nodes: FloatArray, used: int, q: FloatArray) -> int:
    """The row of the nodes that is nearest."""
    least, row = np.inf, 0
    for k in range(used):
        square = 0.0
        for i in range(len(q)):
            square += (nodes[k, i] - q[i]) ** 2
        if square < least:
            least, row = square, k
    return row


@compiled
def _extend(
    world: ArmWorld, trees: _Trees, r: int, side: int, row: int, aim: FloatArray, room: _Room
) -> tuple[int, bool]:
    """Goes from a node toward aim by one step, as far as it is clear.

    Returns:
        The new node, or -1 for none, and whether it is aim.
    """
    q, n = trees.q[r, side], len(aim)
    d = _distance(q[row], aim)
    share = min(1.0, _RANGE / d) if d > 0.0 else 1.0
    for i in range(n):
        room.other[i] = aim[i] if share == 1.0 else q[row, i] + share * (aim[i] - q[row, i])
    clear = _advance(world, q[row], room.other, _COARSE, room, trees.looked_at, r)
    if clear * share * d < min(_LEAST, 0.5 * d):
        return -1, False
    new = trees.used[r, side]
    for i in range(n):
        q[new, i] = (
            room.other[i] if clear == 1.0 else q[row, i] + clear * (room.other[i] - q[row, i])
        )
    trees.parent[r, side, new] = row
    trees.used[r, side] += 1
    return new, share == 1.0 and clear == 1.0


@compiled
def _draw(chain: Chain, trees: _Trees, r: int, aim: FloatArray) -> None:
    """Sets aim (n,) to what the trees grow toward: beside the straight way, or anywhere."""
    random, start, goal = trees.random, trees.q[r, 0, 0], trees.q[r, 1, 0]
    beside, along = _uniform(random, r) < _BESIDE, _uniform(random, r)
    for i in range(len(aim)):
        low, high = chain.lower[i], chain.upper[i]
        if beside:
            # The sum of four has a standard deviation of 1 / sqrt(3).
            off = -2.0
            for _ in range(4):
                off += _uniform(random, r)
            at = start[i] + along * (goal[i] - start[i]) + math.sqrt(3.0) * _WIDE * off
            aim[i] = min(max(at, low), high)
        else:
            aim[i] = low + (high - low) * _uniform(random, r)


@compiled
def _holds(world: ArmWorld, trees: _Trees, r: int, side: int, row: int, room: _Room) -> bool:
    """Whether the way from a root to a node is clear in full; what does not hold is cut off."""
    q, parent = trees.q[r, side], trees.parent[r, side]
    while parent[row] >= 0:
        if _advance(world, q[parent[row]], q[row], STRIDE, room, trees.looked_at, r) < 1.0:
            # Far from everything, with all that grew from it; which came later.
            q[row] = np.inf
            for k in range(row + 1, trees.used[r, side]):
                if math.isinf(q[parent[k], 0]):
                    q[k] = np.inf
            return False
        row = parent[row]
    return True


@compiled
def _grow(world: ArmWorld, trees: _Trees, r: int, most: int) -> None:
    """Grows a pair of trees until they meet, or have looked at so many configurations."""
    N, n = trees.q.shape[2:]
    chain, room = world.chain, _room(n, len(world.spheres.group_joint))
    side = 0
    while trees.looked_at[r] < most and max(trees.used[r, 0], trees.used[r, 1]) < N - 1:
        _draw(chain, trees, r, room.aim)
        row = _nearest(trees.q[r, side], trees.used[r, side], room.aim)
        new, _ = _extend(world, trees, r, side, row, room.aim, room)
        other = 1 - side
        if new >= 0:
            room.aim[:] = trees.q[r, side, new]
            row, there = _nearest(trees.q[r, other], trees.used[r, other], room.aim), False
            while row >= 0 and not there and trees.used[r, other] < N:
                row, there = _extend(world, trees, r, other, row, room.aim, room)
            held = there and _holds(world, trees, r, side, new, room)
            if held and _holds(world, trees, r, other, row, room):
                trees.met[r, side], trees.met[r, other] = new, row
                return
        side = other


@parted
def _grow_some(
    part: int, parts: int, chain: Chain, spheres: Spheres, solids: Solids, asked: Asked,
    now: float, trees: _Trees, most: int,
) -> None:  # fmt: skip
    """Every so many pairs."""
    for r in range(part, len(trees.used), parts):
        _grow(ArmWorld(chain, spheres, solids, asked, now), trees, r, most)


@compiled
def _clear(
    world: ArmWorld, one: FloatArray, other: FloatArray, room: _Room, looked_at: IntArray
) -> bool:
    """Whether a way is clear, looked at in coarse strides first."""
    if _advance(world, one, other, _COARSE, room, looked_at, 0) < 1.0:
        return False
    return _advance(world, one, other, STRIDE, room, looked_at, 0) == 1.0


@compiled
def _without_detours(world: ArmWorld, path: FloatArray, used: int, looked_at: IntArray) -> int:
    """Leaves out corners (N, n) that need not be gone through, in place; how many are left."""
    room, first = _room(path.shape[1], len(world.spheres.group_joint)), 0
    while first < used - 2:
        last = used - 1
        while last > first + 1 and not _clear(world, path[first], path[last], room, looked_at):
            last -= 1
        gone = last - first - 1
        if gone > 0:
            for k in range(last, used):
                path[k - gone] = path[k]
            used -= gone
        first += 1
    return used


@compiled
def _shorten(
    world: ArmWorld,
    path: FloatArray,
    used: int,
    rounds: int,
    random: NDArray[np.uint64],
    looked_at: IntArray,
) -> int:
    """Random shortcuts in a path (N, n) of so many corners, in place; how many are left."""
    n = path.shape[1]
    room, length = _room(n, len(world.spheres.group_joint)), np.empty(len(path))
    for _ in range(rounds):
        length[0] = 0.0
        for k in range(1, used):
            length[k] = length[k - 1] + _distance(path[k], path[k - 1])
        u, v = _uniform(random, 0) * length[used - 1], _uniform(random, 0) * length[used - 1]
        u, v = min(u, v), max(u, v)
        first, last = 0, 0
        for k in range(used - 1):
            first, last = k if length[k] <= u else first, k if length[k] <= v else last
        if first == last or (last - first == 1 and used == len(path)):
            continue
        begin = (u - length[first]) / max(length[first + 1] - length[first], 1e-12)
        end = (v - length[last]) / max(length[last + 1] - length[last], 1e-12)
        for i in range(n):
            room.one[i] = path[first, i] + begin * (path[first + 1, i] - path[first, i])
            room.other[i] = path[last, i] + end * (path[last + 1, i] - path[last, i])
        if v - u - _distance(room.one, room.other) < 1e-3:
            continue
        if not _clear(world, room.one, room.other, room, looked_at):
            continue
        # The corners between are lost, and two are new.
        gone = last - first - 2
        if gone >= 0:
            for k in range(last + 1, used):
                path[k - gone] = path[k]
        else:
            for k in range(used - 1, last, -1):
                path[k + 1] = path[k]
        used -= gone
        path[first + 1], path[first + 2] = room.one, room.other
    return used


def _trees(q_start: FloatArray, goals: FloatArray, most: int, seed: int) -> _Trees:
    n, N = len(q_start), most // 2 + len(goals) + 8
    trees = _Trees(
        np.empty((TREES, 2, N, n)),
        np.full((TREES, 2, N), -1, dtype=np.int64),
        np.tile([1, len(goals)], (TREES, 1)),
        np.random.SeedSequence(seed).generate_state(TREES, np.uint64).astype(np.uint64),
        np.zeros(TREES, dtype=np.int64),
        np.full((TREES, 2), -1, dtype=np.int64),
    )
    trees.q[:, 0, 0] = q_start
    trees.q[:, 1, : len(goals)] = goals
    return trees


def _path(trees: _Trees, r: int) -> FloatArray:
    """(T, n) from start to goal, through where a pair met."""
    halves = []
    for side in range(2):
        row, rows = int(trees.met[r, side]), []
        while row >= 0:
            rows.append(row)
            row = int(trees.parent[r, side, row])
        halves.append(trees.q[r, side, rows])
    # Where they met both have a node.
    return np.concatenate([halves[0][::-1], halves[1][1:]])


def plan_path(
    world: ArmWorld, q_start: FloatArray, goals: FloatArray, *, most: int, seed: int = 0
) -> JointPath:
    """A path that keeps what is asked.

    Args:
        world: what is to be kept clear of, and what is asked.
        q_start: (n,) where it begins [rad].
        goals: (m, n) where it may end [rad].
        most: configurations that may be looked at.
        seed: of the random trees.

    Returns:
        The path, or why there is none.
    """
    n = len(q_start)
    if not exceeds(world, q_start):
        return JointPath(np.zeros((0, n)), "the start does not keep the clearance")
    free = np.array([q for q in goals if exceeds(world, q)])
    if not len(free):
        return JointPath(np.zeros((0, n)), "no configuration at the goal keeps the clearance")
    for q in free:
        share, looked_at = share_clear(world, q_start, q)
        count(configurations=looked_at)
        if share == 1.0:
            return JointPath(np.stack([q_start, q]), "", looked_at)
    trees = _trees(np.asarray(q_start, dtype=float), free, most, seed)
    each = 0
    while (trees.met < 0).any(axis=1).all() and each * TREES < most:
        each = min(each + _SLICE, -(-most // TREES))
        on_cores(_grow_some, min(CORES, TREES), *world, trees, each)
    met = np.flatnonzero((trees.met >= 0).all(axis=1))
    found = JointPath(np.zeros((0, n)), f"no path among {most} configurations")
    looked_at = trees.looked_at.copy()
    if len(met):
        # That of the fewest configurations.
        r = int(met[np.argmin(trees.looked_at[met])])
        path = _path(trees, r)
        used = len(path)
        corners = np.concatenate([path, np.empty((8, n))])
        used = _without_detours(world, corners, used, looked_at)
        used = _shorten(world, corners, used, _SHORTCUTS, trees.random[r : r + 1], looked_at)
        used = _without_detours(world, corners, used, looked_at)
        found = JointPath(corners[:used])
    total = int(looked_at.sum())
    count(configurations=total)
    return JointPath(found.q, found.reason, total)
