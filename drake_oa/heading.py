"""The desired heading v_d of the guidance term (eq. oa_rs).

The paper leaves open which heading leads the motion along a chosen direction
omega_d, and for how long. Here v_d is the heading along the line through E that
supports the obstacle at the asked clearance on the chosen side: the shortest way
past it. It is asked for only while the avoidance term would lead past another side.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from drake_oa.ellipsoid import shape_matrix, tangent_heading
from drake_oa.values import EllipsoidSet, FloatArray, PolicyState


def passing_normals(direction_W: FloatArray, R_WL: FloatArray) -> FloatArray:
    """Normals x_L x omega of the planes in which the obstacles are passed, (M, 3).

    Turning about one by the right-hand rule turns from the baseline toward the chosen
    direction omega, which is orthogonal to the baseline.
    """
    return _cross(np.broadcast_to(R_WL[:, 0], direction_W.shape), direction_W)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.stack(
        [
            a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1],
            a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2],
            a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0],
        ],
        axis=1,
    )


def desired_headings(
    policy: PolicyState,
    ellipsoids: EllipsoidSet,
    direction_W: FloatArray,
    normal_W: FloatArray,
    center_W: FloatArray,
    clearance: FloatArray,
) -> FloatArray:
    """v_d for each obstacle; a zero row where the heading needs no guidance.

    Guidance is needed where the motion is on its way into the obstacle's clearance and
    the avoidance term would turn it to another side than the chosen one: with e the way
    to the centre and u the heading, the P-plane's normal e x u then leans away from the
    normal of the passing plane. v_d goes over from u to the supporting heading as it
    leans by up to 30 degrees below the right angle.

    Args:
        policy: position, scaled velocity and goal of the motion.
        ellipsoids: the M obstacles, dilated by the tool.
        direction_W: (M, 3) chosen unit directions omega_d.
        normal_W: (M, 3) normals of the passing planes, see `passing_normals`.
        center_W: (M, 3) points that the avoidance terms act about [m].
        clearance: (M,) distance to keep [m].

    Returns:
        (M, 3) unit headings or zero rows, in the world frame.
    """
    if len(ellipsoids) == 0:
        return np.zeros((0, 3))
    share = wrong_sides(
        policy.p_WE,
        policy.z_W,
        policy.p_WG,
        policy.R_WL,
        center_W,
        normal_W,
        clearance,
        ellipsoids.p_WO,
        ellipsoids.R_WO,
        ellipsoids.semi_axes,
    )
    if not share.any():
        return np.zeros(normal_W.shape)
    speed = float(np.sqrt(policy.z_W @ policy.z_W))
    u = policy.z_W / speed if speed > 0.0 else policy.R_WL[:, 0]
    tangent, _, _ = tangent_heading(
        policy.p_WE,
        ellipsoids.p_WO,
        shape_matrix(ellipsoids.R_WO, ellipsoids.semi_axes),
        direction_W,
        clearance,
    )
    heading = u + share[:, None] * (tangent - u)
    length = np.sqrt(np.sum(heading * heading, axis=1))
    usable = (share > 0.0) & (length > 0.0)
    return np.where(usable[:, None], heading / np.where(usable, length, 1.0)[:, None], 0.0)


@njit(cache=True, error_model="numpy")
def wrong_sides(
    p_WE: FloatArray,
    z_W: FloatArray,
    p_WG: FloatArray,
    R_WL: FloatArray,
    center_W: FloatArray,
    normal_W: FloatArray,
    clearance: FloatArray,
    p_WO: FloatArray,
    R_WO: FloatArray,
    semi_axes: FloatArray,
) -> FloatArray:
    """How far each obstacle's guidance has gone over from u to the supporting heading, (M,).

    0 where none is needed: the motion leans to the chosen side, the obstacle has no
    clearance to keep, or the ray along u does not enter the ellipsoid grown by it before
    it comes to the goal. At rest u is the baseline: the motion is about to set out along it.
    """
    u = z_W.copy()
    speed = np.sqrt(u[0] ** 2 + u[1] ** 2 + u[2] ** 2)
    for k in range(3):
        u[k] = u[k] / speed if speed > 0.0 else R_WL[k, 0]
    to_G = p_WG - p_WE
    distance_G = np.sqrt(to_G[0] ** 2 + to_G[1] ** 2 + to_G[2] ** 2)
    share = np.zeros(len(center_W))
    for row in range(len(center_W)):
        e = center_W[row] - p_WE
        plane = np.array(
            (e[1] * u[2] - e[2] * u[1], e[2] * u[0] - e[0] * u[2], e[0] * u[1] - e[1] * u[0])
        )
        size = np.sqrt(plane[0] ** 2 + plane[1] ** 2 + plane[2] ** 2)
        lean = 0.0
        for k in range(3):
            lean -= plane[k] * normal_W[row, k]
        if clearance[row] > 0.0 and lean > 1e-9 * size:
            axes = semi_axes[row] + clearance[row]
            if _ray_entry(p_WE - p_WO[row], u, R_WO[row], axes) < distance_G:
                share[row] = min(2.0 * lean / size, 1.0)
    return share


@njit(cache=True, error_model="numpy")
def _ray_entry(p_OE: FloatArray, u: FloatArray, R: FloatArray, axes: FloatArray) -> float:
    """How far along u the ray from E meets an ellipsoid; inf where it misses it."""
    a, b, c = 0.0, 0.0, -1.0
    for axis in range(3):
        p, w = 0.0, 0.0
        for k in range(3):
            p += R[k, axis] * p_OE[k]
            w += R[k, axis] * u[k]
        p, w = p / axes[axis], w / axes[axis]
        a += w * w
        b += p * w
        c += p * p
    discriminant = b * b - a * c
    if discriminant <= 0.0 or b >= 0.0:
        return np.inf
    return max((-b - np.sqrt(discriminant)) / a, 0.0)
