"""Passive motion safety: claims that limit the arm's speed toward moving obstacles and toward
unobserved space.

The arm follows a trajectory for one decision period, and then brakes. It is covered by spheres with
centers c_i, velocities u_i and radii r_i. The last observation has the stamp s. An obstacle slower
than V can touch sphere i at time t only if at s it was within the distance

    rho_i(t) = r_i + V (t - s)

of the position c_i(t). Let d_i(t) be the distance of c_i(t) to the obstacles that move, or have
come to rest less than 2 s before s, at their positions at s. A trajectory violates claim

    (A)  if d_i(t) <= rho_i(t) and d_i(t) decreases faster than 0.02 m/s
    (B)  if u_i(t) . n > v_unseen for a unit vector n from c_i(t) to a point within rho_i(t) that is
         neither observed as free at s nor within 1 cm of a geometry of the scene or of the arm

at some time until the arm rests. Hence a sphere that an obstacle slower than V may reach is at rest
or moves away. The arm does not enter unobserved space faster than v_unseen. A point is observed as
free if it is in front of the measured depth of its pixel; a pixel without depth gives no
information. Points are sampled at the center of the ball of radius rho_i, and in 26 directions at
half and full radius.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.latency import count
from drake_oa.common.messages import BoolArray, FloatArray
from drake_oa.geometry.collision_scene import (
    CollisionGeometries,
    CollisionScene,
    ball_bound,
    geometry_distance,
    least_distances,
)
from drake_oa.geometry.directions import DIRECTIONS
from drake_oa.perception.depth_perception import FreeSpace
from drake_oa.robot.arm import Chain, Spheres
from drake_oa.robot.spheres import sphere_centers

Claim = Literal["", "A", "B"]
CLAIMS: tuple[Claim, ...] = get_args(Claim)

_REST_SPEED = 0.02
"""Speed toward a moving obstacle up to which a sphere of the arm counts as at rest [m/s].

