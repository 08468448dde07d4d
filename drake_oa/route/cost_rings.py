"""Route selection by heuristic cost rings.

For each obstacle a circle of directions omega in the YZ-plane of the policy's
local frame L is weighed by several rings, and the direction of least total cost
is the side on which the obstacle is passed (Pairet et al. 2019, section IV-D, eq. 12):

    min_omega  eta_table(omega) + eta_length(omega) + eta_limits(omega)

eta_limits is the sum of two rings that are nowhere both 1: what is out of reach, and what
is reached only near a joint's limit. A ring is a function from a `RingScene` to an (M, K)
array of costs in [0, 1]; passing more of them to `drake_oa.route.side_choice.select_directions`
adds them to the sum.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drake_oa.common.messages import EllipsoidSet, FloatArray, IntArray, TablePlane
from drake_oa.geometry.ellipsoid import signed_distance

FORBIDDEN = 1.0
"""Cost at which a ring forbids a direction."""
JOINT_LIMITS = "joint_limits"
"""Name of the ring of `joint_limits_ring`."""
_LIMIT_SAMPLES = 12
"""Points of each of the two legs at which `limits_ring` asks for the workspace's margin."""
LEAST_SPREAD = 0.1
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
        asked_clearance: the asked clearance Delta [m].
    """

    p_WS: FloatArray
    p_WG: FloatArray
    ellipsoids: EllipsoidSet
    table: TablePlane | None
    angles: FloatArray
    directions_W: FloatArray
    p_WP: FloatArray
    detour: FloatArray
    asked_clearance: float


Ring = Callable[[RingScene], FloatArray]
Margin = Callable[[FloatArray], FloatArray]
"""Signed margin [m] of points (..., 3) -> (...), positive inside."""


def ring_scene(
    p_WS: FloatArray,
    p_WG: FloatArray,
    R_WL: FloatArray,
    ellipsoids: EllipsoidSet,
    table: TablePlane | None,
    *,
    asked_clearance: float,
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
        asked_clearance: asked clearance Delta [m].
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
    detour = np.maximum(0.0, support + asked_clearance - (p_WB - ellipsoids.p_WO) @ directions_W.T)
    return RingScene(
        p_WS=p_WS,
        p_WG=p_WG,
        ellipsoids=ellipsoids,
        table=table,
        angles=angles,
        directions_W=directions_W,
        p_WP=p_WB[:, None, :] + detour[:, :, None] * directions_W,
        detour=detour,
        asked_clearance=asked_clearance,
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
    least = LEAST_SPREAD * float(np.linalg.norm(scene.p_WG - scene.p_WS))
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


def limits_ring(scene: RingScene, *, workspace: Margin) -> FloatArray:
    """eta_limits: 1 where the way over the passing point leaves the workspace.

    Args:
        scene: the scene.
        workspace: signed margin [m] of points (..., 3) -> (...), positive inside.
    """
    if not scene.detour.size:
        return scene.detour
    share = np.arange(1, _LIMIT_SAMPLES + 1)[:, None, None, None] / _LIMIT_SAMPLES
    legs = np.concatenate(
        [
            scene.p_WS + share * (scene.p_WP - scene.p_WS),
            scene.p_WG + share * (scene.p_WP - scene.p_WG),
        ]
    )
    return np.where(np.any(workspace(legs) < 0.0, axis=0), FORBIDDEN, 0.0)


def joint_limits_ring(
    scene: RingScene,
    *,
    joints: Margin,
    workspace: Margin,
) -> FloatArray:
    """1 where the way is in reach, but comes nearer to a joint's limit than it must.

    A start or goal that lies beyond the margin is where the motion has to be: what lies no
    farther beyond it is allowed.

    Args:
        scene: the scene.
        joints: signed margin [m] of points (..., 3) -> (...), positive where the arm keeps
            its joints off their limits.
        workspace: signed margin [m] to what it reaches at all, positive inside.
    """
    near = limits_ring(scene, workspace=no_worse_than_the_ends(scene, joints))
    return np.where(limits_ring(scene, workspace=workspace) >= FORBIDDEN, 0.0, near)


def no_worse_than_the_ends(scene: RingScene, margin: Margin) -> Margin:
    """A margin [m] that counts from its least at start and goal where that is negative."""
    ends = float(margin(np.stack([scene.p_WS, scene.p_WG])).min())
    return lambda p_WQ: margin(p_WQ) - min(ends, 0.0)


_SAMPLES = 41
"""Places on the baseline at which an obstacle's distance is looked at."""


def remaining_clearance(scene: RingScene) -> FloatArray:
    """(M,) clearance that the motion is to be led at, no more than start and goal leave [m].

    0 where the baseline keeps it already, or is nearest at one of its ends: no side helps there.
    """
    shapes = scene.ellipsoids
    share = np.linspace(0.0, 1.0, _SAMPLES)[:, None, None]
    place = scene.p_WS + share * (scene.p_WG - scene.p_WS)
    distance = signed_distance(place, shapes.p_WO, shapes.R_WO, shapes.semi_axes)
    feasible = np.minimum(scene.asked_clearance, distance[[0, -1]].min(axis=0))
    nearest = distance.argmin(axis=0)
    between = (nearest > 0) & (nearest < _SAMPLES - 1)
    return np.where(between & (distance.min(axis=0) < feasible), feasible, 0.0)


def path_length(scene: RingScene, index: IntArray) -> float:
    """length(pi-hat) of section IV-E: start, passing points in order, goal [m]."""
    rows = np.flatnonzero(scene.detour[np.arange(len(index)), index] > 0.0)
    points = scene.p_WP[rows, index[rows]]
    baseline = scene.p_WG - scene.p_WS
    points = points[np.argsort(points @ baseline, kind="stable")]
    way = np.concatenate([scene.p_WS[None], points, scene.p_WG[None]])
    return float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())
