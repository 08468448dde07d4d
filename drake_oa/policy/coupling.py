"""Coupling terms: turning the motion away from obstacles and toward a heading.

A coupling term C turns the scaled velocity z without pushing it: C = Omega x z
(eq. 6), where Omega is an angular rate per unit of normalized time
s = t / (tau T). Several terms add up (section III-C of the paper). Using z where
the paper writes the velocity makes the path independent of tau.

Signs. The P-plane is spanned by the way to the obstacle's center, p_EO, and z, or is given by its
normal. The avoidance term turns about p_EO x z, the guidance term about z x v_d, both by the
right-hand rule: a positive rate turns away from the obstacle, or toward v_d. Where
these products vanish, the normal of the plane stands in: a positive turn about it
goes from the obstacle's center toward the side to pass on.

How one step turns is derived in docs/equations.md ("Integration"). The kernels pass vectors as
triples, so that nothing is allocated and everything can be inlined. A term is its axis, its turn
over the step alone, and its rate times the step; a turn of 0 says that it does not act.
"""

from __future__ import annotations

import math

import numpy as np

from drake_oa.common.compiled import compiled, leaf
from drake_oa.common.messages import FloatArray

PARALLEL = 1e-6
"""Sine of the angle below which two directions count as parallel.

An imitated motion may begin with a little step back: where its heading passes through none there
is nothing but rounding to it, which must not choose the side."""

ALPHA, PSI, KAPPA, HEADING, NORMAL = 3, 4, 5, 6, 9
"""Columns of a row of terms after its center; heading and normal have three each."""
N_COLUMNS = 12
"""Number of columns of a row of terms."""

_MAX_STIFFNESS = 1e4
_NEGLIGIBLE = 1e-15
"""Largest turn of an avoidance term in a step that is left out [rad]."""

Triple = tuple[float, float, float]
Term = tuple[Triple, float, float]
"""Axis, turn over the step alone [rad] (0: no term), and rate times the step [rad]."""
_ABSENT = (0.0, 0.0, 0.0), 0.0, 0.0


def original_rate(theta: FloatArray, gamma: FloatArray, beta: FloatArray) -> FloatArray:
    """Hoffmann's turning rate, (eq. 7): gamma theta exp(-beta |theta|).

    Args:
        theta: heading relative to the obstacle's center [rad], positive off to one side.
        gamma: strength [1 per time].
        beta: shape [1/rad].

    Returns:
        Turning rate [rad per time], positive away from the obstacle, broadcast.
    """
    return gamma * theta * np.exp(-beta * np.abs(theta))


def dead_zone_free_rate(
    theta: FloatArray, d: FloatArray, alpha: FloatArray, psi: FloatArray, kappa: FloatArray
) -> FloatArray:
    """Dead-zone free turning rate, (eq. 8).

    alpha sign(theta) exp(-theta^2 / psi^2) exp(-kappa d^2), where sign(0) is 1: a
    heading straight at the obstacle turns fastest, and the plane says to which side.

    Args:
        theta: heading relative to the obstacle's center [rad].
        d: distance to the obstacle's center [m].
        alpha: strength [rad per time].
        psi: width of the reaction over the heading [rad].
        kappa: decay over the distance [1/m^2].

    Returns:
        Turning rate [rad per time], positive away from the obstacle, broadcast.
    """
    return np.copysign(alpha, theta) * np.exp(-((theta / psi) ** 2) - kappa * d**2)


@compiled
def dot(a: Triple, b: Triple) -> float:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def cross(a: Triple, b: Triple) -> Triple:
    """Vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def norm(v: Triple) -> float:
    """Length of a vector."""
    return math.sqrt(dot(v, v))


@compiled
def mixed(a: float, v: Triple, b: float, w: Triple) -> Triple:
    """Linear combination a v + b w."""
    return a * v[0] + b * w[0], a * v[1] + b * w[1], a * v[2] + b * w[2]


@compiled
def scaled(a: float, v: Triple) -> Triple:
    """Multiple a v."""
    return a * v[0], a * v[1], a * v[2]


@compiled
def triple(array: FloatArray, row: int, column: int = 0) -> Triple:
    """Vector in a row of an array, from a column on."""
    return array[row, column], array[row, column + 1], array[row, column + 2]


@compiled
def rotate(z: Triple, w: Triple) -> Triple:
    """z turned about the axis times angle w [rad] by Rodrigues' formula."""
    angle = norm(w)
    if angle == 0.0:
        return z
    axis = scaled(1.0 / angle, w)
    half = math.sin(0.5 * angle)
    versine = 2.0 * half * half
    turned = mixed(1.0 - versine, z, 2.0 * half * math.cos(0.5 * angle), cross(axis, z))
    return mixed(1.0, turned, versine * dot(axis, z), axis)


@compiled
def between(a: Triple, b: Triple) -> tuple[Triple, float, bool]:
    """Axis and angle of the turn from unit a to unit b, and whether the axis is defined."""
    across, cosine = cross(a, b), dot(a, b)
    sine = norm(across)
    if sine > PARALLEL:
        return scaled(1.0 / sine, across), math.atan2(sine, cosine), True
    return across, 0.0 if cosine > 0.0 else math.pi, False


@compiled
def between_in_plane(a: Triple, b: Triple, n: Triple) -> tuple[Triple, float, bool]:
    """As `between`, with both seen along a unit normal: the axis is it or its opposite.

    It is the normal where they are parallel, and undefined where they are opposite or one of
    them is seen as a point.
    """
    sine, cosine = dot(n, cross(a, b)), dot(a, b) - dot(a, n) * dot(b, n)
    if abs(sine) <= PARALLEL:
        return n, 0.0 if cosine > PARALLEL else math.pi, cosine > PARALLEL
    return scaled(math.copysign(1.0, sine), n), math.atan2(abs(sine), cosine), True


