"""Kinematics of the arm: poses, Jacobian, tracking of poses and inverse kinematics, compiled.

From pose to pose of the tool two damped Gauss-Newton steps (Y. Nakamura and H. Hanafusa, 1986),

    dq = l + J^T (J J^T + damp I)^-1 (e - J l),    l = g' - g + k (g - q),

e the way and turn to the next pose, g a posture that the null space is led along, g' the next one,
k by how much it is drawn to it. The first step leads, the second one, with l = 0, lands. An arm of
six joints has no null space but where it is singular; what its posture says there, landing leaves.
A joint that a step would take beyond its limit stops there, and the others make the step without
it. Inverse kinematics takes such steps from several configurations, damped in proportion to the
square of the error (T. Sugihara, 2011).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, RevoluteJoint

from drake_oa.common.compiled import compiled, kernel_arrays, leaf
from drake_oa.common.messages import BoolArray, FloatArray, IntArray

PULL = 20.0
"""Rate at which the null space is drawn to the guiding posture: the distance to it falls to
1 / e in 1 / 20 of the motion."""
_DRAWN, _LANDED = 1e-4, 1e-7
"""Damping of the two steps [m^2]: at 1e-4 a singular arm moves a joint by 1 rad for 1 cm."""
_LANDINGS, _MISSED = 4, 1e-4
"""The second step is repeated so often, until no more is missed [m, rad]."""
_STEPS, _NEAR = 60, 1e-6
"""Steps of the inverse kinematics from one configuration, and the error that it leaves [m, rad]."""
_DAMPED = 0.01
"""Share of the square of the error that damps such a step."""
_OFF_PATH = 5e-3
"""Error at which a path counts as not followed [m, rad]."""
_SAME = 0.1
"""Configurations are the same whose joints all differ by less [rad]."""


class Chain(NamedTuple):
    """n revolute joints in series, from the world to the tool.

    Attributes:
        X_PJ: (n + 1, 4, 4) frame of each joint in the body before it (the first in the world),
            its z axis being the joint's, and of the tool point E in the last body.
        lower, upper: (n,) limits of the joints, finite [rad].
        speed: (n,) their greatest speeds [rad/s].
        reach: (n,) no point of a sphere is farther from the joint's axis than this [m].
        q_index: (n,) places of the joints in the plant's positions.
    """

    X_PJ: FloatArray
    lower: FloatArray
    upper: FloatArray
    speed: FloatArray
    reach: FloatArray
    q_index: IntArray = np.zeros(0, dtype=np.int64)


class Spheres(NamedTuple):
    """S spheres of a robot in G groups, a body a group, by joint and then by body.

    Attributes:
        joint: (S,) the joint that moves each; -1: fixed to the world.
        p_JS: (S, 3) centers in that joint's frame (`chain_poses`), or in the world [m].
        radius: (S,) [m].
        of_tool: (S,) whether it is of the tool or of what the tool holds.
        first: (G + 1,) where each group's spheres begin, and S.
        group_joint: (G,) the joint that moves each group.
        bound: (G, 4) center as `p_JS`, and radius, of a sphere that holds the group's [m].
        cluster: (G + 1,) where each group's clusters of neighbors begin, and C.
        cluster_first: (C + 1,) where each cluster's spheres begin, and S.
        cluster_bound: (C, 4) as `bound`, of a cluster.
        pairs: (P, 2) groups that may touch each other.
        allowance: (P,) what a pair's spheres may overlap before its true shapes come near [m].
    """

    joint: IntArray
    p_JS: FloatArray
    radius: FloatArray
    of_tool: BoolArray
    first: IntArray
    group_joint: IntArray
    bound: FloatArray
    cluster: IntArray
    cluster_first: IntArray
    cluster_bound: FloatArray
    pairs: IntArray
    allowance: FloatArray


def make_chain(
    plant: MultibodyPlant, tool_frame: Frame, q: FloatArray, spheres: Spheres | None = None
) -> Chain:
    """Reads the joints between the world and the tool.

    Args:
        plant: finalized plant of the robot alone, its base welded to the world.
        tool_frame: the frame E.
        q: (nq,) configuration; joints that do not move the tool stay as they are here, and those
            without limits go a turn either way from here [rad, m].
        spheres: of the robot; None: `reach` is 0.

    Raises:
        ValueError: if a joint that moves the tool is not revolute.
    """
    context = plant.CreateDefaultContext()
    q = np.asarray(q, dtype=float)
    plant.SetPositions(context, q)
    joints = joints_to(plant, tool_frame)
    index = np.array([joint.position_start() for joint in joints], dtype=np.int64)
    before, X_PJ = RigidTransform(), []
    for joint, angle in zip(joints, q[index], strict=True):
        X_WJ = joint.child_body().EvalPoseInWorld(context) @ axis_frame(joint)
        back = RigidTransform(RotationMatrix.MakeZRotation(-angle), [0.0, 0.0, 0.0])
        X_PJ.append((before.inverse() @ X_WJ @ back).GetAsMatrix4())
        before = X_WJ
    X_PJ.append((before.inverse() @ tool_frame.CalcPoseInWorld(context)).GetAsMatrix4())
    reach = np.zeros(len(joints))
    if spheres is not None:
        far = np.linalg.norm(spheres.p_JS, axis=1) + spheres.radius
        step = np.linalg.norm(np.array(X_PJ)[:, :3, 3], axis=1)
        for last in range(len(joints)):
            farthest = far[spheres.joint == last].max(initial=-np.inf)
            for k in range(last + 1):
                reach[k] = max(reach[k], step[k + 1 : last + 1].sum() + farthest)
    lower, upper = plant.GetPositionLowerLimits()[index], plant.GetPositionUpperLimits()[index]
    lower = np.where(np.isfinite(lower), lower, q[index] - 2.0 * math.pi)
    upper = np.where(np.isfinite(upper), upper, q[index] + 2.0 * math.pi)
    speed = plant.GetVelocityUpperLimits()[[joint.velocity_start() for joint in joints]]
    return Chain(np.array(X_PJ), lower, upper, speed, reach, index)


def joints_to(plant: MultibodyPlant, tool_frame: Frame) -> list[RevoluteJoint]:
    """The moving joints from the world to the tool, in that order."""
    moving = [
        joint
        for joint in map(plant.get_joint, plant.GetJointIndices())
        if joint.num_velocities() > 0
        and tool_frame.body().index() in plant.GetBodiesKinematicallyAffectedBy([joint.index()])
    ]
    for joint in moving:
        if not isinstance(joint, RevoluteJoint):
            raise ValueError(
                f"joint '{joint.name()}' moves '{tool_frame.name()}' and is of type "
                f"{joint.type_name()}; the arm's joints must be revolute"
            )
    return moving


def axis_frame(joint: RevoluteJoint) -> RigidTransform:
    """Pose in the child body of a frame whose z axis is the joint's."""
    X_BM = joint.frame_on_child().GetFixedPoseInBodyFrame()
    return X_BM @ RigidTransform(
        RotationMatrix.MakeFromOneVector(joint.revolute_axis(), 2), [0] * 3
    )


