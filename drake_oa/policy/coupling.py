"""Coupling terms: turning the motion away from obstacles and toward a heading.

A coupling term C turns the scaled velocity z without pushing it: C = Omega x z
(eq. 6), where Omega is an angular rate per unit of normalised time
s = t / (tau T). Several terms add up (section III-C of the paper). Using z where
the paper writes the velocity makes the path independent of tau.

Signs. The P-plane is spanned by the way to the obstacle's centre, p_EO, and z. The
avoidance term turns about p_EO x z, the guidance term about z x v_d, both by the
right-hand rule: a positive rate turns away from the obstacle, or toward v_d. Where
these products vanish, the caller's plane normal stands in: a positive turn about it
goes from the obstacle's centre toward the side to pass on.

How one step turns is derived in docs/equations.md ("Integration"). The kernels pass vectors as
triples, so that nothing is allocated and everything can be inlined. A term is its axis, its
explicit turn over the step and the divisor of the linearly implicit composition; a divisor of 0
says that it does not act.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from drake_oa.common.compiled import compiled, leaf
from drake_oa.common.messages import FloatArray

PARALLEL = 1e-6
"""Sine of the angle below which two directions count as parallel.

An imitated motion may begin with a little step back: where its heading passes through none there
is nothing but rounding to it, which must not choose the side."""

MAX_GUIDANCE_RATE = 1000.0
"""Saturation of the printed guidance term [rad per normalised time]."""

ALPHA, PSI, KAPPA, HEADING, NORMAL, GUIDANCE_ALPHA = 3, 4, 5, 6, 9, 12
"""Columns of a row of terms after its centre; heading and normal take three each."""
N_COLUMNS = 13
"""Number of columns of a row of terms."""

_MAX_STIFFNESS = 1e4
_MAX_EXPONENT = 700.0
_MAX_RATE = 1e300
_NEGLIGIBLE = 1e-15
"""Largest turn of an avoidance term in a step that is left out [rad]."""

Triple = tuple[float, float, float]
Term = tuple[Triple, float, float]
"""Axis, explicit turn [rad], divisor (0: no term)."""
_ABSENT = (0.0, 0.0, 0.0), 0.0, 0.0


def original_rate(theta: ArrayLike, gamma: ArrayLike, beta: ArrayLike) -> FloatArray:
    """Hoffmann's turning rate, (eq. 7): gamma theta exp(-beta |theta|).

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
    """Dead-zone free turning rate, (eq. 8).

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
def norm(v: Triple) -> float:
    """Length of a vector; neither overflows nor underflows on the way."""
    x, y, z = v
    square = x * x + y * y + z * z
    if 1e-280 < square < 1e280:
        return math.sqrt(square)
    most = max(abs(x), abs(y), abs(z))
    if most == 0.0 or not most < math.inf:
        return most
    x, y, z = x / most, y / most, z / most
    return most * math.sqrt(x * x + y * y + z * z)


@compiled
def _dot(a: Triple, b: Triple) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def _cross(a: Triple, b: Triple) -> Triple:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def _divided(v: Triple, by: float) -> Triple:
    return v[0] / by, v[1] / by, v[2] / by


@compiled
def rotate(z: Triple, w: Triple) -> Triple:
    """z turned about the axis times angle w [rad] by Rodrigues' formula."""
    angle = norm(w)
    if angle == 0.0:
        return z
    half = math.sin(0.5 * angle)
    cos = 1.0 - 2.0 * half * half
    axis = _divided(w, angle)
    sin = 2.0 * half * math.cos(0.5 * angle)
    along = _dot(axis, z) * 2.0 * half * half
    across = _cross(axis, z)
    return (
        cos * z[0] + sin * across[0] + along * axis[0],
        cos * z[1] + sin * across[1] + along * axis[1],
        cos * z[2] + sin * across[2] + along * axis[2],
    )


