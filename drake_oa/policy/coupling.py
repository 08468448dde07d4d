"""Coupling terms: turning the motion away from obstacles and toward a heading.

A coupling term C turns the scaled velocity z without pushing it: C = Omega x z
(eq. oa_main), where Omega is an angular rate per unit of normalised time
s = t / (tau T). Several terms add up (section III-C of the paper). Using z where
the paper writes the velocity makes the path independent of tau.

Signs. The P-plane is spanned by the way to the obstacle's centre, p_EO, and z. The
avoidance term turns about p_EO x z, the guidance term about z x v_d, both by the
right-hand rule: a positive rate turns away from the obstacle, or toward v_d. Where
these products vanish, the caller's plane normal stands in: a positive turn about it
goes from the obstacle's centre toward the side to pass on.

How one step turns is derived in docs/equations.md ("Integration"). The kernels pass vectors as
three scalars, so that nothing is allocated and everything can be inlined. A term is its axis,
its explicit turn over the step and the divisor of the linearly implicit composition; a divisor
of 0 says that it does not act.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray

GuidanceForm = Literal["counterphase", "printed"]

PARALLEL = 1e-9
"""Sine of the angle below which two directions count as parallel."""

MAX_GUIDANCE_RATE = 1000.0
"""Saturation of the printed guidance term [rad per normalised time]."""

P_WO, ALPHA, PSI, KAPPA, HEADING, NORMAL, GUIDANCE_ALPHA = 0, 3, 4, 5, 6, 9, 12
"""Columns of a row of terms; centre, heading and normal take three each."""
N_COLUMNS = 13
"""Number of columns of a row of terms."""

_MAX_STIFFNESS = 1e4
_MAX_EXPONENT = 700.0
_MAX_RATE = 1e300

Triple = tuple[float, float, float]
Term = tuple[float, float, float, float, float]
"""Axis (three components), explicit turn [rad], divisor (0: no term)."""


def original_rate(theta: ArrayLike, gamma: ArrayLike, beta: ArrayLike) -> FloatArray:
    """Hoffmann's turning rate, (eq. oa_original): gamma theta exp(-beta |theta|).

    Args:
        theta: heading relative to the obstacle's centre [rad], positive off to one side.
        gamma: strength [1 per time].
        beta: shape [1/rad].

    Returns:
        Turning rate [rad per time], positive away from the obstacle, broadcast.
    """
    theta = np.asarray(theta, dtype=float)
    return np.asarray(gamma * theta * np.exp(-np.multiply(beta, np.abs(theta))))


def dead_zone_free_rate(
    theta: ArrayLike, d: ArrayLike, alpha: ArrayLike, psi: ArrayLike, kappa: ArrayLike
) -> FloatArray:
    """Dead-zone free turning rate, (eq. oa_complete).

    alpha sign(theta) exp(-theta^2 / psi^2) exp(-kappa d^2), where sign(0) is 1: a
    heading straight at the obstacle turns fastest, and the plane says to which side.

    Args:
        theta: heading relative to the obstacle's centre [rad].
        d: distance to the obstacle's centre [m].
        alpha: strength [rad per time].
        psi: width of the reaction over the heading [rad].
        kappa: decay over the distance [1/m^2].

    Returns:
        Turning rate [rad per time], positive away from the obstacle, broadcast.
    """
    theta = np.asarray(theta, dtype=float)
    near = np.exp(-np.multiply(kappa, np.square(d)))
    return np.asarray(
        np.where(theta < 0.0, -1.0, 1.0) * alpha * np.exp(-np.square(theta / psi)) * near
    )


@compiled
def norm(x: float, y: float, z: float) -> float:
    """Length of a vector; neither overflows nor underflows on the way."""
    square = x * x + y * y + z * z
    if 1e-280 < square < 1e280:
        return math.sqrt(square)
    most = max(abs(x), abs(y), abs(z))
    if most == 0.0 or not most < math.inf:
        return most
    x, y, z = x / most, y / most, z / most
    return most * math.sqrt(x * x + y * y + z * z)


@compiled
def rotate(zx: float, zy: float, zz: float, wx: float, wy: float, wz: float) -> Triple:
    """z turned about the axis times angle w [rad] by Rodrigues' formula."""
    angle = norm(wx, wy, wz)
    if angle == 0.0:
        return zx, zy, zz
    half = math.sin(0.5 * angle)
    cos = 1.0 - 2.0 * half * half
    wx, wy, wz = wx / angle, wy / angle, wz / angle
    sin = math.sin(angle)
    along = (wx * zx + wy * zy + wz * zz) * 2.0 * half * half
    return (
        cos * zx + sin * (wy * zz - wz * zy) + along * wx,
        cos * zy + sin * (wz * zx - wx * zz) + along * wy,
        cos * zz + sin * (wx * zy - wy * zx) + along * wz,
    )