class Scratch(NamedTuple):
    """Working memory of the kernels.

    Attributes:
        X: (n + 2, 12) poses.
        J, JJ: (6, n) the tool's Jacobian, and (6, 6) its square.
        e, b: (6,) the error, and the right-hand side of a step.
        lead, dq: (n,) the way of the joints in the null space, and the step.
        held: (n,) whether a joint stays at its limit.
    """

    X: FloatArray
    J: FloatArray
    JJ: FloatArray
    e: FloatArray
    b: FloatArray
    lead: FloatArray
    dq: FloatArray
    held: BoolArray


@compiled
def scratch(n: int) -> Scratch:
    """Allocates the working memory for an arm of n joints."""
    X, J, JJ = np.empty((n + 2, 12)), np.empty((6, n)), np.empty((6, 6))
    lead, dq, held = np.zeros(n), np.empty(n), np.zeros(n, dtype=np.bool_)
    return Scratch(X, J, JJ, np.empty(6), np.empty(6), lead, dq, held)


@leaf
def chain_poses(q: FloatArray, X_PJ: FloatArray, X: FloatArray) -> None:
    """Forward kinematics: X (n + 2, 12) of the world, the n joints and E, rotation, then position.

    Row i + 1 is the frame of joint i, so that row 0 is that of what is fixed to the world, -1.
    """
    n = len(q)
    for i in range(12):
        X[0, i] = 1.0 if i < 9 and i % 4 == 0 else 0.0
    for i in range(n + 1):
        c, s = (math.cos(q[i]), math.sin(q[i])) if i < n else (1.0, 0.0)
        for r in range(3):
            a, b, d = X[i, 3 * r], X[i, 3 * r + 1], X[i, 3 * r + 2]
            x = a * X_PJ[i, 0, 0] + b * X_PJ[i, 1, 0] + d * X_PJ[i, 2, 0]
            y = a * X_PJ[i, 0, 1] + b * X_PJ[i, 1, 1] + d * X_PJ[i, 2, 1]
            z = a * X_PJ[i, 0, 3] + b * X_PJ[i, 1, 3] + d * X_PJ[i, 2, 3]
            X[i + 1, 3 * r], X[i + 1, 3 * r + 1] = c * x + s * y, c * y - s * x
            X[i + 1, 3 * r + 2] = a * X_PJ[i, 0, 2] + b * X_PJ[i, 1, 2] + d * X_PJ[i, 2, 2]
            X[i + 1, 9 + r] = z + X[i, 9 + r]


