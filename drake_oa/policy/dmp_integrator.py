"""System of the policy layer that integrates the movement primitive of the tool point.

Coupling terms of the movement primitive turn the motion away from obstacles."""

from __future__ import annotations

import logging

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, EventStatus, LeafSystem, State, ValueProducer

from drake_oa.common.messages import (
    CouplingParameters,
    EllipsoidSet,
    FloatArray,
    HoldReason,
    PolicyState,
    Route,
)
from drake_oa.common.ports import AbstractInput, declare_state_outputs
from drake_oa.policy.action import CouplingInputs, Segment, make_segment, restart, take_step
from drake_oa.policy.config import Policy
from drake_oa.policy.dmp import Demonstration, Dmp, local_frame

_logger = logging.getLogger("drake_oa")
_SUCCEEDED = EventStatus.Succeeded()


class DmpIntegrator(LeafSystem):
    """Integrator of a dynamic movement primitive (DMP) with coupling terms, for the tool point.

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

    - goal: (3,) goal of the motion in the world frame [m]; it may move. While it is not finite, the
      motion is held (stopped on its path).
    - ellipsoids_W (optional): abstract `EllipsoidSet`, the obstacles dilated by the tool.
      Not connected: nominal motion without avoidance.
    - coupling_parameters (optional): abstract `CouplingParameters`, one row per ellipsoid. Normals
      of the planes of rotation and a temporal scaling tau in this message take precedence over
      those of the route. While `hold` is set in the message, the motion is held. Terms that
      roll-outs (simulations) have verified have their own centers, and act without ellipsoids_W.
      Not connected: no coupling terms.
    - route (optional): abstract `Route` of `CostRingSelector`, one row per ellipsoid: the side on
      which each obstacle is passed. The guidance term, (9) of Pairet et al., RA-L 2019, turns the
      motion toward guidance headings, directions past the obstacles on these sides. They are
      computed at each step. Not connected: no guidance term, and no temporal scaling by the path
      length.
    - speed_scale (optional): (1,) requested fraction of full speed in [0, 1], from
      `MotionGuard`. The speed ds/dt approaches this fraction of 1 / (tau T); its change during the
      time `policy.hold_time` is at most 1 / T. The first motion begins at this fraction of 1 / T,
      unless it is held at first; a restarted motion begins at rest. The path does not change; at 0
      the motion is held. Not connected: 1.
    - evasion_velocity (optional): (3,) velocity in the world frame [m/s] from `MotionGuard`, added
      to that of the primitive. It displaces p_WE, but changes neither phase nor scaled velocity;
      the spring acts on the displaced position. The evasion velocity should be
      continuous, because the desired velocity follows it within one step. Not connected: 0.
    - demonstration (optional): abstract `Demonstration`. A motion that restarts follows the
      demonstration's movement primitive of the position. Not connected or without this primitive:
      the constructor's primitive.
    - desired_position: (3,) p_WE in the world frame [m].
    - desired_velocity: (3,) v_WE in the world frame [m/s].
    - desired_acceleration: (3,) a_WE in the world frame [m/s^2].
    - phase: (1,) phase k of the canonical system, from 1 at the start to 0.
    - policy_state: abstract `PolicyState` at the last step of the integrator: position, scaled
      velocity, phase, speed, and the reason while the motion is held.

    With position x, scaled velocity z, phase k, goal g, and normalized time s = t / (tau T), where
    T is the demonstrated duration and tau the temporal scaling, the system integrates

        dz/ds = alpha_x (beta_x (g - x) - z) + f(k) + sum_i cross(Omega_i, z),
        dx/ds = z,    dk/ds = -alpha_k k,    x(0) = start, z(0) = 0, k(0) = 1.

    f is the forcing term learned from the demonstration, and Omega_i the angular rate of coupling
    term i, which turns the motion away from obstacle i (`drake_oa.policy.coupling`). The speed
    ds/dt approaches speed_scale / (tau T) at a bounded rate. The evasion velocity adds to the
    velocity of the tool point.

    The abstract state is the current `Segment` between two steps. The desired motion is
    interpolated in this segment, so that a controller may run faster than the policy. A simulator
    that starts with an existing Context continues the motion of the Context. While continuing
    would not be safe the motion is held: ds/dt falls to 0, and the motion stays on its path. This
    is the case if the obstacles were not observed for `policy.max_observation_age`, if an input
    requests it, or if the tool or the goal is inside an ellipsoid and roll-outs have not verified
    the motion.
    """

    def __init__(self, dmp: Dmp, start: FloatArray, *, config: Policy | None = None) -> None:
        """Declares ports, state and periodic update; the motion starts with the simulation.

        Args:
            dmp: movement primitive of the tool point, of three dimensions.
            start: (3,) start of the motion in the world frame [m].
            config: configuration of the time step, of the fading of coupling terms near the goal,
                and of holds; None: the defaults.
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
        # Cached, because perception and inference are much slower than the policy.
        self._coupling_inputs = self.DeclareCacheEntry(
            "coupling inputs",
            ValueProducer(lambda: Value(CouplingInputs()), self._calc_coupling_inputs),
            {self._ellipsoids.ticket(), self._coupling.ticket(), self._route.ticket()},
        )
        self._segment = self.DeclareAbstractState(
            Value(make_segment(PolicyState(p_WE=start, p_WS=start, p_WG=start)))
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
        p_WS, p_WG = self._start, self._goal.Eval(context)
        if self._read_segment(context).state.baseline > 0.0 or not np.isfinite(p_WG).all():
            # The Context contains a motion of an earlier simulator, which continues, or the motion
            # starts at the first step with a finite goal.
            return EventStatus.DidNothing()
        state.get_mutable_abstract_state(self._segment).set_value(
            make_segment(
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
        inputs = self._coupling_inputs.Eval(context)
        goal = self._goal.Eval(context)
        if inputs.restart and np.isfinite(goal).all():
            demonstration = self._demonstration.find(context)
            primitive = None if demonstration is None else demonstration.position
            before = restart(before, goal, context.get_time(), primitive)
        scale = self._speed_scale
        after = take_step(
            before,
            goal,
            inputs,
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
        # Holds by the speed scale are logged, with their reason, by the system that outputs it.
        if now.note != earlier.note and HoldReason.SPEED_SCALE not in (now.hold, earlier.hold):
            is_held = now.hold is not HoldReason.NONE
            message = f"motion held: {now.note}" if is_held else "motion resumed"
            # Waiting for the first decision of a motion is normal and needs no warning.
            is_first = (now if is_held else earlier).hold is HoldReason.DECIDING
            level = logging.INFO if is_first else logging.WARNING
            _logger.log(level, "t=%.3f s: %s", context.get_time(), message)
        state.get_mutable_abstract_state(self._segment).set_value(after)
        return _SUCCEEDED
