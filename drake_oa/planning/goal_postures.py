"""With which joints an arm holds its tool at a pose, and where nearby it can if not there."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray
from drake_oa.common.thinking import count
from drake_oa.geometry.directions import DIRECTIONS
from drake_oa.planning.arm_world import Chain
from drake_oa.planning.tracking import reach, scratch

_STEPS, _NEAR = 60, 1e-5
_SAME = 0.1
"""Joints that all differ by less are the same posture [rad]."""
FARTHEST = 0.3
"""So far from a pose that is not free a free one is looked for [m],"""
_STEP, _HALVINGS = 0.02, 3
"""in shells this far apart [m], and then so often halfway back."""


@compiled
def _reach_all(
    q: FloatArray, target: FloatArray, chain: Chain, steps: int, near: float
) -> FloatArray:
    """(N,) 1 for each of N seeds (N, n), in place, that reaches the pose, else 0."""
    found = np.zeros(len(q))
    room = scratch(q.shape[1])
    for row in range(len(q)):
        if reach(q[row], target, chain, room, steps, near):
            found[row] = 1.0
    return found


def goal_postures(
    chain: Chain, X_WE: FloatArray, near: FloatArray, *, seeds: int = 32, seed: int = 0
) -> FloatArray:
    """(m, n) joints with the tool at a pose, those nearest to given ones first [rad].

    The same arguments give the same postures; those of an arm of seven joints are samples of
    its self-motion.

    Args:
        chain: the arm.
        X_WE: (12,) the pose: rotation, row by row, and position [m].
        near: (n,) joints to begin with [rad].
        seeds: as many random ones are begun with besides.
        seed: of those.
    """
    random = np.random.default_rng(seed)
    q = np.vstack([near, random.uniform(chain.lower, chain.upper, (seeds, len(near)))])
    q = q[_reach_all(q, np.array(X_WE, dtype=float), chain, _STEPS, _NEAR) > 0.0]
    kept: list[FloatArray] = []
    for one in q[np.argsort(np.linalg.norm(q - near, axis=1), kind="stable")]:
        if all(np.abs(one - other).max() > _SAME for other in kept):
            kept.append(one)
    return np.array(kept).reshape(-1, len(near))


def nearest_free_place(
    chain: Chain, X_WE: FloatArray, near: FloatArray, is_free: Callable[[FloatArray], bool]
) -> FloatArray | None:
    """Where the tool, turned as in a pose, can be nearest to it, in `DIRECTIONS` from there.

    Args:
        chain: the arm.
        X_WE: (12,) the pose: rotation, row by row, and position [m].
        near: (n,) joints to begin with [rad].
        is_free: whether a posture (n,) will do.

    Returns:
        (3,) the place [m]; None: there is none within `FARTHEST`.
    """

    def held(distance: float, direction: FloatArray) -> bool:
        target = np.append(X_WE[:9], X_WE[9:] + distance * direction)
        postures = goal_postures(chain, target, near, seeds=4)
        count(configurations=len(postures))
        return any(map(is_free, postures))

    for distance in np.arange(_STEP, FARTHEST, _STEP):
        free = [direction for direction in DIRECTIONS if held(distance, direction)]
        if not free:
            continue
        back = 0.5 * _STEP
        for _ in range(_HALVINGS):
            nearer = [direction for direction in free if held(distance - back, direction)]
            free, distance, back = nearer or free, distance - back * bool(nearer), 0.5 * back
        return np.asarray(X_WE[9:] + distance * free[0])
    return None
