"""Compiled roll-outs of the paper's action level, a regressor chain in each step."""

from __future__ import annotations

import math

import numba
import numpy as np

from drake_oa.common.messages import FloatArray, IntArray

DEAD_ZONE_FREE, ORIGINAL = 0, 1
"""Which avoidance term: (eq. oa_complete) or (eq. oa_original)."""

_PARALLEL = 1e-9
"""Sine of the angle below which two directions span no plane."""

_SAME = 1e-9
"""By how much lambda' has to change for the chain to be asked again [m]."""

_NARROWEST = 1e-6
"""Least psi [rad]."""

_LOST = 1e4
"""Speed at which a motion has diverged [m/s]: it is held where it is."""

_STILL = 1e-5
"""Speed below which the released code lets no coupling act [m/s]."""


@numba.njit(cache=True, error_model="numpy", fastmath={"contract", "nnan", "nsz"}, inline="always")
def _tanh(x: float) -> float:
    """tanh to 1e-14, without a branch or a call, so that loops over it vectorise.

    exp(2 |x|) is the 64th power of a Taylor polynomial; above 20 tanh is 1.
    """
    y = min(abs(x), 20.0) * 0.03125
    p = 2.08767569878681e-09
    p = p * y + 2.505210838544172e-08
    p = p * y + 2.755731922398589e-07
    p = p * y + 2.7557319223985893e-06
    p = p * y + 2.48015873015873e-05
    p = p * y + 0.0001984126984126984
    p = p * y + 0.001388888888888889
    p = p * y + 0.008333333333333333
    p = p * y + 0.041666666666666664
    p = p * y + 0.16666666666666666
    p = p * y + 0.5
    p = p * y + 1.0
    p = p * y + 1.0
    p *= p
    p *= p
    p *= p
    p *= p
    p *= p
    p *= p
    return math.copysign(1.0 - 2.0 / (p + 1.0), x)


@numba.njit(cache=True, error_model="numpy", fastmath={"contract"})
def evaluate_chain(
    inputs: FloatArray,
    n_inputs: int,
    first: FloatArray,
    hidden: FloatArray,
    bias: FloatArray,
    last: FloatArray,
    last_bias: FloatArray,
    logarithmic: IntArray,
    work: FloatArray,
    out: FloatArray,
) -> None:
    """The chain kappa, psi, alpha at one input.

    Args:
        inputs: (n_inputs + 3,) lambda1', lambda2' and, if n_inputs is 3, Delta; its other
            entries are overwritten.
        n_inputs: 2 or 3.
        first: (3, n_inputs + 2, H) first layer of each network, transposed and padded.
        hidden: (3, K - 1, H, H) further tanh layers, transposed.
        bias: (3, K, H) biases of the tanh layers.
        last: (3, H) linear layer.
        last_bias: (3,) its bias.
        logarithmic: (3,) 1 where the network's answer is the logarithm of its target.
        work: (2, H) scratch.
        out: (3,) alpha, psi, kappa.
    """
    H = last.shape[1]
    x, y = work[0], work[1]
    for target in range(3):
        for i in range(H):
            x[i] = bias[target, 0, i]
        for k in range(n_inputs + target):
            for i in range(H):
                x[i] += first[target, k, i] * inputs[k]
        for i in range(H):
            x[i] = _tanh(x[i])
        for layer in range(hidden.shape[1]):
            for i in range(H):
                y[i] = bias[target, layer + 1, i]
            for k in range(H):
                given = x[k]
                for i in range(H):
                    y[i] += hidden[target, layer, k, i] * given
            for i in range(H):
                x[i] = _tanh(y[i])
        answer = last_bias[target]
        for i in range(H):
            answer += last[target, i] * x[i]
        inputs[n_inputs + target] = answer
        out[2 - target] = math.exp(answer) if logarithmic[target] else answer


