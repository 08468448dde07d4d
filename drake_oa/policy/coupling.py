"""Coupling terms: rotation of the motion away from obstacles and toward guidance headings.

A coupling term C rotates the scaled velocity z without changing its length: C = Omega x z, (6) of
Pairet et al., RA-L 2019. Omega is an angular rate per normalized time s = t / (tau T), with the
demonstrated duration T and the temporal scaling tau. Several terms add up (section III-C of the
paper). Because z replaces the velocity of the paper, the path does not depend on tau.

Signs. The P-plane (plane of rotation) is spanned by z and the vector p_EO from the tool point to
the center of the obstacle, or is given by its normal. The avoidance term rotates z about p_EO x z,
the guidance term about z x v_d, with the guidance heading v_d. By the right-hand rule, a positive
rate rotates z away from the obstacle, or toward v_d. If these products vanish, the axis is the
normal of the P-plane: a positive rotation about it turns from the center of the obstacle toward the
side on which the obstacle is passed.

The rotation in one step is derived in docs/theory/integration.md. The kernels pass vectors
as triples, so that they do not allocate memory and can be inlined. A kernel describes the effect of
a coupling term in a step by the axis of its rotation, the rotation angle over the step if the term
acts alone, and the turning rate at the beginning of the step times the step.
"""

from __future__ import annotations

import math

import numpy as np

from drake_oa.common.compiled import compiled, leaf
from drake_oa.common.messages import FloatArray

PARALLEL = 1e-6
"""Sine of the angle between two directions below which they count as parallel [-].

A demonstrated motion may start with a short step backward. When its velocity then passes through
zero, its heading is only rounding error, which must not determine the side of avoidance."""

ALPHA, PSI, KAPPA, HEADING, NORMAL = 3, 4, 5, 6, 9
"""Column indices in an array of coupling terms, in which a row of 12 numbers is one term.

They are the columns of the parameters alpha (strength), psi (angular width) and kappa (decay with
the squared distance), and the first of three columns of the guidance heading and of the normal of
the plane of rotation. Columns 0 to 2 contain the center of the obstacle."""
N_COLUMNS = 12
"""Number of columns in an array of coupling terms, in which a row is one term.

They are the obstacle's center (3), alpha, psi, kappa, the guidance heading (3) and the normal of
the plane of rotation (3)."""

_MAX_STIFFNESS = 1e4
"""Maximum ratio of explicit to actual rotation by a coupling term over a step [-].

The explicit rotation is the turning rate at the beginning of the step times the step. The actual
rotation is that of a term that acts alone. Larger ratios are reduced to this value. They would make
the linear system for the rotation by all terms together ill-conditioned."""
_NEGLIGIBLE = 1e-15
"""Product of maximum turning rate and step below which an avoidance term is skipped [rad].

The maximum rate over all headings is alpha exp(-kappa d^2), with the strength alpha, the decay
kappa, and the distance d from the obstacle's center. The step is in normalized time."""

Triple = tuple[float, float, float]
"""Vector of three components, as a tuple for compiled kernels."""
Term = tuple[Triple, float, float]
"""Rotation of the motion by one coupling term, as if it acted alone, over a step of the policy.

The elements are the axis, the rotation over the step [rad] (0: inactive), and the turning rate at
the beginning of the step times the step [rad]."""
_ABSENT = (0.0, 0.0, 0.0), 0.0, 0.0
"""Rotation by an inactive coupling term: zero axis, zero rotation, and zero rate times step."""


def original_rate(theta: FloatArray, gamma: FloatArray, beta: FloatArray) -> FloatArray:
    """Computes the turning rate of the coupling term of Hoffmann et al., which has a dead zone.

    The rate is gamma theta exp(-beta |theta|), (7) of Pairet et al., RA-L 2019. It vanishes for a
    heading straight at the obstacle.

    Args:
        theta: signed angle from the direction of the obstacle's center to the heading [rad].
        gamma: strength [1/s, or 1 per normalized time].
        beta: decay with the angle [1/rad].

    Returns:
        Turning rate d theta/dt [rad times the unit of gamma], with the sign of theta, so that
        |theta| grows (away from the obstacle); in the broadcast shape of the arguments.
    """
    return gamma * theta * np.exp(-beta * np.abs(theta))


