"""The action layer of the orientation: a movement primitive that turns the tool."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import (
    Context,
    EventStatus,
    LeafSystem,
    State,
    ValueProducer,
)

from drake_oa.common.messages import FloatArray, Frozen, PolicyState
from drake_oa.common.ports import Cell, read_optional, read_value, valid_period
from drake_oa.geometry.rotation import rotation_vector
from drake_oa.policy import orientation_dmp as kernels
from drake_oa.policy.demonstration import Demonstration
from drake_oa.policy.dmp import normalised_time
from drake_oa.policy.orientation_dmp import (
    OrientationDmp,
    demonstrated_goal,
    goal_vector,
    rotation_matrix,
    step,
)

_SUCCEEDED = EventStatus.Succeeded()


@dataclass(frozen=True, eq=False)
class OrientationSegment(Frozen):
    """The turning between two steps.

    Attributes:
        motion: (17,) as `drake_oa.policy.orientation_dmp` lays it out.
        r: (3,) rotation vector from the start's orientation at the end of it [rad].
        z: (3,) its derivative by normalised time [rad].
        phase: canonical phase of the policy, as last seen.
        goal: (3,) rotation vector of the goal [rad].
        asked: (4,) quaternion that asked for that goal; NaN: none did.
        start: (4,) quaternion of the orientation that r is counted from; (0,): the constructor's.
        p_WS: (3,) start of the policy's motion, as last seen [m]; (0,): none was.
        demonstration: what is turned along; empty: the constructor's.
    """

    motion: FloatArray = field(default_factory=lambda: np.zeros(kernels.N_MOTION))
    r: FloatArray = field(default_factory=lambda: np.zeros(3))
    z: FloatArray = field(default_factory=lambda: np.zeros(3))
    phase: float = 1.0
    goal: FloatArray = field(default_factory=lambda: np.zeros(3))
    asked: FloatArray = field(default_factory=lambda: np.full(4, np.nan))
    start: FloatArray = field(default_factory=lambda: np.zeros(0))
    p_WS: FloatArray = field(default_factory=lambda: np.zeros(0))
    demonstration: Demonstration = field(default_factory=Demonstration)


class OrientationIntegrator(LeafSystem):
    """Turns the tool along a movement primitive.

    .. pydrake_system::

      name: OrientationIntegrator
      input_ports:
      - policy_state
      - goal_orientation (optional)
      - demonstration (optional)
      output_ports:
      - desired_orientation
      - desired_angular_velocity
      - desired_angular_acceleration

    - policy_state: abstract `PolicyState`: the primitive goes by its normalised time, so that
      what scales or holds the motion does so to the orientation.
    - goal_orientation (optional): (4,) quaternion w, x, y, z of R_WG, of either sign. A new
      one is approached from where the motion is, the way round that is nearest to the
      present goal's. Without it the goal is the constructor's.
    - demonstration (optional): abstract `Demonstration`, in force from where the policy's motion
      begins or begins anew: what is turned along then, in place of the constructor's primitive
      and goal.
    - desired_orientation: (4,) quaternion w, x, y, z of R_WE, which changes
      sign nowhere along a motion.
    - desired_angular_velocity: (3,) w_WE in the world frame [rad/s].
    - desired_angular_acceleration: (3,) in the world frame [rad/s^2].

    The state is abstract, in the Context: the step under way (`OrientationSegment`). Between
    its ends the rotation vector is a cubic in time; angular velocity and acceleration are
    the exact derivatives. Both ends have to be known, so the orientation is two periods behind
    the policy.
    """

    def __init__(
        self,
        primitive: OrientationDmp,
        start: ArrayLike,
        goal: ArrayLike,
        *,
        period: float = 0.005,
    ) -> None:
        """Declares the ports.

        Args:
            primitive: the movement primitive.
            start: (3, 3) R_WE at the start.
            goal: (3, 3) R_WE at the goal.
            period: step; that of the policy [s].

        Raises:
            ValueError: if start or goal is no rotation, or they are half a turn apart and
                no demonstration tells the way round; or for a period that is not positive.
        """
        super().__init__()
        self._primitive = primitive
        self._R_WS = _rotation("start", start)
        self._R_WG = _rotation("goal", goal)
        self._goal = demonstrated_goal(primitive, self._R_WS, self._R_WG)
        self._start = kernels.exponential(rotation_vector(self._R_WS))
        self._period = valid_period(period)

        self._policy = self.DeclareAbstractInputPort("policy_state", Value(PolicyState()))
        self._goal_port = self.DeclareVectorInputPort("goal_orientation", 4)
        self._demonstration = self.DeclareAbstractInputPort("demonstration", Value(Demonstration()))
        self._segment = self.DeclareAbstractState(Value(OrientationSegment(goal=self._goal)))
        self._now = self.DeclareCacheEntry(
            "orientation now",
            ValueProducer(lambda: Value(Cell()), self._calc_now),
            {self.time_ticket(), self.abstract_state_ticket(self._segment)},
        )
        for name, begin, size in (
            ("desired_orientation", kernels.QUATERNION, 4),
            ("desired_angular_velocity", kernels.W, 3),
            ("desired_angular_acceleration", kernels.ALPHA, 3),
        ):
            self.DeclareVectorOutputPort(
                name,
                size,
                lambda context, output, begin=begin, end=begin + size: output.SetFromVector(
                    self._now.Eval(context).value[begin:end]
                ),
                {self._now.ticket()},
            )
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._step)

    def _read_segment(self, context: Context) -> OrientationSegment:
        return context.get_abstract_state(self._segment).get_value()

    def _calc_now(self, context: Context, value: AbstractValue) -> None:
        cell: Cell[FloatArray] = value.get_mutable_value()
        cell.value = self._at(self._read_segment(context), context.get_time())

    def _at(self, segment: OrientationSegment, time: float) -> FloatArray:
        start = segment.start if len(segment.start) else self._start
        return kernels.evaluate(segment.motion, np.array(start), time)

    def _goal_now(self, context: Context, before: OrientationSegment) -> tuple[FloatArray, ...]:
        """The goal's rotation vector, and the quaternion that asked for it."""
        if not self._goal_port.HasValue(context):
            return before.goal, before.asked
        asked = self._goal_port.Eval(context)
        if np.array_equal(asked, before.asked):
            return before.goal, before.asked
        try:
            R_WG = rotation_matrix(asked)
        except ValueError as error:
            raise ValueError(f"{self.get_name()}: goal_orientation: {error}") from None
        origin = rotation_matrix(before.start) if len(before.start) else self._R_WS
        offset = before.motion[kernels.OFFSET :]
        return goal_vector(origin, R_WG, before.goal + offset) - offset, np.array(asked)

    def _begun_anew(
        self, context: Context, before: OrientationSegment, policy: PolicyState
    ) -> OrientationSegment:
        """With the demonstration that the policy's motion has begun anew with, if it has."""
        given = read_optional(self, self._demonstration, context, Demonstration)
        begun = len(before.p_WS) > 0 and not np.array_equal(before.p_WS, policy.p_WS)
        swapped = policy.phase == 1.0 and given is not before.demonstration
        seen = replace(before, p_WS=policy.p_WS)
        if given is None or not (begun or swapped):
            return seen
        if given.orientation is None and before.demonstration.orientation is None:
            return seen
        # Counted anew from where it is, at rest.
        origin = before.start if len(before.start) else self._start
        r = before.r + before.motion[kernels.OFFSET :]
        start = kernels.product(np.array(origin), kernels.exponential(r))
        R_WG = self._R_WG if given.orientation is None else given.R_WG
        primitive = given.orientation or self._primitive
        motion = np.array(before.motion)
        motion[kernels.R : kernels.OFFSET], motion[kernels.OFFSET :] = 0.0, primitive.offset
        return replace(
            seen,
            motion=motion,
            r=np.zeros(3),
            z=np.zeros(3),
            phase=policy.phase,
            goal=demonstrated_goal(primitive, rotation_matrix(start), R_WG),
            start=kernels.product(start, kernels.exponential(-primitive.offset)),
            demonstration=given,
        )

    def _step(self, context: Context, state: State) -> EventStatus:
        before, time = self._read_segment(context), context.get_time()
        policy = read_value(self, self._policy, context, PolicyState)
        before = self._begun_anew(context, before, policy)
        goal, asked = self._goal_now(context, before)
        primitive = before.demonstration.orientation or self._primitive
        alpha_k = primitive.dmp.alpha_k
        passed = normalised_time(policy.phase, alpha_k) - normalised_time(before.phase, alpha_k)
        ds = max(passed, 0.0)
        r, z, _ = step(primitive, before.r, before.z, before.phase, ds, goal)

        motion = np.empty(kernels.N_MOTION)
        motion[kernels.BEGIN], motion[kernels.LENGTH] = time, self._period
        motion[kernels.R : kernels.RATE] = before.r
        motion[kernels.RATE : kernels.R_END] = before.motion[kernels.RATE_END : kernels.OFFSET]
        motion[kernels.R_END : kernels.RATE_END] = r
        motion[kernels.RATE_END : kernels.OFFSET] = policy.speed * z
        motion[kernels.OFFSET :] = before.motion[kernels.OFFSET :]
        state.get_mutable_abstract_state(self._segment).set_value(
            replace(before, motion=motion, r=r, z=z, phase=policy.phase, goal=goal, asked=asked)
        )
        return _SUCCEEDED


def _rotation(name: str, R: ArrayLike) -> FloatArray:
    matrix = np.array(R, dtype=float)
    good = matrix.shape == (3, 3) and np.isfinite(matrix).all()
    if not (
        good and np.abs(matrix @ matrix.T - np.eye(3)).max() < 1e-6 and np.linalg.det(matrix) > 0
    ):
        raise ValueError(f"{name} must be a rotation matrix (3, 3), not {matrix.tolist()}")
    return matrix
