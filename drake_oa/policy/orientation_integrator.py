"""System of the policy layer that integrates the movement primitive of the tool's orientation."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, EventStatus, LeafSystem, State, ValueProducer
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import FloatArray, Frozen, PolicyState, zeros
from drake_oa.common.ports import AbstractInput, valid_period
from drake_oa.policy.dmp import (
    ALPHA,
    QUATERNION,
    Demonstration,
    OrientationDmp,
    W,
    demonstrated_goal,
    evaluate,
    goal_vector,
    normalized_time,
    origin_of,
    roll_orientation,
    rotation_matrix,
)

_SUCCEEDED = EventStatus.Succeeded()


@dataclass(frozen=True, eq=False)
class OrientationSegment(Frozen):
    """Motion of the tool's orientation between two consecutive steps of its integrator.

    The orientation is R_WE = R_WA exp([r]), with a reference frame A that is fixed in the world
    during a motion, and the rotation vector r from A, expressed in A.

    Attributes:
        primitive: movement primitive of the orientation.
        origin: orientation R_WA from which the rotation vectors are measured.
        goal: (3,) rotation vector from A to the goal orientation [rad].
        ends: (2, 2, 3) rotation vector r [rad] and its time derivative [rad/s] at both steps.
        z: (3,) derivative of r by normalized time at the second step [rad].
        phase: phase k of the policy (1 at the start, decaying to 0) at the second step.
        begin: time of the first step [s].
        length: time between the steps [s]; 0 before the integrator's first step.
        p_WS: (3,) position of the tool point at the start of the policy's current motion [m]. A
            change of p_WS marks a restart of this motion. (0,): before the integrator's first step.
        demonstration: active demonstration; if its field `orientation` is None, the primitive of
            the constructor of `OrientationIntegrator` is active.
    """

    primitive: OrientationDmp
    origin: Rotation
    goal: FloatArray
    ends: FloatArray
    z: FloatArray = zeros(3)
    phase: float = 1.0
    begin: float = 0.0
    length: float = 0.0
    p_WS: FloatArray = zeros(0)
    demonstration: Demonstration = field(default_factory=Demonstration)


def start_segment(
    primitive: OrientationDmp, R_WS: FloatArray, R_WG: FloatArray, **more: Any
) -> OrientationSegment:
    """Returns an orientation segment of zero length, at rest at the start of a rotation.

    Args:
        primitive: movement primitive of the orientation.
        R_WS: (3, 3) orientation of the tool at the start.
        R_WG: (3, 3) orientation of the tool at the goal.
        more: further fields of `OrientationSegment`.
    """
    ends = np.array([[primitive.offset, np.zeros(3)]] * 2)
    goal = demonstrated_goal(primitive, R_WS, R_WG)
    return OrientationSegment(primitive, origin_of(primitive, R_WS), goal, ends, **more)


class OrientationIntegrator(LeafSystem):
    """Integrator of a movement primitive for the orientation of the tool.

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

    - policy_state: abstract `PolicyState`. The primitive follows the phase in this message, so that
      temporal scaling and holds (stops) of the position also apply to the orientation.
    - goal_orientation (optional): (4,) quaternion w, x, y, z of R_WG, of either sign. A new
      goal is approached from the current orientation. Among the equivalent rotation vectors of the
      goal, the one nearest to the previous goal's is used. Not connected: the constructor's goal.
    - demonstration (optional): abstract `Demonstration`, which becomes active when the policy's
      motion starts or restarts; its primitive and goal replace those of the constructor.
      Not connected: the constructor's primitive and goal.
    - desired_orientation: (4,) quaternion w, x, y, z of R_WE, continuous along a motion.
    - desired_angular_velocity: (3,) w_WE in the world frame [rad/s].
    - desired_angular_acceleration: (3,) alpha_WE in the world frame [rad/s^2].

    The primitive is a spring-damper system with forcing term for the rotation vector from a fixed
    frame to the tool; `drake_oa.policy.dmp` has the equations. The abstract state is the current
    `OrientationSegment`, the motion between two steps. In a segment the rotation vector is a cubic
    polynomial in time, from which angular velocity and acceleration are computed. The orientation
    is interpolated between two steps that the policy has already completed, and therefore lags two
    periods behind the policy.
    """

    def __init__(
        self, primitive: OrientationDmp, start: ArrayLike, goal: ArrayLike, *, period: float = 0.008
    ) -> None:
        """Declares ports and the periodic update, with the tool at rest in its start orientation.

        Args:
            primitive: movement primitive of the orientation.
            start: (3, 3) orientation R_WE of the tool at the start.
            goal: (3, 3) orientation R_WE of the tool at the goal.
            period: time step, equal to that of the policy [s].

        Raises:
            ValueError: if start and goal differ by 180 degrees and the primitive has no
                demonstrated direction of rotation; or for a period that is not positive.
        """
        super().__init__()
        R_WS, self._R_WG = np.array(start, dtype=float), np.array(goal, dtype=float)
        self._primitive, begin = primitive, start_segment(primitive, R_WS, self._R_WG)
        self._period = valid_period(period)

        self._policy = AbstractInput(self, "policy_state", PolicyState)
        self._goal_port = self.DeclareVectorInputPort("goal_orientation", 4)
        self._demonstration = AbstractInput(self, "demonstration", Demonstration)
        self._segment = self.DeclareAbstractState(Value(begin))
        self._now = self.DeclareCacheEntry(
            "orientation now",
            ValueProducer(lambda: Value(np.zeros(10)), self._calc_now),
            {self.time_ticket(), self.abstract_state_ticket(self._segment)},
        )
        for name, part in (
            ("desired_orientation", QUATERNION),
            ("desired_angular_velocity", W),
            ("desired_angular_acceleration", ALPHA),
        ):
            self.DeclareVectorOutputPort(
                name,
                part.stop - part.start,
                lambda context, output, part=part: output.SetFromVector(
                    self._now.Eval(context)[part]
                ),
                {self._now.ticket()},
            )
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._step)

    def _read_segment(self, context: Context) -> OrientationSegment:
        return context.get_abstract_state(self._segment).get_value()

    def _calc_now(self, context: Context, value: AbstractValue) -> None:
        segment = self._read_segment(context)
        since = max(context.get_time() - segment.begin, 0.0)
        value.set_value(evaluate(segment.ends, segment.length, segment.origin, since))

    def _goal_now(self, context: Context, before: OrientationSegment) -> FloatArray:
        """Computes the rotation vector (3,) [rad] from a motion's origin to its goal orientation.

        The origin is the fixed frame A in which the rotation vectors of the motion are expressed.

        Args:
            context: context of the system, whose input `goal_orientation` is evaluated.
            before: previous segment, with the orientation R_WA of the origin; its goal remains if
                the input is not connected.
        """
        if not self._goal_port.HasValue(context):
            return before.goal
        try:
            R_WG = rotation_matrix(self._goal_port.Eval(context))
        except ValueError as error:
            raise ValueError(f"{self.get_name()}: goal_orientation: {error}") from None
        return goal_vector(before.origin.as_matrix(), R_WG, before.goal)

    def _restart(
        self, context: Context, before: OrientationSegment, policy: PolicyState
    ) -> OrientationSegment:
        """Returns a new orientation segment if a demonstrated motion starts, else the previous one.

        The new segment is at rest. If the demonstration has orientations, the segment starts at the
        first one. Otherwise the constructor's primitive starts at the current orientation.

        Args:
            context: context of the system, whose input `demonstration` is read.
            before: previous segment.
            policy: current state of the policy; the motion starts if the position p_WS of its start
                has changed, or if its phase is 1 and the input is not the demonstration of the
                previous segment.
        """
        demonstration = self._demonstration.find(context)
        has_restarted = len(before.p_WS) > 0 and not np.array_equal(before.p_WS, policy.p_WS)
        is_new = policy.phase == 1.0 and demonstration is not before.demonstration
        if demonstration is None or not (has_restarted or is_new):
            return replace(before, p_WS=policy.p_WS)
        if demonstration.orientation is not None:
            motion = demonstration.orientation, demonstration.R_WS, demonstration.R_WG
        else:
            R_WE = before.origin * Rotation.from_rotvec(+before.ends[1, 0])
            motion = self._primitive, R_WE.as_matrix(), self._R_WG
        return start_segment(
            *motion, phase=policy.phase, p_WS=policy.p_WS, demonstration=demonstration
        )

    def _step(self, context: Context, state: State) -> EventStatus:
        policy = self._policy.read(context)
        before = self._restart(context, self._read_segment(context), policy)
        goal, alpha_k = self._goal_now(context, before), before.primitive.dmp.alpha_k
        passed = normalized_time(policy.phase, alpha_k) - normalized_time(before.phase, alpha_k)
        after = roll_orientation(
            before.primitive, goal, before.ends[1, 0], before.z, before.phase, end=max(passed, 0.0)
        )
        z = after.z[-1]
        state.get_mutable_abstract_state(self._segment).set_value(
            replace(
                before,
                begin=context.get_time(),
                length=self._period,
                ends=np.array([before.ends[1], [after.p[-1], policy.speed * z]]),
                z=z,
                phase=policy.phase,
                goal=goal,
            )
        )
        return _SUCCEEDED