@compiled
def tool_poses(chain: Chain, q: FloatArray) -> FloatArray:
    """(T, 12) poses of the tool, rotation, row by row, and position [m], of (T, n) [rad]."""
    X, X_WE = np.empty((q.shape[1] + 2, 12)), np.empty((len(q), 12))
    for row in range(len(q)):
        chain_poses(q[row], chain.X_PJ, X)
        X_WE[row] = X[-1]
    return X_WE


@leaf
def jacobian(X: FloatArray, J: FloatArray) -> None:
    """Sets J (6, n) to the tool's Jacobian, rotation before translation, in the world.

    X is (n + 2, 12) as `chain_poses` leaves it.
    """
    n = len(X) - 2
    for i in range(n):
        ax, ay, az = X[i + 1, 2], X[i + 1, 5], X[i + 1, 8]
        rx = X[n + 1, 9] - X[i + 1, 9]
        ry = X[n + 1, 10] - X[i + 1, 10]
        rz = X[n + 1, 11] - X[i + 1, 11]
        J[0, i], J[1, i], J[2, i] = ax, ay, az
        J[3, i], J[4, i], J[5, i] = ay * rz - az * ry, az * rx - ax * rz, ax * ry - ay * rx


@leaf
def _solve(A: FloatArray, b: FloatArray) -> None:
    """b becomes A^-1 b, A (m, m) positive definite, of which the lower half is read, and lost."""
    m = len(b)
    for j in range(m):
        d = A[j, j]
        for k in range(j):
            d -= A[j, k] * A[j, k] * A[k, k]
        A[j, j] = d
        for i in range(j + 1, m):
            v = A[i, j]
            for k in range(j):
                v -= A[i, k] * A[j, k] * A[k, k]
            A[i, j] = v / d
    for i in range(m):
        for k in range(i):
            b[i] -= A[i, k] * b[k]
    for i in range(m):
        b[i] /= A[i, i]
    for i in range(m - 1, -1, -1):
        for k in range(i + 1, m):
            b[i] -= A[k, i] * b[k]


@leaf
def pose_error(X: FloatArray, target: FloatArray, e: FloatArray) -> float:
    """Sets e (6,) to the turn [rad] and the way [m] from the last pose of X to another (12,).

    Half a turn, whose axis the skew part does not tell, counts as 1 rad about the world's x axis:
    a step leads out of it.

    Returns:
        The largest of them.
    """
    # The skew part of R_WT R_WE^T, and its trace.
    last = len(X) - 1
    x = y = z = trace = 0.0
    for k in range(3):
        t0, t1, t2 = target[k], target[3 + k], target[6 + k]
        e0, e1, e2 = X[last, k], X[last, 3 + k], X[last, 6 + k]
        x += t2 * e1 - t1 * e2
        y += t0 * e2 - t2 * e0
        z += t1 * e0 - t0 * e1
        trace += t0 * e0 + t1 * e1 + t2 * e2
    sine, cosine = 0.5 * math.sqrt(x * x + y * y + z * z), 0.5 * (trace - 1.0)
    scale = 0.5
    if cosine < 0.0 and sine <= 1e-9:
        x = 2.0
    elif cosine < 0.999:
        scale = 0.5 * math.atan2(sine, cosine) / sine
    e[0], e[1], e[2] = scale * x, scale * y, scale * z
    largest = 0.0
    for i in range(3):
        e[3 + i] = target[9 + i] - X[last, 9 + i]
        largest = max(largest, abs(e[i]), abs(e[3 + i]))
    return largest