@compiled
def between(
    ax: float, ay: float, az: float, bx: float, by: float, bz: float
) -> tuple[float, float, float, float, bool]:
    """Axis and angle of the turn from unit a to unit b, and whether the axis is defined."""
    x = ay * bz - az * by
    y = az * bx - ax * bz
    z = ax * by - ay * bx
    sin = math.sqrt(x * x + y * y + z * z)
    cos = ax * bx + ay * by + az * bz
    if sin > PARALLEL:
        return x / sin, y / sin, z / sin, math.atan2(sin, cos), True
    return 0.0, 0.0, 0.0, 0.0 if cos > 0.0 else math.pi, False


@compiled
def between_in_plane(
    ax: float,
    ay: float,
    az: float,
    bx: float,
    by: float,
    bz: float,
    nx: float,
    ny: float,
    nz: float,
) -> tuple[float, float, float, float, bool]:
    """As `between`, with both seen along n, of any length: the axis is n or its opposite.

    It is n where they are parallel, and undefined where they are opposite or one of them
    is seen as a point.
    """
    size = norm(nx, ny, nz)
    nx, ny, nz = nx / size, ny / size, nz / size
    sine = nx * (ay * bz - az * by) + ny * (az * bx - ax * bz) + nz * (ax * by - ay * bx)
    a_n, b_n = ax * nx + ay * ny + az * nz, bx * nx + by * ny + bz * nz
    cosine = ax * bx + ay * by + az * bz - a_n * b_n
    if abs(sine) <= PARALLEL:
        return nx, ny, nz, 0.0 if cosine > PARALLEL else math.pi, cosine > PARALLEL
    if sine > 0.0:
        return nx, ny, nz, math.atan2(sine, cosine), True
    return -nx, -ny, -nz, math.atan2(-sine, cosine), True


@compiled
def _orthogonal(
    nx: float, ny: float, nz: float, ex: float, ey: float, ez: float
) -> tuple[float, float, float, float]:
    """The part of n orthogonal to the unit e, and its length."""
    along = nx * ex + ny * ey + nz * ez
    x, y, z = nx - along * ex, ny - along * ey, nz - along * ez
    return x, y, z, math.sqrt(x * x + y * y + z * z)


@compiled
def fallback(nx: float, ny: float, nz: float, ex: float, ey: float, ez: float) -> Triple:
    """The normal n made orthogonal to the unit heading e, or a definite stand-in."""
    size = norm(nx, ny, nz)
    if size > 0.0:
        x, y, z, length = _orthogonal(nx / size, ny / size, nz / size, ex, ey, ez)
        if length > 1e-3:
            return x / length, y / length, z / length
    x, y, z, length = _orthogonal(0.0, 0.0, 1.0, ex, ey, ez)
    if length > 1e-3:
        return x / length, y / length, z / length
    x, y, z, length = _orthogonal(1.0, 0.0, 0.0, ex, ey, ez)
    return x / length, y / length, z / length


@compiled
def stiff(explicit: float, angle: float) -> tuple[float, float]:
    """Explicit turn and divisor whose quotient is the angle, kept in a sound range."""
    if not angle > 0.0:
        return 0.0, 1.0
    divisor = min(max(explicit / angle, 1.0), _MAX_STIFFNESS)
    return angle * divisor, divisor


