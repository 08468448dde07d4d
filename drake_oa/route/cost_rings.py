"""Route selection by heuristic cost rings.

For each obstacle a circle of directions omega in the YZ-plane of the policy's
local frame L is weighed by several rings, and the direction of least total cost
is the side on which the obstacle is passed (Pairet et al. 2019, section IV-D, eq. 12):

    min_omega  eta_table(omega) + eta_length(omega) + eta_limits(omega)

eta_limits is the sum of two rings that are nowhere both 1: what is out of reach, and what
is reached only near a joint's limit, both by inverse kinematics along the way. A ring is a
function from a `RingScene` to an (M, K) array of costs in [0, 1]; passing more of them to
`drake_oa.route.side_choice.select_directions` adds them to the sum.
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
JOINT_MARGIN = 0.1
"""Distance that the joints keep from their limits where there is room [rad]."""
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
        joint_margin: (M, K) the least distance of the arm's joints to their limits on the way
            over the passing point [rad]; -inf where the arm cannot follow it, inf: not known.
        straight_margin: the same on the baseline [rad].
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
    joint_margin: FloatArray
    straight_margin: float


Ring = Callable[[RingScene], FloatArray]
JointMargins = Callable[[FloatArray], FloatArray]
"""(N, P, 3) corners of N ways [m] -> (N, P) the least distance of the arm's joints to their limits
on the leg to each corner [rad]; -inf from the first corner that the arm does not reach."""


def ring_scene(
    p_WS: FloatArray,
    p_WG: FloatArray,
    R_WL: FloatArray,
    ellipsoids: EllipsoidSet,
    table: TablePlane | None,
    *,
    asked_clearance: float,
    n_directions: int = 36,
    joint_margins: JointMargins | None = None,
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
        joint_margins: of the arm; None: not known.
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
    p_WP = p_WB[:, None, :] + detour[:, :, None] * directions_W
    margin, straight = np.full(detour.shape, np.inf), np.inf
    if joint_margins is not None and detour.size:
        ways = np.stack(np.broadcast_arrays(p_WS, p_WP, p_WG), axis=2).reshape(-1, 3, 3)
        margin = joint_margins(ways).min(axis=1).reshape(detour.shape)
        straight = float(joint_margins(np.stack([p_WS, p_WG])[None]).min())
    return RingScene(
        p_WS=p_WS,
        p_WG=p_WG,
        ellipsoids=ellipsoids,
        table=table,
        angles=angles,
        directions_W=directions_W,
        p_WP=p_WP,
        detour=detour,
        asked_clearance=asked_clearance,
        joint_margin=margin,
        straight_margin=straight,
    )


UNLIKELY = 2.0
"""Additional cost of a side that certainly does not achieve the clearance, in baselines."""


def side_costs(length: FloatArray, likely: FloatArray) -> FloatArray:
    """Returns costs of sides, in baselines, by expected length and probability (N,) each."""
    return length + UNLIKELY * (1.0 - likely)


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


def reach_ring(scene: RingScene) -> FloatArray:
    """1 where the arm cannot follow the way over the passing point."""
    return np.where(np.isneginf(scene.joint_margin), FORBIDDEN, 0.0)


def joint_limits_ring(scene: RingScene) -> FloatArray:
    """1 where the arm follows the way, but comes nearer to a joint's limit than it must.

    That is nearer than `JOINT_MARGIN`, and than on the baseline.
    """
    is_near = scene.joint_margin < min(JOINT_MARGIN, scene.straight_margin)
    return np.where(is_near & ~np.isneginf(scene.joint_margin), FORBIDDEN, 0.0)


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
