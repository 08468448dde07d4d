"""The coupling terms, readable: an object a set of obstacles, a row a term.

Signs, frames and units are those of `drake_oa.policy.coupling`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from drake_oa.common.messages import FloatArray, Frozen
from drake_oa.policy.coupling import MAX_GUIDANCE_RATE, PARALLEL, GuidanceForm

Vector = tuple[float, float, float]

_MAX_STIFFNESS = 1e4
_MAX_EXPONENT = 700.0
_MAX_RATE = 1e300


def guidance_rate(
    theta_hat: ArrayLike,
    d: ArrayLike,
    alpha: ArrayLike,
    kappa: ArrayLike,
    form: GuidanceForm = "counterphase",
    max_rate: float = MAX_GUIDANCE_RATE,
) -> FloatArray:
    """Turning rate toward the desired heading, (eq. oa_rs).

    "counterphase": alpha theta_hat (1 - exp(-kappa d^2)), which is bounded and
    vanishes at the obstacle. "printed": alpha theta_hat exp(1 + kappa d^2), which the
    paper prints; it grows without bound with d, so it is saturated.

    Args:
        theta_hat: angle between the present and the desired heading [rad].
        d: distance to the obstacle's centre [m].
        alpha: strength [1 per time].
        kappa: decay over the distance [1/m^2].
        form: which of the two.
        max_rate: largest magnitude of the printed form [rad per time].

    Returns:
        Turning rate [rad per time], positive toward the desired heading, broadcast.

    Raises:
        ValueError: for an unknown form.
    """
    check_form(form)
    theta_hat = np.asarray(theta_hat, dtype=float)
    closeness = np.multiply(kappa, np.square(d))
    if form == "counterphase":
        return np.asarray(theta_hat * np.multiply(alpha, -np.expm1(-closeness)))
    grown = np.exp(np.minimum(1.0 + closeness, _MAX_EXPONENT))
    return np.asarray(np.clip(alpha * theta_hat * grown, -max_rate, max_rate))


def coupling_force(Omega_W: FloatArray, z_W: FloatArray) -> FloatArray:
    """C = Omega x z, (eq. oa_main): orthogonal to z. (3,), (3,) -> (3,) [m]."""
    ox, oy, oz = Omega_W.tolist()
    x, y, z = z_W.tolist()
    return np.array((oy * z - oz * y, oz * x - ox * z, ox * y - oy * x))


def rotate(z_W: FloatArray, turn_W: FloatArray) -> FloatArray:
    """Turns a vector about an axis by Rodrigues' formula; the length stays.

    Args:
        z_W: (3,) vector.
        turn_W: (3,) axis times angle [rad].

    Returns:
        (3,) turned vector.
    """
    wx, wy, wz = turn_W.tolist()
    angle = math.hypot(wx, wy, wz)
    if angle == 0.0:
        return z_W
    x, y, z = z_W.tolist()
    half = math.sin(0.5 * angle)
    cos = 1.0 - 2.0 * half * half
    wx, wy, wz = wx / angle, wy / angle, wz / angle
    sin = math.sin(angle)
    along = (wx * x + wy * y + wz * z) * 2.0 * half * half
    return np.array(
        (
            cos * x + sin * (wy * z - wz * y) + along * wx,
            cos * y + sin * (wz * x - wx * z) + along * wy,
            cos * z + sin * (wx * y - wy * x) + along * wz,
        )
    )


@dataclass(frozen=True, eq=False)
class CouplingTerms(Frozen):
    """The coupling terms of M obstacles: what turns the motion at one instant.

    Rates are per unit of normalised time s = t / (tau T), distances to the centres.

    Attributes:
        p_WO: (M, 3) centres of the obstacles in the world frame [m].
        parameters: (M, 3) rows alpha [rad], psi [rad], kappa [1/m^2] of the avoidance
            term; alpha and kappa at least 0, psi above 0.
        heading_W: (M, 3) desired headings v_d, of any length; a zero row: no
            guidance for this obstacle. None: no guidance.
        normal_W: (M, 3) normals of the planes to turn in where heading and obstacle
            define none; positive turns go from the centre to the side to pass on.
            A zero row, or None: about the vertical, to the left (about the world's
            x axis for a vertical heading).
        guidance_alpha: (M,) strength of the guidance term; None: alpha, as the paper
            has it.
        form: form of the guidance term, see `guidance_rate`.
        max_rate: saturation of the printed form [rad per normalised time].
        in_plane: whether the avoidance term sees heading and obstacle along
            `normal_W` and turns about it, so that it acts in that plane only. The
            P-plane of heading and obstacle is unstable: see docs/equations.md.

    Raises:
        ValueError: for wrong shapes, values that are not finite, or parameters out
            of their ranges.
    """

    p_WO: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    parameters: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    heading_W: FloatArray | None = None
    normal_W: FloatArray | None = None
    guidance_alpha: FloatArray | None = None
    form: GuidanceForm = "counterphase"
    max_rate: float = MAX_GUIDANCE_RATE
    in_plane: bool = False
    _rows: tuple[tuple[list[float], ...], ...] = field(init=False, repr=False, default=())

    def __post_init__(self) -> None:
        super().__post_init__()
        check_form(self.form)
        if not self.max_rate > 0.0:
            raise ValueError(f"max_rate must be positive [rad per time], not {self.max_rate}")
        M = len(self.p_WO)
        blocks = [self.p_WO, self.parameters]
        for given in (self.heading_W, self.normal_W):
            blocks.append(np.zeros((M, 3)) if given is None else given)
        alpha = self.parameters[:, 0] if self.guidance_alpha is None else self.guidance_alpha
        names = ("p_WO", "parameters", "heading_W", "normal_W")
        for name, block in zip(names, blocks, strict=True):
            if block.shape != (M, 3):
                raise ValueError(f"{name} must be (M, 3) with M = {M} rows, not {block.shape}")
        if alpha.shape != (M,):
            raise ValueError(f"guidance_alpha must be ({M},), not {alpha.shape}")
        table = np.concatenate([*blocks, alpha[:, None]], axis=1).tolist()
        for row, values in enumerate(table):
            if not all(map(math.isfinite, values)):
                raise ValueError(f"obstacle {row} has a value that is not finite: {values}")
            if values[3] < 0.0 or values[4] <= 0.0 or values[5] < 0.0 or values[12] < 0.0:
                raise ValueError(
                    f"obstacle {row}: alpha, psi, kappa must be >= 0, > 0, >= 0 and guidance_alpha "
                    f">= 0, not {values[3:6]} and {values[12]}"
                )
        rows = tuple((v[0:3], v[3:6], v[6:9], v[9:12], v[12:13]) for v in table)
        object.__setattr__(self, "_rows", rows)

    def __len__(self) -> int:
        return len(self.p_WO)

    def turning_rate(self, p_WE: FloatArray, z_W: FloatArray) -> FloatArray:
        """Total angular rate Omega of the composed coupling term C = Omega x z.

        It is the sum over all terms (section III-C). An avoidance term is absent
        where E is at the obstacle's centre or heads straight away from it, and all
        are at rest (z = 0), where they could not act.

        Args:
            p_WE: (3,) position of the end effector [m].
            z_W: (3,) scaled velocity [m].

        Returns:
            (3,) angular rate in the world frame [rad per normalised time],
            orthogonal to z.
        """
        x = y = z = 0.0
        for (ax, ay, az), rate, _ in self._terms(p_WE, z_W, None):
            x += rate * ax
            y += rate * ay
            z += rate * az
        return np.array((x, y, z))

    def turn(self, p_WE: FloatArray, z_W: FloatArray, step: float) -> FloatArray:
        """Turn of the heading over a step of normalised time.

        Linearly implicit in the sum of all terms, so that each term alone turns as far
        as its own exact flow does (within 2.5 %): never past the direction straight
        away from the obstacle, or past v_d, however large its rate. A turn is at most
        pi.

        Args:
            p_WE: (3,) position of the end effector [m].
            z_W: (3,) scaled velocity [m].
            step: length of the step in normalised time, at least 0.

        Returns:
            (3,) axis times angle [rad] in the world frame, for `rotate`.
        """
        terms = self._terms(p_WE, z_W, step)
        if not terms:
            return np.zeros(3)
        if len(terms) == 1:
            (ax, ay, az), angle, divisor = terms[0]
            angle /= divisor
            return np.array((angle * ax, angle * ay, angle * az))
        x, y, z = _solve(terms)
        angle = math.hypot(x, y, z)
        if angle > math.pi:
            shrink = math.pi / angle
            x, y, z = shrink * x, shrink * y, shrink * z
        return np.array((x, y, z))

    def _terms(
        self, p_WE: FloatArray, z_W: FloatArray, step: float | None
    ) -> list[tuple[Vector, float, float]]:
        """Axis, explicit turn (the rate, without a step) and divisor of each active term."""
        px, py, pz = p_WE.tolist()
        ex, ey, ez = z_W.tolist()
        speed = math.hypot(ex, ey, ez)
        if not 0.0 < speed < math.inf:
            return []
        e = (ex / speed, ey / speed, ez / speed)
        found: list[tuple[Vector, float, float]] = []
        for (cx, cy, cz), (alpha, psi, kappa), v_d, normal, (guide,) in self._rows:
            ox, oy, oz = cx - px, cy - py, cz - pz
            d = math.hypot(ox, oy, oz)
            if not d < math.inf:
                continue
            closeness = kappa * d * d if kappa else 0.0
            if d > 0.0 and alpha > 0.0:
                axis, theta = self._heading((ox / d, oy / d, oz / d), e, normal)
                u = theta / psi
                rate = min(alpha * math.exp(-u * u - closeness), _MAX_RATE)
                if axis is not None and rate > 0.0:
                    found.append((axis, *_limited_avoidance(rate, theta, psi, step)))
            if guide > 0.0 and any(v_d):
                size = math.hypot(*v_d)
                axis, theta = _between(e, (v_d[0] / size, v_d[1] / size, v_d[2] / size))
                if axis is None and theta > 0.0:
                    axis = _fallback(normal, e)
                gain = self._gain(guide, closeness)
                if axis is not None and gain > 0.0:
                    found.append((axis, *self._limited_guidance(gain, theta, step)))
        return found

    def _heading(self, to_O: Vector, e: Vector, normal: list[float]) -> tuple[Vector | None, float]:
        """Axis of the turn away from the obstacle, None where there is none, and theta."""
        if self.in_plane and any(normal):
            return _between_in_plane(to_O, e, normal)
        axis, theta = _between(to_O, e)
        if axis is None and theta == 0.0:
            axis = _fallback(normal, e)
        return axis, theta

    def _gain(self, alpha: float, closeness: float) -> float:
        if self.form == "counterphase":
            gain = -alpha * math.expm1(-closeness)
        else:
            gain = alpha * math.exp(min(1.0 + closeness, _MAX_EXPONENT))
        return min(gain, _MAX_RATE)

    def _limited_guidance(
        self, gain: float, theta: float, step: float | None
    ) -> tuple[float, float]:
        """Explicit turn and divisor of theta' = -min(gain theta, limit)."""
        limit = math.inf if self.form == "counterphase" else self.max_rate
        rate = min(gain * theta, limit)
        if step is None:
            return rate, 1.0
        if rate < limit:
            angle = -theta * math.expm1(-gain * step)
        else:
            linear = theta - limit / gain
            rest = step - linear / limit
            if rest <= 0.0:
                angle = limit * step
            else:
                angle = linear - (limit / gain) * math.expm1(-gain * rest)
        return _stiff(rate * step, angle)