@compiled
def limited_avoidance(rate: float, theta: float, psi: float, step: float) -> tuple[float, float]:
    """Explicit turn and divisor of theta' = A exp(-theta^2 / psi^2), rate at theta >= 0."""
    c = min(rate * step / psi, 1e150)
    u = theta / psi
    if c < 1e-14:
        angle = rate * step
    else:
        grown = math.log1p(c * (2.0 * u + math.asinh(c / math.sqrt(1.0 + 2.0 * u * c))))
        angle = psi * grown / (u + math.sqrt(u * u + grown))
    return stiff(rate * step, min(angle, math.pi - theta))


@compiled
def limited_guidance(gain: float, theta: float, step: float, limit: float) -> tuple[float, float]:
    """Explicit turn and divisor of theta' = -min(gain theta, limit); gain > 0."""
    rate = min(gain * theta, limit)
    if rate < limit:
        angle = -theta * math.expm1(-gain * step)
    else:
        linear = theta - limit / gain
        rest = step - linear / limit
        angle = limit * step if rest <= 0.0 else linear - limit / gain * math.expm1(-gain * rest)
    return stiff(rate * step, angle)


@compiled
def guidance_gain(alpha: float, closeness: float, printed: bool) -> float:
    """Gain of the guidance term, its rate over its angle (eq. oa_rs), at closeness = kappa d^2.

    "counterphase": alpha (1 - exp(-kappa d^2)), bounded, vanishing at the obstacle. "printed":
    alpha exp(1 + kappa d^2), as the paper prints it; it grows without bound with d.
    """
    if printed:
        gain = alpha * math.exp(min(1.0 + closeness, _MAX_EXPONENT))
    else:
        gain = -alpha * math.expm1(-closeness)
    return min(gain, _MAX_RATE)


@compiled
def avoidance_term(
    ux: float,
    uy: float,
    uz: float,
    ex: float,
    ey: float,
    ez: float,
    nx: float,
    ny: float,
    nz: float,
    alpha: float,
    psi: float,
    closeness: float,
    in_plane: bool,
    step: float,
) -> Term:
    """Turn away from the obstacle, (eq. oa_complete).

    Args:
        ux, uy, uz: unit vector from E to the centre.
        ex, ey, ez: unit heading.
        nx, ny, nz: normal of the passing plane, of any length or zero.
        alpha, psi: parameters of the term.
        closeness: kappa d^2.
        in_plane: whether the term acts in the plane of that normal, if there is one.
        step: length of the step.
    """
    if in_plane and (nx != 0.0 or ny != 0.0 or nz != 0.0):
        ax, ay, az, theta, defined = between_in_plane(ux, uy, uz, ex, ey, ez, nx, ny, nz)
    else:
        ax, ay, az, theta, defined = between(ux, uy, uz, ex, ey, ez)
        if not defined and theta == 0.0:
            ax, ay, az = fallback(nx, ny, nz, ex, ey, ez)
            defined = True
    u = theta / psi
    rate = min(alpha * math.exp(-u * u - closeness), _MAX_RATE)
    if not defined or not rate > 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    explicit, divisor = limited_avoidance(rate, theta, psi, step)
    return ax, ay, az, explicit, divisor


@compiled
def guidance_term(
    vx: float,
    vy: float,
    vz: float,
    ex: float,
    ey: float,
    ez: float,
    nx: float,
    ny: float,
    nz: float,
    alpha: float,
    closeness: float,
    printed: bool,
    max_rate: float,
    step: float,
) -> Term:
    """Turn toward the desired heading v, not zero, of any length, (eq. oa_rs).

    The other arguments are those of `avoidance_term` and `turn_step`.
    """
    size = norm(vx, vy, vz)
    ax, ay, az, theta, defined = between(ex, ey, ez, vx / size, vy / size, vz / size)
    if not defined and theta > 0.0:
        ax, ay, az = fallback(nx, ny, nz, ex, ey, ez)
        defined = True
    gain = guidance_gain(alpha, closeness, printed)
    if not defined or not gain > 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    limit = max_rate if printed else math.inf
    explicit, divisor = limited_guidance(gain, theta, step, limit)
    return ax, ay, az, explicit, divisor


