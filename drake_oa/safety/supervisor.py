"""The supervision layer: slows, holds or stops a motion that is not safe."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import (
    BasicVector,
    Context,
    EventStatus,
    LeafSystem,
    State,
)

from drake_oa.common.messages import Evasion, FloatArray, HoldCause, PlannedMotion, PolicyState
from drake_oa.common.ports import read_optional, read_value, valid_period
from drake_oa.geometry.solids import SolidScene
from drake_oa.policy.dmp import Demonstration
from drake_oa.safety.approach_kernels import planned_rate
from drake_oa.safety.config import SupervisorParameters, SupervisorSettings, settings
from drake_oa.safety.guarded_arm import GuardedArm, full_speed_rates, tool_jacobian
from drake_oa.safety.monitors import (
    remaining_distance,
    watch_evasion,
    watch_joints,
    watch_observation,
    watch_solids,
    watch_torque,
    watch_tracking,
)
from drake_oa.safety.supervision import (
    Demand,
    Supervision,
    SupervisorState,
    broken,
    decide,
)

_logger = logging.getLogger("drake_oa")
_DAMPING = 1e-6
"""Of the least-squares joint velocity, against singular postures [m^2]."""
_SAID = {"slow": "slows", "hold": "holds", "stop": "stops"}


class Supervisor(LeafSystem):
    """Watches a motion and says at which share of full speed it may go.

    .. pydrake_system::

      name: Supervisor
      input_ports:
      - robot_state
      - policy_state
      - solids_W (optional)
      - tracking_error (optional)
      - torque_saturation (optional)
      - evading (optional)
      - motion (optional)
      - demonstration (optional)
      output_ports:
      - speed_scale
      - supervision

    - robot_state: positions and velocities of the robot, (2n,) [rad, m, rad/s, m/s].
    - policy_state: abstract `PolicyState` of the movement primitive.
    - solids_W (optional): abstract `SolidScene`: all that is not the robot. Without it neither
      observations nor obstacles are watched.
    - tracking_error (optional): (3,) desired minus actual position of the tool point [m].
    - torque_saturation (optional): (1,) 1 while a joint torque is at its limit, else 0.
    - evading (optional): abstract `drake_oa.safety.evasion.Evasion`: what an `ObstacleEvasion` does
      against what moves. While it lets the motion go on, obstacles that move do not slow it;
      while it waits or evades, or none of its ways avoids a contact, the motion is held.
    - motion (optional): abstract `PlannedMotion` of the arm's joints, verified among the solids.
    - demonstration (optional): abstract `Demonstration` that it imitates, for its duration.
    - speed_scale: (1,) share of full speed, in [0, 1], for `DmpIntegrator`.
    - supervision: abstract `Supervision`: run, slow, hold or stop, and why.

    It watches, every `period`: how old the last good observation is; that each link can be
    brought to rest before it touches anything, by where the motion would
    take it at full speed; the joints' limits of position and speed; the tracking error;
    lasting torque saturation. A value that is not finite stops the motion. See
    `drake_oa.safety.supervision`. A motion that is slowed or held goes on by itself when it is
    safe; one that is held for something that does not go away by itself is stopped
    after some patience, and goes on should it go away after all. Each change is logged once.

    A link that is too near from the start, or touches, may not come nearer, but may leave
    slowly. The decision is abstract state, the outputs are that of the last step.
    """

    def __init__(
        self,
        arm: GuardedArm,
        duration: float,
        *,
        period: float = 0.008,
        parameters: SupervisorParameters | None = None,
        padding: float = 0.005,
        hold_time: float = 0.25,
        frame_period: float = 1.0 / 15.0,
        max_age: float = 0.5,
    ) -> None:
        """Declares the ports.

        Args:
            arm: what is kept safe.
            duration: T of the movement primitive [s].
            period: time between decisions [s].
            parameters: what is kept; None: the defaults.
            padding: how much nearer what moves may be than it was seen [m].
            hold_time: in which the policy comes to rest from full speed [s].
            frame_period: time between observations [s].
            max_age: an older observation holds the motion [s].

        Raises:
            ValueError: if duration or period are not positive and finite.
        """
        super().__init__()
        if not 0.0 < duration < math.inf:
            raise ValueError(f"duration must be finite and positive [s], not {duration}")
        self._arm, self._duration = arm, float(duration)
        self._period = valid_period(period)
        parameters = parameters or SupervisorParameters()
        self._parameters = SupervisorSettings(
            **settings(
                parameters,
                padding=padding,
                reaction_time=hold_time + parameters.lag,
                hold_time=hold_time,
                period=self._period,
                frame_period=frame_period,
                max_age=max_age,
            )
        )

        self._robot_state = self.DeclareVectorInputPort("robot_state", 2 * arm.size)
        self._policy = self.DeclareAbstractInputPort("policy_state", Value(PolicyState()))
        self._solids = self.DeclareAbstractInputPort("solids_W", Value(SolidScene()))
        self._error = self.DeclareVectorInputPort("tracking_error", 3)
        self._saturation = self.DeclareVectorInputPort("torque_saturation", 1)
        self._evading = self.DeclareAbstractInputPort("evading", Value(Evasion()))
        self._motion = self.DeclareAbstractInputPort("motion", Value(PlannedMotion()))
        self._shown = self.DeclareAbstractInputPort("demonstration", Value(Demonstration()))
        self._state = self.DeclareAbstractState(Value(SupervisorState()))
        decided = {self.abstract_state_ticket(self._state)}
        self.DeclareVectorOutputPort("speed_scale", 1, self._calc_scale, decided)
        self.DeclareAbstractOutputPort(
            "supervision", lambda: Value(Supervision()), self._calc_supervision, decided
        )
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._step)

    def _read(self, context: Context) -> SupervisorState:
        return context.get_abstract_state(self._state).get_value()

    def _calc_scale(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._read(context).supervision.speed_scale)

    def _calc_supervision(self, context: Context, output: AbstractValue) -> None:
        output.set_value(self._read(context).supervision)

    def _step(self, context: Context, state: State) -> EventStatus:
        before = self._read(context)
        if before.broken:
            return EventStatus.DidNothing()
        after = self._update(context, before)
        if after is before:
            return EventStatus.DidNothing()
        _log_change(before, after, context.get_time())
        state.get_mutable_abstract_state(self._state).set_value(after)
        return EventStatus.Succeeded()

    def _update(self, context: Context, before: SupervisorState) -> SupervisorState:
        time, parameters = context.get_time(), self._parameters
        x = self._robot_state.Eval(context)
        policy = read_value(self, self._policy, context, PolicyState)
        duration = self._duration
        shown = read_optional(self, self._shown, context, Demonstration)
        if shown is not None and shown.position is not None:
            duration = shown.position.duration
        v_WE = policy.z_W / (policy.tau * duration)
        for name, value in (("robot state", x), ("policy state", v_WE)):
            if not math.isfinite(value.dot(value)):
                return broken(before, f"the {name} is not finite", time)
        demands: list[Demand] = []
        evading = read_optional(self, self._evading, context, Evasion) or Evasion()
        demands.append(watch_evasion(evading))
        scene = read_optional(self, self._solids, context, SolidScene)
        if scene is not None:
            demands.append(watch_observation(scene, time, parameters))
            motion = read_optional(self, self._motion, context, PlannedMotion)
            before = self._with_motion(before, motion, scene, policy, evading)
        demands += self._watch_motion(
            before, x, v_WE, scene, policy.tau * duration, time, evading.action == "going on"
        )
        if self._error.HasValue(context):
            error = math.hypot(*self._error.Eval(context))
            if not math.isfinite(error):
                return broken(before, "the tracking error is not finite", time)
            demands.append(watch_tracking(error, parameters))
        if self._saturation.HasValue(context):
            saturated = bool(self._saturation.Eval(context)[0] > 0.0)
            before, demand = watch_torque(before, saturated, time, self._period, parameters)
            demands.append(demand)
        waits = policy.hold in (HoldCause.DECIDING, HoldCause.OBSTACLES)
        return decide(before, demands, time, self._period, parameters, waits=waits)

    def _watch_motion(
        self,
        before: SupervisorState,
        x: FloatArray,
        v_WE: FloatArray,
        scene: SolidScene | None,
        seconds: float,
        time: float,
        passing: bool,
    ) -> list[Demand]:
        """The watches that need the robot's kinematics at the state x.

        Args:
            before: with the verified motion, see `_with_motion`.
            x: (2n,) the robot's state.
            v_WE: (3,) velocity of the tool at full speed [m/s].
            scene: the solids, or None.
            seconds: that a unit of normalised time takes [s].
            time: now [s].
            passing: whether what moves is left to who has looked ahead.
        """
        arm, motion, parameters = self._arm, before.motion, self._parameters
        q, v = arm.split(x)
        if motion is None:
            v_full = full_speed_rates(tool_jacobian(arm.chain, q), v, v_WE, _DAMPING)
        else:
            # The motion turns the tool as well.
            v_full = planned_rate(np.array(motion.s), np.array(motion.q, order="C"), q) / seconds
        scale, verified = before.supervision.speed_scale, None if motion is None else motion.q
        demands = [
            watch_joints(arm.joints, arm.chain, q, v, v_full, scale, parameters, verified),
        ]
        if scene is not None and scene.stamp > -math.inf:
            kept = None if motion is None else before.kept
            near = watch_solids(arm, q, v_full, scene, time, parameters, kept=kept, passing=passing)
            demands.insert(0, near)
        return demands

    def _with_motion(
        self,
        before: SupervisorState,
        motion: PlannedMotion | None,
        scene: SolidScene,
        policy: PolicyState,
        evading: Evasion,
    ) -> SupervisorState:
        """Takes over the verified motion that is under way, and what it keeps of the solids."""
        if (
            motion is None
            or len(motion) < 2
            or motion.q.shape[1] != len(self._arm.joints)
            or (len(motion.p_WS) and not np.array_equal(motion.p_WS, policy.p_WS))
            or evading.action in ("evading", "caught")
            or scene.stamp == -math.inf
        ):
            return before if before.motion is None else replace(before, motion=None, scene=None)
        if motion is before.motion and before.scene is not None and scene.same_as(before.scene):
            return before
        kept = remaining_distance(self._arm, motion, scene, self._parameters)
        return replace(before, motion=motion, scene=scene, kept=kept)


def _log_change(before: SupervisorState, after: SupervisorState, time: float) -> None:
    """Says once when the action or its cause has changed."""
    was, now = before.supervision, after.supervision
    if now.action == was.action and after.cause == before.cause:
        return
    said: Sequence[str] = (_SAID[now.action], now.reason) if now.reason else ("runs freely again",)
    _logger.warning("t=%.3f s: supervisor %s", time, ": ".join(said))