def dead_zone_free_rate(
    theta: FloatArray, d: FloatArray, alpha: FloatArray, psi: FloatArray, kappa: FloatArray
) -> FloatArray:
    """Computes the turning rate of the paper's avoidance term, without a dead zone straight ahead.

    The rate is alpha sign(theta) exp(-theta^2 / psi^2) exp(-kappa d^2) with sign(0) = 1, (8) of
    Pairet et al., RA-L 2019. A heading straight at the obstacle thus turns fastest; the normal of
    the plane of rotation then determines the side.

    Args:
        theta: signed angle from the direction of the obstacle's center to the heading [rad].
        d: distance to the obstacle's center [m].
        alpha: strength [rad/s, or rad per normalized time].
        psi: width of the response to the heading [rad].
        kappa: decay with the squared distance [1/m^2].

    Returns:
        Turning rate d theta/dt in the unit of alpha, with the sign of theta (positive for 0), so
        that |theta| grows (away from the obstacle); in the broadcast shape of the arguments.
    """
    return np.copysign(alpha, theta) * np.exp(-((theta / psi) ** 2) - kappa * d**2)


@compiled
def dot(a: Triple, b: Triple) -> float:
    """Computes the scalar product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def cross(a: Triple, b: Triple) -> Triple:
    """Computes the vector product a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def norm(v: Triple) -> float:
    """Computes the length of a vector."""
    return math.sqrt(dot(v, v))


@compiled
def mixed(a: float, v: Triple, b: float, w: Triple) -> Triple:
    """Computes the linear combination a v + b w of two vectors."""
    return a * v[0] + b * w[0], a * v[1] + b * w[1], a * v[2] + b * w[2]


@compiled
def scaled(a: float, v: Triple) -> Triple:
    """Computes the multiple a v of a vector."""
    return a * v[0], a * v[1], a * v[2]


@compiled
def triple(array: FloatArray, row: int, column: int = 0) -> Triple:
    """Returns three consecutive elements in a row of an (M, N) array as a vector.

    Args:
        array: (M, N) array.
        row: index of the row.
        column: column of the first element.
    """
    return array[row, column], array[row, column + 1], array[row, column + 2]


@compiled
def rotate(z: Triple, w: Triple) -> Triple:
    """Rotates the vector z by the rotation vector w, the axis times the angle [rad]."""
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
    """Computes axis and angle of the rotation from unit vector a to unit vector b.

    Returns:
        Axis as a unit vector, angle in [0, pi] [rad], and whether the axis is defined, which it is
        not for parallel or opposite vectors.
    """
    across, cosine = cross(a, b), dot(a, b)
    sine = norm(across)
    if sine > PARALLEL:
        return scaled(1.0 / sine, across), math.atan2(sine, cosine), True
    return across, 0.0 if cosine > 0.0 else math.pi, False


@compiled
def between_in_plane(a: Triple, b: Triple, n: Triple) -> tuple[Triple, float, bool]:
    """Computes axis and angle of the rotation from a to b, projected onto the plane with normal n.

    Args:
        a: unit vector.
        b: unit vector.
        n: unit normal of the plane.

    Returns:
        Axis n or -n, angle in [0, pi] [rad], and whether the axis is defined. The axis is n for
        parallel projections. It is not defined if the projections are opposite or one vanishes.
    """
    sine, cosine = dot(n, cross(a, b)), dot(a, b) - dot(a, n) * dot(b, n)
    if abs(sine) <= PARALLEL:
        return n, 0.0 if cosine > PARALLEL else math.pi, cosine > PARALLEL
    return scaled(math.copysign(1.0, sine), n), math.atan2(abs(sine), cosine), True


@compiled
def orthogonal(n: Triple, e: Triple) -> Triple:
    """Computes the unit vector along the component of n that is orthogonal to the unit vector e.

    If n is zero or parallel to e, the world's z axis replaces n, or the x axis if e is vertical.
    """
    part = mixed(1.0, n, -dot(n, e), e)
    if norm(part) <= 1e-3 * norm(n):
        part = mixed(1.0, (0.0, 0.0, 1.0), -e[2], e)
        if norm(part) <= 1e-3:
            part = mixed(1.0, (1.0, 0.0, 0.0), -e[0], e)
    return scaled(1.0 / norm(part), part)