@compiled
def between(a: Triple, b: Triple) -> tuple[Triple, float, bool]:
    """Axis and angle of the turn from unit a to unit b, and whether the axis is defined."""
    across = _cross(a, b)
    sin, cos = math.sqrt(_dot(across, across)), _dot(a, b)
    if sin > PARALLEL:
        return _divided(across, sin), math.atan2(sin, cos), True
    return (0.0, 0.0, 0.0), 0.0 if cos > 0.0 else math.pi, False


@compiled
def between_in_plane(a: Triple, b: Triple, normal: Triple) -> tuple[Triple, float, bool]:
    """As `between`, with both seen along a normal of any length: the axis is it or its opposite.

    It is the normal where they are parallel, and undefined where they are opposite or one of
    them is seen as a point.
    """
    n = _divided(normal, norm(normal))
    sine, cosine = _dot(n, _cross(a, b)), _dot(a, b) - _dot(a, n) * _dot(b, n)
    if abs(sine) <= PARALLEL:
        return n, 0.0 if cosine > PARALLEL else math.pi, cosine > PARALLEL
    if sine > 0.0:
        return n, math.atan2(sine, cosine), True
    return (-n[0], -n[1], -n[2]), math.atan2(-sine, cosine), True


@compiled
def _orthogonal(n: Triple, e: Triple) -> tuple[Triple, float]:
    """The part of n orthogonal to the unit e, and its length."""
    along = _dot(n, e)
    part = n[0] - along * e[0], n[1] - along * e[1], n[2] - along * e[2]
    return part, math.sqrt(_dot(part, part))


@compiled
def fallback(normal: Triple, e: Triple) -> Triple:
    """The normal made orthogonal to the unit heading e, or a definite stand-in."""
    size = norm(normal)
    if size > 0.0:
        part, length = _orthogonal(_divided(normal, size), e)
        if length > 1e-3:
            return _divided(part, length)
    part, length = _orthogonal((0.0, 0.0, 1.0), e)
    if length > 1e-3:
        return _divided(part, length)
    part, length = _orthogonal((1.0, 0.0, 0.0), e)
    return _divided(part, length)


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
        x = c / math.sqrt(1.0 + 2.0 * u * c)
        # Faster than math.asinh.
        asinh = math.log1p(x + x * x / (1.0 + math.sqrt(x * x + 1.0)))
        grown = math.log1p(c * (2.0 * u + asinh))
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
    """Gain of the guidance term, its rate over its angle (eq. 9), at closeness = kappa d^2.

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
    u: Triple,
    e: Triple,
    normal: Triple,
    alpha: float,
    psi: float,
    closeness: float,
    in_plane: bool,
    original: bool,
    step: float,
) -> Term:
    """Turn away from the obstacle, (eq. 8) or (eq. 7).

    Args:
        u: unit vector from E to the centre.
        e: unit heading.
        normal: of the passing plane, of any length or zero.
        alpha, psi: parameters of the term; of the original one gamma and 1 / beta.
        closeness: kappa d^2.
        in_plane: whether the term acts in the plane of that normal, if there is one.
        original: whether it is the original term.
        step: length of the step.
    """
    near = alpha if original else alpha * math.exp(-closeness)
    if near * step < _NEGLIGIBLE:
        return _ABSENT
    if in_plane and (normal[0] != 0.0 or normal[1] != 0.0 or normal[2] != 0.0):
        axis, theta, defined = between_in_plane(u, e, normal)
    else:
        axis, theta, defined = between(u, e)
        if not defined and theta == 0.0:
            axis, defined = fallback(normal, e), True
    u_psi = theta / psi
    if original:
        rate = min(alpha * theta * math.exp(-u_psi), _MAX_RATE)
    else:
        rate = min(near * math.exp(-u_psi * u_psi), _MAX_RATE)
    if not defined or not rate > 0.0:
        return _ABSENT
    if original:
        explicit, divisor = stiff(rate * step, min(rate * step, math.pi - theta))
    else:
        explicit, divisor = limited_avoidance(rate, theta, psi, step)
    return axis, explicit, divisor


@compiled
def guidance_term(
    v: Triple,
    e: Triple,
    normal: Triple,
    alpha: float,
    closeness: float,
    printed: bool,
    max_rate: float,
    step: float,
) -> Term:
    """Turn toward the desired heading v, not zero, of any length, (eq. 9).

    The other arguments are those of `avoidance_term` and `turn_step`.
    """
    axis, theta, defined = between(e, _divided(v, norm(v)))
    if not defined and theta > 0.0:
        axis, defined = fallback(normal, e), True
    gain = guidance_gain(alpha, closeness, printed)
    if not defined or not gain > 0.0:
        return _ABSENT
    limit = max_rate if printed else math.inf
    explicit, divisor = limited_guidance(gain, theta, step, limit)
    return axis, explicit, divisor


@compiled
def _solve(diagonal: Triple, off: Triple, b: Triple) -> Triple:
    """w of the symmetric positive definite A w = b by L D L^T; A's xx, yy, zz and xy, xz, yz."""
    (xx, yy, zz), (xy, xz, yz), (x, y, z) = diagonal, off, b
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


