"""The section of an arm nearest to an obstacle, and how it is turned away, compiled.

`drake_oa.posture.null_space_coupling` calls them. Arrays as `drake_oa.robot.arm_kernels` takes
them.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from drake_oa.common.messages import FloatArray, IntArray
from drake_oa.geometry.primitives import point_distance, posed, to_frame
from drake_oa.policy.coupling_kernels import avoidance_term, norm
from drake_oa.robot.arm_kernels import nearest_point

_AT_REST = 1e-6
"""Speeds below this have no direction [m/s]."""
_FADES = 0.2
"""Cosine of the heading from which on the reaction fades to that of no approach, 0."""


@njit(cache=True, error_model="numpy")
def nearest_section(
    X_WB: FloatArray,
    body_sphere: FloatArray,
    shape_body: IntArray,
    X_BG: FloatArray,
    size: FloatArray,
    bound: FloatArray,
    points: FloatArray,
    block_start: IntArray,
    block_owner: IntArray,
    block_sphere: FloatArray,
    v_WO: FloatArray,
    age: float,
    only: int,
    limit: float,
    p_WS: FloatArray,
    u_W: FloatArray,
) -> tuple[float, int]:
    """The point S of an arm's shapes that is nearest to an obstacle.

    Args:
        X_WB, ..., limit: as of `arm_kernels.nearest_point`; `only` is an obstacle's row.
        p_WS: (3,) receives S in the world [m].
        u_W: (3,) receives the unit direction from there to the obstacle.

    Returns:
        The distance [m], negative inside, and the body; the limit and -1 where all of the
        obstacle is farther away.
    """
    distance, shape, owner, row = nearest_point(
        X_WB, body_sphere, shape_body, X_BG, size, bound, points, block_start, block_owner,
        block_sphere, v_WO, age, only, limit,
    )  # fmt: skip
    if shape < 0:
        return limit, -1
    body = shape_body[shape]
    X_WG = np.empty((3, 4))
    posed(X_WB[body], X_BG[shape], X_WG)
    p_WQ = np.empty(3)
    for i in range(3):
        p_WQ[i] = points[row, i] + v_WO[owner, i] * age
    x, y, z = to_frame(X_WG, p_WQ[0] - X_WG[0, 3], p_WQ[1] - X_WG[1, 3], p_WQ[2] - X_WG[2, 3])
    _, ux, uy, uz = point_distance(x, y, z, size[shape])
    for i in range(3):
        u_W[i] = X_WG[i, 0] * ux + X_WG[i, 1] * uy + X_WG[i, 2] * uz
        p_WS[i] = p_WQ[i] - distance * u_W[i]
    return distance, body


@njit(cache=True, error_model="numpy")
def point_jacobian(X_WB: FloatArray, body: int, p_WS: FloatArray, J: FloatArray) -> None:
    """Jacobian of the velocity of a body's point.

    Args:
        X_WB: (n + 1, 4, 4) as `arm_kernels.poses` leaves them.
        body: the body's row.
        p_WS: (3,) the point in the world [m].
        J: (3, n) receives it.
    """
    for i in range(J.shape[1]):
        if i > body:
            J[0, i], J[1, i], J[2, i] = 0.0, 0.0, 0.0
            continue
        ax, ay, az = X_WB[i, 0, 2], X_WB[i, 1, 2], X_WB[i, 2, 2]
        rx, ry, rz = p_WS[0] - X_WB[i, 0, 3], p_WS[1] - X_WB[i, 1, 3], p_WS[2] - X_WB[i, 2, 3]
        J[0, i], J[1, i], J[2, i] = ay * rz - az * ry, az * rx - ax * rz, ax * ry - ay * rx


@njit(cache=True, error_model="numpy")
def turned_away(
    v_W: FloatArray,
    u_W: FloatArray,
    distance: float,
    alpha: float,
    psi: float,
    kappa: float,
    step: float,
    a_W: FloatArray,
) -> None:
    """The acceleration Omega x v that turns a point away from what is nearest to it.

    Args:
        v_W: (3,) its velocity relative to the obstacle's [m/s].
        u_W: (3,) unit direction to the obstacle.
        distance: to its surface [m].
        alpha, psi, kappa: of (eq. oa_complete) [rad/s, rad, 1/m^2].
        step: how long the acceleration is held [s]; in it the heading does not turn past
            the direction straight away.
        a_W: (3,) receives it [m/s^2].
    """
    a_W[:] = 0.0
    speed = norm(v_W[0], v_W[1], v_W[2])
    if not speed > _AT_REST:
        return
    ex, ey, ez = v_W[0] / speed, v_W[1] / speed, v_W[2] / speed
    toward = ex * u_W[0] + ey * u_W[1] + ez * u_W[2]
    if toward <= 0.0:
        return
    near = max(distance, 0.0)
    ax, ay, az, explicit, divisor = avoidance_term(
        u_W[0], u_W[1], u_W[2], ex, ey, ez, 0.0, 0.0, 0.0,
        alpha, psi, kappa * near * near, False, step,
    )  # fmt: skip
    if divisor == 0.0:
        return
    # It ends with the approach, and without a jump.
    rate = min(toward / _FADES, 1.0) * explicit / divisor / step
    a_W[0] = rate * (ay * v_W[2] - az * v_W[1])
    a_W[1] = rate * (az * v_W[0] - ax * v_W[2])
    a_W[2] = rate * (ax * v_W[1] - ay * v_W[0])