@compiled
def avoidance_turn(rate: float, theta: float, psi: float, step: float) -> float:
    """Computes by how much the avoidance term, acting alone, turns the heading over a time step.

    The avoidance term is (8) of Pairet et al., RA-L 2019, which turns the motion away from an
    obstacle. The angle theta from the direction of the obstacle's center to the heading obeys
    d theta/ds = A exp(-theta^2 / psi^2). A = alpha exp(-kappa d^2), with the distance d from this
    center, is constant over the step. The solution is approximated within 2.5 %: with
    u = theta / psi, c = rate * step / psi and g = 2 u + asinh(c / sqrt(1 + 2 u c)), the angle after
    the step is psi sqrt(u^2 + log(1 + c g)), at most pi.

    Args:
        rate: d theta/ds at the beginning of the step [rad per normalized time].
        theta: angle at the beginning of the step, at least 0 [rad].
        psi: width of the response to the heading [rad].
        step: length of the step in normalized time.

    Returns:
        Increase of theta over the step [rad].
    """
    c, u = rate * step / psi, theta / psi
    if c < 1e-14:
        return rate * step
    x = c / math.sqrt(1.0 + 2.0 * u * c)
    # This form is faster than math.asinh(x).
    asinh = math.log1p(x + x * x / (1.0 + math.sqrt(x * x + 1.0)))
    growth = math.log1p(c * (2.0 * u + asinh))
    return min(psi * growth / (u + math.sqrt(u * u + growth)), math.pi - theta)


@compiled
def avoidance_term(
    o: Triple, e: Triple, normal: Triple, alpha: float, psi: float, kappa: float, step: float
) -> Term:
    """Computes the rotation of the motion away from an obstacle over a step of the policy.

    The turning rate is that of the avoidance term (8) of Pairet et al., RA-L 2019.

    Args:
        o: vector from the tool point E to the center of the obstacle in the world frame [m].
        e: heading of the motion in the world frame, unit vector.
        normal: normal of the plane of rotation in the world frame, of any length; zero: the plane
            of o and e.
        alpha: strength [rad per normalized time].
        psi: width of the response to the heading [rad].
        kappa: decay with the squared distance [1/m^2].
        step: length of the step in normalized time.

    Returns:
        Axis in the world frame, rotation over the step if the term acts alone [rad] (0: the term is
        inactive), and turning rate at the beginning of the step times the step [rad].
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
    """Computes the rotation of the motion toward a guidance heading over a step of the policy.

    The guidance heading leads past an obstacle on the selected side. The gain (rate over angle) is
    alpha (1 - exp(-kappa d^2)), which is bounded and vanishes at the obstacle. It replaces the gain
    in (9) of Pairet et al., RA-L 2019, which grows without bound with the distance d from the
    center of the obstacle.

    Args:
        v: guidance heading in the world frame, unit vector; zero: no guidance.
        e: heading of the motion in the world frame, unit vector.
        normal: normal of the plane in which the obstacle is passed, of any length; it determines
            the axis if v is opposite to e.
        alpha: strength [rad per normalized time].
        closeness: kappa d^2, with the decay kappa of the coupling term [-].
        step: length of the step in normalized time.

    Returns:
        Axis in the world frame, rotation over the step if the term acts alone [rad] (0: the term is
        inactive), and turning rate at the beginning of the step times the step [rad].
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
    """Solves A w = b for w, with a symmetric positive definite matrix A (3, 3), by A = L D L^T.

    Args:
        diagonal: elements xx, yy, zz of A.
        off: elements xy, xz, yz of A.
        b: right-hand side.
    """
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
    """Computes the rotation of the motion's heading by all coupling terms together over a step.

    The rotation vector w solves (I + sum (q_i - 1) a_i a_i^T) w = sum q_i phi_i a_i. Term i has the
    unit axis a_i, and rotates by phi_i over the step if it acts alone. q_i is the ratio
    rate_i * step / phi_i, with the turning rate rate_i at the beginning of the step. A term that
    acts alone thus rotates the heading by phi_i, even if its rate is large. Such a term never
    rotates past the direction straight away from the obstacle, or past the guidance heading. The
    angle |w| is at most pi.

    Args:
        terms: (M, 12) coupling terms with the columns p_WO (3), alpha, psi, kappa, guidance heading
            (3, unit vector; zero: no guidance) and normal of the plane of rotation (3; zero: the
            plane of heading and obstacle's center); all finite, psi > 0, alpha and kappa not
            negative.
        fade: factor in [0, 1] on the strengths alpha, which fade near the goal.
        p: position p_WE of the tool point [m].
        z: scaled velocity z_W, the derivative of p_WE by normalized time [m].
        step: length of the step in normalized time, at least 0.

    Returns:
        Rotation vector (axis times angle) [rad] in the world frame, for `rotate`.
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
