"""Compiled kinematics of an arm: poses, Jacobian, tracking of tool poses, and inverse kinematics.

To track a path, the arm reaches each next pose of the tool by damped Gauss-Newton steps (Y.
Nakamura and H. Hanafusa, 1986) with the Jacobian J,

    dq = l + J^T (J J^T + damp I)^-1 (e - J l),    l = g' - g + k (g - q),

where q is the configuration, e is the rotation and translation to the next pose, damp is the
damping, and l is the desired joint displacement in the null space. The present and the next nominal
posture are g and g', and k (`pull`) is the fraction of the distance from q to g that is corrected
per pose. The first step to a pose follows the nominal posture in the null space; then corrective
steps with l = 0 reduce the remaining pose error. An arm of six joints has a null space at
singularities only. Its corrective steps have the damping of the first step, so that they do not
undo the null-space motion there. A joint that would exceed its limit is fixed at the limit, and the
other joints perform the step. Inverse kinematics performs such steps from several initial
configurations, with a damping that grows with the squared error (T. Sugihara, 2011).
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
"""Rate at which the arm approaches the nominal posture in its null space, per normalized time (time
over the duration of the motion) [-]. At a rate of 20, the distance to the nominal posture decreases
to 1 / e in 1 / 20 of the motion."""
_TRACKING_DAMPING, _CORRECTION_DAMPING = 1e-4, 1e-7
"""Damping of two kinds of inverse-kinematics steps when an arm tracks a tool path [m^2].

_TRACKING_DAMPING applies to the first step to each tool pose: an error of 1 cm moves the joints by
at most 0.5 rad in this step, even at a singularity. For an arm of six joints, _TRACKING_DAMPING
also applies to the corrective steps that follow. For an arm of more joints, corrective steps have
_CORRECTION_DAMPING, which is also the minimum damping of the inverse kinematics."""
_MAX_CORRECTIONS, _POSE_TOLERANCE = 4, 1e-4
"""Maximum number of corrective inverse-kinematics steps per tool pose of a tracked path, and pose
error below which these steps end (largest element of the tool's rotation vector [rad] and
translation [m] to the pose)."""
_MAX_STEP_ERROR, _MAX_JUMP = 0.25, 1.0
"""Limits of the inverse-kinematics steps to one pose of a tracked path.