@compiled
def solve(
    xx: float,
    yy: float,
    zz: float,
    xy: float,
    xz: float,
    yz: float,
    x: float,
    y: float,
    z: float,
) -> Triple:
    """Solves the symmetric positive definite A w = (x, y, z) by L D L^T."""
    l1, l2 = xy / xx, xz / xx
    d2 = yy - l1 * xy
    m = yz - l1 * xz
    l3 = m / d2
    d3 = zz - l2 * xz - l3 * m
    y -= l1 * x
    z -= l2 * x + l3 * y
    z /= d3
    y = y / d2 - l3 * z
    x = x / xx - l1 * y - l2 * z
    return x, y, z


@compiled
def turn_step(
    terms: FloatArray,
    in_plane: bool,
    printed: bool,
    max_rate: float,
    px: float,
    py: float,
    pz: float,
    zx: float,
    zy: float,
    zz: float,
    step: float,
) -> Triple:
    """Turn of the heading over a step of normalised time.

    Linearly implicit in the sum of all terms, so that each term alone turns as far as its own
    exact flow does (within 2.5 %): never past the direction straight away from the obstacle,
    or past v_d, however large its rate. A turn is at most pi.

    Args:
        terms: (M, 13) rows p_WO (3), alpha, psi, kappa, heading (3), normal (3) and
            guidance alpha; finite, psi > 0, the other parameters not negative.
        in_plane: whether avoidance terms act in the planes of the normals.
        printed: the printed form of the guidance term, not the counterphase.
        max_rate: saturation of the printed form [rad per normalised time].
        px, py, pz: p_WE [m].
        zx, zy, zz: scaled velocity z_W [m].
        step: length of the step in normalised time, at least 0.

    Returns:
        Axis times angle [rad] in the world frame, for `rotate`.
    """
    speed = norm(zx, zy, zz)
    if not 0.0 < speed < math.inf:
        return 0.0, 0.0, 0.0
    ex, ey, ez = zx / speed, zy / speed, zz / speed
    xx = yy = zz_ = 1.0
    xy = xz = yz = x = y = z = 0.0
    ax = ay = az = explicit = divisor = 0.0
    count = 0
    for row in range(len(terms)):
        ox, oy, oz = terms[row, 0] - px, terms[row, 1] - py, terms[row, 2] - pz
        d = norm(ox, oy, oz)
        if not d < math.inf:
            continue
        alpha, psi, kappa = terms[row, ALPHA], terms[row, PSI], terms[row, KAPPA]
        guide = terms[row, GUIDANCE_ALPHA]
        nx, ny, nz = terms[row, NORMAL], terms[row, NORMAL + 1], terms[row, NORMAL + 2]
        vx, vy, vz = terms[row, HEADING], terms[row, HEADING + 1], terms[row, HEADING + 2]
        closeness = kappa * d * d if kappa != 0.0 else 0.0
        for guides in range(2):
            if guides:
                if not guide > 0.0 or (vx == 0.0 and vy == 0.0 and vz == 0.0):
                    continue
                term = guidance_term(
                    vx, vy, vz, ex, ey, ez, nx, ny, nz, guide, closeness, printed, max_rate, step
                )
            else:
                if not (d > 0.0 and alpha > 0.0):
                    continue
                ux, uy, uz = ox / d, oy / d, oz / d
                term = avoidance_term(
                    ux, uy, uz, ex, ey, ez, nx, ny, nz, alpha, psi, closeness, in_plane, step
                )
            if term[4] == 0.0:
                continue
            ax, ay, az, explicit, divisor = term
            q = divisor - 1.0
            xx += q * ax * ax
            yy += q * ay * ay
            zz_ += q * az * az
            xy += q * ax * ay
            xz += q * ax * az
            yz += q * ay * az
            x += explicit * ax
            y += explicit * ay
            z += explicit * az
            count += 1
    if count == 0:
        return 0.0, 0.0, 0.0
    if count == 1:
        angle = explicit / divisor
        return angle * ax, angle * ay, angle * az
    x, y, z = solve(xx, yy, zz_, xy, xz, yz, x, y, z)
    angle = norm(x, y, z)
    if angle > math.pi:
        shrink = math.pi / angle
        return shrink * x, shrink * y, shrink * z
    return x, y, z
