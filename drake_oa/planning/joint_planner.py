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
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_oa.common.compiled import CORES, compiled, on_cores, parted
from drake_oa.common.messages import FloatArray, IntArray
from drake_oa.common.thinking import count
from drake_oa.planning.arm_world import (
    FAR,
    STRIDE,
    ArmWorld,
    exceeds,
    share_clear,
)
from drake_oa.robot.arm import Chain

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


@compiled
def _uniform(random: NDArray[np.uint64], r: int) -> float:
    """The next of the numbers r in [0, 1) (G. L. Steele et al., SplitMix, OOPSLA 2014)."""
    random[r] += np.uint64(0x9E3779B97F4A7C15)
    z = random[r]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return float((z ^ (z >> np.uint64(31))) >> np.uint64(11)) / 9007199254740992.0


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
    world: ArmWorld, trees: _Trees, r: int, side: int, row: int, aim: FloatArray
) -> tuple[int, bool]:
    """Goes from a node toward aim by one step, as far as it is clear.

    Returns:
        The new node, or -1 for none, and whether it is aim.
    """
    q = trees.q[r, side]
    d = _distance(q[row], aim)
    share = min(1.0, _RANGE / d) if d > 0.0 else 1.0
    other = aim.copy() if share == 1.0 else q[row] + share * (aim - q[row])
    clear, looked_at = share_clear(world, q[row], other, _COARSE, _NEAR)
    trees.looked_at[r] += looked_at
    if clear * share * d < min(_LEAST, 0.5 * d):
        return -1, False
    new = trees.used[r, side]
    q[new] = other if clear == 1.0 else q[row] + clear * (other - q[row])
    trees.parent[r, side, new] = row
    trees.used[r, side] += 1
    return new, share == 1.0 and clear == 1.0


@compiled
def _draw(chain: Chain, trees: _Trees, r: int) -> FloatArray:
    """Draws a configuration (n,) to grow toward: near the straight way, or anywhere."""
    random, start, goal = trees.random, trees.q[r, 0, 0], trees.q[r, 1, 0]
    beside, along = _uniform(random, r) < _BESIDE, _uniform(random, r)
    aim = np.empty(len(start))
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
    return aim


@compiled
def _holds(world: ArmWorld, trees: _Trees, r: int, side: int, row: int) -> bool:
    """Whether the way from a root to a node is clear in full; what does not hold is cut off."""
    q, parent = trees.q[r, side], trees.parent[r, side]
    while parent[row] >= 0:
        share, looked_at = share_clear(world, q[parent[row]], q[row], STRIDE, _NEAR)
        trees.looked_at[r] += looked_at
        if share < 1.0:
            # Far from everything, with all that grew from it; which came later.
            q[row] = np.inf
            for k in range(row + 1, trees.used[r, side]):
                if math.isinf(q[parent[k], 0]):
                    q[k] = np.inf
            return False
        row = parent[row]
    return True


@parted
def _grow(part: int, parts: int, world: ArmWorld, trees: _Trees, most: int) -> None:
    """Grows each part's pairs until they meet, or have looked at so many configurations."""
    N = trees.q.shape[2]
    for r in range(part, len(trees.used), parts):
        side = 0
        while (
            trees.met[r, 0] < 0
            and trees.looked_at[r] < most
            and max(trees.used[r, 0], trees.used[r, 1]) < N - 1
        ):
            aim, other = _draw(world.chain, trees, r), 1 - side
            row = _nearest(trees.q[r, side], trees.used[r, side], aim)
            new, _ = _extend(world, trees, r, side, row, aim)
            if new >= 0:
                aim = trees.q[r, side, new]
                row, there = _nearest(trees.q[r, other], trees.used[r, other], aim), False
                while row >= 0 and not there and trees.used[r, other] < N:
                    row, there = _extend(world, trees, r, other, row, aim)
                held = there and _holds(world, trees, r, side, new)
                if held and _holds(world, trees, r, other, row):
                    trees.met[r, side], trees.met[r, other] = new, row
            side = other


def _is_clear(world: ArmWorld, one: FloatArray, other: FloatArray) -> bool:
    """Whether a way is clear, looked at in coarse strides first."""
    for step in (_COARSE, STRIDE):
        share, looked_at = share_clear(world, one, other, step, _NEAR)
        count(configurations=looked_at)
        if share < 1.0:
            return False
    return True


def _leave_out_detours(world: ArmWorld, path: list[FloatArray]) -> None:
    """Leaves out corners that need not be gone through."""
    first = 0
    while first < len(path) - 2:
        last = len(path) - 1
        while last > first + 1 and not _is_clear(world, path[first], path[last]):
            last -= 1
        del path[first + 1 : last]
        first += 1


def _shorten(world: ArmWorld, path: list[FloatArray], random: NDArray[np.uint64]) -> None:
    """Takes random shortcuts between two places of a path."""
    for _ in range(_SHORTCUTS):
        length = np.append(0.0, np.cumsum([_distance(*ends) for ends in pairwise(path)]))
        places = sorted(_uniform(random, 0) * length[-1] for _ in range(2))
        first, last = np.searchsorted(length[:-1], places, "right") - 1
        if first == last:
            continue
        ends = []
        for place, row in zip(places, (first, last), strict=True):
            share = (place - length[row]) / max(length[row + 1] - length[row], 1e-12)
            ends.append(path[row] + share * (path[row + 1] - path[row]))
        if places[1] - places[0] - _distance(*ends) >= 1e-3 and _is_clear(world, *ends):
            path[first + 1 : last + 1] = ends


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
) -> FloatArray:
    """A path that keeps what is asked.

    Args:
        world: what is to be kept clear of, and what is asked.
        q_start: (n,) where it begins [rad].
        goals: (m, n) where it may end [rad].
        most: configurations that may be looked at.
        seed: of the random trees.

    Returns:
        (T, n) corners of the path, from start to goal [rad]; (0, n): none was found.
    """
    free = np.array([q for q in goals if exceeds(world, q)])
    if not (len(free) and exceeds(world, q_start)):
        return np.zeros((0, len(q_start)))
    for q in free:
        share, looked_at = share_clear(world, q_start, q, STRIDE, FAR)
        count(configurations=looked_at)
        if share == 1.0:
            return np.stack([q_start, q])
    trees = _trees(np.asarray(q_start, dtype=float), free, most, seed)
    each = 0
    while (trees.met < 0).any(axis=1).all() and each * TREES < most:
        each = min(each + _SLICE, -(-most // TREES))
        on_cores(_grow, min(CORES, TREES), world, trees, each)
    count(configurations=int(trees.looked_at.sum()))
    met = np.flatnonzero((trees.met >= 0).all(axis=1))
    if not len(met):
        return np.zeros((0, len(q_start)))
    # That of the fewest configurations.
    r = int(met[np.argmin(trees.looked_at[met])])
    path = [*_path(trees, r)]
    _leave_out_detours(world, path)
    _shorten(world, path, trees.random[r : r + 1])
    _leave_out_detours(world, path)
    return np.array(path)