A pose error above _MAX_STEP_ERROR is scaled down to this limit before the first step (largest
element of the tool's rotation vector [rad] and translation [m] to the pose). A pose counts as out
of reach if the steps move a joint by more than _MAX_JUMP [rad], because such a displacement leads
to another branch of the inverse kinematics."""
_OUT_OF_REACH = 1e-3
"""Minimum pose error at which a pose of a tracked path counts as out of reach, because the
inverse-kinematics steps have not reduced the error (largest element of the tool's rotation vector
[rad] and translation [m] to the pose)."""
_MAX_STEPS, _IK_TOLERANCE = 60, 1e-6
"""Maximum number of steps of the inverse kinematics from one initial configuration, and maximum
pose error at a solution (largest element of the tool's rotation vector [rad] and translation [m] to
the target pose)."""
_ERROR_DAMPING = 0.01
"""Ratio of the damping of an inverse-kinematics step to the squared norm of the pose error, which
consists of the tool's rotation vector [rad] and translation [m] to the target pose [-]. Far from
the target pose, the steps are thus damped more."""
_MAX_PATH_ERROR = 5e-3
"""Maximum pose error at which the arm still counts as following a path of the tool (largest element
of the tool's rotation vector [rad] and translation [m] to the desired pose)."""
_MIN_DIFFERENCE = 0.1
"""Minimum difference in the position of at least one joint between two distinct solutions of the
inverse kinematics [rad]. Solutions with a smaller difference count as the same."""


class Chain(NamedTuple):
    """Arm as arrays for compiled kernels: n revolute joints in series, from the world to the tool.

    Attributes:
        X_PJ: (n + 1, 4, 4) pose of each joint's frame J, at joint angle 0, in the frame P of the
            previous joint (in the world for the first joint). The z axis of J is the joint axis.
            The last row is the pose of the tool frame E in the frame of the last joint.
        lower, upper: (n,) finite position limits of the joints [rad].
        speed: (n,) maximum speeds of the joints [rad/s].
        reach: (n,) upper bound of the distance from each joint axis to any point of the spheres
            that cover the bodies moved by the joint; 0 without spheres [m]. Times the rotation of
            the joint, it bounds the displacement of these points.
        q_index: (n,) index of each joint in the positions of the plant.
    """

    X_PJ: FloatArray
    lower: FloatArray
    upper: FloatArray
    speed: FloatArray
    reach: FloatArray
    q_index: IntArray = np.zeros(0, dtype=np.int64)


class Spheres(NamedTuple):
    """Arrays of the spheres that cover a robot: S spheres in G groups, one group per body, sorted
    by joint and body.

    Attributes:
        joint: (S,) index of the last joint that moves each sphere; -1: the sphere is fixed to the
            world.
        p_JS: (S, 3) center of each sphere in the frame J of its joint, which moves with the joint
            and has the joint axis as z axis; in the world for joint -1 [m].
        radius: (S,) radius of each sphere [m].
        of_tool: (S,) whether each sphere belongs to the tool or to the grasped object.
        first: (G + 1,) index of the first sphere of each group; the last element is S.
        group_joint: (G,) index of the last joint that moves each group; -1: the group is fixed to
            the world.
        bound: (G, 4) center and radius of a sphere that contains the group [m]. The center is in
            the same frame as the centers `p_JS` of the group's spheres.
        cluster: (G + 1,) index of the first cluster of each group, where a cluster is a set of
            neighboring spheres; the last element is the number C of clusters.
        cluster_first: (C + 1,) index of the first sphere of each cluster; the last element is S.
        cluster_bound: (C, 4) center and radius of a sphere that contains the cluster [m], in the
            same frame.
        pairs: (P, 2) indices of two groups that can collide with each other.
        allowance: (P,) overlap of the spheres of each pair up to which the exact shapes of both
            bodies count as apart [m].
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
    """Builds the `Chain` of an arm, which describes the joints between the world and the tool by
    arrays for compiled kernels.

    Args:
        plant: finalized plant of the robot alone, its base welded to the world.
        tool_frame: tool frame E.
        q: (nq,) configuration [rad, m]. Joints that do not move the tool are fixed at this
            configuration. Joints without limits can turn by one revolution in each direction from
            it.
        spheres: spheres that cover the robot, from which `reach` is computed; None: `reach` is 0.

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
    """Returns the joints that move the tool, in the order from the world to the tool.

    Raises:
        ValueError: if one of these joints is not revolute.
    """
    moving = [
        joint
        for joint in map(plant.get_joint, plant.GetJointIndices())
        if joint.num_velocities() > 0
        and tool_frame.body().index() in plant.GetBodiesKinematicallyAffectedBy([joint.index()])
    ]
    for joint in moving:
        if not isinstance(joint, RevoluteJoint):
            raise ValueError(
                f"joint '{joint.name()}' moves '{tool_frame.name()}' and has type "
                f"{joint.type_name()}; the arm's joints must be revolute"
            )
    return moving


def check_actuated(plant: MultibodyPlant) -> None:
    """Checks that every joint of a finalized plant that moves has an actuator.

    Joints with an actuator have one degree of freedom. A body without a joint to another body
    gets a floating joint, which has no actuator and is an error, too.

    Raises:
        ValueError: naming the first joint that moves without an actuator.
    """
    actuators = map(plant.get_joint_actuator, plant.GetJointActuatorIndices())
    actuated = {actuator.joint().index() for actuator in actuators}
    for joint in map(plant.get_joint, plant.GetJointIndices()):
        if joint.num_velocities() and joint.index() not in actuated:
            raise ValueError(
                f"joint '{joint.name()}' moves without an actuator; add a transmission and an "
                "effort limit above 0, or fix the joint; the plant must have the robot alone"
            )


def axis_frame(joint: RevoluteJoint) -> RigidTransform:
    """Returns the pose X_BJ of a revolute joint's frame J in the child body B of the joint.

    The origin of J is that of the joint, and the z axis of J is along the joint axis.
    """
    X_BM = joint.frame_on_child().GetFixedPoseInBodyFrame()
    return X_BM @ RigidTransform(
        RotationMatrix.MakeFromOneVector(joint.revolute_axis(), 2), [0] * 3
    )


class Scratch(NamedTuple):
    """Working memory of the compiled kinematics kernels for an arm of n joints, allocated once and
    overwritten in each step.

    Attributes:
        X: (n + 2, 12) poses of the world, the joint frames and the tool, as computed by
            `chain_poses`.
        J, JJ: (6, n) Jacobian J of the tool; (6, 6) product J J^T plus damping.
        e, b: (6,) pose error of the tool, that is, rotation [rad] and translation [m] to the target
            pose in the world; (6,) right-hand side of a step's linear equations.
        null_step, dq: (n,) desired joint displacement l in the null space [rad]; (n,) joint
            displacement of the step [rad].
        q_before: (n,) configuration before the steps to a tool pose [rad].
        is_fixed: (n,) whether each joint is fixed at its limit during the step.
    """

    X: FloatArray
    J: FloatArray
    JJ: FloatArray
    e: FloatArray
    b: FloatArray
    null_step: FloatArray
    dq: FloatArray
    q_before: FloatArray
    is_fixed: BoolArray


@compiled
def scratch(n: int) -> Scratch:
    """Allocates the working memory `Scratch` of the compiled kinematics kernels for an arm of n
    joints.
    """
    X, J, JJ = np.empty((n + 2, 12)), np.empty((6, n)), np.empty((6, 6))
    null_step, dq, q_before = np.zeros(n), np.empty(n), np.empty(n)
    is_fixed = np.zeros(n, dtype=np.bool_)
    return Scratch(X, J, JJ, np.empty(6), np.empty(6), null_step, dq, q_before, is_fixed)


@leaf
def chain_poses(q: FloatArray, X_PJ: FloatArray, X: FloatArray) -> None:
    """Computes the poses of the joint frames and of the tool at a configuration (forward
    kinematics).

    The poses are in the world. A row of X is a rotation matrix, row by row, and a position [m]. Row
    0 is the world, which is the frame of bodies with joint index -1. Row i + 1 is the frame of
    joint i. The last row is the tool frame E.

    Args:
        q: (n,) configuration [rad].
        X_PJ: (n + 1, 4, 4) pose of each joint frame, at joint angle 0, in the previous one (the
            first in the world), and of the tool frame E in the last joint frame.
        X: (n + 2, 12) poses, set in place.
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
    """Computes the poses (T, 12) of the tool frame E at configurations q (T, n) [rad].

    A pose is a rotation matrix, row by row, and a position [m], both in the world.
    """
    X, X_WE = np.empty((q.shape[1] + 2, 12)), np.empty((len(q), 12))
    for row in range(len(q)):
        chain_poses(q[row], chain.X_PJ, X)
        X_WE[row] = X[-1]
    return X_WE


@leaf
def jacobian(X: FloatArray, J: FloatArray) -> None:
    """Computes the geometric Jacobian of the tool frame in the world, which maps joint speeds to
    the tool's angular velocity (first three rows) and velocity.

    Args:
        X: (n + 2, 12) poses of the world, the joint frames and the tool in the world, from
            `chain_poses`: rotation matrix, row by row, and position [m].
        J: (6, n) Jacobian, set in place.
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
    """Solves A x = b for a positive definite matrix A by LDL^T factorization, in place: b becomes
    the solution x.

    Args:
        A: (m, m) matrix, whose lower triangle is read and overwritten.
        b: (m,) right-hand side, overwritten by the solution x.
    """
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
    """Computes the rotation and translation that move the tool from its present pose, the last pose
    of X, to a target pose.

    For a rotation by half a turn, the skew-symmetric part of the rotation matrix gives no axis.
    Then the error is a rotation of 1 rad about the world's x axis, so that one step leaves this
    case.

    Args:
        X: (n + 2, 12) poses of the world, the joint frames and, in the last row, the tool in the
            world, from `chain_poses`: rotation matrix, row by row, and position [m].
        target: (12,) target pose in the world, in the same form.
        e: (6,) rotation [rad] and translation [m] in the world, set in place.

    Returns:
        Maximum absolute element of e [rad, m].
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
def step_toward(q: FloatArray, damping: float, chain: Chain, work: Scratch) -> None:
    """Moves a configuration by one damped least-squares step toward a pose of the tool, within the
    joint limits.

    The step is dq = l + J^T (J J^T + damp I)^-1 (e - J l), with the Jacobian J, the pose error e,
    and the desired joint displacement l in the null space. A joint that would exceed its limit is
    fixed at the limit, and the other joints perform the step.

    Args:
        q: (n,) configuration, modified in place [rad].
        damping: damping of the step, `damp` in the equation [m^2].
        chain: chain of the arm.
        work: working memory with the poses of q in `X`, the pose error e in `e`, and the
            displacement l in `null_step`.
    """
    n = len(q)
    X, J, JJ, e, b, null_step, dq, _, is_fixed = work
    jacobian(X, J)
    is_fixed[:] = False
    for _ in range(n + 1):
        # Pose error that remains after the steps of fixed joints and the null-space displacement.
        for i in range(6):
            b[i] = e[i]
            for k in range(n):
                b[i] -= J[i, k] * (dq[k] if is_fixed[k] else null_step[k])
            for j in range(i + 1):
                v = 0.0
                for k in range(n):
                    if not is_fixed[k]:
                        v += J[i, k] * J[j, k]
                JJ[i, j] = v
            JJ[i, i] += damping
        _solve(JJ, b)
        is_within = True
        for k in range(n):
            if not is_fixed[k]:
                v = null_step[k]
                for i in range(6):
                    v += J[i, k] * b[i]
                dq[k] = min(max(v, chain.lower[k] - q[k]), chain.upper[k] - q[k])
                if dq[k] != v:
                    is_fixed[k], is_within = True, False
        if is_within:
            break
    for k in range(n):
        q[k] = min(max(q[k] + dq[k], chain.lower[k]), chain.upper[k])


@leaf
def follow(
    q: FloatArray,
    target: FloatArray,
    postures: FloatArray,
    row: int,
    pull: float,
    chain: Chain,
    work: Scratch,
) -> float:
    """Moves a configuration to the next tool pose of a path by damped least-squares steps, and
    tracks nominal postures in the null space.

    A pose error with an element above 0.25 m or 0.25 rad is scaled down to this maximum before the
    step. The configuration does not change if the steps do not reduce the pose error, because the
    pose is out of reach, or if they move a joint by more than 1 rad: near an extended elbow, steps
    would alternate between two mirrored configurations. The poses of the joint frames and of the
    tool at the new configuration are stored in `work.X`.

    Args:
        q: (n,) configuration, modified in place [rad].
        target: (12,) next pose of the tool in the world: rotation matrix, row by row, and position
            [m].
        postures: (T, n) nominal postures along the path, which the arm tracks in its null space
            [rad].
        row: index, in `postures`, of the nominal posture for the next pose; row - 1 is that of the
            present pose. 0: no motion in the null space.
        pull: fraction of the distance to the nominal posture that is corrected in this step [-].
        chain: chain of the arm.
        work: working memory.

    Returns:
        Remaining pose error of the tool: largest absolute element of the rotation and translation
        to the target [rad, m].
    """
    chain_poses(q, chain.X_PJ, work.X)
    error = error_before = pose_error(work.X, target, work.e)
    for i in range(len(q)):
        work.q_before[i] = q[i]
        if row > 0:
            ahead = postures[row, i] - postures[row - 1, i]
            work.null_step[i] = ahead + pull * (postures[row - 1, i] - q[i])
    for i in range(6):
        work.e[i] *= _MAX_STEP_ERROR / max(error, _MAX_STEP_ERROR)
    step_toward(q, _TRACKING_DAMPING, chain, work)
    work.null_step[:] = 0.0
    chain_poses(q, chain.X_PJ, work.X)
    error = pose_error(work.X, target, work.e)
    for _ in range(_MAX_CORRECTIONS if error_before <= _MAX_STEP_ERROR else 0):
        step_toward(q, _CORRECTION_DAMPING if len(q) > 6 else _TRACKING_DAMPING, chain, work)
        chain_poses(q, chain.X_PJ, work.X)
        error = pose_error(work.X, target, work.e)
        if error < _POSE_TOLERANCE:
            break
    jump = 0.0
    for i in range(len(q)):
        jump = max(jump, abs(q[i] - work.q_before[i]))
    if error >= max(error_before, _OUT_OF_REACH) or jump > _MAX_JUMP:
        for i in range(len(q)):
            q[i] = work.q_before[i]
        chain_poses(q, chain.X_PJ, work.X)
        return error_before
    return error


@compiled
def reach(
    q: FloatArray, target: FloatArray, chain: Chain, near: FloatArray, pull: float
) -> FloatArray:
    """Moves each of N configurations toward one pose of the tool by at most 60 damped least-squares
    steps, the iteration of the inverse kinematics.

    Args:
        q: (N, n) initial configurations, modified in place [rad].
        target: (12,) pose of the tool in the world: rotation matrix, row by row, and position [m].
        chain: chain of the arm.
        near: (n,) nominal posture, which the arm tracks in its null space [rad].
        pull: fraction of the distance to the nominal posture that is corrected per step [-]. At 0,
            the steps of a configuration end once it reaches the pose; otherwise all steps are
            performed.

    Returns:
        (N,) remaining pose error of each configuration: largest absolute element of the rotation
        and translation to the pose [rad, m].
    """
    errors, work = np.empty(len(q)), scratch(q.shape[1])
    for row in range(len(q)):
        for step in range(_MAX_STEPS + 1):
            chain_poses(q[row], chain.X_PJ, work.X)
            errors[row] = pose_error(work.X, target, work.e)
            if step == _MAX_STEPS or (pull == 0.0 and errors[row] <= _IK_TOLERANCE):
                break
            for i in range(q.shape[1]):
                work.null_step[i] = pull * (near[i] - q[row, i])
            damping = _CORRECTION_DAMPING + _ERROR_DAMPING * (work.e @ work.e)
            step_toward(q[row], damping, chain, work)
    return errors


@compiled
def joint_margins(q_start: FloatArray, X_WE: FloatArray, pull: float, chain: Chain) -> FloatArray:
    """Simulates an arm that tracks paths of the tool, and computes the distance of the joints from
    their limits at each pose.

    Args:
        q_start: (n,) configuration at the start of each path, also the nominal posture [rad].
        X_WE: (N, T, 12) tool poses of N paths in the world: rotation matrices, row by row, and
            positions [m].
        pull: fraction of the distance to the nominal posture that is corrected per pose [-].
        chain: chain of the arm.

    Returns:
        (N, T) minimum over the joints of the distance from a joint limit [rad]; -inf from the first
        pose of a path that the arm cannot reach.
    """
    N, T = X_WE.shape[:2]
    margins, work = np.full((N, T), -np.inf), scratch(len(q_start))
    postures = np.empty((2, len(q_start)))
    postures[:] = q_start
    for i in range(N):
        q = q_start.copy()
        for row in range(T):
            if follow(q, X_WE[i, row], postures, 1, pull, chain, work) > _MAX_PATH_ERROR:
                break
            margins[i, row] = np.minimum(q - chain.lower, chain.upper - q).min()
    return margins


def inverse_kinematics(
    chain: Chain, X_WE: FloatArray, near: FloatArray, *, seeds: int = 32, seed: int = 0
) -> FloatArray:
    """Computes distinct configurations (m, n) [rad] of an arm that reach a pose of the tool, in
    order of Euclidean distance from the configuration `near`.

    The result has no rows if the pose cannot be reached. The same arguments give the same
    configurations. An arm of seven joints has infinitely many solutions; the configurations are
    samples of them.

    Args:
        chain: chain of the arm.
        X_WE: (12,) pose of the tool in the world: rotation matrix, row by row, and position [m].
        near: (n,) configuration at which the first of several searches starts [rad].
        seeds: number of further searches, which start at random configurations.
        seed: seed of the random number generator.
    """
    random = np.random.default_rng(seed)
    q = np.vstack([near, random.uniform(chain.lower, chain.upper, (seeds, len(near)))])
    q = q[reach(q, *kernel_arrays(X_WE), chain, *kernel_arrays(near), 0.0) <= _IK_TOLERANCE]
    distinct: list[FloatArray] = []
    for one in q[np.argsort(np.linalg.norm(q - near, axis=1), kind="stable")]:
        if all(np.abs(one - other).max() > _MIN_DIFFERENCE for other in distinct):
            distinct.append(one)
    return np.array(distinct).reshape(-1, len(near))


def solve_tool_pose(
    plant: MultibodyPlant, tool_frame: str, X_WE: RigidTransform, q_seed: FloatArray
) -> FloatArray:
    """Computes a configuration (nq,) of the robot within the joint limits for a pose of the tool
    frame E [rad, m].

    The result is the solution nearest to the seed, moved closer to the seed in the null space of
    the arm. The same arguments give the same configuration. Joints that do not move the tool have
    the positions of the seed.

    Args:
        plant: finalized plant of the robot alone, with its base welded to the world.
        tool_frame: name of the tool frame E in the plant.
        X_WE: pose of the tool frame in the world.
        q_seed: (nq,) configuration that is the seed of the search [rad, m].

    Raises:
        ValueError: if no solution is found, with a text that begins with "out of reach:", or if a
            joint that moves the tool is not revolute.
    """
    chain = make_chain(plant, plant.GetFrameByName(tool_frame), q_seed)
    near, target = kernel_arrays(q_seed[chain.q_index], X_WE.GetAsMatrix34())
    target = np.append(target[:, :3].ravel(), target[:, 3])
    solutions = inverse_kinematics(chain, target, near)
    if not len(solutions):
        rpy = np.round(X_WE.rotation().ToRollPitchYaw().vector(), 3).tolist()
        raise ValueError(
            f"out of reach: {tool_frame} cannot be at {np.round(target[9:], 4).tolist()} m in the "
            f"world, roll, pitch, yaw {rpy} rad, within the joint limits"
        )
    refined, q = solutions[:1].copy(), np.array(q_seed, dtype=float)
    reach(refined, target, chain, near, 1.0)
    q[chain.q_index] = (
        refined[0] if reach(refined, target, chain, near, 0.0)[0] <= _IK_TOLERANCE else solutions[0]
    )
    return q


@compiled
def rotation_vector(R: FloatArray) -> FloatArray:
    """Computes the rotation vector of a rotation matrix: unit axis times angle in [0, pi] (log
    map).

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
    # Near half a turn the antisymmetric part vanishes. The symmetric part is
    # cos I + (1 - cos) a a^T; its largest column gives the axis a.
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
    """Computes the rotation matrix (3, 3) of a quaternion (4,), w first, which need not have unit
    length.

    If the quaternion is zero or not finite, all elements of the matrix are NaN.
    """
    with np.errstate(invalid="ignore"):
        scaled = quaternion / np.abs(quaternion).max()
        w, x, y, z = scaled / math.sqrt(scaled @ scaled)
        K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        return np.asarray(np.eye(3) + 2.0 * (w * K + K @ K))
