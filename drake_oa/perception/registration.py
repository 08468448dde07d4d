"""How far an obstacle has gone since the frame before, by what both frames show of it.

Its surface in the frame before is laid on its surface now: the shift d that leaves the least
distances along the normals,

    d = argmin sum_i w_i (n_i . (q_i - p_i - d))^2 + |d - d_0|^2 / prior^2

(point to plane, Y. Chen and G. Medioni, Image and Vision Computing 1992; translation alone). What
has come into view since has no counterpart and counts for nothing, so that it holds for what is
cut off by the image or comes from behind something, as the sides of an obstacle do not. Along a
plane that slides in itself it tells nothing, and its variance says so.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from drake_oa.common.messages import FloatArray, IntArray
from drake_oa.perception.memory import DOUBTED, INITIAL_SPEED, LONGEST_GAP, MOVED, Tracks
from drake_oa.perception.sides import SIDE_DEVIATION

_MOST = 160
"""Points of a surface that are looked at."""
_NEIGHBOURS = 8
"""Points that a normal is of."""
_ROUNDS = 4
_TELLS = 0.5
"""An axis is measured whose deviation is less than this share of what was unknown."""
_TOGETHER = 12.0
"""Points that have the same noise: it is smooth over pixels."""
_GATE = 0.02
"""Distance between points of two frames beyond which they are not the same [m]."""


def registered(
    before: FloatArray,
    now: FloatArray,
    guess: FloatArray,
    *,
    noise: float,
    prior: float,
    gate: float,
) -> tuple[FloatArray, FloatArray]:
    """The shift from one frame's points (N, 3) to the next one's (M, 3).

    Args:
        before, now: surfaces in the world [m]; a few points at least.
        guess: (3,) the shift that is expected [m].
        noise: standard deviation of a point along the normal [m].
        prior: how far off the guess may be, a standard deviation [m].
        gate: points farther apart are not the same [m].

    Returns:
        (3,) the shift [m], and its variances (3,) [m^2]; those of the prior where nothing tells.
    """
    if min(len(before), len(now)) < _NEIGHBOURS:
        return np.array(guess), np.full(3, prior**2)
    tree, own = cKDTree(now), cKDTree(before)
    moving = before[:: -(-len(before) // _MOST)]
    # Means of as many points as those that they are laid on: a bent surface is flattened alike.
    moving = before[own.query(moving, k=_NEIGHBOURS)[1]].mean(axis=1)
    shift, weak = np.array(guess, dtype=float), np.eye(3) / prior**2
    information = weak
    for reach in np.geomspace(2.0 * gate, gate, _ROUNDS):
        distance, rows = tree.query(moving + shift, k=_NEIGHBOURS, distance_upper_bound=reach)
        # Where a whole neighbourhood is there.
        there = np.isfinite(distance).all(axis=1)
        if not there.any():
            break
        patches = now[rows[there]]
        middle = patches.mean(axis=1)
        apart = patches - middle[:, None]
        spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", apart, apart))
        normal = axes[:, :, 0]
        left = np.einsum("ni,ni->n", normal, middle - moving[there])
        off = np.abs(left - normal @ shift)
        # Edges have no normal, and outliers no say.
        weight = (1.0 - spread[:, 0] / np.maximum(spread[:, 1], 1e-12)) ** 2
        weight = weight / (1.0 + (off / (3.0 * noise)) ** 2) / (_TOGETHER * noise**2)
        told = np.einsum("n,ni,nj->ij", weight, normal, normal)
        pull = np.einsum("n,ni,n->i", weight, normal, left) + weak @ guess
        shift = np.linalg.solve(told + weak, pull)
        # A normal that noise has tilted seems to tell of what is along its surface.
        rough = np.minimum(spread[:, 0] / (_NEIGHBOURS - 3), noise**2)
        tilted = weight @ (rough / np.maximum(spread[:, 1], noise**2))
        size, along = np.linalg.eigh(told - tilted * np.eye(3))
        information = (along * np.maximum(size, 0.0)) @ along.T + weak
    return shift, np.diag(np.linalg.inv(information)).copy()


def shown_of(seen: FloatArray, row: IntArray, ids: IntArray) -> dict[int, FloatArray]:
    """What a frame's points (Q, 3) show of the obstacles (M,) that they belong to, rows (Q,)."""
    found = {name: seen[row == number] for number, name in enumerate(ids.tolist())}
    return {name: points for name, points in found.items() if len(points)}


class NowSeen(NamedTuple):
    """A frame: what it shows of the obstacles, by name, all its points (Q, 3) [m], and their rows.

    `row` (Q,) is of their obstacles, `cluster` (Q,) of their clusters: what an obstacle has become
    one cluster with may show its surface too.
    """

    shown: dict[int, FloatArray]
    points: FloatArray
    row: IntArray
    cluster: IntArray


def registered_tracks(
    tracks: Tracks,
    before: dict[int, FloatArray],
    now: NowSeen,
    dt: float,
) -> tuple[FloatArray, FloatArray]:
    """How far the obstacles that may move have gone since dt [s] ago, and how well it is known.

    Args:
        tracks: the M obstacles, as predicted.
        before: what the frame before showed of them, by name.
        now: this frame.
        dt: see there.

    Returns:
        (M, 3) shifts [m], NaN where nothing tells, and their variances (M, 3) [m^2].
    """
    shift, spread = np.full((len(tracks), 3), np.nan), np.ones((len(tracks), 3))
    unknown = dt * INITIAL_SPEED
    for row, name in enumerate(tracks.ids.tolist()):
        if name not in now.shown or name not in before or not 0.0 < dt <= LONGEST_GAP:
            continue
        then = before[name]
        moved = np.abs(now.shown[name].mean(axis=0) - then.mean(axis=0)).max() > MOVED
        if not (moved or tracks.moving[row] or tracks.doubt[row] > DOUBTED):
            continue
        shift[row], spread[row] = registered(
            then,
            now.points[np.isin(now.cluster, np.unique(now.cluster[now.row == row]))],
            dt * tracks.estimate.v_W[row],
            noise=SIDE_DEVIATION,
            prior=unknown,
            gate=_GATE,
        )
        shift[row, spread[row] > (_TELLS * unknown) ** 2] = np.nan
    return shift, spread
