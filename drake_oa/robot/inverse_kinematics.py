"""Joint positions that put the tool where it is asked for.

`solve_tool_pose` is for set-up: any Drake plant, Drake's `InverseKinematics`. `solve_pose` is for
a great many poses of one arm, compiled: damped Newton steps within the joint limits.
"""

from __future__ import annotations

import math

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.inverse_kinematics import InverseKinematics
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, JacobianWrtVariable
from pydrake.solvers import Solve
from pydrake.systems.framework import Context
from scipy.optimize import lsq_linear

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray
from drake_oa.geometry.rotation import rotation_vector
from drake_oa.robot.arm_kernels import jacobian, poses

_SEEDS = 8
_MORE_SEEDS, _FEW = 400, 30
"""Seeds of the search by bounded steps, where the solver finds nothing from the first ones: of
poses at the joint limits one seed in thirty led to a solution. So many at most, and few ..."""
_FAR_OFF = 0.2
"""... where none of these comes as near as this [m, rad]."""
_NEWTON_STEPS = 10
_MORE_STEPS = 60
_TRUST = 0.5
"""Largest step of a joint [rad or m]."""
_STALLED = 0.995
"""A step that leaves more than this share of the error is the last one."""
_DISTANCE_WEIGHT = 1e4
_POSITION_BOUND = 1e-4
"""Half width of the solver's position constraint [m], narrowed by the Newton steps."""
_ORIENTATION_BOUND = 0.01
"""Width of the solver's orientation constraint [rad], narrowed by the Newton steps."""
_TOLERANCE = 1e-6
"""Greatest distance from the requested position [m], and angle from the orientation [rad]."""


def solve_tool_pose(
    plant: MultibodyPlant,
    tool_frame: str,
    X_WE: RigidTransform,
    q_seed: FloatArray,
    *,
    thorough: bool = True,
) -> FloatArray:
    """Positions, within the joint limits, that put the tool frame E at a pose.

    Drake's `InverseKinematics` finds the solution nearest to the seed; Newton steps
    then bring it onto the pose. Where it finds none from a few seeds, as for a pose at the
    joint limits, steps within the limits alone go on from many more. The same arguments give
    the same answer. Joints that do not move the tool keep their seed.

    Args:
        plant: finalized plant of the robot alone.
        tool_frame: name of the frame E.
        X_WE: asked pose.
        q_seed: (n,) positions to start from and to stay near [rad].
        thorough: whether to look further where the solver finds none: it takes seconds to
            refuse what is just out of reach.

    Returns:
        (n,) positions.

    Raises:
        ValueError: "out of reach: ..." when there is none, with how near the tool
            comes; or when the seed or the frame does not fit the plant.
    """
    q_seed = np.array(q_seed, dtype=float)
    n = plant.num_positions()
    if q_seed.shape != (n,) or not np.isfinite(q_seed).all():
        raise ValueError(f"q_seed is {q_seed}; it must hold {n} finite numbers for this plant")
    if not plant.HasFrameNamed(tool_frame):
        raise ValueError(f"tool_frame: the plant has no frame '{tool_frame}'")
    p_WE = X_WE.translation()
    if not np.isfinite(p_WE).all():
        raise ValueError(f"X_WE: the position {p_WE} must be finite [m]")
    frame = plant.GetFrameByName(tool_frame)

    def solved(guess: FloatArray) -> FloatArray | None:
        q = _nearest_solution(plant, frame, X_WE, guess, q_seed)
        if q is None:
            return None
        q, left = _refine(plant, frame, X_WE, q, _NEWTON_STEPS)
        return q if (left <= _TOLERANCE).all() else None

    for seed in _seeds(plant, frame, q_seed, _SEEDS):
        q = solved(seed)
        if q is not None:
            return q
    nearest = math.inf
    more = _seeds(plant, frame, q_seed, _MORE_SEEDS) if thorough else []
    for number, seed in enumerate(more):
        q, left = _refine(plant, frame, X_WE, seed, _MORE_STEPS)
        if (left <= _TOLERANCE).all():
            nearer = solved(q)
            return q if nearer is None else nearer
        nearest = min(nearest, float(np.linalg.norm(left)))
        if number >= _FEW and nearest > _FAR_OFF:
            break
    raise ValueError(_out_of_reach(plant, frame, X_WE, q_seed))


