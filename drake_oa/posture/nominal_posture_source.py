"""Drake system of the posture layer: source of the nominal posture that the arm's null space
tracks.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, EventStatus, LeafSystem, State

from drake_oa.common.messages import FloatArray, PlannedMotion, PolicyState
from drake_oa.common.ports import DECISION_OFFSET, AbstractInput, valid_period
from drake_oa.policy.dmp import normalized_time
from drake_oa.posture.posture_trajectory import PostureTrajectory, trajectory_of


class NominalPostureSource(LeafSystem):
    """Source of the nominal posture that is planned along the motion of the tool, and that the null
    space of the arm tracks.

    .. pydrake_system::

      name: NominalPostureSource
      input_ports:
      - motion
      - policy_state
      output_ports:
      - desired_posture

    - motion: abstract `PlannedMotion`, joint positions over normalized time (time over tau T, with
      the demonstrated duration T and the temporal scaling tau); without joint positions the nominal
      posture is the argument `q_rest`.
    - policy_state: abstract `PolicyState` of the movement primitive.
    - desired_posture: (2n,) nominal positions [rad] and velocities [rad/s] of the arm's n joints,
      for `MotionGuard` or `CartesianInverseDynamics`.

    The posture is that of the planned motion at the normalized time of the movement primitive. The
    posture is at rest while the motion is held (stopped on its path). The posture is also at rest
    after a restart of the motion from another start, until the input contains a plan for the new
    motion. The transition to a new plan is continuous (`drake_oa.posture.posture_trajectory`). The
    abstract state is the current `PostureTrajectory`.
    """

    def __init__(self, q_rest: FloatArray, alpha_k: float, *, period: float = 0.008) -> None:
        """Declares the ports and the state, the current trajectory.

        Args:
            q_rest: (n,) nominal posture while no joint positions are planned [rad].
            alpha_k: decay rate of the movement primitive's phase, per normalized time [-].
            period: period at which the input `motion` is checked for a new plan [s].
        """
        super().__init__()
        period = valid_period(period)
        self._rest, self._alpha_k = np.array(q_rest, dtype=float), alpha_k
        self._motion = AbstractInput(self, "motion", PlannedMotion)
        self._policy = AbstractInput(self, "policy_state", PolicyState)
        self._trajectory = self.DeclareAbstractState(
            Value(trajectory_of(PlannedMotion(), self._rest))
        )
        self.DeclareVectorOutputPort(
            "desired_posture",
            2 * len(self._rest),
            self._calc,
            {
                self.time_ticket(),
                self._policy.ticket(),
                self.abstract_state_ticket(self._trajectory),
            },
        )
        self.DeclareInitializationUnrestrictedUpdateEvent(self._take_over)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 2.0 * DECISION_OFFSET, self._take_over)

    def _read(self, context: Context) -> PostureTrajectory:
        return context.get_abstract_state(self._trajectory).get_value()

    def _now(self, context: Context, motion: PlannedMotion) -> tuple[float, float, float]:
        """Computes the arguments of `PostureTrajectory.at`, which evaluates the trajectory at the
        current time.

        Args:
            context: context of the system.
            motion: planned motion.

        Returns:
            Normalized time in the planned motion, rate of normalized time [1/s] (0: the posture is
            at rest), and time of the context [s].
        """
        policy = self._policy.read(context)
        time = context.get_time()
        if len(motion.p_WS) and not (motion.p_WS == policy.p_WS).all():
            # The policy has restarted since this plan was made. Until there is a new plan, the
            # posture rests at the planned sample nearest to the current position.
            off = np.linalg.norm(motion.p_WE - policy.p_WE, axis=1)
            return float(motion.s[off.argmin()]), 0.0, time
        s = normalized_time(policy.phase, self._alpha_k)
        # Between two steps of the policy, normalized time is extrapolated.
        return s + policy.speed * max(time - policy.stamp, 0.0), policy.speed, time

    def _take_over(self, context: Context, state: State) -> EventStatus:
        before = self._read(context)
        motion = self._motion.read(context)
        if motion is before.motion or not (len(motion.q) or len(before.motion.q)):
            return EventStatus.DidNothing()
        after = trajectory_of(motion, self._rest)
        offset = before.at(*self._now(context, before.motion))
        offset -= after.at(*self._now(context, motion))
        state.get_mutable_abstract_state(self._trajectory).set_value(
            replace(after, offset=offset, since=context.get_time())
        )
        return EventStatus.Succeeded()

    def _calc(self, context: Context, output: BasicVector) -> None:
        trajectory = self._read(context)
        output.SetFromVector(trajectory.at(*self._now(context, trajectory.motion)))
