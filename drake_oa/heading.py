"""The desired heading v_d of the guidance term (eq. oa_rs).

The paper leaves open which heading leads the motion along a chosen direction
omega_d, and for how long. Here v_d is the heading along the line through E that
supports the obstacle at the asked clearance on the chosen side: the shortest way
past it. It is asked for only while the avoidance term would lead past another side.
"""

from __future__ import annotations

import numpy as np

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
    p_WE = policy.p_WE
    to_G = policy.p_WG - p_WE
    distance_G = float(np.sqrt(to_G @ to_G))
    speed = float(np.sqrt(policy.z_W @ policy.z_W))
    # At rest the motion is about to set out along the baseline.
    u = policy.z_W / speed if speed > 0.0 else policy.R_WL[:, 0]

    to_center = center_W - p_WE
    # (e x u) . n of each obstacle, up to the length of e.
    lean = -np.sum(to_center * _cross(np.broadcast_to(u, normal_W.shape), normal_W), axis=1)
    if lean.max() <= 0.0:
        return np.zeros(normal_W.shape)
    plane = _cross(to_center, np.broadcast_to(u, normal_W.shape))
    size = np.sqrt(np.sum(plane * plane, axis=1))
    wrong = (lean > 1e-9 * size) & (clearance > 0.0)
    if not wrong.any():
        return np.zeros(normal_W.shape)
    wrong &= _ray_entry(p_WE, u, ellipsoids, clearance) < distance_G
    if not wrong.any():
        return np.zeros(normal_W.shape)
    tangent, _, _ = tangent_heading(
        p_WE,
        ellipsoids.p_WO,
        shape_matrix(ellipsoids.R_WO, ellipsoids.semi_axes),
        direction_W,
        clearance,
    )
    share = np.where(wrong, np.minimum(2.0 * lean / np.maximum(size, 1e-300), 1.0), 0.0)
    heading = u + share[:, None] * (tangent - u)
    length = np.sqrt(np.sum(heading * heading, axis=1))
    usable = wrong & (length > 0.0)
    return np.where(usable[:, None], heading / np.where(usable, length, 1.0)[:, None], 0.0)


def _ray_entry(
    p_WE: FloatArray, u: FloatArray, ellipsoids: EllipsoidSet, clearance: FloatArray
) -> FloatArray:
    """How far along u the ray from E meets each ellipsoid grown by the clearance, (M,) [m].

    Infinite where it misses or leads away.
    """
    axes = ellipsoids.semi_axes + clearance[:, None]
    p = np.einsum("mji,mj->mi", ellipsoids.R_WO, p_WE - ellipsoids.p_WO) / axes
    w = np.einsum("mji,j->mi", ellipsoids.R_WO, u) / axes
    a = np.sum(w * w, axis=1)
    b = np.sum(p * w, axis=1)
    c = np.sum(p * p, axis=1) - 1.0
    disc = b * b - a * c
    meets = (disc > 0.0) & (b < 0.0)
    root = np.sqrt(np.where(meets, disc, 0.0))
    return np.where(meets, np.maximum((-b - root) / a, 0.0), np.inf)
