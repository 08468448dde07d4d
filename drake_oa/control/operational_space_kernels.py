"""Compiled arithmetic behind `drake_oa.control.operational_space`; call its functions instead.

Every kernel takes writable C-contiguous float64 arrays, so that numba compiles
each of them once, and caches it on disk.
"""

from __future__ import annotations

import math

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray
from drake_oa.geometry.rotation import rotation_vector


@compiled
def cholesky(A: FloatArray) -> tuple[bool, FloatArray]:
    """Whether A (n, n) is positive definite, and its factor: A = L L^T.

    For matrices this small the calls into LAPACK would cost more than the arithmetic.
    """
    n = len(A)
    L = np.zeros((n, n))
    for j in range(n):
        for i in range(j, n):
            rest = A[i, j]
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            if i == j:
                if not rest > 0.0:
                    return False, L
                L[j, j] = math.sqrt(rest)
            else:
                L[i, j] = rest / L[j, j]
    return True, L


@compiled
def forward(L: FloatArray, B: FloatArray) -> FloatArray:
    """L^-1 B for a lower triangular L (n, n) and B (n, m)."""
    X = B.copy()
    for i in range(len(L)):
        for k in range(i):
            for j in range(X.shape[1]):
                X[i, j] -= L[i, k] * X[k, j]
        for j in range(X.shape[1]):
            X[i, j] /= L[i, i]
    return X


@compiled
def gram(X: FloatArray, Y: FloatArray) -> FloatArray:
    """X^T Y of X (n, a) and Y (n, b)."""
    G = np.zeros((X.shape[1], Y.shape[1]))
    for k in range(len(X)):
        for i in range(X.shape[1]):
            for j in range(Y.shape[1]):
                G[i, j] += X[k, i] * Y[k, j]
    return G


@compiled
def damped_task_force(
    inverse_inertia: FloatArray, acceleration: FloatArray, max_mass: float, length: float
) -> tuple[FloatArray, float]:
    """Task force (J M^-1 J^T)^-1 A of an acceleration A, damped near singularities.

    In the eigenvectors u_i of S (J M^-1 J^T) S, where S multiplies angles by a
    length, an eigenvalue w_i is one over the effective mass in that direction. The
    inverse used is S sum_i u_i u_i^T / (w_i + mu_i) S with

        mu_i = w_0 (1 - w_i / w_0)^2 where w_i < w_0 = 1 / max_mass, else 0:

    damped least squares along the near-singular directions only. Task accuracy in
    the others is untouched, and the joint accelerations stay bounded because the
    smallest denominator is 3 w_0 / 4 (compare Chiaverini, IEEE T. Robotics and
    Automation 13(3), 1997, with singular values in place of effective masses).

    Args:
        inverse_inertia: (6, 6) J M^-1 J^T, rotation first.
        acceleration: (6,) task acceleration A, rotation first.
        max_mass: heaviest direction that is driven exactly [kg].
        length: weighs angles against distances [m].

    Returns:
        (6,) spatial force, and the share of damping mu / (w + mu) in the worst
        direction.
    """
    scale = np.array([length, length, length, 1.0, 1.0, 1.0])
    weighed = np.empty((6, 6))
    for i in range(6):
        for j in range(6):
            weighed[i, j] = scale[i] * scale[j] * inverse_inertia[i, j]
    # The trace of the inverse is the sum of all effective masses: where even that is
    # light enough, nothing is to be damped, and the eigenvectors are not needed.
    regular, L = cholesky(weighed)
    force = np.zeros(6)
    if regular:
        inverse_L = forward(L, np.eye(6))
        if np.sum(inverse_L**2) <= max_mass:
            for k in range(6):
                along = 0.0
                for i in range(k + 1):
                    along += inverse_L[k, i] * scale[i] * acceleration[i]
                for i in range(k + 1):
                    force[i] += inverse_L[k, i] * along
            return scale * force, 0.0
    eigenvalues, vectors = np.linalg.eigh(weighed)
    floor = 1.0 / max_mass
    share = 0.0
    for k in range(6):
        # Rounding may leave a vanishing eigenvalue slightly negative.
        w = max(eigenvalues[k], 0.0)
        mu = floor * (1.0 - w / floor) ** 2 if w < floor else 0.0
        share = max(share, mu / (w + mu))
        along = 0.0
        for i in range(6):
            along += vectors[i, k] * scale[i] * acceleration[i]
        for i in range(6):
            force[i] += scale[i] * vectors[i, k] * along / (w + mu)
    return force, share


