"""The action layer: a movement primitive bent by coupling terms."""

from __future__ import annotations

import logging

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import (
    Context,
    EventStatus,
    LeafSystem,
    State,
    ValueProducer,
)

from drake_oa.common.messages import (
    CouplingParameters,
    EllipsoidSet,
    FloatArray,
    HoldReason,
    PolicyState,
    Route,
)
from drake_oa.common.ports import AbstractInput, declare_state_outputs
from drake_oa.policy.action import CouplingInputs, Segment, restarted, resting, take_step
from drake_oa.policy.config import Policy
from drake_oa.policy.dmp import Demonstration, Dmp, local_frame

_logger = logging.getLogger("drake_oa")
_SUCCEEDED = EventStatus.Succeeded()


class DmpIntegrator(LeafSystem):
    """Integrates the movement primitive with its coupling terms.

    .. pydrake_system::

      name: DmpIntegrator
      input_ports:
      - goal
      - ellipsoids_W (optional)
      - coupling_parameters (optional)
      - route (optional)
      - speed_scale (optional)
      - evasion_velocity (optional)
      - demonstration (optional)
      output_ports:
      - desired_position
      - desired_velocity
      - desired_acceleration
      - phase
      - policy_state

    - goal: (3,) goal of the motion in the world frame [m].
    - ellipsoids_W (optional): abstract `EllipsoidSet`, the dilated obstacles. Without
      it the motion is the pre-planned one.
    - coupling_parameters (optional): abstract `CouplingParameters`, one row an
      ellipsoid. Without it there is no avoidance term. Its normals and its tau, where it
      gives them, go before the route's; while its `hold` is set the motion is held.
    - route (optional): abstract `Route`, one row an ellipsoid: `CostRingSelector`'s
      decision. The headings are computed here from where the motion is at each step.
      Without it there is no guidance term, and the motion is not scaled in time.
    - speed_scale (optional): (1,) share of full speed at which the motion is to go, in
      [0, 1], as `MotionGuard` outputs it. The rate of normalized time follows it at the rate
      of a hold, and the path stays; at 0 the motion is held. Without it the share is 1.
    - evasion_velocity (optional): (3,) velocity in the world [m/s] by which p_WE is displaced besides
      its motion, as `MotionGuard` outputs it; phase and scaled velocity stay as they
      are, and the spring leads on from where it has come to. It should be continuous: the
      desired velocity follows it within a step.
    - demonstration (optional): abstract `Demonstration`: what a motion that begins anew
      imitates, where there is one, in place of the constructor's primitive.
    - desired_position: (3,) p_WE [m].
    - desired_velocity: (3,) v_WE [m/s].
    - desired_acceleration: (3,) a_WE [m/s^2].
    - phase: (1,) the canonical phase k.
    - policy_state: abstract `PolicyState` at the last step.

    The state is abstract, in the Context: the step under way (`Segment`), between
    whose ends the desired motion is interpolated, so that a controller may run faster
    than the policy. A simulator that takes over a Context goes on with its motion. The
    motion is held (its normalized time slows down to a stop, on the path) while it
    would not be safe: see `drake_oa.policy.action.CouplingInputs.hold_at`.
    """

    def __init__(
        self,
        dmp: Dmp,
        start: FloatArray,
        *,
        config: Policy | None = None,
    ) -> None:
        """Declares the ports.

        Args:
            dmp: the movement primitive.
            start: (3,) where the motion starts [m].
            config: its period, and how coupling terms and holds act; None: the defaults.
        """
        super().__init__()
        self._dmp, self._config = dmp, config or Policy()
        self._start = start = np.asarray(start, dtype=float)

        self._goal = self.DeclareVectorInputPort("goal", 3)
        self._ellipsoids = AbstractInput(self, "ellipsoids_W", EllipsoidSet)
        self._coupling = AbstractInput(self, "coupling_parameters", CouplingParameters)
        self._route = AbstractInput(self, "route", Route)
        self._speed_scale = self.DeclareVectorInputPort("speed_scale", 1)
        self._evasion = self.DeclareVectorInputPort("evasion_velocity", 3)
        self._demonstration = AbstractInput(self, "demonstration", Demonstration)
        # Perception and decision are much slower than the policy.
        self._coupling_inputs = self.DeclareCacheEntry(
            "surroundings",
            ValueProducer(lambda: Value(CouplingInputs()), self._calc_coupling_inputs),
            {self._ellipsoids.ticket(), self._coupling.ticket(), self._route.ticket()},
        )
        self._segment = self.DeclareAbstractState(
            Value(resting(PolicyState(p_WE=start, p_WS=start, p_WG=start)))
        )
        desired = self.DeclareCacheEntry(
            "desired_motion",
            ValueProducer(
                lambda: Value(np.zeros((3, 3))),
                lambda context, output: output.set_value(
                    self._read_segment(context).interpolate(context.get_time())
                ),
            ),
            {self.time_ticket(), self.abstract_state_ticket(self._segment)},
        )
        names = ("desired_position", "desired_velocity", "desired_acceleration")
        for row, name in enumerate(names):
            self.DeclareVectorOutputPort(
                name,
                3,
                lambda context, output, row=row: output.SetFromVector(desired.Eval(context)[row]),
                {desired.ticket()},
            )
        declare_state_outputs(
            self, self._segment, ("phase", 1, "state.phase"), ("policy_state", PolicyState, "state")
        )
        self.DeclareInitializationUnrestrictedUpdateEvent(self._initialize)
        self.DeclarePeriodicUnrestrictedUpdateEvent(self._config.period, 0.0, self._step)

    def _read_segment(self, context: Context) -> Segment:
        return context.get_abstract_state(self._segment).get_value()

    def _initialize(self, context: Context, state: State) -> EventStatus:
        if self._read_segment(context).state.baseline > 0.0:
            # A motion under way, in a Context that another simulator takes over.
            return EventStatus.DidNothing()
        p_WS, p_WG = self._start, self._goal.Eval(context)
        state.get_mutable_abstract_state(self._segment).set_value(
            resting(
                PolicyState(
                    p_WE=p_WS,
                    p_WS=p_WS,
                    p_WG=p_WG,
                    R_WL=local_frame(p_WS, p_WG),
                    stamp=context.get_time(),
                    speed=1.0 / self._dmp.duration,
                )
            )
        )
        return _SUCCEEDED

    def _calc_coupling_inputs(self, context: Context, output: AbstractValue) -> None:
        output.set_value(
            CouplingInputs.of(
                self._ellipsoids.find(context),
                self._coupling.find(context),
                self._route.find(context),
            )
        )

    def _step(self, context: Context, state: State) -> EventStatus:
        before = self._read_segment(context)
        around = self._coupling_inputs.Eval(context)
        goal = self._goal.Eval(context)
        if around.restart:
            given = self._demonstration.find(context)
            primitive = None if given is None else given.position
            before = restarted(before, goal, context.get_time(), primitive)
        scale = self._speed_scale
        after = take_step(
            before,
            goal,
            around,
            context.get_time(),
            self._config.period,
            dmp=self._dmp,
            config=self._config,
            speed_scale=scale.Eval(context)[0] if scale.HasValue(context) else 1.0,
            evasion_velocity=self._evasion.Eval(context)
            if self._evasion.HasValue(context)
            else None,
        )
        now, earlier = after.end, before.end
        # The system that scales the speed logs the reason.
        if now.note != earlier.note and HoldReason.SPEED_SCALE not in (now.hold, earlier.hold):
            held = now.hold is not HoldReason.NONE
            message = f"held: {now.note}" if held else "running again"
            # The first decision of a motion deserves no warning.
            quiet = (now if held else earlier).hold is HoldReason.DECIDING
            level = logging.INFO if quiet else logging.WARNING
            _logger.log(level, "t=%.3f s: %s", context.get_time(), message)
        state.get_mutable_abstract_state(self._segment).set_value(after)
        return _SUCCEEDED