def _seeds(plant: MultibodyPlant, frame: Frame, q_seed: FloatArray, count: int) -> list[FloatArray]:
    """The given seed, the middle of the joint ranges, and fixed random places.

    Joints that do not move the frame are where the given seed has them.
    """
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q_seed)
    moves = _jacobian(plant, context, frame).any(axis=0)
    lower, upper = plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()
    bounded = moves & np.isfinite(lower) & np.isfinite(upper)
    lower, upper = np.where(bounded, lower, q_seed), np.where(bounded, upper, q_seed)
    random = np.random.default_rng(0)
    spread = [random.uniform(lower, upper) for _ in range(count)]
    return [q_seed, 0.5 * (lower + upper), *spread]


def _program(
    plant: MultibodyPlant, frame: Frame, X_WE: RigidTransform, q_seed: FloatArray
) -> InverseKinematics:
    """Joint limits, the asked orientation, and as near to the seed as can be."""
    problem = InverseKinematics(plant, with_joint_limits=True)
    problem.AddOrientationConstraint(
        plant.world_frame(), X_WE.rotation(), frame, RotationMatrix(), _ORIENTATION_BOUND
    )
    # It also keeps the joints that do not move the tool where they were.
    weight = np.eye(plant.num_positions())
    problem.prog().AddQuadraticErrorCost(weight, q_seed, problem.q())
    return problem


def _nearest_solution(
    plant: MultibodyPlant,
    frame: Frame,
    X_WE: RigidTransform,
    guess: FloatArray,
    q_seed: FloatArray,
) -> FloatArray | None:
    """The solver's answer from one initial guess, or None."""
    problem = _program(plant, frame, X_WE, q_seed)
    p_WE = X_WE.translation()
    problem.AddPositionConstraint(
        frame, np.zeros(3), plant.world_frame(), p_WE - _POSITION_BOUND, p_WE + _POSITION_BOUND
    )
    result = Solve(problem.prog(), guess)
    return np.array(result.GetSolution(problem.q())) if result.is_success() else None


def _error_at(
    plant: MultibodyPlant, context: Context, frame: Frame, X_WE: RigidTransform, q: FloatArray
) -> FloatArray:
    """(6,) rotation vector [rad] and translation [m] from the pose at q to the asked one."""
    plant.SetPositions(context, q)
    X_WF = frame.CalcPoseInWorld(context)
    R_error = X_WE.rotation().matrix() @ X_WF.rotation().matrix().T
    return np.concatenate(
        [rotation_vector(np.ascontiguousarray(R_error)), X_WE.translation() - X_WF.translation()]
    )


def _refine(
    plant: MultibodyPlant, frame: Frame, X_WE: RigidTransform, q: FloatArray, steps: int
) -> tuple[FloatArray, FloatArray]:
    """Newton steps onto the pose within the limits; positions, (2,) distance, angle left."""
    context = plant.CreateDefaultContext()
    lower, upper = plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()
    q, trust = np.clip(q, lower, upper), _TRUST
    error = _error_at(plant, context, frame, X_WE, q)
    for _ in range(steps):
        if not error.any():
            break
        plant.SetPositions(context, q)
        J = _jacobian(plant, context, frame)
        step = _bounded_step(J, error, np.maximum(lower - q, -trust), np.minimum(upper - q, trust))
        left = _error_at(plant, context, frame, X_WE, q + step)
        gained = np.linalg.norm(left) / np.linalg.norm(error)
        if gained < 1.0:
            q, error = np.clip(q + step, lower, upper), left
        elif trust > _TRUST / 64.0:
            trust *= 0.25
            continue
        if gained > _STALLED:
            break
        trust = min(2.0 * trust, _TRUST)
    return q, np.linalg.norm(error.reshape(2, 3), axis=1)[::-1]


def _jacobian(plant: MultibodyPlant, context: Context, frame: Frame) -> FloatArray:
    """(6, n) of the frame's origin in the world, angular part first."""
    world = plant.world_frame()
    return np.asarray(
        plant.CalcJacobianSpatialVelocity(
            context, JacobianWrtVariable.kQDot, frame, np.zeros(3), world, world
        )
    )


def _bounded_step(
    J: FloatArray, error: FloatArray, lower: FloatArray, upper: FloatArray
) -> FloatArray:
    """The (n,) step within bounds that makes up the most of an error (6,)."""
    step = np.linalg.lstsq(J, error, rcond=1e-6)[0]
    if (step >= lower).all() and (step <= upper).all():
        return np.asarray(step)
    return np.asarray(lsq_linear(J, error, bounds=(lower, upper), method="bvls").x)


