"""The safety layer: the arm's commanded motion, on the verified one or away from an obstacle."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field, replace

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
    ARRIVED,
    AT_REST,
    GuardDecision,
    GuardInputs,
    GuardSearch,
)
from drake_oa.safety.supervision import (
    Supervision,
    monitor_guard,
    monitor_observation,
    monitor_path,
    monitor_torque,
    supervise,
)

_logger = logging.getLogger("drake_oa")
_RATE = 20.0
"""Rate at which the null space converges to the desired posture [1/s]."""
_CARRY, _CARRIED = 0.1, 5e-4
"""Time constant with which the desired position follows the tool [s], and distance at which it
rests, so that the motion to be planned keeps its start [m]."""
_PATIENCE, _PROGRESS = 1.0, 0.02
"""Time in which the arm comes no nearer to the verified motion by so much, after which it stops
and a new one is planned from there [s, rad]."""
_LONGEST_WAIT = 5.0
"""Time for which such a motion is awaited before the arm tries to return again [s]."""
_STILL = 0.01
"""Joint speed below which the arm waits [rad/s]."""
_FOUND = 0.03
"""Error of the tool below which a desired pose is that of the arm at rest [m, rad]."""
_DAMPING, _FEEDBACK = 0.1, 0.6
"""Damping over stiffness of the joint controller [s], and share of `contact_error` above which the
error by the controller's feedback torque counts as contact."""
_LATE = 3.0
"""Number of periods after which the arm brakes because no newer decision is in force."""
_SAID = {"slow": "slows", "hold": "holds", "stop": "stops"}