Claim (A) of passive motion safety forbids a faster approach if the obstacle may reach the sphere.
"""
_OCCUPIED_MARGIN = 0.01
"""Distance from a collision geometry or from the arm within which a point counts as occupied, and
not as unobserved space [m]."""
_BALL_SAMPLES = np.vstack([0.5 * DIRECTIONS, DIRECTIONS])
"""Sample points (52, 3) in the unit ball, except its center [-]. They are scaled to test whether
the space near the arm is observed."""
_PARTS = 8
"""Number of subsets into which the arm's spheres are divided to check claim (B) of passive motion
safety: no speed above `v_unseen` toward unobserved space [-]. The first subset with a violation
ends the check."""
_SAMPLE_RADII = np.linalg.norm(_BALL_SAMPLES, axis=1)
"""Distances (52,) of the sample points in the unit ball from its center: 0.5 or 1 [-]. The points
are scaled to test whether the space near the arm is observed."""


def violated_claim(
    chain: Chain,
    spheres: Spheres,
    t: FloatArray,
    q: FloatArray,
    scene: CollisionScene,
    free_space: FreeSpace | None,
    *,
    V: float,
    v_unseen: float,
    may_move: BoolArray | None = None,
) -> Claim:
    """Finds the first claim of passive motion safety that a trajectory of the arm violates: "A",
    "B", or "" for none.

    The arm is covered by spheres. Claim A: no sphere that an obstacle slower than V may reach
    approaches a moving obstacle faster than 0.02 m/s. Claim B: no sphere moves faster than v_unseen
    toward a point from which such an obstacle may reach it, unless the point was observed as free,
    or is occupied by known collision geometry or the arm.

    Args:
        chain, spheres: kinematics of the arm, and spheres that cover it.
        t: (T,) times of the trajectory until the arm rests, increasing [s].
        q: (T, n) configurations at these times [rad].
        scene: collision scene of the last observation.
        free_space: space observed as free; None: all space outside collision geometry, so that
            claim B always holds.
        V: maximum speed of obstacles [m/s].
        v_unseen: maximum speed toward unobserved space [m/s].
        may_move: (K,) whether claim A applies to each of the scene's K geometries; None: it applies
            to those that move.
    """
    geometries = scene.geometries
    may_move = geometries.moving if may_move is None else may_move
    p_WS = sphere_centers(chain, spheres, np.ascontiguousarray(q))
    dt = np.diff(t)[:, None]
    reach = spheres.radius + V * (t[:-1] - scene.stamp)[:, None]
    count(claims=1)
    if may_move.any():
        moving = geometries.select(may_move)
        # Within a step rho grows and the distance decreases: check the end of each step.
        if _is_any_approaching(p_WS, reach + V * dt, np.diff(t), moving, scene.stamp):
            return "A"
    if free_space is None:
        return ""
    count(claims=3)
    # A violation usually appears in a few spheres; then the others are not sampled.
    for part in range(_PARTS):
        p = p_WS[:, part::_PARTS]
        v = np.diff(p, axis=0) / dt[..., None]
        fast = (v**2).sum(axis=2) > v_unseen**2
        v, centers, rho = v[fast], p[:-1][fast], reach[:, part::_PARTS][fast]
        point, sample = (v @ _BALL_SAMPLES.T > v_unseen * _SAMPLE_RADII).nonzero()
        around = centers[point] + rho[point, None] * _BALL_SAMPLES[sample]
        samples = np.concatenate([centers, around])
        unobserved = samples[~free_space.contains(samples)]
        if _is_any_unknown(unobserved, p_WS[0], spheres.radius, geometries, scene.stamp):
            return "B"
    return ""


@compiled
def _is_any_approaching(
    p_WS: FloatArray, reach: FloatArray, dt: FloatArray, moving: CollisionGeometries, stamp: float
) -> bool:
    """Checks whether any of S spheres approaches a moving obstacle faster than 0.02 m/s although
    the obstacle may reach the sphere.

    Args:
        p_WS: (T, S, 3) centers of the spheres in the world [m].
        reach: (T - 1, S) radius around the center of each sphere at the end of each step [m]. An
            obstacle inside it at the time `stamp` may reach the sphere by the end of the step.
        dt: (T - 1,) durations of the steps [s].
        moving: collision geometries of moving obstacles.
        stamp: time at which the geometries are evaluated [s].
    """
    for k in range(len(dt)):
        for i in range(p_WS.shape[1]):
            x, y, z = p_WS[k + 1, i]
            distance = reach[k, i]
            for m in range(len(moving.ball)):
                if ball_bound(moving, m, x, y, z, stamp) < distance:
                    distance = min(distance, geometry_distance(moving, m, x, y, z, stamp))
            if distance < reach[k, i]:
                least, before = distance + _REST_SPEED * dt[k], p_WS[k, i : i + 1]
                if least_distances(moving, before, stamp, least, -1.0)[0] >= least:
                    return True
    return False


@compiled
def _is_any_unknown(
    samples: FloatArray,
    p_WS: FloatArray,
    radius: FloatArray,
    geometries: CollisionGeometries,
    stamp: float,
) -> bool:
    """Checks whether any of N unobserved sample points is more than 1 cm away from the arm and from
    all collision geometries.

    Args:
        samples: (N, 3) sample points in the world [m].
        p_WS, radius: (S, 3) centers in the world and (S,) radii of the arm's spheres [m].
        geometries: collision geometries of obstacles and environment.
        stamp: time at which the geometries are evaluated [s].
    """
    for i in range(len(samples)):
        x, y, z = samples[i]
        is_occupied = False
        for k in range(len(p_WS)):
            square = (x - p_WS[k, 0]) ** 2 + (y - p_WS[k, 1]) ** 2 + (z - p_WS[k, 2]) ** 2
            if square < (radius[k] + _OCCUPIED_MARGIN) ** 2:
                is_occupied = True
                break
        if (
            not is_occupied
            and least_distances(geometries, samples[i : i + 1], stamp, _OCCUPIED_MARGIN, -1.0)[0]
            >= _OCCUPIED_MARGIN
        ):
            return True
    return False