def _out_of_reach(
    plant: MultibodyPlant, frame: Frame, X_WE: RigidTransform, q_seed: FloatArray
) -> str:
    """What to tell about a pose that has no solution: how near the tool comes."""
    problem = _program(plant, frame, X_WE, q_seed)
    problem.AddPositionCost(
        plant.world_frame(), X_WE.translation(), frame, np.zeros(3), _DISTANCE_WEIGHT * np.eye(3)
    )
    context = plant.CreateDefaultContext()
    nearest, p_WF = np.inf, np.zeros(3)
    for seed in _seeds(plant, frame, q_seed, _SEEDS):
        result = Solve(problem.prog(), seed)
        if result.is_success():
            q = result.GetSolution(problem.q())
            distance = float(np.linalg.norm(_error_at(plant, context, frame, X_WE, q)[3:]))
            if distance < nearest:
                nearest, p_WF = distance, frame.CalcPoseInWorld(context).translation()
    p_WE = X_WE.translation()
    rpy = X_WE.rotation().ToRollPitchYaw().vector()
    comes = (
        "no configuration with this orientation was found"
        if nearest == np.inf
        else f"with this orientation it comes as near as {nearest:.3f} m, "
        f"to {(np.round(p_WF, 3) + 0.0).tolist()}"
    )
    return (
        f"out of reach: {frame.name()} cannot be at {np.round(p_WE, 4).tolist()} m in the world, "
        f"roll, pitch, yaw {np.round(rpy, 3).tolist()} rad; {comes}"
    )


_ITERATIONS = 14


_POSITION, _ANGLE = 5e-4, 2e-3
"""Errors at which a pose counts as reached [m], [rad]."""


_LARGEST_STEP = 0.4
"""Of a joint in one iteration [rad]."""


_CENTRED = 0.2
"""Share of the way to the middle of the ranges, in the null space, of an iteration."""


_DAMPING = 1e-5


@compiled
def solve_pose(
    q: FloatArray,
    p_WE: FloatArray,
    R_WE: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    X_PJ: FloatArray,
    X_WB: FloatArray,
) -> bool:
    """Damped Newton steps to a tool pose within joint limits, q (n,) being changed.

    A joint that a step would push through its limit stops there, and the others make
    the step without it; what they are free to do draws them to the middle of their ranges,
    the more so the wider these are.

    Args:
        q: (n,) seed within the limits; receives the positions [rad].
        p_WE: (3,) asked position [m].
        R_WE: (3, 3) asked orientation.
        lower, upper: (n,) limits [rad].
        X_PJ: (n + 1, 4, 4) see `arm_kernels.poses`.
        X_WB: (n + 1, 4, 4) room for the bodies' poses.

    Returns:
        Whether the pose is reached.
    """
    n = len(q)
    e, left = np.empty(6), np.empty(6)
    J, A = np.empty((6, n)), np.empty((6, 6))
    weight, dq = np.empty(n), np.empty(n)
    held = np.empty(n, dtype=np.bool_)
    for i in range(n):
        weight[i] = min(upper[i] - lower[i], 2.0 * math.pi) ** 2
    for _ in range(_ITERATIONS):
        poses(q, X_PJ, X_WB)
        if _pose_error(X_WB[n], p_WE, R_WE, e):
            return True
        jacobian(X_WB, J)
        for i in range(n):
            held[i] = False
            dq[i] = 0.0
            if upper[i] - lower[i] < 100.0:
                dq[i] = _CENTRED * (0.5 * (lower[i] + upper[i]) - q[i])
        pulled = dq.copy()
        for _ in range(n):
            for row in range(6):
                left[row] = e[row]
                for i in range(n):
                    left[row] -= J[row, i] * (dq[i] if held[i] else pulled[i])
                for column in range(row + 1):
                    total = 0.0
                    for i in range(n):
                        if not held[i]:
                            total += J[row, i] * weight[i] * J[column, i]
                    A[row, column] = total
                A[row, row] += _DAMPING
            _solve_spd(A, left)
            again = False
            for i in range(n):
                if held[i]:
                    continue
                step = pulled[i]
                for row in range(6):
                    step += weight[i] * J[row, i] * left[row]
                dq[i] = step
            largest = 0.0
            for i in range(n):
                largest = max(largest, abs(dq[i]))
            shrink = min(1.0, _LARGEST_STEP / largest) if largest > 0.0 else 1.0
            for i in range(n):
                if held[i]:
                    continue
                if q[i] + shrink * dq[i] > upper[i] + 1e-12:
                    dq[i], held[i], again = upper[i] - q[i], True, True
                elif q[i] + shrink * dq[i] < lower[i] - 1e-12:
                    dq[i], held[i], again = lower[i] - q[i], True, True
            if not again:
                break
        largest = 0.0
        for i in range(n):
            largest = max(largest, abs(dq[i]))
        shrink = min(1.0, _LARGEST_STEP / largest) if largest > 0.0 else 1.0
        for i in range(n):
            q[i] = min(max(q[i] + shrink * dq[i], lower[i]), upper[i])
    poses(q, X_PJ, X_WB)
    return _pose_error(X_WB[n], p_WE, R_WE, e)


