"""Passive motion safety: claims that limit how fast the arm may move, by the last observation.

The arm follows a motion for one period and brakes after that. Its points are the centers c_i of
enclosing spheres of radius r_i, with velocities u_i; the observation has the stamp s, and

    rho_i(t) = r_i + V (t - s)

is the distance from c_i(t) within which anything slower than V that was outside at s may touch the
point. With d_i the distance of c_i to the obstacles that moved at s, where they were then, a motion
violates

    (A)  if d_i(t) <= rho_i(t) and d_i(t) decreases by more than 0.02 m/s
    (B)  if u_i(t) . n > v_unseen for a direction n in which a place within rho_i(t) of c_i(t) was
         neither seen free at s nor taken by a known solid or by the arm

at some instant until the arm rests. Hence a point that an obstacle slower than V may reach is at
rest or moves away, and nothing is run into faster than v_unseen in space that no camera has seen. A
place is seen free if it is nearer than the depth of its pixel in an image; a pixel without depth
tells nothing. The places are the center of the ball of radius rho_i, and 26 directions at half and
at full radius.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray
from drake_oa.geometry.collision_scene import CollisionGeometries, CollisionScene, least_distances
from drake_oa.geometry.directions import DIRECTIONS
from drake_oa.perception.depth_perception import FreeSpace
from drake_oa.robot.arm import Chain, Spheres
from drake_oa.robot.spheres import sphere_centers

Claim = Literal["", "A", "B"]
CLAIMS: tuple[Claim, ...] = get_args(Claim)

_AT_REST = 0.02
"""Speed of approach at which a point counts as at rest [m/s]."""
_SKIN = 0.01
"""Distance up to which a place counts as taken by a solid or by the arm [m]."""
_PLACES = np.vstack([0.5 * DIRECTIONS, DIRECTIONS])
"""(52, 3) places in the unit ball, other than its center."""
_SHARE = np.linalg.norm(_PLACES, axis=1)
"""(52,) their distances from it."""


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
) -> Claim:
    """Finds the first of the claims (A) and (B) that a motion violates; "": it violates none.

    Args:
        chain, spheres: the arm.
        t: (T,) times of the motion until it rests, increasing [s].
        q: (T, n) configurations then [rad].
        scene: collision geometry of everything else, as observed.
        free_space: the space that was seen free; None: all space outside the solids.
        V: maximum speed of obstacles [m/s].
        v_unseen: maximum speed toward space that was not seen [m/s].
    """
    geometries = scene.geometries
    p_WS = sphere_centers(chain, spheres, np.ascontiguousarray(q))
    dt = np.diff(t)[:, None]
    reach = spheres.radius + V * (t[:-1] - scene.stamp)[:, None]
    if scene.moves:
        moving, points = geometries.select(geometries.moving), p_WS.reshape(-1, 3)
        d = least_distances(moving, points, scene.stamp, (reach + V * dt).max(), -1.0)
        d = d.reshape(p_WS.shape[:2])
        # Within a step the reach grows while the distance falls: the worst is its end.
        if ((d[1:] < reach + V * dt) & (d[:-1] - d[1:] > _AT_REST * dt)).any():
            return "A"
    if free_space is None:
        return ""
    v_WS = np.diff(p_WS, axis=0) / dt[..., None]
    is_fast = (v_WS**2).sum(axis=2) > v_unseen**2
    centers, rho = p_WS[:-1][is_fast], reach[is_fast]
    point, place = (v_WS[is_fast] @ _PLACES.T > v_unseen * _SHARE).nonzero()
    places = np.concatenate([centers, centers[point] + rho[point, None] * _PLACES[place]])
    unseen = places[~free_space.contains(places)]
    is_open = _is_any_open(unseen, p_WS[0], spheres.radius, geometries, scene.stamp)
    return "B" if is_open else ""


@compiled
def _is_any_open(
    places: FloatArray,
    p_WS: FloatArray,
    radius: FloatArray,
    geometries: CollisionGeometries,
    stamp: float,
) -> bool:
    """Checks whether any place (N, 3) is outside the spheres p_WS (S, 3), (S,) and the solids."""
    for i in range(len(places)):
        x, y, z = places[i]
        is_taken = False
        for k in range(len(p_WS)):
            square = (x - p_WS[k, 0]) ** 2 + (y - p_WS[k, 1]) ** 2 + (z - p_WS[k, 2]) ** 2
            if square < (radius[k] + _SKIN) ** 2:
                is_taken = True
                break
        if (
            not is_taken
            and least_distances(geometries, places[i : i + 1], stamp, _SKIN, -1.0)[0] >= _SKIN
        ):
            return True
    return False
