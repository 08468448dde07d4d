"""The links' reaction to obstacles: the coupling law in the null space of the tool's task.

The final remarks of the paper: "collisions of the links can also be considered by finding the
closest geometric section on the robot to the obstacle, and then modulating the kinematic
null-space movement with the proposed approach". For each obstacle, of the links' point S that
is nearest to it, at distance d and with velocity v relative to the obstacle,

    a_S = Omega x v,    |Omega| = alpha exp(-theta^2 / psi^2) exp(-kappa d^2),

which is (eq. oa_complete) with theta the angle from the way to the obstacle to v, d counted
from the surface, and time in place of normalised time. It acts while v approaches, theta <
pi / 2, and fades over the last 0.2 of cos(theta). In joint space, with Z an orthonormal basis
of the null space of the tool's Jacobian, the sum over the obstacles of

    a_0 = Z (J_S Z)^+ a_S

with a damped inverse (A. A. Maciejewski, C. A. Klein, Int. J. Robotics Research 4(3), 1985)
is what the controller adds: none of it moves the tool.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, EventStatus, LeafSystem, State

from drake_oa.common.compiled import compiled
from drake_oa.common.config import check_values
from drake_oa.common.messages import FloatArray, Frozen, ObstacleClouds
from drake_oa.common.numba_tools import kernel_arrays
from drake_oa.common.ports import DECISION_OFFSET, read_value, valid_period
from drake_oa.geometry.points import GuardShapes, ObstaclePoints, PointBlocks
from drake_oa.geometry.primitives import point_distance, posed, to_frame
from drake_oa.geometry.voxels import VOXEL, thinned
from drake_oa.policy.coupling import avoidance_term, norm
from drake_oa.robot.arm import ArmModel
from drake_oa.robot.arm_kernels import jacobian, nearest_point
from drake_oa.robot.config import NullSpaceCouplingParameters

_AT_REST = 1e-6
"""Speeds below this have no direction [m/s]."""
_FADES = 0.2
"""Cosine of the heading from which on the reaction fades to that of no approach, 0."""


@compiled
def nearest_section(
    X_WB: FloatArray,
    shapes: GuardShapes,
    blocks: PointBlocks,
    age: float,
    only: int,
    limit: float,
    p_WS: FloatArray,
    u_W: FloatArray,
) -> tuple[float, int]:
    """The point S of an arm's shapes that is nearest to an obstacle.

    Args:
        X_WB, ..., limit: as of `arm_kernels.nearest_point`; `only` is an obstacle's row.
        p_WS: (3,) receives S in the world [m].
        u_W: (3,) receives the unit direction from there to the obstacle.

    Returns:
        The distance [m], negative inside, and the body; the limit and -1 where all of the
        obstacle is farther away.
    """
    distance, shape, owner, row = nearest_point(X_WB, shapes, blocks, age, only, limit)
    if shape < 0:
        return limit, -1
    body = shapes.shape_body[shape]
    X_WG = np.empty((3, 4))
    posed(X_WB[body], shapes.X_BG[shape], X_WG)
    p_WQ = np.empty(3)
    for i in range(3):
        p_WQ[i] = blocks.points[row, i] + blocks.v_WO[owner, i] * age
    x, y, z = to_frame(X_WG, p_WQ[0] - X_WG[0, 3], p_WQ[1] - X_WG[1, 3], p_WQ[2] - X_WG[2, 3])
    _, ux, uy, uz = point_distance(x, y, z, shapes.size[shape])
    for i in range(3):
        u_W[i] = X_WG[i, 0] * ux + X_WG[i, 1] * uy + X_WG[i, 2] * uz
        p_WS[i] = p_WQ[i] - distance * u_W[i]
    return distance, body


@compiled
def point_jacobian(X_WB: FloatArray, body: int, p_WS: FloatArray, J: FloatArray) -> None:
    """Jacobian of the velocity of a body's point.

    Args:
        X_WB: (n + 1, 4, 4) as `arm_kernels.poses` leaves them.
        body: the body's row.
        p_WS: (3,) the point in the world [m].
        J: (3, n) receives it.
    """
    for i in range(J.shape[1]):
        if i > body:
            J[0, i], J[1, i], J[2, i] = 0.0, 0.0, 0.0
            continue
        ax, ay, az = X_WB[i, 0, 2], X_WB[i, 1, 2], X_WB[i, 2, 2]
        rx, ry, rz = p_WS[0] - X_WB[i, 0, 3], p_WS[1] - X_WB[i, 1, 3], p_WS[2] - X_WB[i, 2, 3]
        J[0, i], J[1, i], J[2, i] = ay * rz - az * ry, az * rx - ax * rz, ax * ry - ay * rx


@compiled
def turned_away(
    v_W: FloatArray,
    u_W: FloatArray,
    distance: float,
    alpha: float,
    psi: float,
    kappa: float,
    step: float,
    a_W: FloatArray,
) -> None:
    """The acceleration Omega x v that turns a point away from what is nearest to it.

    Args:
        v_W: (3,) its velocity relative to the obstacle's [m/s].
        u_W: (3,) unit direction to the obstacle.
        distance: to its surface [m].
        alpha, psi, kappa: of (eq. oa_complete) [rad/s, rad, 1/m^2].
        step: how long the acceleration is held [s]; in it the heading does not turn past
            the direction straight away.
        a_W: (3,) receives it [m/s^2].
    """
    a_W[:] = 0.0
    speed = norm((v_W[0], v_W[1], v_W[2]))
    if not speed > _AT_REST:
        return
    e = v_W[0] / speed, v_W[1] / speed, v_W[2] / speed
    u = u_W[0], u_W[1], u_W[2]
    toward = e[0] * u[0] + e[1] * u[1] + e[2] * u[2]
    if toward <= 0.0:
        return
    near = max(distance, 0.0)
    (ax, ay, az), explicit, divisor = avoidance_term(
        u, e, (0.0, 0.0, 0.0), alpha, psi, kappa * near * near, False, False, step
    )
    if divisor == 0.0:
        return
    # It ends with the approach, and without a jump.
    rate = min(toward / _FADES, 1.0) * explicit / divisor / step
    a_W[0] = rate * (ay * v_W[2] - az * v_W[1])
    a_W[1] = rate * (az * v_W[0] - ax * v_W[2])
    a_W[2] = rate * (ax * v_W[1] - ay * v_W[0])


DAMPING = 0.1
"""Of the damped inverse [m]: a section that the null space moves by less a radian than this
is not chased."""
_FAINT = 1e-3
"""Where exp(-kappa d^2) is below this there is no reaction."""
_SINGULAR = 1e-6
"""Singular values of the tool's Jacobian below this share of the largest are zero."""


