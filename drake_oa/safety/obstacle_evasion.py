"""The evasion layer: gets the arm out of the way of what moves toward it."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field, replace

from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import (
    BasicVector,
    Context,
    EventStatus,
    LeafSystem,
    State,
)

from drake_oa.common.messages import Evasion, FloatArray, Frozen, PlannedMotion, PolicyState, zeros
from drake_oa.common.ports import DECISION_OFFSET, read_optional, read_value, valid_period
from drake_oa.common.thinking import Thinking, Thoughts
from drake_oa.geometry.directions import ramped
from drake_oa.geometry.solids import SolidScene
from drake_oa.policy.dmp import Demonstration, Dmp, normalised_time
from drake_oa.safety.config import EvasionParameters, EvasionSettings, settings
from drake_oa.safety.evasion import NOTHING_MOVES, choose, left_alone
from drake_oa.safety.guarded_arm import GuardedArm
from drake_oa.safety.lookout import Lookout, Underway

_logger = logging.getLogger("drake_oa")


@dataclass(frozen=True, eq=False)
class _Kept(Frozen):
    """What is kept from step to step: what was decided, and the velocity now [m/s]."""

    thoughts: Thoughts[Evasion] = field(default_factory=lambda: Thoughts(NOTHING_MOVES))
    velocity: FloatArray = zeros(3)

    @property
    def evasion(self) -> Evasion:
        """What is in force."""
        return self.thoughts.in_force


class ObstacleEvasion(LeafSystem):
    """Displaces a motion in real time where slowing and holding it does not help.

    .. pydrake_system::

      name: ObstacleEvasion
      input_ports:
      - robot_state
      - policy_state
      - solids_W
      - motion (optional)
      - demonstration (optional)
      output_ports:
      - evasion
      - evading
      - decision

    - robot_state: positions and velocities of the robot, (2n,) [rad, m, rad/s, m/s].
    - policy_state: abstract `PolicyState` of the movement primitive.
    - solids_W: abstract `SolidScene`: all that is not the robot, with velocities.
    - motion (optional): abstract `PlannedMotion`, what is expected of the motion; without
      it, that it goes straight on.
    - demonstration (optional): abstract `Demonstration` that it imitates, for its duration.
    - evasion: (3,) velocity of the displacement in the world [m/s], for `DmpIntegrator`.
    - evading: abstract `drake_oa.safety.evasion.Evasion`: what was decided, for `Supervisor`, and
      for `PostureFollower`, which turns the arm.
    - decision: (2,) when the last decision began (NaN: none has) and the time that it takes
      [s]; NaN and 0 where thinking costs none.

    It decides every `period`, shortly after it so that an observation of the same instant
    counts; the velocity follows every `step` at a bounded acceleration. While nothing moves
    it is exactly zero. Where thinking costs time, a decision is in force from the first `step`
    after that, and no other begins before. See `drake_oa.safety.evasion`. Each change is logged
    once.
    """

    def __init__(
        self,
        arm: GuardedArm,
        dmp: Dmp,
        *,
        period: float = 1.0 / 30.0,
        step: float = 0.005,
        max_age: float = 0.5,
        parameters: EvasionParameters | None = None,
        padding: float = 0.01,
        hold_time: float = 0.25,
        turns: bool = True,
        table_height: float = -math.inf,
        thinking: Thinking | None = None,
    ) -> None:
        """Declares the ports.

        Args:
            arm: what gets out of the way.
            dmp: the movement primitive whose motion is displaced.
            period: time between decisions [s].
            step: time between steps of the velocity [s].
            max_age: an older observation is not looked at [s].
            parameters: what is kept; None: the defaults.
            padding: how much nearer what moves may be than it was seen [m].
            hold_time: in which the motion comes to rest [s].
            turns: whether something turns the arm as `evading` asks.
            table_height: least height of the tool point over the table [m].
            thinking: what decisions cost in simulated time; None: none.

        Raises:
            ValueError: for a period that is not positive.
        """
        super().__init__()
        self._arm = arm
        self._dmp, self._step_length = dmp, valid_period(step)
        self._max_age = max_age
        derived = settings(parameters or EvasionParameters(), padding=padding, hold_time=hold_time)
        self._parameters = EvasionSettings(**derived | ({} if turns else {"turn_speed": 0.0}))
        self._table_height = table_height
        self._thinking = thinking

        self._robot_state = self.DeclareVectorInputPort("robot_state", 2 * arm.size)
        self._policy = self.DeclareAbstractInputPort("policy_state", Value(PolicyState()))
        self._solids = self.DeclareAbstractInputPort("solids_W", Value(SolidScene()))
        self._motion = self.DeclareAbstractInputPort("motion", Value(PlannedMotion()))
        self._shown = self.DeclareAbstractInputPort("demonstration", Value(Demonstration()))
        self._state = self.DeclareAbstractState(Value(_Kept()))
        decided = {self.abstract_state_ticket(self._state)}
        self.DeclareVectorOutputPort("evasion", 3, self._calc_velocity, decided)
        self.DeclareAbstractOutputPort(
            "evading", lambda: Value(Evasion()), self._calc_evading, decided
        )
        self.DeclareVectorOutputPort("decision", 2, self._calc_decision, decided)
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            valid_period(period), DECISION_OFFSET, self._decide
        )
        self.DeclarePeriodicUnrestrictedUpdateEvent(step, 0.0, self._follow)

    def _read(self, context: Context) -> _Kept:
        return context.get_abstract_state(self._state).get_value()

    def _calc_velocity(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._read(context).velocity)

    def _calc_evading(self, context: Context, output: AbstractValue) -> None:
        output.set_value(self._read(context).evasion)

    def _calc_decision(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._read(context).thoughts.last)

    def _follow(self, context: Context, state: State) -> EventStatus:
        # Not the Context's: the other event of the same instant may have come first.
        held = state.get_mutable_abstract_state(self._state)
        kept: _Kept = held.get_value()
        time = context.get_time()
        made = kept.thoughts.made(time)
        if made is not None:
            _log_change(kept.evasion, made, time)
            kept = replace(kept, thoughts=kept.thoughts.taken())
            held.set_value(kept)
        if kept.velocity is kept.evasion.velocity or not (
            kept.velocity.any() or kept.evasion.velocity.any()
        ):
            return EventStatus.DidNothing() if made is None else EventStatus.Succeeded()
        velocity = ramped(
            kept.velocity,
            kept.evasion.velocity,
            self._parameters.acceleration * self._step_length,
        )
        held.set_value(replace(kept, velocity=velocity))
        return EventStatus.Succeeded()

    def _decide(self, context: Context, state: State) -> EventStatus:
        held = state.get_mutable_abstract_state(self._state)
        before: _Kept = held.get_value()
        if before.thoughts.pending is not None:
            return EventStatus.DidNothing()
        time = context.get_time()
        thoughts = before.thoughts.thought(
            lambda evasion: self._choose(context, before.velocity, evasion), time, self._thinking
        )
        after = replace(before, thoughts=thoughts)
        _log_change(before.evasion, after.evasion, time)
        held.set_value(after)
        return EventStatus.Succeeded()

    def _choose(self, context: Context, velocity: FloatArray, before: Evasion) -> Evasion:
        time = context.get_time()
        scene = read_value(self, self._solids, context, SolidScene)
        policy = read_value(self, self._policy, context, PolicyState)
        x = self._robot_state.Eval(context)
        unknown = time - scene.stamp > self._max_age or not math.isfinite(
            x.sum() + policy.z_W.sum()
        )
        if unknown or not (scene.moves or before.action):
            turned = unknown and len(before.turn) > 0
            return left_alone(before) if turned else NOTHING_MOVES
        q, v = self._arm.split(x)
        shown = read_optional(self, self._shown, context, Demonstration)
        dmp = self._dmp if shown is None or shown.position is None else shown.position
        underway = Underway(
            policy,
            max(0.0, normalised_time(policy.phase, dmp.alpha_k)),
            1.0 / (policy.tau * dmp.duration),
            read_optional(self, self._motion, context, PlannedMotion),
        )
        ahead = Lookout(
            self._arm,
            q,
            scene,
            time,
            underway,
            self._parameters,
            table_height=self._table_height,
        )
        return choose(before, velocity, v, ahead, self._parameters)


def _log_change(before: Evasion, after: Evasion, time: float) -> None:
    """Says once when what is done changes."""
    if after.action == before.action:
        return
    what = f"obstacle {after.obstacle}"
    said = {
        "": "nothing to evade",
        "going on": f"goes on past {what}",
        "waiting": f"waits for {what}",
        "evading": f"evades {what}",
        "caught": f"{what} cannot be evaded",
    }[after.action]
    _logger.warning("t=%.3f s: %s", time, said)