@leaf
def step_toward(q: FloatArray, damping: float, chain: Chain, room: Scratch) -> None:
    """Moves q (n,), in place and within the limits, one step toward a pose of the tool.

    Args:
        q: (n,) [rad]; `room.X` holds its poses, see `chain_poses`, `room.e` the error, see
            `pose_error`, and `room.lead` where its null space is led.
        damping: [m^2].
        chain: the arm.
        room: working memory.
    """
    n = len(q)
    X, J, JJ, e, b, lead, dq, held = room
    jacobian(X, J)
    held[:] = False
    for _ in range(n + 1):
        # What the held joints and the lead of the others leave of the error.
        for i in range(6):
            b[i] = e[i]
            for k in range(n):
                b[i] -= J[i, k] * (dq[k] if held[k] else lead[k])
            for j in range(i + 1):
                v = 0.0
                for k in range(n):
                    if not held[k]:
                        v += J[i, k] * J[j, k]
                JJ[i, j] = v
            JJ[i, i] += damping
        _solve(JJ, b)
        is_within = True
        for k in range(n):
            if not held[k]:
                v = lead[k]
                for i in range(6):
                    v += J[i, k] * b[i]
                dq[k] = min(max(v, chain.lower[k] - q[k]), chain.upper[k] - q[k])
                if dq[k] != v:
                    held[k], is_within = True, False
        if is_within:
            break
    for k in range(n):
        q[k] = min(max(q[k] + dq[k], chain.lower[k]), chain.upper[k])


@leaf
def follow(
    q: FloatArray,
    target: FloatArray,
    guide: FloatArray,
    row: int,
    pull: float,
    chain: Chain,
    room: Scratch,
) -> float:
    """Moves q, in place, to the next pose of the tool; leaves the poses of the new q in `room`.

    Args:
        q: (n,) [rad].
        target: (12,) the next pose.
        guide: (T, n) postures that the null space is led along [rad].
        row: of the next of them; 0: it is not led.
        pull: share of the way to them that it is drawn.
        chain: the arm.
        room: working memory.

    Returns:
        The error that is left [m, rad].
    """
    chain_poses(q, chain.X_PJ, room.X)
    missed = pose_error(room.X, target, room.e)
    if row > 0:
        for i in range(len(q)):
            ahead = guide[row, i] - guide[row - 1, i]
            room.lead[i] = ahead + pull * (guide[row - 1, i] - q[i])
    step_toward(q, _DRAWN, chain, room)
    room.lead[:] = 0.0
    chain_poses(q, chain.X_PJ, room.X)
    missed = pose_error(room.X, target, room.e)
    for _ in range(_LANDINGS):
        step_toward(q, _LANDED if len(q) > 6 else _DRAWN, chain, room)
        chain_poses(q, chain.X_PJ, room.X)
        missed = pose_error(room.X, target, room.e)
        if missed < _MISSED:
            break
    return missed


@compiled
def reach(
    q: FloatArray, target: FloatArray, chain: Chain, near: FloatArray, pull: float
) -> FloatArray:
    """Moves configurations to a pose of the tool.

    Args:
        q: (N, n) where to begin [rad]; they are changed.
        target: (12,) the pose.
        chain: the arm.
        near: (n,) configuration that the null space is drawn to [rad].
        pull: share of the way there that it is drawn in each step; 0: a pose that is reached is
            left at once.

    Returns:
        (N,) the errors that are left [m, rad].
    """
    missed, room = np.empty(len(q)), scratch(q.shape[1])
    for row in range(len(q)):
        for step in range(_STEPS + 1):
            chain_poses(q[row], chain.X_PJ, room.X)
            missed[row] = pose_error(room.X, target, room.e)
            if step == _STEPS or (pull == 0.0 and missed[row] <= _NEAR):
                break
            for i in range(q.shape[1]):
                room.lead[i] = pull * (near[i] - q[row, i])
            damping = _LANDED + _DAMPED * (room.e @ room.e)
            step_toward(q[row], damping, chain, room)
    return missed


@compiled
def joint_margins(q_start: FloatArray, X_WE: FloatArray, pull: float, chain: Chain) -> FloatArray:
    """Tracks paths of the tool, and computes how far the joints stay from their limits.

    Args:
        q_start: (n,) where each path begins, and the null space is drawn to [rad].
        X_WE: (N, T, 12) the paths.
        pull: share of the way there that it is drawn from pose to pose.
        chain: the arm.

    Returns:
        (N, T) the least distance of a joint to its limit [rad]; -inf from the first pose that
        the arm does not reach.
    """
    N, T = X_WE.shape[:2]
    margins, room = np.full((N, T), -np.inf), scratch(len(q_start))
    guide = np.empty((2, len(q_start)))
    guide[:] = q_start
    for i in range(N):
        q = q_start.copy()
        for row in range(T):
            if follow(q, X_WE[i, row], guide, 1, pull, chain, room) > _OFF_PATH:
                break
            margins[i, row] = np.minimum(q - chain.lower, chain.upper - q).min()
    return margins