def reach(parameters: NullSpaceCouplingParameters) -> float:
    """Distance beyond which there is no reaction [m]."""
    return math.sqrt(-math.log(_FAINT) / parameters.kappa)


def section_acceleration(
    v_W: FloatArray,
    u_W: FloatArray,
    distance: float,
    parameters: NullSpaceCouplingParameters,
    step: float,
) -> FloatArray:
    """(3,) acceleration a_S of a section [m/s^2], orthogonal to v.

    Args:
        v_W: (3,) velocity relative to the obstacle's [m/s].
        u_W: (3,) unit direction to the obstacle.
        distance: to its surface [m].
        parameters: of the law.
        step: how long it is held [s].
    """
    a_W = np.zeros(3)
    if distance < reach(parameters):
        p = parameters
        v, u = kernel_arrays(v_W, u_W)
        turned_away(v, u, distance, p.alpha, p.psi, p.kappa, step, a_W)
    return a_W


def null_space_basis(J: FloatArray) -> FloatArray:
    """(n, n - rank) orthonormal columns Z with J Z = 0."""
    _, values, rows = np.linalg.svd(J)
    rank = int(np.count_nonzero(values > _SINGULAR * values[0])) if len(values) else 0
    return np.asarray(rows[rank:].T)


PADDING = 0.25 * VOXEL
"""In the middle of four points of a sheet its surface is nearer by this, for a link that touches it
in a point of the rounding of 6 cm [m]."""


def thinned_points(seen: ObstacleClouds) -> ObstaclePoints:
    """The obstacles' points, one a voxel of 2 cm.

    Raises:
        ValueError: if a point or a velocity is not finite.
    """
    clouds = tuple(thinned(cloud) for cloud in seen.clouds_W)
    return ObstaclePoints.of(replace(seen, clouds_W=clouds))