def _limited_avoidance(
    rate: float, theta: float, psi: float, step: float | None
) -> tuple[float, float]:
    """Explicit turn and divisor of theta' = A exp(-theta^2 / psi^2), rate at theta.

    With u = theta / psi and c = rate step / psi the exact u' solves
    int_u^u' exp(x^2 - u^2) dx = c. Here u'^2 = u^2 + log(1 + c g), where
    g = 2 u + asinh(c / sqrt(1 + 2 u c)): within 2.5 % of the exact turn.
    """
    if step is None:
        return rate, 1.0
    c = min(rate * step / psi, 1e150)
    u = theta / psi
    if c < 1e-14:
        angle = rate * step
    else:
        grown = math.log1p(c * (2.0 * u + math.asinh(c / math.sqrt(1.0 + 2.0 * u * c))))
        angle = psi * grown / (u + math.sqrt(u * u + grown))
    return _stiff(rate * step, min(angle, math.pi - theta))


def _stiff(explicit: float, angle: float) -> tuple[float, float]:
    """Explicit turn and divisor whose quotient is the angle, kept in a sound range."""
    if angle <= 0.0:
        return 0.0, 1.0
    divisor = min(max(explicit / angle, 1.0), _MAX_STIFFNESS)
    return angle * divisor, divisor