@numba.njit(cache=True, error_model="numpy")
def section_axes(
    to_O: FloatArray, normal: FloatArray, R: FloatArray, semi_axes: FloatArray, out: FloatArray
) -> None:
    """lambda': principal semi-axes of an ellipsoid's section through its centre.

    The first is the one within 45 degrees of the baseline's (the x axis') projection
    into the plane, or of the way to the centre where the plane is square to it.

    Args:
        to_O: (3,) way to the centre, in the plane [m].
        normal: (3,) unit normal of the plane.
        R: (3, 3) principal axes in the columns.
        semi_axes: (3,) [m].
        out: (>= 2,) lambda1', lambda2' [m].
    """
    n0, n1, n2 = normal[0], normal[1], normal[2]
    u0, u1, u2 = 1.0 - n0 * n0, -n0 * n1, -n0 * n2
    size = math.sqrt(u0 * u0 + u1 * u1 + u2 * u2)
    if size <= _PARALLEL:
        u0, u1, u2 = to_O[0], to_O[1], to_O[2]
        size = math.sqrt(u0 * u0 + u1 * u1 + u2 * u2)
    if size == 0.0:
        u1, size = 1.0, 1.0
    u0, u1, u2 = u0 / size, u1 / size, u2 / size
    v0, v1, v2 = n1 * u2 - n2 * u1, n2 * u0 - n0 * u2, n0 * u1 - n1 * u0
    s11, s12, s22 = 0.0, 0.0, 0.0
    for k in range(3):
        a = (u0 * R[0, k] + u1 * R[1, k] + u2 * R[2, k]) / semi_axes[k]
        b = (v0 * R[0, k] + v1 * R[1, k] + v2 * R[2, k]) / semi_axes[k]
        s11 += a * a
        s12 += a * b
        s22 += b * b
    half = 0.5 * (s11 - s22)
    big = 0.5 * (s11 + s22) + math.sqrt(half * half + s12 * s12)
    # The product of the eigenvalues keeps the small one exact for flat sections.
    small = (s11 * s22 - s12 * s12) / big
    along, across = (big, small) if half >= 0.0 else (small, big)
    out[0] = 1.0 / math.sqrt(along)
    out[1] = 1.0 / math.sqrt(across)


@numba.njit(cache=True, error_model="numpy")
def start_sections(
    center: FloatArray, R: FloatArray, semi_axes: FloatArray, across: FloatArray
) -> None:
    """lambda2' of each obstacle's section by the plane of the baseline and its centre.

    Args:
        center: (N, M, 3) from the start, the baseline along x [m].
        R: (N, M, 3, 3) principal axes in the columns.
        semi_axes: (N, M, 3) [m].
        across: (N, M) takes lambda2' [m], NaN for a NaN centre.
    """
    normal, extents = np.empty(3), np.empty(2)
    for n in range(len(center)):
        for m in range(center.shape[1]):
            y, z = center[n, m, 1], center[n, m, 2]
            size = math.sqrt(y * y + z * z)
            normal[0] = 0.0
            normal[1] = z / size if size > 0.0 else 0.0
            normal[2] = -y / size if size > 0.0 else 1.0
            section_axes(center[n, m], normal, R[n, m], semi_axes[n, m], extents)
            across[n, m] = math.nan if math.isnan(size) else extents[1]