@leaf
def turn_step(
    terms: FloatArray,
    in_plane: bool,
    original: bool,
    printed: bool,
    max_rate: float,
    p: Triple,
    z: Triple,
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
        original: whether they are the original ones.
        printed: the printed form of the guidance term, not the counterphase.
        max_rate: saturation of the printed form [rad per normalised time].
        p: p_WE [m].
        z: scaled velocity z_W [m].
        step: length of the step in normalised time, at least 0.

    Returns:
        Axis times angle [rad] in the world frame, for `rotate`.
    """
    speed = norm(z)
    if not 0.0 < speed < math.inf:
        return 0.0, 0.0, 0.0
    e = _divided(z, speed)
    xx = yy = zz = 1.0
    xy = xz = yz = wx = wy = wz = 0.0
    axis, explicit, divisor = _ABSENT
    count = 0
    for row in range(len(terms)):
        o = terms[row, 0] - p[0], terms[row, 1] - p[1], terms[row, 2] - p[2]
        d = norm(o)
        if not d < math.inf:
            continue
        alpha, psi, kappa = terms[row, ALPHA], terms[row, PSI], terms[row, KAPPA]
        guide = terms[row, GUIDANCE_ALPHA]
        normal = terms[row, NORMAL], terms[row, NORMAL + 1], terms[row, NORMAL + 2]
        v = terms[row, HEADING], terms[row, HEADING + 1], terms[row, HEADING + 2]
        closeness = kappa * d * d if kappa != 0.0 else 0.0
        for guides in range(2):
            if guides:
                if not guide > 0.0 or (v[0] == 0.0 and v[1] == 0.0 and v[2] == 0.0):
                    continue
                term = guidance_term(v, e, normal, guide, closeness, printed, max_rate, step)
            else:
                if not (d > 0.0 and alpha > 0.0):
                    continue
                u = _divided(o, d)
                term = avoidance_term(u, e, normal, alpha, psi, closeness, in_plane, original, step)
            if term[2] == 0.0:
                continue
            axis, explicit, divisor = term
            ax, ay, az = axis
            q = divisor - 1.0
            xx += q * ax * ax
            yy += q * ay * ay
            zz += q * az * az
            xy += q * ax * ay
            xz += q * ax * az
            yz += q * ay * az
            wx += explicit * ax
            wy += explicit * ay
            wz += explicit * az
            count += 1
    if count == 0:
        return 0.0, 0.0, 0.0
    if count == 1:
        angle = explicit / divisor
        return angle * axis[0], angle * axis[1], angle * axis[2]
    w = _solve((xx, yy, zz), (xy, xz, yz), (wx, wy, wz))
    angle = norm(w)
    if angle > math.pi:
        shrink = math.pi / angle
        return shrink * w[0], shrink * w[1], shrink * w[2]
    return w