def _solve(terms: list[tuple[Vector, float, float]]) -> Vector:
    """Solves (I + sum q a a^T) w = sum w0 a, q = divisor - 1, by L D L^T."""
    xx = yy = zz = 1.0
    xy = xz = yz = x = y = z = 0.0
    for (ax, ay, az), explicit, divisor in terms:
        q = divisor - 1.0
        xx += q * ax * ax
        yy += q * ay * ay
        zz += q * az * az
        xy += q * ax * ay
        xz += q * ax * az
        yz += q * ay * az
        x += explicit * ax
        y += explicit * ay
        z += explicit * az
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


def _between(a: Vector, b: Vector) -> tuple[Vector | None, float]:
    """Axis and angle of the turn from unit a to unit b; the axis is None if parallel."""
    ax, ay, az = a
    bx, by, bz = b
    x = ay * bz - az * by
    y = az * bx - ax * bz
    z = ax * by - ay * bx
    sin = math.sqrt(x * x + y * y + z * z)
    cos = ax * bx + ay * by + az * bz
    if sin > PARALLEL:
        return (x / sin, y / sin, z / sin), math.atan2(sin, cos)
    return None, 0.0 if cos > 0.0 else math.pi


def _between_in_plane(a: Vector, b: Vector, normal: list[float]) -> tuple[Vector | None, float]:
    """Axis (the normal or its opposite) and angle from a to b, both seen along the normal.

    The axis is the normal where the two are parallel, and None where they are opposite
    or one of them is seen as a point.
    """
    size = math.hypot(*normal)
    nx, ny, nz = normal[0] / size, normal[1] / size, normal[2] / size
    ax, ay, az = a
    bx, by, bz = b
    sine = nx * (ay * bz - az * by) + ny * (az * bx - ax * bz) + nz * (ax * by - ay * bx)
    a_n, b_n = ax * nx + ay * ny + az * nz, bx * nx + by * ny + bz * nz
    cosine = ax * bx + ay * by + az * bz - a_n * b_n
    if abs(sine) <= PARALLEL:
        return (None, math.pi) if cosine <= PARALLEL else ((nx, ny, nz), 0.0)
    if sine > 0.0:
        return (nx, ny, nz), math.atan2(sine, cosine)
    return (-nx, -ny, -nz), math.atan2(-sine, cosine)


def _fallback(normal: list[float], e: Vector) -> Vector:
    """The given normal made orthogonal to the heading e, or a definite stand-in."""
    size = math.hypot(*normal)
    given = (normal[0] / size, normal[1] / size, normal[2] / size) if size > 0.0 else e
    ex, ey, ez = e
    for nx, ny, nz in (given, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)):
        along = nx * ex + ny * ey + nz * ez
        x, y, z = nx - along * ex, ny - along * ey, nz - along * ez
        size = math.sqrt(x * x + y * y + z * z)
        if size > 1e-3:
            return (x / size, y / size, z / size)
    raise ValueError(f"the heading {e} must be a unit vector")


def check_form(form: str) -> None:
    """Raises ValueError unless `form` names a form of the guidance term."""
    if form not in ("counterphase", "printed"):
        raise ValueError(f'form must be "counterphase" or "printed", not {form!r}')
