"""The evasion layer: gets the arm out of the way of what moves toward it."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import (
    BasicVector,
    Context,
    EventStatus,
    LeafSystem,
    State,
)

from drake_oa.common.config import check_values
from drake_oa.common.messages import (
    BoolArray,
    Evasion,
    FloatArray,
    Frozen,
    IntArray,
    ObstacleClouds,
    PlannedMotion,
    PolicyState,
    TablePlane,
)
from drake_oa.common.ports import (
    DECISION_OFFSET,
    ModelContext,
    read_optional,
    read_value,
    valid_period,
)
from drake_oa.common.thinking import Thinking, Thoughts
from drake_oa.geometry.annulus import Annulus
from drake_oa.geometry.collision_shapes import RobotModel
from drake_oa.geometry.directions import ramped
from drake_oa.geometry.points import GuardShapes, ObstaclePoints
from drake_oa.policy.dmp import Dmp, normalised_time
from drake_oa.safety.config import EvasionParameters, EvasionSettings, settings
from drake_oa.safety.evasion import NOTHING_MOVES, choose, left_alone
from drake_oa.safety.lookahead import Lookout, posed_arm
from drake_oa.safety.lookahead_kernels import Arm

_logger = logging.getLogger("drake_oa")


@dataclass(frozen=True, eq=False)
class _Kept(Frozen):
    """What is kept from step to step: what was decided, and the velocity now [m/s]."""

    thoughts: Thoughts[Evasion] = field(default_factory=lambda: Thoughts(NOTHING_MOVES))
    velocity: FloatArray = field(default_factory=lambda: np.zeros(3))
    seen: ObstacleClouds | None = None
    obstacles: ObstaclePoints = field(default_factory=ObstaclePoints)

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
      - obstacles_W
      - motion (optional)
      output_ports:
      - evasion
      - evading
      - decision

    - robot_state: positions and velocities of the robot, (2n,) [rad, m, rad/s, m/s].
    - policy_state: abstract `PolicyState` of the movement primitive.
    - obstacles_W: abstract `ObstacleClouds`, with their velocities.
    - motion (optional): abstract `PlannedMotion`, what is expected of the motion; without
      it, that it goes straight on.
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

    def __init__(  # noqa: PLR0913
        self,
        robot: RobotModel,
        tool_frame: str,
        dmp: Dmp,
        *,
        period: float = 1.0 / 30.0,
        step: float = 0.005,
        max_age: float = 0.5,
        parameters: EvasionParameters | None = None,
        padding: float = 0.01,
        hold_time: float = 0.25,
        turns: bool = True,
        table: TablePlane | None = None,
        table_height: float = -math.inf,
        annulus: Annulus | None = None,
        thinking: Thinking | None = None,
    ) -> None:
        """Declares the ports.

        Args:
            robot: the robot alone, from `collect_collision_shapes`; its base welded to the
                world, every joint of one degree of freedom.
            tool_frame: name of the frame E.
            dmp: the movement primitive whose motion is displaced.
            period: time between decisions [s].
            step: time between steps of the velocity [s].
            max_age: an older observation is not looked at [s].
            parameters: what is kept; None: the defaults.
            padding: how far an obstacle's surface may lie outside its points [m].
            hold_time: in which the motion comes to rest [s].
            turns: whether something turns the arm as `evading` asks.
            table: the supporting plane until one is observed; None: none.
            table_height: least height of the tool point over the table [m].
            annulus: workspace of the tool point, see `drake_oa.safety.evasion.Lookout`.
            thinking: what decisions cost in simulated time; None: none.

        Raises:
            ValueError: if the plant has no such frame, a joint of several degrees of
                freedom, or none that moves the frame; or for a period that is not positive.
        """
        super().__init__()
        plant = robot.plant
        if not plant.HasFrameNamed(tool_frame):
            raise ValueError(f"tool_frame: the plant has no frame '{tool_frame}'")
        self._robot = robot
        self._frame = plant.GetFrameByName(tool_frame)
        self._shapes = GuardShapes.of(robot.shapes, len(robot.bodies))
        self._joints, self._moved, self._limits = arm_joints(robot, self._frame.body().index())
        self._dmp, self._step_length = dmp, valid_period(step)
        self._max_age = max_age
        derived = settings(parameters or EvasionParameters(), padding=padding, hold_time=hold_time)
        self._parameters = EvasionSettings(**derived | ({} if turns else {"turn_speed": 0.0}))
        check_values(self._parameters, "evasion")
        self._table, self._table_height = table, table_height
        self._annulus = annulus
        self._thinking = thinking
        self._n = n = plant.num_velocities()

        self._robot_state = self.DeclareVectorInputPort("robot_state", 2 * n)
        self._policy = self.DeclareAbstractInputPort("policy_state", Value(PolicyState()))
        self._clouds = self.DeclareAbstractInputPort("obstacles_W", Value(ObstacleClouds()))
        self._motion = self.DeclareAbstractInputPort("motion", Value(PlannedMotion()))
        self._model = ModelContext(self, plant)
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
        kept = self._seen(context, before)
        after = replace(
            kept,
            thoughts=kept.thoughts.thought(
                lambda evasion: self._choose(context, kept, evasion), time, self._thinking
            ),
        )
        _log_change(before.evasion, after.evasion, time)
        held.set_value(after)
        return EventStatus.Succeeded()

    def _seen(self, context: Context, before: _Kept) -> _Kept:
        """With what is seen now."""
        seen = read_value(self, self._clouds, context, ObstacleClouds)
        if seen is before.seen or seen.stamp < before.obstacles.stamp:
            return before
        try:
            active = before.evasion.action != ""
            return replace(before, seen=seen, obstacles=_points(seen, active))
        except ValueError:
            # What is not finite leaves what was seen before: it ages.
            return replace(before, seen=seen)

    def _choose(self, context: Context, kept: _Kept, before: Evasion) -> Evasion:
        time, obstacles = context.get_time(), kept.obstacles
        policy = read_value(self, self._policy, context, PolicyState)
        x = self._robot_state.Eval(context)
        unknown = time - obstacles.stamp > self._max_age or not math.isfinite(
            x.sum() + policy.z_W.sum()
        )
        if unknown or not (obstacles.v_WO.any() or before.action):
            turned = unknown and len(before.turn) > 0
            return left_alone(before) if turned else NOTHING_MOVES
        table = obstacles.table or self._table
        plane = np.full(4, np.nan)
        if table is not None:
            plane[:3], plane[3] = table.normal_W, table.offset
        ahead = Lookout(
            self._arm(context, x),
            obstacles,
            plane,
            max(time - obstacles.stamp, 0.0),
            self._parameters,
            table_height=self._table_height,
            annulus=self._annulus,
        )
        return choose(
            before,
            kept.velocity,
            x[self._n :][self._joints],
            policy,
            read_optional(self, self._motion, context, PlannedMotion),
            max(0.0, normalised_time(policy.phase, self._dmp.alpha_k)),
            1.0 / (policy.tau * self._dmp.duration),
            ahead,
            obstacles,
            self._parameters,
        )

    def _arm(self, context: Context, x: FloatArray) -> Arm:
        model = self._model.at(context, x[: self._n])
        limits = self._limits
        return posed_arm(
            self._model.jacobian(model, self._frame)[:, self._joints],
            self._frame.CalcPoseInWorld(model).translation(),
            x[self._joints],
            limits,
            self._shapes,
            self._robot.body_poses(model),
            self._moved,
            self._parameters,
        )


def arm_joints(
    robot: RobotModel, tool: int
) -> tuple[IntArray, BoolArray, tuple[FloatArray, FloatArray, FloatArray]]:
    """The joints that move the tool.

    Returns:
        (n,) where they are in the plant's velocities; (B, n) which of the robot's bodies each
        moves; their limits.
    """
    plant = robot.plant
    joints, moved = [], []
    for joint in map(plant.get_joint, plant.GetJointIndices(robot.model_instance)):
        bodies = plant.GetBodiesKinematicallyAffectedBy([joint.index()])
        if joint.num_velocities() == 1 and tool in bodies:
            joints.append(joint)
            moved.append([body in bodies for body in robot.bodies])
    if plant.num_positions() != plant.num_velocities():
        raise ValueError("robot: each joint must have one degree of freedom")
    if not joints:
        raise ValueError("robot: no joint of one degree of freedom moves the tool frame")
    limits = (
        np.array([joint.position_lower_limits()[0] for joint in joints]),
        np.array([joint.position_upper_limits()[0] for joint in joints]),
        np.array([joint.velocity_upper_limits()[0] for joint in joints]),
    )
    where = np.array([joint.velocity_start() for joint in joints], dtype=np.int64)
    return where, np.ascontiguousarray(np.array(moved).T), limits


def _points(seen: ObstacleClouds, active: bool) -> ObstaclePoints:
    """The points; laid out only where something moves or has been evaded."""
    if active or seen.v_WO.any():
        return ObstaclePoints.of(seen)
    return ObstaclePoints(stamp=seen.stamp, table=seen.table)


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