def inverse_kinematics(
    chain: Chain, X_WE: FloatArray, near: FloatArray, *, seeds: int = 32, seed: int = 0
) -> FloatArray:
    """Computes configurations (m, n) with the tool at a pose, the nearest first [rad].

    The same arguments give the same configurations; those of an arm of seven joints are samples of
    its self-motion.

    Args:
        chain: the arm.
        X_WE: (12,) the pose: rotation, row by row, and position [m].
        near: (n,) configuration to begin with [rad].
        seeds: number of random ones to begin with as well.
        seed: of those.
    """
    random = np.random.default_rng(seed)
    q = np.vstack([near, random.uniform(chain.lower, chain.upper, (seeds, len(near)))])
    q = q[reach(q, *kernel_arrays(X_WE), chain, *kernel_arrays(near), 0.0) <= _NEAR]
    kept: list[FloatArray] = []
    for one in q[np.argsort(np.linalg.norm(q - near, axis=1), kind="stable")]:
        if all(np.abs(one - other).max() > _SAME for other in kept):
            kept.append(one)
    return np.array(kept).reshape(-1, len(near))


def solve_tool_pose(
    plant: MultibodyPlant, tool_frame: str, X_WE: RigidTransform, q_seed: FloatArray
) -> FloatArray:
    """Computes positions (nq,), within the joint limits, with the tool frame E at a pose.

    Of the configurations that are found it is the one nearest to the seed; its null space is drawn
    there. The same arguments give the same positions. Joints that do not move the tool keep their
    seed.

    Args:
        plant: finalized plant of the robot alone.
        tool_frame: name of the frame E.
        X_WE: the pose.
        q_seed: (nq,) positions to begin with [rad, m].

    Raises:
        ValueError: "out of reach: ..." if none is found; or if a joint is not revolute.
    """
    chain = make_chain(plant, plant.GetFrameByName(tool_frame), q_seed)
    near, target = kernel_arrays(q_seed[chain.q_index], X_WE.GetAsMatrix34())
    target = np.append(target[:, :3].ravel(), target[:, 3])
    found = inverse_kinematics(chain, target, near)
    if not len(found):
        rpy = np.round(X_WE.rotation().ToRollPitchYaw().vector(), 3).tolist()
        raise ValueError(
            f"out of reach: {tool_frame} cannot be at {np.round(target[9:], 4).tolist()} m in the "
            f"world, roll, pitch, yaw {rpy} rad, within the joint limits"
        )
    drawn, q = found[:1].copy(), np.array(q_seed, dtype=float)
    reach(drawn, target, chain, near, 1.0)
    q[chain.q_index] = drawn[0] if reach(drawn, target, chain, near, 0.0)[0] <= _NEAR else found[0]
    return q


@compiled
def rotation_vector(R: FloatArray) -> FloatArray:
    """Log map of a rotation: unit axis times angle, the angle in [0, pi].

    Args:
        R: (3, 3) rotation matrix.

    Returns:
        (3,) rotation vector [rad].
    """
    twice = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = 0.5 * math.sqrt(twice[0] ** 2 + twice[1] ** 2 + twice[2] ** 2)
    cosine = 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0)
    angle = math.atan2(sine, cosine)
    if cosine > 0.0:
        scale = 0.5 * angle / sine if sine > 1e-8 else 0.5
        return scale * twice
    # Towards half a turn the antisymmetric part fades; the symmetric part is
    # cos I + (1 - cos) a a^T, from whose largest column the axis a follows.
    k = 0
    for i in range(1, 3):
        if R[i, i] > R[k, k]:
            k = i
    axis = np.empty(3)
    for i in range(3):
        axis[i] = 0.5 * (R[i, k] + R[k, i])
    axis[k] -= cosine
    norm = math.sqrt(axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2)
    sense = axis[0] * twice[0] + axis[1] * twice[1] + axis[2] * twice[2]
    return (angle / norm if sense >= 0.0 else -angle / norm) * axis


def rotation_of(quaternion: FloatArray) -> FloatArray:
    """Rotation matrix (3, 3) of a quaternion (4,), w first, of any length but zero.

    All NaN where the quaternion is zero or not finite.
    """
    with np.errstate(invalid="ignore"):
        scaled = quaternion / np.abs(quaternion).max()
        w, x, y, z = scaled / math.sqrt(scaled @ scaled)
        K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        return np.asarray(np.eye(3) + 2.0 * (w * K + K @ K))
