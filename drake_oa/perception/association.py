"""Which obstacle a cluster of a new frame belongs to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from drake_oa.common.messages import BoolArray, FloatArray, IntArray
from drake_oa.perception.tracking_kernels import counted_votes

_FEW = 4  # common points that say nothing
_SHARE = 0.25  # of the smaller of the two that must be common


@dataclass(frozen=True, eq=False)
class Association:
    """Rows of obstacles for the points and clusters of a frame.

    Attributes:
        point_row: (Q,) obstacle of each point; those not known before follow the others.
        cluster_row: (C,) obstacle that most of each cluster belongs to.
        mixed: (C,) whether a cluster holds points of several obstacles.
        new: the clusters that are new obstacles, in the order of their rows.
        partner: (M,) the largest obstacle in a cluster with this one, -1: none.
    """

    point_row: IntArray
    cluster_row: IntArray
    mixed: BoolArray
    new: IntArray
    partner: IntArray


def associate(
    points: FloatArray,
    cluster: IntArray,
    clusters: int,
    voted: IntArray,
    remembered: FloatArray,
    owner: IntArray,
    tracks: int,
    gate: float,
) -> Association:
    """Gives clusters to obstacles: by common points, else by predicted centroids.

    An obstacle takes every cluster that has points in common with it, 25 % of the smaller
    of the two. A cluster that two obstacles claim is divided between them, each point to
    that of the nearest remembered point. The rest is matched by the least total distance
    of centroids below the gate; what then is left is new.

    Args:
        points: (Q, 3) of the frame in the world [m].
        cluster: (Q,) their clusters.
        clusters: C, how many there are.
        voted: (Q,) the remembered point nearest to each, -1: none near.
        remembered: (N, 3) where remembered points should be in the world [m].
        owner: (N,) their obstacles.
        tracks: M, how many there are.
        gate: the largest distance of centroids [m].
    """
    sizes = np.bincount(cluster, minlength=clusters)
    known = np.bincount(owner, minlength=tracks)
    votes, vote_row = counted_votes(cluster, clusters, voted, owner, tracks)
    least = np.maximum(_FEW, _SHARE * np.minimum(sizes[:, None], known[None]))
    claims = votes >= least
    cluster_row = np.full(clusters, -1, dtype=np.int64)
    if tracks:
        claimed = claims.any(axis=1)
        cluster_row[claimed] = np.where(claims, votes, -1)[claimed].argmax(axis=1)
        _match_centroids(
            cluster_row,
            np.asarray(claims.any(axis=0)),
            points,
            cluster,
            sizes,
            remembered,
            owner,
            known,
            gate,
        )
    new = np.flatnonzero(cluster_row < 0)
    cluster_row[new] = tracks + np.arange(len(new))
    mixed = claims.sum(axis=1) > 1
    point_row = cluster_row[cluster]
    partner = np.full(tracks, -1, dtype=np.int64)
    for c in np.flatnonzero(mixed):
        inside = np.flatnonzero(cluster == c)
        rows = np.flatnonzero(claims[c])
        point_row[inside] = _divided(points[inside], vote_row[inside], rows, remembered, owner)
        largest = rows[known[rows].argmax()]
        partner[rows[rows != largest]] = largest
    return Association(point_row, cluster_row, mixed, new, partner)


def _match_centroids(
    cluster_row: IntArray,
    taken: BoolArray,
    points: FloatArray,
    cluster: IntArray,
    sizes: IntArray,
    remembered: FloatArray,
    owner: IntArray,
    known: IntArray,
    gate: float,
) -> None:
    left, lost = np.flatnonzero(cluster_row < 0), np.flatnonzero(~taken & (known > 0))
    if not len(left) or not len(lost):
        return
    seen = np.stack([points[cluster == c].mean(axis=0) for c in left])
    expected = np.stack([remembered[owner == m].mean(axis=0) for m in lost])
    gap = np.linalg.norm(seen[:, None] - expected[None], axis=2)
    # Pairs beyond the gate cost more than any number of pairs within it.
    rows, columns = linear_sum_assignment(np.where(gap < gate, gap, 1e3 * gate))
    near = gap[rows, columns] < gate
    cluster_row[left[rows[near]]] = lost[columns[near]]


def _divided(
    points: FloatArray, vote: IntArray, rows: IntArray, remembered: FloatArray, owner: IntArray
) -> IntArray:
    """Rows (Q,) for the points of one cluster that several obstacles claim."""
    claiming = np.zeros(max(int(vote.max(initial=-1)), int(rows.max())) + 2, dtype=bool)
    claiming[rows] = True  # of -1 the last place, which is no obstacle's
    result = np.where(claiming[vote], vote, -1)
    far = np.flatnonzero(result < 0)
    if len(far):
        gaps = []
        for m in rows:
            mine = remembered[owner == m]
            low, high = mine.min(axis=0), mine.max(axis=0)
            outside = np.maximum(0.0, np.maximum(low - points[far], points[far] - high))
            gaps.append(np.linalg.norm(outside, axis=1))
        result[far] = rows[np.argmin(gaps, axis=0)]
    return np.asarray(result, dtype=np.int64)
