"""The regulation layer past the paper: coupling parameters that roll-outs have checked."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, EventStatus, LeafSystem, State

from drake_oa.common.messages import (
    DECIDING,
    CouplingParameters,
    EllipsoidSet,
    Frozen,
    HoldCause,
    ObstacleClouds,
    PlannedMotion,
    PolicyState,
    TablePlane,
)
from drake_oa.common.ports import DECISION_OFFSET, read_optional, read_value, valid_period
from drake_oa.common.thinking import ForMotion, Thinking, Thoughts
from drake_oa.geometry.annulus import Annulus
from drake_oa.policy.dmp import Dmp
from drake_oa.posture.posture_planner import ArmSight, WholeArm
from drake_oa.regulation.config import SearchParameters
from drake_oa.regulation.regressor import ChainWeights
from drake_oa.regulation.regulated_arm import ArmRegulator
from drake_oa.regulation.regulation import Regulation, concern
from drake_oa.regulation.regulator import Regulator

_logger = logging.getLogger("drake_oa")
_NOTHING_SEEN = ObstacleClouds()


@dataclass(frozen=True, eq=False)
class RobotArm:
    """The arm of a robot whose posture is planned.

    Attributes:
        planner: plans it.
        positions: where its joints are in the robot's state.
        num_states: size of that state [q, v].
    """

    planner: WholeArm
    positions: tuple[int, ...]
    num_states: int


@dataclass(frozen=True, eq=False)
class _State(Frozen):
    """What has been chosen; `holds`: the motion has begun anew since, and waits for a choice."""

    thoughts: Thoughts[ForMotion[Regulation]] = field(
        default_factory=lambda: Thoughts(ForMotion(Regulation()))
    )
    holds: bool = False

    @property
    def regulation(self) -> Regulation:
        """What is in force."""
        return self.thoughts.in_force.decision

    @property
    def waits(self) -> bool:
        """Whether no motion has been verified yet from where the policy is."""
        in_force = self.thoughts.in_force
        leads_away = not np.array_equal(in_force.p_WS, in_force.p_WG)
        return self.holds or (self.regulation.tau == 0.0 and leads_away)


class VerifiedRegressorChain(LeafSystem):
    """Regulates the coupling terms by motions that have been rolled out beforehand.

    .. pydrake_system::

      name: VerifiedRegressorChain
      input_ports:
      - ellipsoids_W
      - policy_state
      - goal
      - table (optional)
      - robot_state (optional)
      - obstacles_W (optional)
      - camera_pose (optional)
      output_ports:
      - coupling_parameters
      - shortfall
      - short_of
      - lowered
      - motion
      - decision

    - ellipsoids_W: abstract `EllipsoidSet`, M dilated obstacles with their velocities; may
      be empty.
    - policy_state: abstract `PolicyState` of the movement primitive.
    - goal: (3,) goal of the motion in the world frame [m].
    - table (optional): abstract `TablePlane`; without it the plane that came with
      the ellipsoids is used.
    - robot_state (optional): (2m,) positions and velocities of the robot whose arm's posture
      is planned [rad, m, rad/s, m/s]; without it none is. Without an arm to plan for it has
      size 1 and is not read.
    - obstacles_W (optional): abstract `ObstacleClouds` that the arm must not touch, with the
      far sides that `HiddenSides` gives to what moves; without it the arm minds the table,
      its limits and itself.
    - camera_pose (optional): abstract `RigidTransform` of the camera that sees them: what is
      behind is not seen. Without it they are taken to be seen from all sides.
    - coupling_parameters: abstract `CouplingParameters`, M rows. One avoidance term bends
      the whole motion: it is on the row of the obstacle that the motion comes nearest to,
      with the point it acts about and the normal of its plane; the other rows have
      alpha 0. With it tau, at least 1, among moving obstacles at least 0.6; a note that
      holds the motion where none was found that clears the obstacles; whether a motion that
      rests is to begin anew; and p_WV, where it is to go to a point aside first.
    - shortfall: (1,) what the verified motion lacks of the feasible clearance, min(Delta,
      distance of E now, distance of the goal) of each obstacle [m]; 0 where it is kept.
    - short_of: (1,) name of the obstacle that it lacks it to; -1 where it is kept.
    - lowered: (1,) by how much the least of these feasible clearances is below Delta [m].
    - motion: abstract `PlannedMotion`, the motion that was verified, from the instant of
      the choice to the goal; without samples while there is none. While a planned posture is
      kept it is the motion that the posture was planned along, from that instant on.
    - decision: (2,) when the last choice began (NaN: none has) and the time that it takes [s];
      NaN and 0 where thinking costs none.

    The regressor chain proposes. Candidates, and what is in use, are rolled out from where
    the policy is, among all obstacles with their velocities, above the table and within
    the workspace; of those that keep the clearance and reach the goal the shortest is
    taken, and another side than the one in use only where it is shorter by some
    hysteresis: see `drake_oa.regulation.search`. Where the arm cannot follow it, another
    motion is looked for every second, longer or with less of the clearance, but 5 cm; where the arm
    is stuck beside what rests, also by way of points aside: see `drake_oa.posture.waypoint_tree`.

    It has the place of `RegressorChain` in a diagram; the `DmpIntegrator` that takes its
    parameters must have the same primitive and fade, and needs no route.

    The choice is abstract state. It is made at initialization and every `period`, shortly
    after it so that an observation of the same instant counts; while obstacles, goal and
    table stay as they were and nothing moves, it stands. Where thinking costs time, a choice
    is in force from the first `step` of the policy after that, and no other begins before;
    one for a goal or a start that are others by then is dropped. The motion is held until the
    first choice is in force, and from where it begins anew until the first one from there is.
    Between choices an obstacle with
    a name that was not there has alpha 0. There is no term while start and goal coincide
    or nothing has been observed.
    """

    def __init__(
        self,
        weights: ChainWeights,
        dmp: Dmp,
        asked_clearance: float,
        *,
        period: float = 1.0 / 15.0,
        parameters: SearchParameters | None = None,
        table_height: float = 0.05,
        annulus: Annulus | None = None,
        arm: RobotArm | None = None,
        begins_anew: bool = False,
        thinking: Thinking | None = None,
        step: float = 0.008,
    ) -> None:
        """Declares the ports.

        Args:
            weights: the trained chain, see `drake_oa.regulation.regressor.load_chain`.
            dmp: the movement primitive whose motion is regulated.
            asked_clearance: asked distance Delta between tool and obstacle [m].
            period: time between choices [s].
            parameters: how far the search goes; None: the defaults.
            table_height: least height of E above the table [m].
            annulus: where E may be, of two heights or more; None: anywhere.
            arm: plans the posture along the motion; None: nothing does.
            begins_anew: whether a motion that rests, as none that clears the obstacles or that
                the arm can follow goes on from it, begins anew from there where such a one
                does, and may step aside first.
            thinking: what choices cost in simulated time; None: none.
            step: of the policy, at which choices come into force then [s].

        Raises:
            TypeError: if weights are no `ChainWeights`.
            ValueError: if clearance, period or step are not finite and positive, the primitive
                does not have three dimensions, the height is not finite, or the annulus has
                another shape or heights that do not increase.
        """
        super().__init__()
        if not isinstance(weights, ChainWeights):
            raise TypeError(
                f"weights must be ChainWeights (see load_chain), not {type(weights).__name__}"
            )
        if not 0.0 < asked_clearance < np.inf:
            raise ValueError(
                f"asked_clearance must be finite and positive [m], not {asked_clearance}"
            )
        if dmp.dimension != 3:
            raise ValueError(f"dmp must have 3 dimensions, not {dmp.dimension}")
        if annulus is not None:
            _check_annulus(annulus)
        if not math.isfinite(table_height):
            raise ValueError(f"table_height must be finite [m], not {table_height}")
        period = valid_period(period)
        self._regulator = Regulator(
            weights,
            dmp,
            float(asked_clearance),
            parameters=parameters or SearchParameters(),
            table_height=table_height,
            annulus=annulus,
            begins_anew=begins_anew,
        )
        self._arm = None if arm is None else ArmRegulator(self._regulator, arm.planner, dmp)
        self._arm_positions = [] if arm is None else list(arm.positions)
        self._ellipsoids = self.DeclareAbstractInputPort("ellipsoids_W", Value(EllipsoidSet()))
        self._policy = self.DeclareAbstractInputPort("policy_state", Value(PolicyState()))
        self._goal = self.DeclareVectorInputPort("goal", 3)
        self._table = self.DeclareAbstractInputPort("table", Value(TablePlane()))
        self._robot = self.DeclareVectorInputPort(
            "robot_state", 1 if arm is None else arm.num_states
        )
        self._obstacles = self.DeclareAbstractInputPort("obstacles_W", Value(ObstacleClouds()))
        self._camera = self.DeclareAbstractInputPort("camera_pose", Value(RigidTransform()))
        self._thinking = thinking
        self._chosen = self.DeclareAbstractState(Value(_State()))
        chosen = self.abstract_state_ticket(self._chosen)
        self.DeclareAbstractOutputPort(
            "coupling_parameters",
            lambda: Value(CouplingParameters()),
            self._calc_parameters,
            prerequisites_of_calc={self._ellipsoids.ticket(), chosen},
        )
        self.DeclareVectorOutputPort("shortfall", 1, self._calc_shortfall, {chosen})
        self.DeclareVectorOutputPort("short_of", 1, self._calc_short_of, {chosen})
        self.DeclareVectorOutputPort("lowered", 1, self._calc_lowered, {chosen})
        self.DeclareAbstractOutputPort(
            "motion", lambda: Value(PlannedMotion()), self._calc_motion, {chosen}
        )
        self.DeclareVectorOutputPort("decision", 2, self._calc_decision, {chosen})
        self.DeclareInitializationUnrestrictedUpdateEvent(self._choose)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, DECISION_OFFSET, self._choose)
        if thinking is not None:
            step = valid_period(step)
            # Just before the policy looks.
            self.DeclarePeriodicUnrestrictedUpdateEvent(
                step, step - min(DECISION_OFFSET, 0.5 * step), self._take_effect
            )

    def _read(self, context: Context) -> _State:
        return context.get_abstract_state(self._chosen).get_value()

    def _choose(self, context: Context, state: State) -> EventStatus:
        # Not the Context's: the other event of the same instant may have come first.
        held = state.get_mutable_abstract_state(self._chosen)
        kept: _State = held.get_value()
        time = context.get_time()
        thoughts = kept.thoughts.thought(
            lambda before: self._decide(context, before.decision), time, self._thinking
        )
        if thoughts is kept.thoughts:
            return EventStatus.DidNothing()
        _log_change(kept.regulation, thoughts.in_force.decision, time)
        held.set_value(replace(kept, thoughts=thoughts))
        return EventStatus.Succeeded()

    def _take_effect(self, context: Context, state: State) -> EventStatus:
        held = state.get_mutable_abstract_state(self._chosen)
        kept: _State = held.get_value()
        time = context.get_time()
        made = kept.thoughts.made(time)
        if made is None and not kept.regulation.anew:
            return EventStatus.DidNothing()
        if made is not None and not self._is_outdated(context, made):
            _log_change(kept.regulation, made.decision, time)
            held.set_value(_State(kept.thoughts.taken()))
            return EventStatus.Succeeded()
        if made is not None:
            _logger.info("t=%.3f s: a decision of t=%.3f s is dropped", time, kept.thoughts.begun)
            kept = replace(kept, thoughts=kept.thoughts.dropped())
        if kept.regulation.anew:
            # The policy has looked once, and is not to begin anew from where it comes to next.
            begun = replace(kept.regulation, anew=False)
            in_force = replace(kept.thoughts.in_force, decision=begun)
            kept = _State(replace(kept.thoughts, in_force=in_force), holds=True)
        held.set_value(kept)
        return EventStatus.Succeeded()

    def _is_outdated(self, context: Context, made: ForMotion[Regulation]) -> bool:
        """Whether a choice is for another motion than the one that is under way now."""
        policy = read_value(self, self._policy, context, PolicyState)
        if not made.fits(policy, self._goal.Eval(context)):
            return True
        return made.decision.anew and policy.speed > 0.0

    def _decide(self, context: Context, before: Regulation) -> ForMotion[Regulation]:
        policy = read_value(self, self._policy, context, PolicyState)
        goal = self._goal.Eval(context)
        ellipsoids = read_value(self, self._ellipsoids, context, EllipsoidSet)
        asked = (
            before,
            policy,
            goal,
            ellipsoids,
            read_optional(self, self._table, context, TablePlane) or ellipsoids.table,
        )
        if self._arm is None or not self._robot.HasValue(context):
            after = self._regulator.update(*asked)
        else:
            seen = read_optional(self, self._obstacles, context, ObstacleClouds)
            q = self._robot.Eval(context)[self._arm_positions]
            X_WC = read_optional(self, self._camera, context, RigidTransform)
            view = np.zeros(0) if X_WC is None else X_WC.translation()
            after = self._arm.update(*asked, ArmSight(q, seen or _NOTHING_SEEN, view))
        return ForMotion(after, policy.p_WS, np.array(goal))

    def _calc_parameters(self, context: Context, output: AbstractValue) -> None:
        ellipsoids = read_value(self, self._ellipsoids, context, EllipsoidSet)
        kept = self._read(context)
        coupling = kept.regulation.coupling(ellipsoids)
        if self._thinking is not None and kept.waits and not kept.regulation.held:
            coupling = replace(coupling, hold=HoldCause.DECIDING, note=DECIDING)
        output.set_value(coupling)

    def _calc_shortfall(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._read(context).regulation.shortfall)

    def _calc_short_of(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._read(context).regulation.short_of)

    def _calc_lowered(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._read(context).regulation.lowered)

    def _calc_motion(self, context: Context, output: AbstractValue) -> None:
        output.set_value(self._read(context).regulation.motion)

    def _calc_decision(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._read(context).thoughts.last)


def _check_annulus(annulus: Annulus) -> None:
    radii = annulus.radii
    if radii.ndim != 2 or len(radii) != 3 or radii.shape[1] < 2:
        raise ValueError(f"annulus.radii must be (3, n) with n at least 2, not {radii.shape}")
    if not (np.isfinite(radii).all() and (np.diff(radii[0]) > 0.0).all()):
        raise ValueError(f"annulus must be finite, its heights increasing [m], not {radii}")


def _log_change(before: Regulation, after: Regulation, time: float) -> None:
    """Says once what a new choice does not do; why it holds, who holds says."""
    said = "" if after.held else concern(after)
    was, now = ((one.short_of, one.lowered_for) for one in (before, after))
    if said and (now != was or before.held or not concern(before)):
        _logger.warning("t=%.3f s: %s", time, said)