@compiled
def limit_torque(
    bias: FloatArray, drive: FloatArray, effort: FloatArray
) -> tuple[FloatArray, np.ndarray]:
    """Fits tau = bias + drive into the effort limits.

    When a joint is asked for too much, the whole drive is scaled by the largest
    factor in [0, 1] that fits: gravity stays carried and the commanded acceleration
    keeps its direction, where clipping joint by joint would bend the tool's path and
    turn the tool. A bias that alone is beyond its limit is clipped.

    Args:
        bias: (n,) torques that carry the arm [N m].
        drive: (n,) torques that accelerate it [N m].
        effort: (n,) largest torque either way [N m].

    Returns:
        (n,) torques within the limits, and (n,) which joints asked for more.
    """
    n = len(bias)
    saturated = np.zeros(n, dtype=np.bool_)
    factor = 1.0
    for i in range(n):
        tau = bias[i] + drive[i]
        if abs(tau) > effort[i]:
            saturated[i] = True
            room = effort[i] - bias[i] if tau > 0.0 else effort[i] + bias[i]
            if room <= 0.0:
                # Carrying alone takes it all: a drive that unloads it may stay.
                factor = min(factor, 0.0 if tau * drive[i] > 0.0 else 1.0)
            else:
                factor = min(factor, room / abs(drive[i]))
    tau = np.empty(n)
    for i in range(n):
        tau[i] = min(max(bias[i] + factor * drive[i], -effort[i]), effort[i])
    return tau, saturated


@compiled
def law(  # noqa: PLR0913
    q: FloatArray,
    v: FloatArray,
    p_WE: FloatArray,
    R_WE: FloatArray,
    M: FloatArray,
    h: FloatArray,
    J: FloatArray,
    Jdot_v: FloatArray,
    p_d: FloatArray,
    v_d: FloatArray,
    a_d: FloatArray,
    R_d: FloatArray,
    q_posture: FloatArray,
    forward_fed: FloatArray,
    q_lower: FloatArray,
    q_upper: FloatArray,
    effort: FloatArray,
    gains: tuple[float, ...],
) -> tuple[bool, FloatArray, np.ndarray, FloatArray, FloatArray, float]:
    """`drake_oa.control.operational_space.operational_space_torque` on plain arrays.

    `forward_fed` (6 + n,) is what is zero for a tool that does not turn and a posture at
    rest: w_d, alpha_d and v_posture, one after the other.

    Returns:
        Whether it applies: all is finite and M positive definite, else the rest means
        nothing; torques, saturated joints, position error, orientation error,
        singularity.
    """
    kp_p, kd_p, kp_R, kd_R, kp_n, kd_n, kp_limit, margin, max_mass, length = gains
    n = len(q)
    error_p = p_d - p_WE
    # R_d R_WE^T.
    error_R = rotation_vector(gram(R_d.T.copy(), R_WE.T.copy()))
    posture = kp_n * (q_posture - q) + kd_n * (forward_fed[6:] - v)
    velocity, wanted = np.zeros(6), -Jdot_v
    for i in range(6):
        for j in range(n):
            velocity[i] += J[i, j] * v[j]
            wanted[i] -= J[i, j] * posture[j]
    for i in range(3):
        wanted[i] += kp_R * error_R[i] + kd_R * (forward_fed[i] - velocity[i]) + forward_fed[3 + i]
        wanted[3 + i] += a_d[i] + kd_p * (v_d[i] - velocity[3 + i]) + kp_p * error_p[i]
    # A sum is finite only if every term is; and finite inputs may still overflow.
    nothing = np.zeros(n), np.zeros(n, dtype=np.bool_)
    if not math.isfinite(wanted.sum() + h.sum() + M.sum()):
        return False, nothing[0], nothing[1], error_p, error_R, 0.0
    # Repulsion is a torque: as an acceleration, the inertia that couples the joints
    # could turn it towards the limit.
    drive = np.zeros(n)
    for i in range(n):
        inside = min(max(q[i], q_lower[i] + margin), q_upper[i] - margin)
        drive[i] = kp_limit * M[i, i] * (inside - q[i])
    definite, L = cholesky(M)
    if not definite:
        return False, nothing[0], nothing[1], error_p, error_R, 0.0
    # With M = L L^T, J M^-1 x is (L^-1 J^T)^T (L^-1 x).
    root = forward(L, J.T.copy())
    wanted -= gram(root, forward(L, drive.reshape((n, 1))))[:, 0]
    force, singularity = damped_task_force(gram(root, root), wanted, max_mass, length)
    # M M^-1 J^T = J^T: the task's share of the torque needs no product with M.
    for i in range(n):
        for j in range(n):
            drive[i] += M[i, j] * posture[j]
        for j in range(6):
            drive[i] += J[j, i] * force[j]
    if not math.isfinite(drive.sum()):
        return False, nothing[0], nothing[1], error_p, error_R, 0.0
    tau, saturated = limit_torque(h, drive, effort)
    return True, tau, saturated, error_p, error_R, singularity