@dataclass(frozen=True, eq=False)
class GuardState(Frozen):
    """State of the guard between two steps.

    Attributes:
        end: time of the next step [s].
        x: (2n,) commanded joint state then [rad, rad/s].
        acceleration: (n,) commanded until then [rad/s^2].
        path: (2n,) joint state on the verified motion at the end, at its phase [rad, rad/s].
        carry: (3,) velocity by which the desired position is displaced to the tool [m/s].
        pending: the decision in force, and the pending one.
        lost_since: time since which the arm comes no nearer to the verified motion that it has left
            [s]; inf: it does, or has not left it.
        nearest: least distance of the joints to it since then [rad].
        expires: time at which the decision in force is too old [s].
        slow_until: time until which the arm moves slowly after a contact [s].
        number: of decisions so far.
        supervision: state of the monitors.
    """

    end: float = -math.inf
    x: FloatArray = zeros(0)
    acceleration: FloatArray = zeros(0)
    path: FloatArray = zeros(0)
    carry: FloatArray = zeros(3)
    pending: PendingDecision[GuardDecision] = field(
        default_factory=lambda: PendingDecision(GuardDecision())
    )
    lost_since: float = math.inf
    nearest: float = math.inf
    expires: float = math.inf
    slow_until: float = -math.inf
    number: int = 0
    supervision: Supervision = field(default_factory=Supervision)

    @property
    def decision(self) -> GuardDecision:
        """Decision in force."""
        return self.pending.active

    @property
    def speed_scale(self) -> float:
        """Share of full speed at which the phase runs."""
        return self.supervision.speed_scale if self.decision.follows else 0.0

    @property
    def speed(self) -> float:
        """Largest commanded joint speed [rad/s]."""
        return float(np.abs(self.x[len(self.x) // 2 :]).max())

    @property
    def is_lost(self) -> bool:
        """Whether the arm waits for a new motion from where it is."""
        return self.end - self.lost_since > _PATIENCE

    @property
    def on_path(self) -> bool:
        """Whether the commanded motion is the verified one, or rests on it."""
        n = len(self.path) // 2
        near = bool((np.abs(self.x - self.path)[:n] <= ARRIVED).all())
        return self.decision.follows or (self.speed <= AT_REST and near and not self.is_lost)

    def at(self, time: float) -> FloatArray:
        """Computes the joint state (2n,) at a time of the step that ends at `end`."""
        since = min(time - self.end, 0.0)
        q, v = np.split(self.x, 2)
        q = q + since * v + 0.5 * since**2 * self.acceleration
        return np.append(q, v + since * self.acceleration)


class MotionGuard(LeafSystem):
    """Command of the arm's joints: the verified motion, or a maneuver away from obstacles.

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

    - robot_state: positions and velocities of the robot, (2m,) [rad, m, rad/s, m/s].
    - policy_state: abstract `PolicyState` of the movement primitive.
    - desired_position, desired_velocity: (3,) of the tool point in the world frame [m, m/s].
    - desired_orientation: (4,) quaternion w, x, y, z of R_WE.
    - desired_angular_velocity: (3,) w_WE in the world frame [rad/s].
    - desired_posture: (2n,) posture that the null space follows [rad, rad/s].
    - motion: abstract `PlannedMotion`, the verified motion q(s).
    - collision_scene_W: abstract `CollisionScene`: collision geometry of everything but the robot.
    - free_space_W (optional): abstract `FreeSpace`; not connected: all space outside the solids.
    - demonstration (optional): abstract `Demonstration` that the motion imitates.
    - torque_saturation (optional): (1,) 1 while a joint torque is at its limit, else 0.
    - desired_joint_state: (2n,) of the arm's joints [rad, rad/s].
    - desired_joint_acceleration: (n,) [rad/s^2].
    - speed_scale: (1,) share of full speed for `DmpIntegrator`, in [0, 1].
    - evasion_velocity: (3,) velocity in the world [m/s] by which `DmpIntegrator` displaces its motion to the
      tool during a maneuver; 0 otherwise.
    - supervision: abstract `Supervision`: run, slow, hold or stop, and the reason.
    - decision: (2,) time at which the last decision began and its duration [s].
    - path_state: (2m,) state of the robot with its arm on the verified motion at the present
      phase, from which `MotionVerifier` predicts [rad, m, rad/s, m/s].
    - tracking_error: (3,) desired minus actual position of the tool point [m].
    - orientation_error: (3,) rotation vector from the actual to the desired orientation [rad].
    - guard_action: (1,) row of `drake_oa.safety.maneuvers.ACTIONS`.
    - guard_contact: (1,) time of the first contact predicted on the verified motion [s]; inf: none.
    - guard_claim: (1,) row of `drake_oa.safety.passive_safety.CLAIMS`: the claim that limits the
      speed.

    While no maneuver is active, the commanded joints have the tool at the desired pose, by a
    damped Gauss-Newton step each `step`, and their null space follows the posture. Each `period`
    `drake_oa.safety.maneuvers` compares this motion with slower ones and, if obstacles move, with
    maneuvers. During a maneuver the phase rests; then the arm returns to the motion. If it comes no
    nearer to it for 1 s, the arm stops, the desired position follows the tool, and a motion that
    begins there is awaited. Where no newer decision comes into force in time, the phase or the arm
    comes to rest.

    Contact reaction: where the error e of a joint exceeds `contact_error`, or e + (kd / kp) de/dt
    0.6 times as much, the command begins anew at rest at the measured configuration, and for
    `contact_time` no point of the arm moves faster than `v_unseen`. The second sum is the torque of
    the controller's feedback over kp M, a residual torque: at most 0.003 rad without contact, and
    0.01 rad with a wrong model of the arm.
    """

    def __init__(
        self,
        robot: RobotPlant,
        chain: Chain,
        covered: ArmSpheres,
        duration: float,
        q_start: FloatArray,
        *,
        config: Policy,
        parameters: GuardParameters,
        period: float = 1.0 / 15.0,
        padding: float = 0.005,
        turn_limit: float | None = None,
        compute_latency: LatencyModel | None = None,
    ) -> None:
        """Declares the ports.

        Args:
            robot: the robot alone, with joints of one degree of freedom.
            chain, covered: its arm.
            duration: T of the movement primitive [s].
            q_start: (n,) command before the initialization [rad].
            config: of the policy: its period is the time between steps of the commanded motion.
            parameters: of the search, the contact reaction and the monitors.
            period: time between decisions [s].
            padding: distance by which moving obstacles may be nearer than observed [m].
            turn_limit: maximum angle by which a maneuver turns the tool [rad]; None: any.
            compute_latency: simulated duration of decisions; None: they act immediately.

        Raises:
            ValueError: if a duration or period is not positive and finite.
        """
        super().__init__()
        self._chain, self._index, self._size = chain, chain.q_index, robot.plant.num_positions()
        self._joints = [joint.name() for joint in joints_to(robot.plant, robot.tool_frame)]
        self._duration, self._config = valid_period(duration), config
        self._period, self._parameters = valid_period(period), parameters
        self._compute_latency, self._step_length = compute_latency, config.period
        self._fresh = min(parameters.stale_frames * period, 0.9 * config.max_observation_age)
        self._search = GuardSearch(
            chain, covered, config=config, period=period, padding=padding, turn_limit=turn_limit,
            parameters=parameters,
        )  # fmt: skip
        reach = float(chain.reach @ self._search.speed)
        self._slow_share = min(1.0, parameters.v_unseen / max(reach, 1e-9))
        self._n = n = len(self._joints)

        self._robot = self.DeclareVectorInputPort("robot_state", 2 * self._size)
        self._policy = AbstractInput(self, "policy_state", PolicyState)
        self._position = self.DeclareVectorInputPort("desired_position", 3)
        self._velocity = self.DeclareVectorInputPort("desired_velocity", 3)
        self._orientation = self.DeclareVectorInputPort("desired_orientation", 4)
        self._angular = self.DeclareVectorInputPort("desired_angular_velocity", 3)
        self._posture = self.DeclareVectorInputPort("desired_posture", 2 * n)
        self._motion = AbstractInput(self, "motion", PlannedMotion)
        self._solids = AbstractInput(self, "collision_scene_W", CollisionScene)
        self._free_space = AbstractInput(self, "free_space_W", FreeSpace)
        self._shown = AbstractInput(self, "demonstration", Demonstration)
        self._saturation = self.DeclareVectorInputPort("torque_saturation", 1)

        rest = np.append(q_start, np.zeros(n))
        self._state = self.DeclareAbstractState(
            Value(GuardState(x=rest, path=rest, acceleration=np.zeros(n)))
        )
        own = {self.time_ticket(), self.abstract_state_ticket(self._state)}
        measured = own | {
            port.ticket() for port in (self._robot, self._position, self._orientation)
        }
        for name, size, calc, of in (
            ("desired_joint_state", 2 * n, lambda c: self._read(c).at(c.get_time()), own),
            ("path_state", 2 * self._size, self._path_state, measured),
            ("tracking_error", 3, lambda c: self._tool_error(c)[:3], measured),
            ("orientation_error", 3, lambda c: self._tool_error(c)[3:], measured),
        ):
            self.DeclareVectorOutputPort(
                name,
                size,
                lambda context, output, calc=calc: output.SetFromVector(calc(context)),
                of,
            )
        declare_state_outputs(
            self,
            self._state,
            ("desired_joint_acceleration", n, "acceleration"),
            ("speed_scale", 1, "speed_scale"),
            ("evasion_velocity", 3, "carry"),
            ("decision", 2, "pending.last"),
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
        x, state = self._robot.Eval(context).copy(), self._read(context)
        if not state.on_path and not state.is_lost:
            x[self._index] = state.path[: self._n]
            x[self._size + self._index] = state.path[self._n :]
        return x

    def _scene(self, context: Context) -> CollisionScene:
        scene = self._solids.read(context)
        return scene if scene.is_finite else CollisionScene(note="the solids are not finite")

    def _arm_state(self, context: Context) -> tuple[FloatArray, FloatArray]:
        """Returns positions and velocities of the arm's joints, (n,) each."""
        x = self._robot.Eval(context)
        return x[self._index], x[self._size + self._index]

    def _desired_pose(self, context: Context) -> FloatArray:
        return np.append(rotation_of(self._orientation.Eval(context)), self._position.Eval(context))

    def _tool_error(self, context: Context) -> FloatArray:
        """Returns position and rotation vector from the actual to the desired pose (6,)."""
        q, _ = self._arm_state(context)
        return _pose_error(self._desired_pose(context), tool_poses(self._chain, q[None])[0])

    # --- steps -----------------------------------------------------------------------------

    def _initialize(self, context: Context, state: State) -> EventStatus:
        held, time = state.get_mutable_abstract_state(self._state), context.get_time()
        before: GuardState = held.get_value()
        if before.end > -math.inf:
            # A motion under way, in a Context that another simulator takes over.
            return EventStatus.DidNothing()
        q, _ = self._arm_state(context)
        rest = np.append(q, np.zeros(self._n)) if math.isfinite(q.sum()) else before.x
        held.set_value(replace(before, x=rest, path=rest, end=time))
        return EventStatus.Succeeded()

    def _step(self, context: Context, state: State) -> None:
        held = state.get_mutable_abstract_state(self._state)
        before: GuardState = held.get_value()
        time = context.get_time()
        q, v = self._arm_state(context)
        if not math.isfinite(self._robot.Eval(context).sum()):
            supervision = before.supervision.faulted("the robot state is not finite", time)
            held.set_value(replace(before, supervision=supervision))
            return
        if before.pending.completed(time) is not None:
            before = self._active(replace(before, pending=before.pending.activated()), time)
        before = self._reacted(before, q, v, time)
        scene = self._scene(context)
        before = self._supervised(context, before, scene, time)
        if time > before.expires and not before.decision.follows:
            before = self._braked(before, before.x)
        held.set_value(self._advanced(context, before, time, moves=scene.moves))

    def _braked(self, state: GuardState, x: FloatArray) -> GuardState:
        """Returns the state in which the arm brakes from a joint state (2n,)."""
        stop = self._search.brake(*np.split(x, 2))
        pending = replace(state.pending.discarded(), active=stop)
        return replace(state, pending=pending, expires=math.inf)

    def _active(self, after: GuardState, time: float) -> GuardState:
        """Returns the state with a new decision in force; a brake begins at the present state."""
        if after.decision.action == "brake":
            # The end predicted for another time is overshot, and the arm would return to it.
            target = self._search.brake(*np.split(after.x, 2)).target
            stop = replace(after.decision, target=target)
            after = replace(after, pending=replace(after.pending, active=stop))
        rests = after.decision.follows and after.decision.scale == 0.0
        late = time + _LATE * self._period + after.pending.cost
        return replace(after, expires=math.inf if rests else late)

    def _reacted(self, state: GuardState, q: FloatArray, v: FloatArray, time: float) -> GuardState:
        """Returns the state after a check for contact by the joint state (n,), (n,)."""
        n = self._n
        error = q - state.x[:n]
        ahead = np.abs(error + _DAMPING * (v - state.x[n:]))
        if max(np.abs(error).max(), ahead.max() / _FEEDBACK) <= self._parameters.contact_error:
            return state
        if time > state.slow_until:
            joint = self._joints[int(ahead.argmax())]
            _logger.warning("t=%.3f s: contact: %s is pushed by %.3f rad", time, joint, ahead.max())
        rest = np.append(q, np.zeros(n))
        state = replace(state, x=rest, slow_until=time + self._parameters.contact_time)
        return self._braked(state, rest)

    def _supervised(
        self, context: Context, state: GuardState, scene: CollisionScene, time: float
    ) -> GuardState:
        """Returns the state after the monitors of observations, torques and the guard itself."""
        kept = state.supervision
        policy = self._policy.read(context)
        late = state.decision.follows and time > state.expires
        demands = [
            monitor_observation(scene, time, self._fresh, self._config.max_observation_age),
            monitor_guard(state.decision, time, late=late, moves=scene.moves),
        ]
        if state.decision.follows:
            demands.append(monitor_path(float(np.abs(state.path - state.x)[: self._n].max())))
        if self._saturation.HasValue(context):
            saturated = bool(self._saturation.Eval(context)[0] > 0.0)
            kept, demand = monitor_torque(kept, saturated, time, self._step_length)
            demands.append(demand)
        waits = policy.hold in (HoldReason.DECIDING, HoldReason.OBSTACLES)
        after = supervise(kept, demands, time, self._step_length, waits=waits)
        was = state.supervision
        if (after.action, after.cause) != (was.action, was.cause):
            said = f"{_SAID[after.action]}: {after.reason}" if after.reason else "runs freely again"
            _logger.warning("t=%.3f s: supervisor %s", time, said)
        return replace(state, supervision=after)

    def _advanced(
        self, context: Context, state: GuardState, time: float, *, moves: bool
    ) -> GuardState:
        """Returns the state with the next step of the commanded motion.

        Args:
            context: of the system.
            state: of the guard.
            time: now [s].
            moves: whether an obstacle moves.
        """
        n, step, chain = self._n, self._step_length, self._chain
        X_WE, posture = self._desired_pose(context), np.array(self._posture.Eval(context))
        V_WE = np.append(self._angular.Eval(context), self._velocity.Eval(context))
        q, v = np.array(state.path[:n]), np.zeros(n)
        if math.isfinite(X_WE.sum() + V_WE.sum() + posture.sum()):
            q, v = track(chain, q, X_WE, V_WE, posture, step, _RATE)
        elif not state.supervision.is_broken:
            supervision = state.supervision.faulted("the desired motion is not finite", time)
            state = replace(state, supervision=supervision)
        path, ahead, carry = np.append(q, v), np.array(state.x), np.zeros(3)
        lost_since = nearest = math.inf
        if state.decision.follows:
            limit = self._parameters.acceleration_limit
            ahead = approach(ahead, path, chain.speed, limit, step)
        else:
            self._search.advance(state.decision, ahead, time)
            away = float(np.abs(ahead - path)[:n].max())
            lost_since, nearest = self._lost_since(state, away, time, moves=moves)
        if state.is_lost and lost_since < math.inf:
            # The desired position follows the tool, and a motion that begins there is awaited.
            error = -_pose_error(X_WE, tool_poses(chain, ahead[None, :n])[0])
            carry = error[:3] / _CARRY if np.abs(error[:3]).max() > _CARRIED else carry
            path = np.append(ahead[:n], np.zeros(n))
            if state.speed <= _STILL and np.abs(error).max() <= _FOUND:
                lost_since, carry = math.inf, np.zeros(3)
        return replace(
            state,
            end=time + step,
            x=ahead,
            acceleration=(ahead - state.x)[n:] / step,
            path=path,
            carry=carry,
            lost_since=lost_since,
            nearest=nearest,
        )

    def _lost_since(
        self, state: GuardState, away: float, time: float, *, moves: bool
    ) -> tuple[float, float]:
        """Computes since when the arm comes no nearer to its path, and its least distance to it.

        Args:
            state: of the guard.
            away: largest distance of a joint from the path [rad].
            time: now [s].
            moves: whether an obstacle moves, for which the arm may still be evading.

        Returns:
            Time [s], inf if the arm is not stuck, and distance [rad].
        """
        if time - state.lost_since > _PATIENCE + _LONGEST_WAIT or away <= ARRIVED:
            return math.inf, away
        if state.is_lost:
            return state.lost_since, state.nearest
        rests = time > state.slow_until and state.speed <= _STILL
        if (moves and not rests) or away < state.nearest - _PROGRESS:
            return time, away
        return min(state.lost_since, time), state.nearest

    # --- decisions -------------------------------------------------------------------------

    def _decide(self, context: Context, state: State) -> EventStatus:
        held = state.get_mutable_abstract_state(self._state)
        before: GuardState = held.get_value()
        time = context.get_time()
        scene = self._scene(context)
        if before.pending.pending is not None or -math.inf in (scene.stamp, before.end):
            return EventStatus.DidNothing()
        inputs = self._inputs(context, before, scene, time)
        pending = before.pending.start(
            lambda decision: self._search.decide(decision, inputs), time, self._compute_latency
        )
        after = replace(before, pending=pending, number=before.number + 1)
        if self._compute_latency is None:
            after = self._active(after, time)
        held.set_value(after)
        return EventStatus.Succeeded()

    def _inputs(
        self, context: Context, state: GuardState, scene: CollisionScene, time: float
    ) -> GuardInputs:
        """Returns the input of a decision that comes into force after the usual latency."""
        n, step = self._n, self._step_length
        policy = self._policy.read(context)
        motion = self._motion.read(context)
        shown = self._shown.find(context)
        duration = self._duration
        if shown is not None and shown.position is not None:
            duration = shown.position.duration
        held = policy.hold in (HoldReason.DECIDING, HoldReason.OBSTACLES)
        is_other = len(motion.p_WS) > 0 and not np.array_equal(motion.p_WS, policy.p_WS)
        if held or is_other or motion.q.shape[1:] != (n,):
            motion = PlannedMotion()
        latency = 0.0 if self._compute_latency is None else state.pending.cost
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
            on_path=state.on_path,
            s=s + policy.speed * (begin - policy.stamp),
            rate=policy.speed,
            full_rate=1.0 / (policy.tau * duration),
            motion=motion,
            scene=scene,
            speed_fraction=self._slow_share if time < state.slow_until else 1.0,
            number=state.number,
            free_space=self._free_space.find(context),
        )


def _pose_error(X_d: FloatArray, X: FloatArray) -> FloatArray:
    """Computes position and rotation vector (6,) from a pose (12,) to a desired one [m, rad]."""
    turn = X_d[:9].reshape(3, 3) @ X[:9].reshape(3, 3).T
    return np.append(X_d[9:] - X[9:], rotation_vector(np.ascontiguousarray(turn)))