def null_space_acceleration(
    arm: ArmModel,
    seen: ObstaclePoints,
    q: FloatArray,
    v: FloatArray,
    parameters: NullSpaceCouplingParameters,
    *,
    time: float,
    step: float,
) -> FloatArray:
    """The joints' accelerations that turn the arm's nearest sections away from the obstacles.

    Args:
        arm: whose.
        seen: the obstacles, see `thinned_points`; the table is none of them.
        q, v: (n,) positions and velocities of the arm's joints [rad, rad/s].
        parameters: of the law.
        time: now [s].
        step: how long the acceleration is held [s].

    Returns:
        (n,) in the null space of the tool's Jacobian [rad/s^2], of a bounded norm.
    """
    n = len(arm.posture)
    total = np.zeros(n)
    if not len(seen.points) or parameters.alpha == 0.0:
        return total
    X_WB = arm.poses(q)
    age = max(time - seen.stamp, 0.0)
    p_WS, u_W, J_S, Z = np.empty(3), np.empty(3), np.empty((3, n)), np.empty((n, 0))
    for row, v_WO in enumerate(seen.v_WO):
        limit = reach(parameters) + PADDING
        distance, body = nearest_section(X_WB, arm.shapes, seen.blocks, age, row, limit, p_WS, u_W)
        if body < 0:
            continue
        point_jacobian(X_WB, body, p_WS, J_S)
        a_S = section_acceleration(J_S @ v - v_WO, u_W, distance - PADDING, parameters, step)
        if not a_S.any():
            continue
        if not Z.shape[1]:
            J = np.empty((6, n))
            jacobian(X_WB, J)
            Z = null_space_basis(J)
            if not Z.shape[1]:
                return total
        moves = J_S @ Z
        square = moves.T @ moves + DAMPING**2 * np.eye(Z.shape[1])
        total += Z @ np.linalg.solve(square, moves.T @ a_S)
    size = float(np.linalg.norm(total))
    return total if size <= parameters.most else total * (parameters.most / size)


@dataclass(frozen=True, eq=False)
class _Held(Frozen):
    """What is kept from step to step: the obstacles, laid out, and the answer [rad/s^2]."""

    acceleration: FloatArray
    seen: ObstacleClouds | None = None
    points: ObstaclePoints = field(default_factory=ObstaclePoints)


class NullSpaceCoupling(LeafSystem):
    """Applies the coupling law to the links, as `drake_oa.posture.null_space_coupling` describes
    it.

    .. pydrake_system::

      name: NullSpaceCoupling
      input_ports:
      - robot_state
      - obstacles_W
      output_ports:
      - null_space_acceleration

    - robot_state: positions and velocities of the robot, (2m,) [rad, m, rad/s, m/s].
    - obstacles_W: abstract `ObstacleClouds`, with their velocities.
    - null_space_acceleration: (n,) of the arm's n joints, for `CartesianInverseDynamics`
      [rad/s^2]; 0 where nothing is near or approached, or the state is not finite.

    It is decided every `period` and held in between. What is held is abstract state.
    """

    def __init__(
        self,
        arm: ArmModel,
        num_states: int,
        parameters: NullSpaceCouplingParameters,
        *,
        period: float = 0.008,
    ) -> None:
        """Declares the ports.

        Args:
            arm: whose links.
            num_states: 2m, size of the robot's state; velocities are in the order of the
                positions.
            parameters: of the law.
            period: time between decisions [s].

        Raises:
            ValueError: if the state does not hold the arm's joints, a parameter is out of its
                range, or the period is not positive.
        """
        super().__init__()
        if num_states % 2 or num_states < 2 * (int(arm.index.max()) + 1):
            raise ValueError(f"num_states must hold the arm's joints, not {num_states}")
        check_values(parameters, "null_space_coupling")
        self._period = valid_period(period)
        self._arm, self._parameters = arm, parameters
        self._index: Sequence[int] = arm.index.tolist()
        self._count = num_states // 2
        n = len(self._index)
        self._robot = self.DeclareVectorInputPort("robot_state", num_states)
        self._obstacles = self.DeclareAbstractInputPort("obstacles_W", Value(ObstacleClouds()))
        self._held = self.DeclareAbstractState(Value(_Held(np.zeros(n))))
        self.DeclareVectorOutputPort(
            "null_space_acceleration", n, self._calc, {self.abstract_state_ticket(self._held)}
        )
        self.DeclareInitializationUnrestrictedUpdateEvent(self._decide)
        self.DeclarePeriodicUnrestrictedUpdateEvent(self._period, DECISION_OFFSET, self._decide)

    def _decide(self, context: Context, state: State) -> EventStatus:
        held: _Held = context.get_abstract_state(self._held).get_value()
        seen = read_value(self, self._obstacles, context, ObstacleClouds)
        points = held.points if seen is held.seen else thinned_points(seen)
        x = self._robot.Eval(context)
        acceleration = np.zeros(len(self._index))
        if np.isfinite(x).all():
            acceleration = null_space_acceleration(
                self._arm,
                points,
                x[self._index],
                x[self._count :][self._index],
                self._parameters,
                time=context.get_time(),
                step=self._period,
            )
        state.get_mutable_abstract_state(self._held).set_value(_Held(acceleration, seen, points))
        return EventStatus.Succeeded()

    def _calc(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_abstract_state(self._held).get_value().acceleration)
