"""Drake system that commands the arm's joints along the verified motion, or on a maneuver that
evades obstacles.

The verified motion is the joint motion q(s) over normalized time s that MotionVerifier predicted
and checked by simulation.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import compress

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, EventStatus, LeafSystem, State

from drake_oa.common.latency import LatencyModel, PendingDecision
from drake_oa.common.messages import (
    FloatArray,
    Frozen,
    HoldReason,
    PlannedMotion,
    PolicyState,
    zeros,
)
from drake_oa.common.ports import (
    DECISION_OFFSET,
    AbstractInput,
    declare_state_outputs,
    valid_period,
)
from drake_oa.geometry.collision_scene import CollisionScene
from drake_oa.perception.depth_perception import FreeSpace
from drake_oa.policy.config import Policy
from drake_oa.policy.dmp import Demonstration, normalized_time
from drake_oa.robot.arm import Chain, joints_to, rotation_of, rotation_vector, tool_poses
from drake_oa.robot.plant import RobotPlant
from drake_oa.robot.spheres import ArmSpheres
from drake_oa.safety.config import GuardParameters
from drake_oa.safety.joint_motions import approach, track
from drake_oa.safety.maneuvers import (
    ON_PATH_DEVIATION,
    REST_SPEED,
    GuardDecision,
    GuardInputs,
    GuardSearch,
    time_on_path,
)
from drake_oa.safety.supervision import (
    Supervision,
    monitor_contact,
    monitor_guard,
    monitor_observation,
    monitor_path,
    monitor_torque,
    supervise,
)

_logger = logging.getLogger("drake_oa")
_NULL_SPACE_RATE = 20.0
"""Rate at which the null space of the arm converges to the nominal posture while the tool tracks
the desired motion [1/s]."""
_SHIFT_TIME = 0.1
"""Time constant with which the desired position of the tool converges to the commanded one while
the arm is stuck, that is, cannot return to the verified motion (checked by simulation) [s]."""
_SHIFT_TOLERANCE = 5e-4
"""Maximum distance along each world axis at which the desired position of the tool counts as equal
to the commanded one while the arm is stuck [m]. The desired position then stops moving, so that
replanning has a fixed start."""
_PROGRESS_TIMEOUT = 1.0
"""Time without progress of a maneuver toward the verified motion (checked by simulation) after
which the arm counts as stuck [s]."""
_MIN_PROGRESS = 0.02
"""Minimum decrease of the joints' deviation from the verified motion (checked by simulation) that
counts as progress of a maneuver [rad]."""
_MAX_WAIT = 5.0
"""Maximum time for which an arm that cannot return to the verified motion (checked by simulation)
waits for a new motion, before it tries again to return [s]."""
_REST_SPEED = 0.01
"""Maximum joint speed at which an arm that cannot return to the verified motion (checked by
simulation) counts as at rest [rad/s]."""
_POSE_TOLERANCE = 0.03
"""Maximum error between desired and commanded tool pose at which an arm that was stuck may follow
the desired motion again: largest element of position [m] and rotation vector [rad]."""
_FEEDBACK_FRACTION = 0.6
"""Threshold of |e + (kd / kp) de/dt| for the detection of a contact, relative to the threshold of
|e| [-]. Here e is the position error of a joint, and kp and kd are the gains of the joint
controller. The first expression is proportional to the feedback torque."""
_MAX_PERIODS = 3.0
"""Number of decision periods after which a decision of the motion guard is too old, if no newer one
has become active [-]. The arm then stops on the verified motion (checked by simulation), or brakes
if it executes a maneuver."""
_PAUSE = 2.0
"""Time for which an obstacle that has come to rest still counts as moving in claim (A) of passive
motion safety, a limit of the speed toward it, and in the decisions whether a wait is lasting and
whether the arm is stuck [s]."""
_VERBS = {"slow": "slows", "hold": "holds", "stop": "stops"}
"""Verbs of the actions slow, hold and stop in log messages."""


@dataclass(frozen=True, eq=False)
class GuardState(Frozen):
    """State of the motion guard between two steps of the joint command, each of length
    `policy.period`.

    The verified motion is the joint motion q(s) over normalized time s that MotionVerifier
    predicted and checked by simulation.

    Attributes:
        end: end time of the current step [s].
        x: (2n,) commanded joint positions [rad] and velocities [rad/s] at the end of the step.
        acceleration: (n,) commanded joint acceleration during the step [rad/s^2].
        path: (2n,) joint positions [rad] and velocities [rad/s] on the verified motion at the end
            of the step; those of the command at rest if the arm is stuck.
        shift_velocity: (3,) velocity in the world that moves the desired position to the tool of a
            stuck arm [m/s]; 0 otherwise.
        pending: active decision of the guard, and the next one while it is computed.
        stuck_since: time of the last progress of a maneuver toward the verified motion [s]; 1 s
            later, the arm is stuck. inf: no maneuver is active, the maneuver has reached this
            motion, or a stuck arm no longer waits for a new motion.
        min_deviation: maximum joint deviation from the verified motion at `stuck_since`, from which
            progress is measured [rad].
        expiry: time after which the active decision is too old, so that the arm comes to rest [s].
        slow_until: end time of the reaction to a contact [s]. Until then, maneuvers move no point
            of the arm faster than `v_unseen`, and the arm does not advance on the verified motion.
        decision_count: number of decisions so far.
        supervision: state of the supervisor, which scales the speed of the motion.
        last_moved: label of each geometry that moved less than 2 s ago -> stamp of the last
            observation in which it moved [s].
    """

    end: float = -math.inf
    x: FloatArray = zeros(0)
    acceleration: FloatArray = zeros(0)
    path: FloatArray = zeros(0)
    shift_velocity: FloatArray = zeros(3)
    pending: PendingDecision[GuardDecision] = field(
        default_factory=lambda: PendingDecision(GuardDecision())
    )
    stuck_since: float = math.inf
    min_deviation: float = math.inf
    expiry: float = math.inf
    slow_until: float = -math.inf
    decision_count: int = 0
    supervision: Supervision = field(default_factory=Supervision)
    last_moved: Mapping[str, float] = field(default_factory=dict)

    @property
    def decision(self) -> GuardDecision:
        """Decision of the motion guard that is being executed: to follow the verified motion
        (checked by simulation), or a maneuver.
        """
        return self.pending.active

    @property
    def speed_scale(self) -> float:
        """Fraction of full speed at which the movement primitive runs, in [0, 1]; 0 during a
        maneuver.
        """
        return self.supervision.speed_scale if self.decision.follows else 0.0

    @property
    def speed(self) -> float:
        """Largest commanded speed of any joint at the end of the current step [rad/s]."""
        return float(np.abs(self.x[len(self.x) // 2 :]).max())

    @property
    def is_stuck(self) -> bool:
        """Whether the arm waits for a new motion from its current configuration, after 1 s without
        progress toward the verified motion (checked by simulation).
        """
        return self.end - self.stuck_since > _PROGRESS_TIMEOUT

    @property
    def is_on_path(self) -> bool:
        """Whether the joint command follows the verified motion (checked by simulation), or rests
        within 0.01 rad of it while the arm is not stuck.

        The arm counts as at rest if its joint speeds are at most 0.1 rad/s, both absolute and
        relative to the verified motion.
        """
        q, v = np.split(np.abs(self.x - self.path), 2)
        rests = max(self.speed, float(v.max())) <= REST_SPEED and q.max() <= ON_PATH_DEVIATION
        return self.decision.follows or (bool(rests) and not self.is_stuck)

    def at(self, time: float) -> FloatArray:
        """Computes the commanded joint state (2n,) [rad, rad/s] at a time within the current step
        [s], by constant acceleration.
        """
        elapsed = min(time - self.end, 0.0)
        q, v = np.split(self.x, 2)
        q = q + elapsed * v + 0.5 * elapsed**2 * self.acceleration
        return np.append(q, v + elapsed * self.acceleration)


class MotionGuard(LeafSystem):
    """Drake system that commands the arm's joints on the verified motion or an evasive maneuver.

    .. pydrake_system::

      name: MotionGuard
      input_ports:
      - robot_state
      - policy_state
      - desired_position
      - desired_velocity
      - desired_orientation
      - desired_angular_velocity
      - desired_posture
      - motion
      - collision_scene_W
      - free_space_W (optional)
      - demonstration (optional)
      - torque_saturation (optional)
      - stopping (optional)
      output_ports:
      - desired_joint_state
      - path_state
      - tracking_error
      - orientation_error
      - desired_joint_acceleration
      - speed_scale
      - evasion_velocity
      - decision
      - guard_action
      - guard_contact
      - guard_claim
      - supervision

    - robot_state: (2m,) positions and velocities of the robot's m joints [rad, m, rad/s, m/s]; the
      arm has n of these joints.
    - policy_state: abstract `PolicyState` of the movement primitive: its phase, its rate ds/dt, and
      the reason if it is held, that is, stopped on its path.
    - desired_position, desired_velocity: (3,) position and velocity of the tool point in the world
      frame [m, m/s].
    - desired_orientation: (4,) quaternion w, x, y, z of R_WE.
    - desired_angular_velocity: (3,) w_WE in the world frame [rad/s].
    - desired_posture: (2n,) nominal posture of the null space, and its velocity [rad, rad/s].
    - motion: abstract `PlannedMotion`, the verified motion: the joint motion q(s) over normalized
      time s that MotionVerifier predicted and checked.
    - collision_scene_W: abstract `CollisionScene`: collision geometry of everything but the robot.
    - free_space_W (optional): abstract `FreeSpace`: space that the cameras observed to be free. Not
      connected: all space outside collision geometry counts as free.
    - demonstration (optional): abstract `Demonstration` that the motion imitates, with its
      duration. Not connected: the duration is the argument `duration` of the constructor.
    - torque_saturation (optional): (1,) 1 while a joint torque is at its limit, else 0. Not
      connected: never saturated.
    - stopping (optional): (1,) 1 while the controller brakes the arm because one of its inputs is
      not finite, else 0; the motion is then stopped. Not connected: never.
    - desired_joint_state: (2n,) commanded state of the arm's joints [rad, rad/s].
    - desired_joint_acceleration: (n,) commanded acceleration of the arm's joints [rad/s^2].
    - speed_scale: (1,) fraction of full speed at which `DmpIntegrator` advances, in [0, 1].
    - evasion_velocity: (3,) velocity in the world frame by which `DmpIntegrator` shifts its motion
      to the tool of a stuck arm [m/s]; 0 otherwise.
    - supervision: abstract `Supervision`: run, slow, hold (rest until the cause ends) or stop, and
      the reason.
    - decision: (2,) start time and simulated compute latency of the last decision [s].
    - path_state: (2m,) start of the predictions of `MotionVerifier` [rad, m, rad/s, m/s]: the
      measured state of the robot. While a maneuver has moved the arm away from the verified motion,
      the arm's joints are those on this motion at the current phase, unless the arm is stuck.
    - tracking_error: (3,) desired minus actual position of the tool point in the world frame [m].
    - orientation_error: (3,) rotation vector from the actual to the desired orientation of the
      tool, in the world frame [rad].
    - guard_action: (1,) action of the active decision: 0 follow the verified motion at full speed,
      1 slow (follow it at reduced speed), 2 wait (rest on it), 3 evade, 4 brake.
    - guard_contact: (1,) simulation time of the first contact predicted on the verified motion [s];
      inf: no contact, or the arm is not on this motion.
    - guard_claim: (1,) claim of passive motion safety that limits the speed: 0 none, 1 claim (A), a
      limit toward moving obstacles that may reach the arm, 2 claim (B), a limit toward unobserved
      space.

    While no maneuver is active, a damped Gauss-Newton step in each step of the command places the
    tool at the desired pose, and the null space follows the nominal posture. Once per `period`,
    `drake_oa.safety.maneuvers` compares this motion with slower ones and, if obstacles move, with
    evasive maneuvers (joint trajectories of two legs). The phase of the movement primitive rests
    during a maneuver; afterwards the arm returns to the verified motion. An arm without progress
    for 1 s is stuck: it stops, the desired position moves to the tool, and the guard waits for a
    new motion from there. If no newer decision becomes active within about three periods, the arm
    stops on the verified motion, or brakes if it executes a maneuver.

    With the error e between measured and commanded position of a joint, and the gains kp and kd of
    the joint controller, a contact is detected if

        |e| > contact_error   or   |e + (kd / kp) de/dt| > 0.6 contact_error

    The arm is then commanded to rest at its measured configuration. For `contact_time`, maneuvers
    move no point of the arm faster than `v_unseen`, and the arm does not advance on the verified
    motion. The left side of the second condition is the feedback torque over kp M, with the mass
    matrix M. Without contact it is at most 0.003 rad, or 0.01 rad with a wrong model of the arm.
    """

    def __init__(
        self,
        robot: RobotPlant,
        chain: Chain,
        arm_spheres: ArmSpheres,
        duration: float,
        q_start: FloatArray,
        *,
        config: Policy,
        parameters: GuardParameters,
        period: float = 1.0 / 15.0,
        damping: float = 0.1,
        padding: float = 0.005,
        turn_limit: float | None = None,
        compute_latency: LatencyModel | None = None,
    ) -> None:
        """Declares the ports and the state of the motion guard.

        Args:
            robot: plant of the robot alone, with joints of one degree of freedom.
            chain, arm_spheres: kinematics of the arm, and spheres that cover it.
            duration: duration T of the movement primitive [s].
            q_start: (n,) commanded configuration before initialization [rad].
            config: configuration of the movement primitive; its `period` is the time step of the
                joint command.
            parameters: parameters of the search for maneuvers, the contact reaction and the speed
                limits.
            period: time between decisions [s].
            damping: ratio kd / kp of the gains of the joint controller [s].
            padding: position uncertainty of moving obstacles, added to their clearance [m].
            turn_limit: maximum angle by which a maneuver turns the tool away from its orientation
                on the verified motion [rad]; None: no limit.
            compute_latency: model of the simulated compute latency of decisions; None: decisions
                are active at once.

        Raises:
            ValueError: if a duration or period is not positive and finite.
        """
        super().__init__()
        self._chain, self._index, self._size = chain, chain.q_index, robot.plant.num_positions()
        self._joints = [joint.name() for joint in joints_to(robot.plant, robot.tool_frame)]
        self._duration, self._config = valid_period(duration), config
        self._period, self._parameters = valid_period(period), parameters
        self._damping = damping
        self._compute_latency, self._step_length = compute_latency, config.period
        self._max_fresh_age = min(
            parameters.stale_frames * period, 0.9 * config.max_observation_age
        )
        self._search = GuardSearch(
            chain, arm_spheres, config=config, period=period, padding=padding,
            turn_limit=turn_limit, parameters=parameters,
        )  # fmt: skip
        reach = float(chain.reach @ self._search.speed)
        self._slow_fraction = min(1.0, parameters.v_unseen / max(reach, 1e-9))
        self._n = n = len(self._joints)

        self._robot = self.DeclareVectorInputPort("robot_state", 2 * self._size)
        self._policy = AbstractInput(self, "policy_state", PolicyState)
        self._position = self.DeclareVectorInputPort("desired_position", 3)
        self._velocity = self.DeclareVectorInputPort("desired_velocity", 3)
        self._orientation = self.DeclareVectorInputPort("desired_orientation", 4)
        self._angular = self.DeclareVectorInputPort("desired_angular_velocity", 3)
        self._posture = self.DeclareVectorInputPort("desired_posture", 2 * n)
        self._motion = AbstractInput(self, "motion", PlannedMotion)
        self._collision_scene = AbstractInput(self, "collision_scene_W", CollisionScene)
        self._free_space = AbstractInput(self, "free_space_W", FreeSpace)
        self._demonstration = AbstractInput(self, "demonstration", Demonstration)
        self._saturation = self.DeclareVectorInputPort("torque_saturation", 1)
        self._stopping = self.DeclareVectorInputPort("stopping", 1)

        rest_state = np.append(q_start, np.zeros(n))
        self._state = self.DeclareAbstractState(
            Value(GuardState(x=rest_state, path=rest_state, acceleration=np.zeros(n)))
        )
        internal = {self.time_ticket(), self.abstract_state_ticket(self._state)}
        measured_inputs = internal | {
            port.ticket() for port in (self._robot, self._position, self._orientation)
        }
        for name, size, calc, tickets in (
            ("desired_joint_state", 2 * n, lambda c: self._read(c).at(c.get_time()), internal),
            ("path_state", 2 * self._size, self._path_state, measured_inputs),
            ("tracking_error", 3, lambda c: self._tool_error(c)[:3], measured_inputs),
            ("orientation_error", 3, lambda c: self._tool_error(c)[3:], measured_inputs),
        ):
            self.DeclareVectorOutputPort(
                name,
                size,
                lambda context, output, calc=calc: output.SetFromVector(calc(context)),
                tickets,
            )
        declare_state_outputs(
            self,
            self._state,
            ("desired_joint_acceleration", n, "acceleration"),
            ("speed_scale", 1, "speed_scale"),
            ("evasion_velocity", 3, "shift_velocity"),
            ("decision", 2, "pending.timing"),
            ("guard_action", 1, "decision.action_number"),
            ("guard_contact", 1, "decision.contact"),
            ("guard_claim", 1, "decision.claim_number"),
            ("supervision", Supervision, "supervision"),
        )
        self.DeclareInitializationUnrestrictedUpdateEvent(self._initialize)
        self.DeclarePeriodicUnrestrictedUpdateEvent(config.period, 0.0, self._step)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 3.0 * DECISION_OFFSET, self._decide)

    # --- outputs ---------------------------------------------------------------------------

    def _read(self, context: Context) -> GuardState:
        return context.get_abstract_state(self._state).get_value()

    def _path_state(self, context: Context) -> FloatArray:
        """Computes the value (2m,) of the output port path_state: the state of the robot [rad, m,
        rad/s, m/s] from which the verified motion (checked by simulation) is predicted.

        The value is the measured state, with one exception: while a maneuver has moved the arm away
        from the verified motion, the joints of the arm are replaced by those on this motion. They
        are not replaced if the arm is stuck, that is, makes no progress in returning.
        """
        x, state = self._robot.Eval(context).copy(), self._read(context)
        if not state.is_on_path and not state.is_stuck:
            x[self._index] = state.path[: self._n]
            x[self._size + self._index] = state.path[self._n :]
        return x

    def _scene(self, context: Context) -> CollisionScene:
        """Returns the collision scene of the input port; if it is not finite, an empty scene that
        counts as no observation.
        """
        scene = self._collision_scene.read(context)
        note = "the collision scene is not finite"
        return scene if scene.is_finite else CollisionScene(note=note)

    def _arm_state(self, context: Context) -> tuple[FloatArray, FloatArray]:
        """Returns measured positions (n,) [rad] and velocities (n,) [rad/s] of the arm's joints."""
        x = self._robot.Eval(context)
        return x[self._index], x[self._size + self._index]

    def _desired_pose(self, context: Context) -> FloatArray:
        """Returns the desired tool pose (12,) in the world from the input ports: rotation matrix,
        row by row, and position [m].
        """
        return np.append(rotation_of(self._orientation.Eval(context)), self._position.Eval(context))

    def _tool_error(self, context: Context) -> FloatArray:
        """Computes the error (6,) from actual to desired tool pose in the world: position [m], then
        rotation vector [rad].
        """
        q, _ = self._arm_state(context)
        return _pose_error(self._desired_pose(context), tool_poses(self._chain, q[None])[0])

    # --- steps -----------------------------------------------------------------------------

    def _initialize(self, context: Context, state: State) -> EventStatus:
        value, time = state.get_mutable_abstract_state(self._state), context.get_time()
        previous: GuardState = value.get_value()
        if previous.end > -math.inf:
            # This is the Context of a running motion, which another Simulator continues.
            return EventStatus.DidNothing()
        q, _ = self._arm_state(context)
        rest_state = np.append(q, np.zeros(self._n)) if math.isfinite(q.sum()) else previous.x
        value.set_value(replace(previous, x=rest_state, path=rest_state, end=time))
        return EventStatus.Succeeded()

    def _step(self, context: Context, state: State) -> None:
        value = state.get_mutable_abstract_state(self._state)
        current: GuardState = value.get_value()
        time = context.get_time()
        q, v = self._arm_state(context)
        is_finite = math.isfinite(self._robot.Eval(context).sum())
        if not is_finite or (self._stopping.HasValue(context) and self._stopping.Eval(context)[0]):
            source = "an input of the controller" if is_finite else "the robot state"
            supervision = current.supervision.latch_fault(f"{source} is not finite", time)
            # A braked arm continues from rest when the input is finite again.
            x = np.append(q, np.zeros(self._n)) if is_finite else current.x
            value.set_value(replace(current, supervision=supervision, x=x))
            return
        if current.pending.result_at(time) is not None:
            current = self._activate(replace(current, pending=current.pending.activate()), time)
        current = self._react_to_contact(current, q, v, time)
        scene = self._scene(context)
        current = self._supervise(context, current, scene, time)
        if time > current.expiry and not current.decision.follows:
            current = self._brake(current, current.x)
        value.set_value(self._advance(context, current, time, has_moving=scene.moves))

    def _brake(self, state: GuardState, x: FloatArray) -> GuardState:
        """Returns the guard state in which the arm starts to brake from a joint state x (2n,) [rad,
        rad/s], and older decisions are discarded.
        """
        pending = replace(state.pending.discard(), active=self._search.brake(*np.split(x, 2)))
        return replace(state, pending=pending, expiry=math.inf)

    def _activate(self, state: GuardState, time: float) -> GuardState:
        """Returns the guard state with the expiry time of a decision of the guard that has just
        become active.

        The decision expires after three decision periods and the compute latency; a decision to
        rest on the verified motion (checked by simulation) never expires. A braking maneuver is
        recomputed from the current joint state.
        """
        if state.decision.action == "brake":
            # The arm would overshoot a target predicted for another state, and return to it.
            target = self._search.brake(*np.split(state.x, 2)).target
            maneuver = replace(state.decision, target=target)
            state = replace(state, pending=replace(state.pending, active=maneuver))
        is_waiting = state.decision.follows and state.decision.scale == 0.0
        expiry = time + _MAX_PERIODS * self._period + state.pending.latency
        return replace(state, expiry=math.inf if is_waiting else expiry)

    def _react_to_contact(
        self, state: GuardState, q: FloatArray, v: FloatArray, time: float
    ) -> GuardState:
        """Detects a contact of the arm by the measured joint state; after a contact, the arm is
        commanded to rest at its measured configuration.

        Args:
            state: state of the guard.
            q, v: (n,) measured positions [rad] and velocities [rad/s].
            time: current time [s].

        Returns:
            State of the guard, unchanged without a contact.
        """
        n = self._n
        error = q - state.x[:n]
        feedback_error = np.abs(error + self._damping * (v - state.x[n:]))
        max_error = max(np.abs(error).max(), feedback_error.max() / _FEEDBACK_FRACTION)
        if max_error <= self._parameters.contact_error:
            return state
        if time > state.slow_until:
            joint = self._joints[int(feedback_error.argmax())]
            message = "t=%.3f s: contact: %s deviates by %.3f rad; the command restarts at rest"
            _logger.warning(message, time, joint, feedback_error.max())
        rest_state = np.append(q, np.zeros(n))
        state = replace(state, x=rest_state, slow_until=time + self._parameters.contact_time)
        return self._brake(state, rest_state)

    def _supervise(
        self, context: Context, state: GuardState, scene: CollisionScene, time: float
    ) -> GuardState:
        """Evaluates the monitors that limit the speed of the motion, and returns the guard state
        with the new speed scale.

        The monitors check the age of the observation, the guard's decision, recent contacts, the
        deviation from the verified motion (checked by simulation), and torque saturation.

        Args:
            context: context of the system.
            state: state of the guard.
            scene: collision scene.
            time: current time [s].
        """
        previous = last = state.supervision
        policy = self._policy.read(context)
        is_late = state.decision.follows and time > state.expiry
        limits = [
            monitor_observation(scene, time, self._max_fresh_age, self._config.max_observation_age),
            monitor_guard(state.decision, time, is_late=is_late, has_moving=bool(state.last_moved)),
            monitor_contact(time < state.slow_until),
        ]
        if state.decision.follows:
            limits.append(monitor_path(float(np.abs(state.path - state.x)[: self._n].max())))
        if self._saturation.HasValue(context):
            is_saturated = bool(self._saturation.Eval(context)[0] > 0.0)
            previous, limit = monitor_torque(previous, is_saturated, time, self._step_length)
            limits.append(limit)
        is_waiting = policy.hold not in (HoldReason.NONE, HoldReason.SPEED_SCALE)
        result = supervise(previous, limits, time, self._step_length, is_waiting=is_waiting)
        if (result.action, result.cause) != (last.action, last.cause):
            message = "resumes full speed"
            if result.reason:
                message = f"{_VERBS[result.action]}: {result.reason}"
            _logger.warning("t=%.3f s: motion guard %s", time, message)
        return replace(state, supervision=result)

    def _advance(
        self, context: Context, state: GuardState, time: float, *, has_moving: bool
    ) -> GuardState:
        """Computes the next step of the joint command, on the verified motion (checked by
        simulation) or the active maneuver.

        Args:
            context: context of the system.
            state: state of the guard.
            time: current time [s].
            has_moving: whether an obstacle moves; if so, an arm in motion does not become stuck.

        Returns:
            State of the guard after the step.
        """
        n, step, chain = self._n, self._step_length, self._chain
        X_WE, posture = self._desired_pose(context), np.array(self._posture.Eval(context))
        V_WE = np.append(self._angular.Eval(context), self._velocity.Eval(context))
        q, v = np.array(state.path[:n]), np.zeros(n)
        if math.isfinite(X_WE.sum() + V_WE.sum() + posture.sum()):
            # The null space rests during a maneuver, so that the arm does not chase it.
            rate = _NULL_SPACE_RATE if state.decision.follows else 0.0
            q, v = track(chain, q, X_WE, V_WE, posture, step, rate)
        elif not state.supervision.is_faulted:
            supervision = state.supervision.latch_fault("the desired motion is not finite", time)
            state = replace(state, supervision=supervision)
        path, command, shift_velocity = np.append(q, v), np.array(state.x), np.zeros(3)
        stuck_since = min_deviation = math.inf
        if state.decision.follows:
            limit = self._parameters.acceleration_limit
            command = approach(command, path, chain.speed, limit, step)
        else:
            self._search.advance(state.decision, command, time)
            deviation = float(np.abs(command - path)[:n].max())
            stuck_since, min_deviation = self._stuck_since(
                state, deviation, time, has_moving=has_moving
            )
        if state.is_stuck and stuck_since < math.inf:
            # The desired position moves to the tool, where a new motion is to start.
            error = -_pose_error(X_WE, tool_poses(chain, command[None, :n])[0])
            if np.abs(error[:3]).max() > _SHIFT_TOLERANCE:
                shift_velocity = error[:3] / _SHIFT_TIME
            if state.speed <= _REST_SPEED and np.abs(error).max() <= _POSE_TOLERANCE:
                stuck_since, shift_velocity = math.inf, np.zeros(3)
            path = np.append(command[:n], np.zeros(n))
        return replace(
            state,
            end=time + step,
            x=command,
            acceleration=(command - state.x)[n:] / step,
            path=path,
            shift_velocity=shift_velocity,
            stuck_since=stuck_since,
            min_deviation=min_deviation,
        )

    def _stuck_since(
        self, state: GuardState, deviation: float, time: float, *, has_moving: bool
    ) -> tuple[float, float]:
        """Computes the time of the arm's last progress toward the verified motion (checked by
        simulation).

        Args:
            state: state of the guard.
            deviation: maximum joint deviation from the verified motion [rad].
            time: current time [s].
            has_moving: whether an obstacle moves. If so, motion of the arm counts as progress,
                because the arm may be evading the obstacle. For 2 s after the last obstacle has
                come to rest, waiting counts as progress, too, because the obstacle may move on.

        Returns:
            Time of the last progress [s], inf if the arm is within 0.01 rad of the motion or has
            been stuck for 5 s; and the deviation at this time, or `deviation` for inf [rad].
        """
        has_waited = time - state.stuck_since > _PROGRESS_TIMEOUT + _MAX_WAIT
        if has_waited or deviation <= ON_PATH_DEVIATION:
            return math.inf, deviation
        if state.is_stuck:
            return state.stuck_since, state.min_deviation
        is_at_rest = time > state.slow_until and state.speed <= _REST_SPEED
        may_progress = not is_at_rest if has_moving else bool(state.last_moved)
        if may_progress or deviation < state.min_deviation - _MIN_PROGRESS:
            return time, deviation
        return min(state.stuck_since, time), state.min_deviation

    # --- decisions -------------------------------------------------------------------------

    def _decide(self, context: Context, state: State) -> EventStatus:
        value = state.get_mutable_abstract_state(self._state)
        current: GuardState = value.get_value()
        time = context.get_time()
        scene = self._scene(context)
        if current.pending.pending is not None or -math.inf in (scene.stamp, current.end):
            return EventStatus.DidNothing()
        moving, begin = compress(scene.labels, scene.geometries.moving), scene.stamp - _PAUSE
        last_moved = {**current.last_moved, **dict.fromkeys(moving, scene.stamp)}
        last_moved = {label: stamp for label, stamp in last_moved.items() if stamp > begin}
        current = replace(current, last_moved=last_moved)
        inputs = self._inputs(context, current, scene, time)
        pending = current.pending.start(
            lambda decision: self._search.decide(decision, inputs), time, self._compute_latency
        )
        result = replace(current, pending=pending, decision_count=current.decision_count + 1)
        if self._compute_latency is None:
            result = self._activate(result, time)
        value.set_value(result)
        return EventStatus.Succeeded()

    def _inputs(
        self, context: Context, state: GuardState, scene: CollisionScene, time: float
    ) -> GuardInputs:
        """Returns the inputs of a decision of the motion guard, predicted for the time at which the
        decision becomes active.

        This time is the current time plus the compute latency of the previous decision, rounded up
        to a whole step of the joint command.

        Args:
            context: context of the system.
            state: state of the guard.
            scene: collision scene.
            time: current time [s].
        """
        n, step = self._n, self._step_length
        policy = self._policy.read(context)
        motion = self._motion.read(context)
        demo = self._demonstration.find(context)
        duration = self._duration
        if demo is not None and demo.position is not None:
            duration = demo.position.duration
        is_held = policy.hold in (HoldReason.DECIDING, HoldReason.OBSTACLES)
        is_outdated = len(motion.p_WS) > 0 and not np.array_equal(motion.p_WS, policy.p_WS)
        if is_held or is_outdated or motion.q.shape[1:] != (n,):
            motion = PlannedMotion()
        latency = 0.0 if self._compute_latency is None else state.pending.latency
        steps = max(math.ceil((time + latency - state.end) / step), 0)
        begin = state.end + steps * step
        x, decision = np.array(state.x), state.decision
        for k in range(steps):
            if decision.follows:
                x[:n] += step * x[n:]
            else:
                self._search.advance(decision, x, state.end + k * step)
        s = max(0.0, normalized_time(policy.phase, self._config.alpha_k))
        return GuardInputs(
            begin=begin,
            q=x[:n],
            v=x[n:],
            q_path=x[:n] if decision.follows else state.path[:n],
            is_on_path=state.is_on_path,
            s=time_on_path(motion, x[:n], s + policy.speed * (begin - policy.stamp)),
            rate=policy.speed,
            full_rate=1.0 / (policy.tau * duration),
            motion=motion,
            scene=scene,
            speed_fraction=self._slow_fraction if time < state.slow_until else 1.0,
            decision_count=state.decision_count,
            free_space=self._free_space.find(context),
            may_move=np.isin(scene.labels, list(state.last_moved)),
        )


def _pose_error(X_d: FloatArray, X: FloatArray) -> FloatArray:
    """Computes the error (6,) from a tool pose X to a desired pose X_d: position [m], then rotation
    vector [rad], both in the world.

    A pose (12,) in the world is a rotation matrix, row by row, and a position [m].
    """
    rotation = X_d[:9].reshape(3, 3) @ X[:9].reshape(3, 3).T
    return np.append(X_d[9:] - X[9:], rotation_vector(np.ascontiguousarray(rotation)))