@compiled
def orthogonal(n: Triple, e: Triple) -> Triple:
    """Unit vector along the part of n that is orthogonal to the unit e, or a definite stand-in."""
    part = mixed(1.0, n, -dot(n, e), e)
    if norm(part) <= 1e-3 * norm(n):
        part = mixed(1.0, (0.0, 0.0, 1.0), -e[2], e)
        if norm(part) <= 1e-3:
            part = mixed(1.0, (1.0, 0.0, 0.0), -e[0], e)
    return scaled(1.0 / norm(part), part)


@compiled
def avoidance_turn(rate: float, theta: float, psi: float, step: float) -> float:
    """Turn over a step of theta' = A exp(-theta^2 / psi^2), rate at theta >= 0 [rad]."""
    c, u = rate * step / psi, theta / psi
    if c < 1e-14:
        return rate * step
    x = c / math.sqrt(1.0 + 2.0 * u * c)
    # Faster than math.asinh.
    asinh = math.log1p(x + x * x / (1.0 + math.sqrt(x * x + 1.0)))
    grown = math.log1p(c * (2.0 * u + asinh))
    return min(psi * grown / (u + math.sqrt(u * u + grown)), math.pi - theta)


@compiled
def avoidance_term(
    o: Triple, e: Triple, normal: Triple, alpha: float, psi: float, kappa: float, step: float
) -> Term:
    """Turn away from the obstacle, (eq. 8).

    Args:
        o: vector from E to the center [m].
        e: unit heading.
        normal: of the plane in which the term acts, of any length; zero: the P-plane.
        alpha, psi, kappa: parameters of the term.
        step: length of the step.
    """
    d, size = norm(o), norm(normal)
    near = alpha * math.exp(-kappa * d * d)
    if d == 0.0 or near * step < _NEGLIGIBLE:
        return _ABSENT
    u = scaled(1.0 / d, o)
    if size > 0.0:
        axis, theta, defined = between_in_plane(u, e, scaled(1.0 / size, normal))
    else:
        axis, theta, defined = between(u, e)
        if not defined and theta == 0.0:
            axis, defined = orthogonal(normal, e), True
    rate = near * math.exp(-((theta / psi) ** 2))
    if not defined:
        return _ABSENT
    return axis, avoidance_turn(rate, theta, psi, step), rate * step


@compiled
def guidance_term(
    v: Triple, e: Triple, normal: Triple, alpha: float, closeness: float, step: float
) -> Term:
    """Turn toward the unit heading v; zero: none.

    The gain, its rate over its angle, is alpha (1 - exp(-kappa d^2)) in place of (eq. 9), which
    grows without bound with d: bounded, vanishing at the obstacle. `closeness` is kappa d^2; the
    other arguments are those of `avoidance_term`.
    """
    gain = -alpha * math.expm1(-closeness)
    if norm(v) == 0.0 or not gain > 0.0:
        return _ABSENT
    axis, theta, defined = between(e, v)
    if not defined and theta > 0.0:
        axis, defined = orthogonal(normal, e), True
    if not defined:
        return _ABSENT
    return axis, -theta * math.expm1(-gain * step), gain * theta * step


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
def turn_step(terms: FloatArray, fade: float, p: Triple, z: Triple, step: float) -> Triple:
    """Turn of the heading over a step of normalized time.

    Linearly implicit in the sum of all terms, so that each term alone turns as far as its own
    exact flow does (within 2.5 %): never past the direction straight away from the obstacle,
    or past v_d, however large its rate. A turn is at most pi.

    Args:
        terms: (M, 12) rows p_WO (3), alpha, psi, kappa, unit heading (3; zero: no guidance) and
            normal (3); finite, psi > 0, alpha and kappa not negative.
        fade: factor on the strengths alpha.
        p: p_WE [m].
        z: scaled velocity z_W [m].
        step: length of the step in normalized time, at least 0.

    Returns:
        Axis times angle [rad] in the world frame, for `rotate`.
    """
    speed = norm(z)
    if speed == 0.0:
        return z
    e = scaled(1.0 / speed, z)
    xx = yy = zz = 1.0
    xy = xz = yz = wx = wy = wz = 0.0
    alone, count = z, 0
    for row in range(len(terms)):
        alpha, psi, kappa = triple(terms, row, ALPHA)
        alpha *= fade
        if not alpha > 0.0:
            continue
        o, normal = mixed(1.0, triple(terms, row), -1.0, p), triple(terms, row, NORMAL)
        for axis, angle, explicit in (
            avoidance_term(o, e, normal, alpha, psi, kappa, step),
            guidance_term(triple(terms, row, HEADING), e, normal, alpha, kappa * dot(o, o), step),
        ):
            if not angle > 0.0:
                continue
            divisor = min(max(explicit / angle, 1.0), _MAX_STIFFNESS)
            q, (ax, ay, az) = divisor - 1.0, axis
            xx += q * ax * ax
            yy += q * ay * ay
            zz += q * az * az
            xy += q * ax * ay
            xz += q * ax * az
            yz += q * ay * az
            wx += divisor * angle * ax
            wy += divisor * angle * ay
            wz += divisor * angle * az
            alone, count = scaled(angle, axis), count + 1
    if count == 0:
        return 0.0, 0.0, 0.0
    w = alone if count == 1 else _solve((xx, yy, zz), (xy, xz, yz), (wx, wy, wz))
    return scaled(min(1.0, math.pi / norm(w)), w)