@compiled
def _pose_error(tool: FloatArray, p_WE: FloatArray, R_WE: FloatArray, e: FloatArray) -> bool:
    """Sets e (6,) to sin(angle) times the axis, and the way; says if both are small.

    Beyond a quarter turn the axis has the angle's sine of 1, so that half a turn is no rest.
    """
    cosine = -1.0
    for k in range(3):
        e[3 + k] = p_WE[k] - tool[k, 3]
        e[k] = 0.0
        i, j = (k + 1) % 3, (k + 2) % 3
        for c in range(3):
            # Sum over the columns of half tool x asked.
            e[k] += 0.5 * (tool[i, c] * R_WE[j, c] - tool[j, c] * R_WE[i, c])
            cosine += tool[k, c] * R_WE[k, c]
    cosine *= 0.5
    sine = math.sqrt(e[0] ** 2 + e[1] ** 2 + e[2] ** 2)
    distance = math.sqrt(e[3] ** 2 + e[4] ** 2 + e[5] ** 2)
    if cosine > 0.0:
        return distance < _POSITION and sine < _ANGLE
    if sine > 1e-6:
        for k in range(3):
            e[k] /= sine
    return False


@compiled
def _solve_spd(A: FloatArray, b: FloatArray) -> None:
    """Solves A x = b in place of b for a positive definite A, whose lower half is given."""
    n = len(b)
    for j in range(n):
        total = A[j, j]
        for k in range(j):
            total -= A[j, k] * A[j, k]
        d = math.sqrt(max(total, 1e-30))
        A[j, j] = d
        for i in range(j + 1, n):
            total = A[i, j]
            for k in range(j):
                total -= A[i, k] * A[j, k]
            A[i, j] = total / d
    for i in range(n):
        for k in range(i):
            b[i] -= A[i, k] * b[k]
        b[i] /= A[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= A[k, i] * b[k]
        b[i] /= A[i, i]


@compiled
def follow(
    q: FloatArray,
    path: FloatArray,
    R_WE: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    X_PJ: FloatArray,
    step: float,
    jump: float,
) -> int:
    """Leads the tool along straight legs.

    Args:
        q: (n,) where the arm is, at the first point or near it [rad]; changed.
        path: (P, 3) corners of the way [m].
        R_WE, lower, upper, X_PJ: as of `solve_pose`.
        step: of the tool [m].
        jump: of a joint in such a step, above which the arm does not follow [rad].

    Returns:
        The first corner that it does not get to; P where it gets to all.
    """
    n = len(q)
    X_WB = np.empty((n + 1, 4, 4))
    p, before = path[0].copy(), np.empty(n)
    if not solve_pose(q, p, R_WE, lower, upper, X_PJ, X_WB):
        return 0
    for corner in range(1, len(path)):
        length = 0.0
        for c in range(3):
            length += (path[corner, c] - path[corner - 1, c]) ** 2
        count = int(math.sqrt(length) / step) + 1
        for part in range(1, count + 1):
            before[:] = q
            for c in range(3):
                share = part / count
                p[c] = path[corner - 1, c] + share * (path[corner, c] - path[corner - 1, c])
            if not solve_pose(q, p, R_WE, lower, upper, X_PJ, X_WB):
                return corner
            for i in range(n):
                if abs(q[i] - before[i]) > jump:
                    return corner
    return len(path)
