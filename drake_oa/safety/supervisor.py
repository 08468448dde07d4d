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

from drake_oa.common.config import check_values
from drake_oa.common.messages import (
    BoolArray,
    Evasion,
    FloatArray,
    HoldCause,
    IntArray,
    ObstacleClouds,
    PlannedMotion,
    PolicyState,
    TablePlane,
)
from drake_oa.common.ports import ModelContext, read_optional, read_value, valid_period
from drake_oa.geometry.collision_shapes import RobotModel
from drake_oa.geometry.points import GuardShapes
from drake_oa.planning.solid_scene import SolidScene
from drake_oa.policy.demonstration import Demonstration
from drake_oa.safety.approach_kernels import full_speed_motion, planned_rate
from drake_oa.safety.config import SupervisorParameters, SupervisorSettings, settings
from drake_oa.safety.monitors import (
    GuardedArm,
    JointRange,
    remaining_distance,
    watch_clearance,
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
      - obstacles_W (optional)
      - tracking_error (optional)
      - torque_saturation (optional)
      - evading (optional)
      - solids_W (with arm)
      - motion (with arm)
      - demonstration (with arm)
      output_ports:
      - speed_scale
      - supervision

    - robot_state: positions and velocities of the robot, (2n,) [rad, m, rad/s, m/s].
    - policy_state: abstract `PolicyState` of the movement primitive.
    - obstacles_W (optional): abstract `ObstacleClouds`. Without it neither observations nor
      obstacles are watched; the table that was given still is.
    - tracking_error (optional): (3,) desired minus actual position of the tool point [m].
    - torque_saturation (optional): (1,) 1 while a joint torque is at its limit, else 0.
    - evading (optional): abstract `drake_oa.safety.evasion.Evasion`: what an `ObstacleEvasion` does
      against what moves. While it lets the motion go on, obstacles that move do not slow it;
      while it waits or evades, or none of its ways avoids a contact, the motion is held.
    - solids_W (with arm): abstract `SolidScene`, the true shapes; with it the arm's spheres are
      measured against them, in place of its primitives against points and table. This port and
      the next ones are there if an `arm` is given.
    - motion (with arm): abstract `PlannedMotion` of the arm's joints, verified among the solids.
    - demonstration (with arm): abstract `Demonstration` that the motion imitates, for its duration.
    - speed_scale: (1,) share of full speed, in [0, 1], for `DmpIntegrator`.
    - supervision: abstract `Supervision`: run, slow, hold or stop, and why.

    It watches, every `period`: how old the last good observation is; that each link can be
    brought to rest before it touches an obstacle or the table, by where the motion would
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
        robot: RobotModel,
        tool_frame: str,
        duration: float,
        *,
        period: float = 0.008,
        parameters: SupervisorParameters | None = None,
        padding: float = 0.005,
        hold_time: float = 0.25,
        frame_period: float = 1.0 / 15.0,
        max_age: float = 0.5,
        table: TablePlane | None = None,
        arm: GuardedArm | None = None,
    ) -> None:
        """Declares the ports.

        Args:
            robot: the robot alone, from `collect_collision_shapes`; its base welded to the
                world, every joint of one degree of freedom.
            tool_frame: name of the frame E.
            duration: T of the movement primitive [s].
            period: time between decisions [s].
            parameters: what is kept; None: the defaults.
            padding: how far an obstacle's surface may lie outside its points [m].
            hold_time: in which the policy comes to rest from full speed [s].
            frame_period: time between observations [s].
            max_age: an older observation holds the motion [s].
            table: the supporting plane until one is observed; None: none.
            arm: the arm as spheres, to be measured against solids; None: there are none.

        Raises:
            ValueError: if the plant has no such frame, a joint of several degrees of
                freedom, or none that moves the frame; or if duration or period are not
                positive and finite.
        """
        super().__init__()
        plant = robot.plant
        if not plant.HasFrameNamed(tool_frame):
            raise ValueError(f"tool_frame: the plant has no frame '{tool_frame}'")
        if not 0.0 < duration < math.inf:
            raise ValueError(f"duration must be finite and positive [s], not {duration}")
        self._robot = robot
        self._frame = plant.GetFrameByName(tool_frame)
        self._names = tuple(plant.get_body(index).name() for index in robot.bodies)
        self._shapes = GuardShapes.of(robot.shapes, len(robot.bodies))
        self._arm, self._moved, self._joints = arm_joints(robot, self._frame.body().index())
        self._duration = float(duration)
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
        check_values(self._parameters, "supervisor")
        self._n = n = plant.num_velocities()

        self._robot_state = self.DeclareVectorInputPort("robot_state", 2 * n)
        self._policy = self.DeclareAbstractInputPort("policy_state", Value(PolicyState()))
        self._obstacles = self.DeclareAbstractInputPort("obstacles_W", Value(ObstacleClouds()))
        self._error = self.DeclareVectorInputPort("tracking_error", 3)
        self._saturation = self.DeclareVectorInputPort("torque_saturation", 1)
        self._evading = self.DeclareAbstractInputPort("evading", Value(Evasion()))
        self._guarded = arm
        if arm is not None:
            if len(arm.chain.lower) != len(self._arm):
                raise ValueError(
                    f"arm: {len(arm.chain.lower)} joints, but {len(self._arm)} move the tool"
                )
            self._solids = self.DeclareAbstractInputPort("solids_W", Value(SolidScene()))
            self._motion = self.DeclareAbstractInputPort("motion", Value(PlannedMotion()))
            self._shown = self.DeclareAbstractInputPort("demonstration", Value(Demonstration()))
        self._model = ModelContext(self, plant)
        self._state = self.DeclareAbstractState(Value(SupervisorState(table=table)))
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
        if self._guarded is not None:
            shown = read_optional(self, self._shown, context, Demonstration)
            if shown is not None and shown.position is not None:
                duration = shown.position.duration
        v_WE = policy.z_W / (policy.tau * duration)
        for name, value in (("robot state", x), ("policy state", v_WE)):
            if not math.isfinite(value.dot(value)):
                return broken(before, f"the {name} is not finite", time)
        demands: list[Demand] = []
        seen = read_optional(self, self._obstacles, context, ObstacleClouds)
        if seen is not None:
            before = before.with_observation(seen)
            demands.append(watch_observation(before.obstacles, time, parameters, seen.note))
        evading = read_optional(self, self._evading, context, Evasion) or Evasion()
        demands.append(watch_evasion(evading))
        scene = None
        if self._guarded is not None:
            scene = read_optional(self, self._solids, context, SolidScene)
        if scene is not None:
            before = self._with_motion(context, before, scene, policy, evading)
        demands += self._watch_motion(
            context,
            before,
            x,
            v_WE,
            scene=scene,
            seconds=policy.tau * duration,
            passing=evading.action == "going on",
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
        context: Context,
        before: SupervisorState,
        x: FloatArray,
        v_WE: FloatArray,
        *,
        scene: SolidScene | None,
        seconds: float,
        passing: bool,
    ) -> list[Demand]:
        """The watches that need the robot's kinematics at the state x.

        With `passing` what moves is left to who has looked ahead.
        """
        n = self._n
        model = self._model.at(context, x[:n])
        J = self._model.jacobian(model, self._frame)
        X_WB = self._robot.body_poses(model)
        q, v = x[self._arm], x[n + self._arm]
        p_WE = self._frame.CalcPoseInWorld(model).translation()
        v_full, V_WB = full_speed_motion(
            np.ascontiguousarray(J[:, self._arm]), v, v_WE, p_WE, X_WB, self._moved, _DAMPING
        )
        time, motion = context.get_time(), before.motion
        if scene is not None and self._guarded is not None:
            if motion is not None:
                # The motion turns the tool as well.
                v_full = planned_rate(np.array(motion.s), np.array(motion.q, order="C"), q)
                v_full /= seconds
            near = watch_solids(
                self._guarded,
                q,
                v_full,
                scene,
                time,
                self._parameters,
                kept=None if motion is None else before.kept,
                passing=passing,
            )
        else:
            near = watch_clearance(
                self._names,
                X_WB,
                V_WB,
                self._shapes,
                before.obstacles.resting() if passing else before.obstacles,
                before.table,
                time,
                self._parameters,
            )
        scale, verified = before.supervision.speed_scale, None
        if scene is not None and motion is not None:
            verified = motion.q
        at_limits = watch_joints(self._joints, q, v, v_full, scale, self._parameters, verified)
        return [near, at_limits]

    def _with_motion(
        self,
        context: Context,
        before: SupervisorState,
        scene: SolidScene,
        policy: PolicyState,
        evading: Evasion,
    ) -> SupervisorState:
        """Takes over the verified motion that is under way, and what it keeps of the solids."""
        motion = read_optional(self, self._motion, context, PlannedMotion)
        arm = self._guarded
        if (
            arm is None
            or motion is None
            or len(motion) < 2
            or motion.q.shape[1] != len(self._arm)
            or (len(motion.p_WS) and not np.array_equal(motion.p_WS, policy.p_WS))
            or evading.action in ("evading", "caught")
            or scene.stamp == -math.inf
        ):
            return before if before.motion is None else replace(before, motion=None, scene=None)
        if motion is before.motion and before.scene is not None and scene.same_as(before.scene):
            return before
        kept = remaining_distance(arm, motion, scene, self._parameters)
        return replace(before, motion=motion, scene=scene, kept=kept)


def arm_joints(robot: RobotModel, tool: int) -> tuple[IntArray, BoolArray, JointRange]:
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
    limits = JointRange(
        tuple(joint.name() for joint in joints),
        np.array([joint.position_lower_limits()[0] for joint in joints]),
        np.array([joint.position_upper_limits()[0] for joint in joints]),
        np.array([joint.velocity_upper_limits()[0] for joint in joints]),
    )
    where = np.array([joint.velocity_start() for joint in joints], dtype=np.int64)
    return where, np.ascontiguousarray(np.array(moved).T), limits


def _log_change(before: SupervisorState, after: SupervisorState, time: float) -> None:
    """Says once when the action or its cause has changed."""
    was, now = before.supervision, after.supervision
    if now.action == was.action and after.cause == before.cause:
        return
    said: Sequence[str] = (_SAID[now.action], now.reason) if now.reason else ("runs freely again",)
    _logger.warning("t=%.3f s: supervisor %s", time, ": ".join(said))