@numba.njit(cache=True, error_model="numpy", parallel=True)
def roll_out(
    term: int,
    regulate: bool,
    baseline: FloatArray,
    center: FloatArray,
    velocity: FloatArray,
    semi_axes: FloatArray,
    R: FloatArray,
    parameters: FloatArray,
    clearance: FloatArray,
    scale: FloatArray,
    forcing: FloatArray,
    constants: FloatArray,
    n_inputs: int,
    first: FloatArray,
    hidden: FloatArray,
    bias: FloatArray,
    last: FloatArray,
    last_bias: FloatArray,
    logarithmic: IntArray,
    path: FloatArray,
    speed: FloatArray,
) -> None:
    """Semi-implicit Euler from rest at the origin to the goal (baseline, 0, 0).

    With the scene's factors c and the step h of its policy's time::

        a = c_spring alpha_x (beta_x (g - x) - v) + f + c_coupling sum_i R_i v theta'_i
        v += h a,  x += h v

    alpha and kappa below 0 count as 0 (the released code does so with kappa; the paper's
    output layer rules them out). Where way and velocity span no plane, the obstacle's last
    normal stands in, at first the vertical. A motion that diverges, as explicit steps can,
    stays where it is from then on.

    Args:
        term: `DEAD_ZONE_FREE` or `ORIGINAL`.
        regulate: whether the chain sets the parameters in each step, from the section
            of the obstacle by the P-plane.
        baseline: (N,) [m].
        center: (N, M, 3) at t = 0 [m]; NaN where there is no obstacle.
        velocity: (N, M, 3) of the centres [m/s].
        semi_axes: (N, M, 3) [m].
        R: (N, M, 3, 3) principal axes in the columns.
        parameters: (N, M, 3) alpha, psi, kappa (or gamma, beta, unused), overwritten
            where `regulate`.
        clearance: (N,) Delta asked of the chain [m].
        scale: (N, 3) c_spring, c_coupling, and seconds per unit of policy time.
        forcing: (S,) along the baseline, for a baseline of 1 m.
        constants: alpha_x, beta_x, step h.
        n_inputs: see `evaluate_chain`, as for the arrays that follow.
        first: of the chain.
        hidden: of the chain.
        bias: of the chain.
        last: of the chain.
        last_bias: of the chain.
        logarithmic: of the chain.
        path: (N, S + 1, 3) takes the positions [m].
        speed: (N, S + 1, 3) takes the velocities [m/s].
    """
    steps, M, H = len(forcing), center.shape[1], last.shape[1]
    alpha_x, beta_x, h = constants[0], constants[1], constants[2]
    for n in numba.prange(len(baseline)):
        work, inputs = np.empty((2, H)), np.empty(n_inputs + 3)
        normal, to_O = np.zeros((M, 3)), np.empty(3)
        normal[:, 2] = 1.0
        seen = np.full((M, 2), -1.0)
        spring, couple, seconds = scale[n, 0], scale[n, 1], scale[n, 2]
        x0, x1, x2, v0, v1, v2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        path[n, 0] = 0.0
        speed[n, 0] = 0.0
        for step in range(steps):
            c0, c1, c2 = 0.0, 0.0, 0.0
            v = math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
            t = step * h * seconds
            for m in range(M if v >= _STILL else 0):
                if math.isnan(center[n, m, 0]):
                    continue
                o0 = center[n, m, 0] + t * velocity[n, m, 0] - x0
                o1 = center[n, m, 1] + t * velocity[n, m, 1] - x1
                o2 = center[n, m, 2] + t * velocity[n, m, 2] - x2
                d = math.sqrt(o0 * o0 + o1 * o1 + o2 * o2)
                if d == 0.0:
                    continue
                r0, r1, r2 = o1 * v2 - o2 * v1, o2 * v0 - o0 * v2, o0 * v1 - o1 * v0
                size = math.sqrt(r0 * r0 + r1 * r1 + r2 * r2)
                if size > _PARALLEL * d * v:
                    normal[m, 0], normal[m, 1], normal[m, 2] = r0 / size, r1 / size, r2 / size
                if regulate:
                    to_O[0], to_O[1], to_O[2] = o0, o1, o2
                    section_axes(to_O, normal[m], R[n, m], semi_axes[n, m], inputs)
                    moved = max(abs(inputs[0] - seen[m, 0]), abs(inputs[1] - seen[m, 1]))
                    if moved > _SAME:
                        seen[m, 0], seen[m, 1] = inputs[0], inputs[1]
                        if n_inputs == 3:
                            inputs[2] = clearance[n]
                        evaluate_chain(
                            inputs,
                            n_inputs,
                            first,
                            hidden,
                            bias,
                            last,
                            last_bias,
                            logarithmic,
                            work,
                            parameters[n, m],
                        )
                p = parameters[n, m]
                theta = math.acos(max(-1.0, min(1.0, (o0 * v0 + o1 * v1 + o2 * v2) / (d * v))))
                if term == ORIGINAL:
                    rate = p[0] * theta * math.exp(-p[1] * theta)
                else:
                    width = max(abs(p[1]), _NARROWEST)
                    exponent = -((theta / width) ** 2) - max(p[2], 0.0) * d * d
                    rate = max(p[0], 0.0) * math.exp(exponent)
                n0, n1, n2 = normal[m, 0], normal[m, 1], normal[m, 2]
                c0 += rate * (n1 * v2 - n2 * v1)
                c1 += rate * (n2 * v0 - n0 * v2)
                c2 += rate * (n0 * v1 - n1 * v0)
            stiffness = spring * alpha_x * beta_x
            damping = spring * alpha_x
            f = baseline[n] * forcing[step]
            v0 += h * (stiffness * (baseline[n] - x0) - damping * v0 + f + couple * c0)
            v1 += h * (-stiffness * x1 - damping * v1 + couple * c1)
            v2 += h * (-stiffness * x2 - damping * v2 + couple * c2)
            if not abs(v0) + abs(v1) + abs(v2) < _LOST:
                for later in range(step + 1, steps + 1):
                    path[n, later, 0], path[n, later, 1], path[n, later, 2] = x0, x1, x2
                    speed[n, later] = 0.0
                break
            x0 += h * v0
            x1 += h * v1
            x2 += h * v2
            path[n, step + 1, 0], path[n, step + 1, 1], path[n, step + 1, 2] = x0, x1, x2
            speed[n, step + 1, 0] = v0 / seconds
            speed[n, step + 1, 1] = v1 / seconds
            speed[n, step + 1, 2] = v2 / seconds
