"""Route selection by heuristic cost rings.

For each obstacle a circle of directions omega in the YZ-plane of the policy's
local frame L is weighed by several rings, and the direction of least total cost
is the side on which the obstacle is passed (Pairet et al. 2019, section IV-D):

    min_omega  eta_table(omega) + eta_length(omega) + eta_limits(omega)

A ring is a function from a `RingScene` to an (M, K) array of costs in [0, 1];
passing more of them to `select_directions` adds them to the sum.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from drake_oa.values import EllipsoidSet, FloatArray, IntArray, TablePlane

FORBIDDEN = 1.0
"""Cost at which a ring forbids a direction."""
_LEAST_SPREAD = 0.1
"""Spread of path lengths, in baselines, below which they count as near to each other."""


@dataclass(frozen=True, eq=False)
class RingScene:
    """What a ring may look at: M obstacles, K directions.

    Attributes:
        p_WS: (3,) start [m].
        p_WG: (3,) goal [m].
        ellipsoids: the M obstacles, dilated by the tool.
        table: the supporting plane, or None.
        angles: (K,) angles on the local YZ circle [rad].
        directions_W: (K, 3) the directions omega as unit vectors.
        p_WP: (M, K, 3) passing points: where a motion that leaves the baseline
            along omega has the asked clearance to the obstacle [m].
        detour: (M, K) distance of the passing point from the baseline [m].
        clearance: the asked clearance Delta [m].
    """

    p_WS: FloatArray
    p_WG: FloatArray
    ellipsoids: EllipsoidSet
    table: TablePlane | None
    angles: FloatArray
    directions_W: FloatArray
    p_WP: FloatArray
    detour: FloatArray
    clearance: float


Ring = Callable[[RingScene], FloatArray]


def ring_scene(
    p_WS: FloatArray,
    p_WG: FloatArray,
    R_WL: FloatArray,
    ellipsoids: EllipsoidSet,
    table: TablePlane | None,
    *,
    clearance: float,
    n_directions: int = 36,
) -> RingScene:
    """Lays the circle of directions round the baseline.

    The passing point of obstacle i along omega is

        p_P = b + omega max(0, h_i(omega) + Delta - omega . (b - c_i)),

    with b the point of the baseline nearest to the centre c_i and h_i the support
    function of the ellipsoid about its centre: the plane through p_P with normal
    omega is Delta away from the obstacle.

    Args:
        p_WS: (3,) start [m].
        p_WG: (3,) goal [m].
        R_WL: (3, 3) local frame, x from start to goal.
        ellipsoids: the obstacles.
        table: the supporting plane, or None.
        clearance: asked clearance Delta [m].
        n_directions: K, how many directions.
    """
    angles: FloatArray = np.arange(n_directions, dtype=float) * (2.0 * np.pi / n_directions)
    circle_L = np.stack([np.zeros(n_directions), np.cos(angles), np.sin(angles)], axis=1)
    directions_W = circle_L @ R_WL.T
    baseline = p_WG - p_WS
    length = float(np.sqrt(baseline @ baseline))
    along = np.clip((ellipsoids.p_WO - p_WS) @ R_WL[:, 0], 0.0, length)
    p_WB = p_WS + along[:, None] * R_WL[:, 0]
    in_axes = np.einsum("mji,kj->mki", ellipsoids.R_WO, directions_W)
    support = np.sqrt(np.sum((in_axes * ellipsoids.semi_axes[:, None, :]) ** 2, axis=2))
    detour = np.maximum(0.0, support + clearance - (p_WB - ellipsoids.p_WO) @ directions_W.T)
    return RingScene(
        p_WS=p_WS,
        p_WG=p_WG,
        ellipsoids=ellipsoids,
        table=table,
        angles=angles,
        directions_W=directions_W,
        p_WP=p_WB[:, None, :] + detour[:, :, None] * directions_W,
        detour=detour,
        clearance=clearance,
    )


def length_ring(scene: RingScene) -> FloatArray:
    """eta_length: path start - passing point - goal, scaled to [0, 1] over the ring.

    Lengths that differ by less than a tenth of the baseline count as near to each
    other: else an obstacle right on the baseline, whose sides are about as long, would
    change its side, against all hysteresis, with every millimetre it moves.
    """
    length = np.linalg.norm(scene.p_WP - scene.p_WS, axis=2)
    length = length + np.linalg.norm(scene.p_WG - scene.p_WP, axis=2)
    if not length.size:
        return length
    low, high = length.min(axis=1, keepdims=True), length.max(axis=1, keepdims=True)
    least = _LEAST_SPREAD * float(np.linalg.norm(scene.p_WG - scene.p_WS))
    return np.asarray((length - low) / np.maximum(high - low, least))


def table_ring(scene: RingScene, *, height: float) -> FloatArray:
    """eta_table: 1 where the passing point is lower than `height` above the table.

    Args:
        scene: the scene.
        height: least height of E above the table [m]: how far the tool reaches
            below E, and a margin.
    """
    if scene.table is None:
        return np.zeros(scene.detour.shape)
    return np.where(scene.table.height(scene.p_WP) < height, FORBIDDEN, 0.0)


def limits_ring(
    scene: RingScene, *, workspace: Callable[[FloatArray], FloatArray], n_samples: int = 4
) -> FloatArray:
    """eta_limits: 1 where the way over the passing point leaves the workspace.

    Args:
        scene: the scene.
        workspace: signed margin [m] of points (..., 3) -> (...), positive inside.
        n_samples: points looked at on each of the two legs.
    """
    if not scene.detour.size:
        return scene.detour
    share = np.arange(1, n_samples + 1)[:, None, None, None] / n_samples
    legs = np.concatenate(
        [
            scene.p_WS + share * (scene.p_WP - scene.p_WS),
            scene.p_WG + share * (scene.p_WP - scene.p_WG),
        ]
    )
    return np.where(np.any(workspace(legs) < 0.0, axis=0), FORBIDDEN, 0.0)


def overlap_groups(ellipsoids: EllipsoidSet, clearance: float) -> IntArray:
    """Numbers the groups of obstacles that leave no way between them, (M,).

    Two obstacles belong together when their gap along the line of centres is less
    than two clearances; groups are the connected components.
    """
    count = len(ellipsoids)
    gap = ellipsoids.p_WO[:, None, :] - ellipsoids.p_WO[None, :, :]
    distance = np.linalg.norm(gap, axis=2)
    unit = np.divide(
        gap, distance[:, :, None], out=np.zeros_like(gap), where=distance[:, :, None] > 0.0
    )
    in_axes = np.einsum("iab,ija->ijb", ellipsoids.R_WO, unit)
    reach = np.linalg.norm(in_axes * ellipsoids.semi_axes[:, None, :], axis=2)
    linked = distance < reach + reach.T + 2.0 * clearance
    label = np.arange(count)
    for _ in range(count):
        spread = np.where(linked, label[None, :], count).min(axis=1, initial=count)
        if np.array_equal(spread, label):
            break
        label = spread
    return label


@dataclass(frozen=True, eq=False)
class Selection:
    """The chosen side of each obstacle.

    Attributes:
        index: (M,) chosen column of the rings.
        groups: (M,) numbers of the groups, see `overlap_groups`.
        costs: name -> (M, K) each ring.
        blocked: (M,) whether every direction is forbidden by some ring.
    """

    index: IntArray
    groups: IntArray
    costs: dict[str, FloatArray]
    blocked: np.ndarray


def select_directions(
    scene: RingScene,
    rings: Mapping[str, Ring],
    *,
    previous: IntArray | None = None,
    hysteresis: float = 0.2,
) -> Selection:
    """Chooses omega_d: the direction of least total cost for each obstacle.

    Obstacles with no way between them (`overlap_groups`) are passed on one side:
    the mean of their costs decides, and what one of them forbids is forbidden to
    all. Equal costs are decided by the lowest angle, so the answer is definite.

    Args:
        scene: the scene.
        rings: the rings by name.
        previous: (M,) the columns chosen before, -1 where there was none. A group
            keeps its side while that is allowed and dearer than the best one by
            less than `hysteresis`.
        hysteresis: in units of cost.
    """
    count, width = scene.detour.shape
    costs = {name: np.asarray(ring(scene), dtype=float) for name, ring in rings.items()}
    for name, cost in costs.items():
        if cost.shape != (count, width):
            raise ValueError(
                f"ring '{name}' returned shape {cost.shape}; it must be ({count}, {width}), "
                "obstacles by directions"
            )
    index = np.zeros(count, dtype=np.int64)
    blocked = np.zeros(count, dtype=bool)
    groups = overlap_groups(scene.ellipsoids, scene.clearance)
    total = sum(costs.values(), np.zeros((count, width)))
    forbidden = np.zeros((count, width), dtype=bool)
    for name, cost in costs.items():
        if name != "length":
            forbidden |= cost >= FORBIDDEN
    for group in np.unique(groups):
        rows = np.flatnonzero(groups == group)
        shut = forbidden[rows].any(axis=0)
        blocked[rows] = bool(shut.all())
        # A forbidden direction never beats an allowed one, whatever the sum of the others.
        shared = total[rows].mean(axis=0) + np.where(shut, float(len(costs)), 0.0)
        best = int(np.argmin(shared))
        if previous is not None:
            kept = previous[rows][previous[rows] >= 0]
            if kept.size and shared[kept[0]] < shared[best] + hysteresis:
                best = int(kept[0])
        index[rows] = best
    return Selection(index, groups, costs, blocked)


def path_length(scene: RingScene, index: IntArray) -> float:
    """length(pi-hat) of section IV-E: start, passing points in order, goal [m]."""
    rows = np.flatnonzero(scene.detour[np.arange(len(index)), index] > 0.0)
    points = scene.p_WP[rows, index[rows]]
    baseline = scene.p_WG - scene.p_WS
    points = points[np.argsort(points @ baseline, kind="stable")]
    way = np.concatenate([scene.p_WS[None], points, scene.p_WG[None]])
    return float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())
