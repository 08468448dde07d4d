"""Decisions of the motion guard: selection of the joint trajectory of least cost among resting and
moving obstacles.

The verified motion is the joint motion q(s) over normalized time s that MotionVerifier predicted
and checked by simulation. Each decision compares joint trajectories over a horizon of 1.34 s. They
are the verified motion at several speeds (follow, slow, wait), and evasive maneuvers of two legs:
brake, return to the verified motion, random targets and via points, and refinements of the best of
these. The trajectory with the least cost

    J = w_c contact + w_m near_moving + w_r near_resting + w_o turn + delay

is selected, with constant weights w. The maneuver in progress has a slightly lower cost, so that
the selection does not alternate. `contact`, `near_moving` and `near_resting` are the costs of the
first contact and of proximity to moving and resting obstacles (equations in
`joint_motions.MotionCosts`). `turn`, 0 except in maneuvers, is the time integral of the angle by
which the tool is turned from its orientation on the verified motion. `delay` is the time lost on
this motion. Obstacles are predicted at constant velocity, and the margin to them grows with the
prediction time. Every trajectory can come to rest: on the verified motion, s can stop advancing
within `policy.hold_time`, and in each leg of a maneuver every joint moves to a target and rests
there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Literal, get_args

import numpy as np

from drake_oa.common.latency import counted
from drake_oa.common.messages import BoolArray, FloatArray, Frozen, PlannedMotion, zeros
from drake_oa.geometry.collision_scene import CollisionScene
from drake_oa.perception.depth_perception import FreeSpace
from drake_oa.planning.collision_model import (
    ArmCollisionModel,
    ClearanceRequirements,
    group_distances,
    self_distance,
)
from drake_oa.policy.config import Policy
from drake_oa.robot.arm import Chain, tool_poses
from drake_oa.robot.spheres import ArmSpheres, sphere_centers
from drake_oa.safety.config import GuardParameters
from drake_oa.safety.joint_motions import (
    Legs,
    MotionCosts,
    advance_leg,
    evaluate_motions,
    roll_out_legs,
)
from drake_oa.safety.passive_safety import CLAIMS, Claim, violated_claim

Action = Literal["follow", "slow", "wait", "evade", "brake"]
ACTIONS: tuple[Action, ...] = get_args(Action)

_FOLLOW_OPTIONS: tuple[tuple[Action, float], ...] = (
    ("follow", 1.0), ("slow", 0.6), ("slow", 0.3), ("slow", 0.15), ("wait", 0.0),
)  # fmt: skip
"""Actions of the motion guard that follow the verified motion (checked by simulation), each with
its speed scale: the fraction of full speed."""
HORIZON = 1.4
"""Approximate time over which the motion guard predicts the trajectories of the arm and of
obstacles [s]. It is divided into 28 intervals, which are rounded to whole time steps. With steps of
8 ms, an interval is 48 ms, and the predicted time is 1.34 s."""
_SAMPLES = 28
"""Number of configurations at which each predicted trajectory of the arm is checked for contact and
proximity [-]."""
_CONTACT_WEIGHT = 60.0
"""Weight w_c of predicted contact in the cost from which the motion guard selects a trajectory [-].
"""
_MOVING_WEIGHT = 6.0
"""Weight w_m of proximity to moving obstacles in the cost from which the motion guard selects a
trajectory [-]."""
_RESTING_WEIGHT = 2.0
"""Weight w_r of proximity to resting obstacles in the cost from which the motion guard selects a
trajectory [-]."""
_TURN_WEIGHT = 0.1
"""Weight w_o, in the cost of a maneuver, of the time integral of the angle between the tool and its
orientation on the verified motion (checked by simulation) [1/rad]."""
_TURN_STRIDE = 2
"""Interval, in samples of a trajectory, at which the tool's orientation is evaluated [-]; 2: at
every second sample."""
_HYSTERESIS = 0.1
"""Maximum bonus of the maneuver in progress, subtracted from its cost so that the motion guard
selects another one only for a clear advantage [s]. The bonus is smaller if the arm can return to
the verified motion (checked by simulation) in less than 0.5 s."""
_MOVING_CONTACT_DISTANCE = 0.012
"""Distance from the arm to a padded moving obstacle below which a predicted trajectory counts as a
contact, unless the arm is already closer [m]. A padded obstacle is enlarged by its position
uncertainty."""
_RESTING_CONTACT_DISTANCE = 0.004
"""Distance to a resting obstacle below which a predicted trajectory counts as a contact, unless the
arm is already closer, or comes closer on the verified motion (checked by simulation) [m]."""
_DISTANCE_SLACK = 2e-3
"""Amount by which an arm that is closer than required may come still closer, so that no trajectory
starts in contact [m]. The required distance is then the current one minus this amount. Also the
tolerance of the maximum angle by which a maneuver turns the tool [rad]."""
_ROUNDING = 1e-6
"""Tolerance of a maneuver that must not come closer to an obstacle or link than the current
configuration [m]. With it, rounding errors cause no contact."""
_VERIFIED_SLACK = 5e-3
"""Amount by which the arm may come closer to resting obstacles than on the verified motion (checked
by simulation), so that this motion does not count as a contact [m]. Where necessary, the required
distance is reduced to the minimum along the verified motion minus this amount, but not below minus
the protrusion of the covering spheres beyond their body."""
_SELF_CLEARANCE = 5e-3
"""Required distance between links of the arm in a maneuver, unless they are closer to each other in
the current configuration or on the verified motion (checked by simulation) [m]."""
_MAX_NEARNESS = 0.02
"""Maximum cost `near_moving` of proximity to moving obstacles at which the verified motion (checked
by simulation) is followed without comparing alternatives [s]."""
_OFFSET_DECAY = 4.0
"""Rate at which the joints' predicted offset from the verified motion (checked by simulation)
decays while the arm follows this motion [1/s]."""
_LIMIT_MARGIN = 0.03
"""Minimum distance of the target configurations of maneuvers from the joint limits [rad]."""
_SPREADS = ((0.15, 0.4, 0.9), (0.4, 1.0), (0.2, 0.5), (0.0,))
"""Standard deviations of random joint offsets that define the targets of random maneuvers [rad]: a
tuple for each of four kinds of target. Each maneuver has one value of a tuple, drawn at random.

The first kind adds offsets in all joints to the configuration in which the arm would rest after
full braking. The second kind adds offsets in some joints to this rest configuration. The third kind
adds offsets to a configuration between the rest configuration and the verified motion (checked by
simulation). The fourth kind is drawn uniformly within the joint limits; the value 0 is unused."""
_NO_LEGS = Legs(np.zeros((0, 2, 0)), np.zeros((0, 2, 0)), np.zeros(0))
"""Empty set of maneuvers, which are joint motions of two legs each."""
_N_PARENTS = 8
"""Number of parent maneuvers [-]: the motion guard also evaluates random variations of the cheapest
maneuvers."""
_RETURN_FRACTIONS = (1.0, 0.6, 0.3)
"""Speeds of the candidate maneuvers that return to the verified motion (checked by simulation), as
fractions of the highest speeds at which all joints arrive at the same time [-]. In a further
candidate, no point of the arm begins to return faster than 0.9 `v_unseen`, where `v_unseen` is the
maximum speed toward unobserved space."""
_SLOW_FRACTION = 0.9
"""Maximum initial speed of the arm's fastest point in two slow candidates, relative to `v_unseen`,
the maximum speed toward unobserved space [-]. One candidate follows the verified motion (checked by
simulation), the other returns to it. The ratio is less than 1, since the speed changes on the way.

The same value limits the speed of the first candidate relative to full speed, and that of the
second relative to the fastest return."""
_MAX_CLAIM_WORK = 42
"""Number of checks for passive motion safety after which a decision discards the other unchecked
trajectories and only checks braking and the slow return to the verified motion (checked by
simulation) [-]. The simulated compute latency of the decision is thus below the period of 33 ms.

A check of the speed toward moving obstacles counts as one, toward unobserved space as three."""
_VIOLATION_COSTS: dict[Claim, float] = {"": 0.0, "A": 6.0, "B": 4.0}
"""Additional cost of a trajectory that violates claim "A" or "B" of passive motion safety [s]; less
than the cost of any predicted contact.

"A": a part of the arm that a moving obstacle may reach rests or moves away from it. "B": no part is
faster than `v_unseen` toward unobserved space from which an obstacle may reach it."""
_BRAKE_SAMPLES = 8
"""Number of configurations of a braking motion that are checked for passive motion safety [-]. The
braking motion begins after one decision period on the checked trajectory."""
ON_PATH_DEVIATION = 0.01
"""Maximum joint deviation from the verified motion (checked by simulation) at which the arm may
leave a maneuver and follow this motion again [rad]."""
REST_SPEED = 0.1
"""Maximum speed of any joint at which the arm may leave a maneuver and follow the verified motion
(checked by simulation) again [rad/s]."""


@dataclass(frozen=True, eq=False)
class GuardDecision(Frozen):
    """Decision of the motion guard: to follow the verified motion (checked by simulation) at a
    certain speed, or to execute a joint maneuver.

    Attributes:
        action: "follow": follow the verified motion at full speed; "slow": follow it at a fraction
            of full speed; "wait": rest on it; "evade": execute an evasive maneuver; "brake": come
            to rest.
        scale: fraction of full speed at which the verified motion is followed, in [0, 1].
        target: (2, n) target configurations of the two legs of a maneuver [rad]; empty: the
            verified motion is followed.
        speed: (2, n) maximum joint speeds in the two legs [rad/s].
        switch: simulation time at which the second leg starts [s]; inf: only the first leg is
            executed.
        contact: simulation time of the first contact predicted on the verified motion at full speed
            [s]; inf: no contact, or the arm is not on this motion.
        obstacle: label of the moving obstacle that is nearest to the arm; "": no obstacle moves.
        claim: violated claim of passive motion safety: "A" (limit of the speed toward moving
            obstacles), "B" (toward unobserved space), or "" (none). The violating trajectory is
            that of least cost without the costs of violations; another one may be selected.
    """

    action: Action = "follow"
    scale: float = 1.0
    target: FloatArray = zeros(0, 0)
    speed: FloatArray = zeros(0, 0)
    switch: float = math.inf
    contact: float = math.inf
    obstacle: str = ""
    claim: Claim = ""

    @property
    def action_number(self) -> int:
        """Index of the decision's action (follow, slow, wait, evade, brake) in `ACTIONS`, for the
        output port guard_action of MotionGuard.
        """
        return ACTIONS.index(self.action)

    @property
    def claim_number(self) -> int:
        """Number of the claim of passive motion safety that limits the speed, for the output port
        guard_claim of MotionGuard.

        0: none; 1: claim "A", toward moving obstacles; 2: claim "B", toward unobserved space.
        """
        return CLAIMS.index(self.claim)

    @property
    def follows(self) -> bool:
        """Whether the decision is to follow the verified motion (checked by simulation), at any
        speed or at rest, instead of a maneuver.
        """
        return not len(self.target)


@dataclass(frozen=True, eq=False)
class GuardInputs(Frozen):
    """Inputs of one decision of the motion guard, predicted for the time at which the decision
    becomes active.

    The verified motion is the joint motion q(s) over normalized time s that MotionVerifier
    predicted and checked by simulation.

    Attributes:
        begin: time at which the decision becomes active [s].
        q, v: (n,) predicted positions [rad] and velocities [rad/s] of the joints at `begin`.
        q_path: (n,) configuration on the verified motion to which maneuvers return [rad]. While the
            arm follows this motion, it is `q`. During a maneuver, it is the configuration at the
            phase of the movement primitive, which does not advance.
        is_on_path: whether the arm follows the verified motion, or rests on it.
        s: normalized time on the verified motion at `begin`, predicted from the movement primitive.
            If the arm is late, it is the time of the motion's sample nearest to q instead (see
            `time_on_path`).
        rate, full_rate: ds/dt at the current and at full speed [1/s].
        motion: verified motion; without configurations: no motion is verified.
        scene: collision scene, all collision geometry except the robot's.
        speed_fraction: fraction of the maneuvers' joint speed limits that may be used; 1 unless a
            contact occurred less than `contact_time` (0.5 s by default) ago.
        decision_count: number of previous decisions, a part of the seed of random candidates.
        free_space: space observed as free; None: all space outside collision geometry counts as
            free.
        may_move: (K,) whether each geometry of the scene moves, or moved less than 2 s ago.
    """

    begin: float
    q: FloatArray
    v: FloatArray
    q_path: FloatArray
    is_on_path: bool
    s: float
    rate: float
    full_rate: float
    motion: PlannedMotion
    scene: CollisionScene
    speed_fraction: float
    decision_count: int
    free_space: FreeSpace | None
    may_move: BoolArray


def time_on_path(motion: PlannedMotion, q: FloatArray, s: float) -> float:
    """Returns the normalized time at which the verified motion passes a configuration of the arm.

    It is the predicted time s, unless the arm is late on its path. An arm counts as late if the
    nearest sample of the motion is less than half as far away as the configuration at s, by the
    maximum joint difference. The result is then the normalized time of this sample.

    Args:
        motion: verified motion (checked by simulation); without configurations, the result is s.
        q: (n,) configuration of the arm [rad].
        s: normalized time at which the arm is predicted to be at `q`.
    """
    if not len(motion.q):
        return s
    deviation = np.abs(motion.q - q).max(axis=1)
    is_late = 2.0 * deviation.min() < np.abs(q - motion.joints(s)).max()
    return float(motion.s[deviation.argmin()]) if is_late else s


class GuardSearch:
    """Search of the motion guard for the joint trajectory of least cost: the verified motion
    (checked by simulation) at some speed, or an evasive maneuver.
    """

    def __init__(
        self,
        chain: Chain,
        arm_spheres: ArmSpheres,
        *,
        config: Policy,
        period: float,
        padding: float,
        turn_limit: float | None,
        parameters: GuardParameters,
    ) -> None:
        """Stores the constants of the search.

        Args:
            chain, arm_spheres: kinematics of the arm, and spheres that cover it.
            config: configuration of the movement primitive, of which the time step and the time for
                slowing from full speed to rest (`hold_time`) are used.
            period: time between decisions [s].
            padding: position uncertainty of moving obstacles, added to their clearance [m].
            turn_limit: maximum angle by which a maneuver turns the tool away from its orientation
                on the verified motion [rad]; None: no limit.
            parameters: parameters of the search.
        """
        self._turn_limit = math.pi if turn_limit is None else turn_limit
        self._chain, self._arm_spheres = chain, arm_spheres
        self._step, self._hold_time = config.period, config.hold_time
        self._padding, self._parameters = padding, parameters
        self._every = max(round(HORIZON / _SAMPLES / self._step), 1)
        self._interval = self._every * self._step
        self._times = self._interval * np.arange(1, _SAMPLES + 1)
        self._until_next = math.ceil(period / self._interval)
        self.acceleration = np.full(len(chain.speed), parameters.acceleration)
        self.speed = chain.speed * parameters.speed_fraction
        self._lower, self._upper = chain.lower + _LIMIT_MARGIN, chain.upper - _LIMIT_MARGIN
        spheres = arm_spheres.arrays
        # Cached: the verified motion is the same for many decisions.
        self._verified_self_distance = lru_cache(maxsize=2)(
            lambda motion: min(
                (self_distance(chain, spheres, np.array(q)) for q in _sample_motion(motion)),
                default=math.inf,
            )
        )

    def decide(self, previous: GuardDecision, inputs: GuardInputs) -> GuardDecision:
        """Selects the trajectory that the arm executes from `inputs.begin` on: the verified motion
        (checked by simulation) at some speed, or a maneuver.

        Args:
            previous: active decision, whose maneuver, if any, is one of the candidates.
            inputs: inputs of the new decision.
        """
        distance = self._verified_self_distance(inputs.motion)
        model = _GuardModel(self._chain, self._arm_spheres, inputs, self._padding, distance)
        decision = GuardDecision()
        if inputs.is_on_path:
            verified = self._followed_motion(inputs, 1.0)
            costs = self._evaluate(model, verified[None])
            contact = inputs.begin + float(costs.first[0])
            decision = replace(decision, contact=contact, obstacle=model.nearest)
            is_clear = costs.contact[0] == 0.0 and costs.near_moving[0] <= _MAX_NEARNESS
            if is_clear and not self._find_violated_claim(verified, inputs):
                return decision
        options = [GuardDecision(*option) for option in _FOLLOW_OPTIONS if inputs.is_on_path]
        has_claim_b = self._parameters.obstacle_speed > 0.0 and inputs.free_space is not None
        if inputs.is_on_path and has_claim_b and len(inputs.motion.q):
            # The fastest motion that claim (B) allows in unobserved space.
            s = inputs.s + inputs.full_rate * np.array([0.0, self._step])
            options.append(GuardDecision("slow", self._slow_fraction(inputs.motion.joints(s))))
        q_followed = [self._followed_motion(inputs, option.scale) for option in options]
        q = np.array(q_followed).reshape(-1, _SAMPLES, len(inputs.q))
        progress = [self._rates(inputs, option.scale).sum() for option in options]
        delay = self._times[-1] - self._interval * np.array(progress) / inputs.full_rate
        cost = self._obstacle_cost(model, q) + delay
        legs, n_followed = _NO_LEGS, len(options)
        if inputs.scene.moves or not inputs.is_on_path:
            options += [] if previous.follows else [previous]
            options += [self.brake(inputs.q, inputs.v, speed_fraction=inputs.speed_fraction)]
            legs = self._candidates(options[n_followed:], inputs)
            q_legs = self._roll_out(legs, inputs)
            cost_legs = self._maneuver_cost(model, q_legs)
            if not previous.follows:
                # The first maneuver is the current one.
                return_time = float((np.abs(inputs.q - inputs.q_path) / self.speed).max())
                cost_legs[0] -= _HYSTERESIS * min(1.0, 2.0 * return_time)
            refined = self._refine(legs, cost_legs, inputs)
            q_refined = self._roll_out(refined, inputs)
            cost_refined = self._maneuver_cost(model, q_refined)
            q, cost = np.concatenate([q, q_legs, q_refined]), np.r_[cost, cost_legs, cost_refined]
            legs = Legs(*map(np.concatenate, zip(legs, refined, strict=True)))
        # Other maneuvers become decisions only if they are selected.
        evasions = legs.rows(slice(len(options) - n_followed, None))
        evasions = evasions._replace(switch=inputs.begin + evasions.switch)
        plan = self._select(model, options, evasions, q, cost)
        return replace(plan, contact=decision.contact)

    def _select(
        self,
        model: _GuardModel,
        options: list[GuardDecision],
        evasions: Legs,
        q: FloatArray,
        cost: FloatArray,
    ) -> GuardDecision:
        """Selects the trajectory of least cost, after adding the costs of violated claims of
        passive motion safety (limits of the speed toward moving obstacles and unobserved space).

        Args:
            model: collision models of the decision.
            options: first M of N candidate trajectories: the verified motion (checked by
                simulation) at several speeds, the active maneuver, and braking.
            evasions: the other N - M candidates, with the times at which their second legs start;
                first the slow and the fastest return to the verified motion.
            q: (N, T, n) configurations along the trajectories [rad].
            cost: (N,) costs of the trajectories without the costs of violated claims [s].

        Returns:
            Decision to execute the selected trajectory; its `claim` is that which the trajectory of
            least `cost` violates.
        """
        inputs, min_cost = model.inputs, math.inf
        claim: Claim = ""
        claims: dict[int, Claim] = {}
        selected = self.brake(inputs.q, inputs.v)
        always = [row for row, option in enumerate(options) if option.action == "brake"]
        slow = len(options)
        always += [slow] if len(q) > slow else []
        with counted() as work:
            for row in [*cost.argsort().tolist(), *always]:
                is_skipped = work["claims"] > _MAX_CLAIM_WORK and row not in always
                row_cost = float(cost[row])
                if row == slow and claim == "B":
                    # The claim forbids the fastest return; the slow one counts as no later.
                    slow_delay, fastest_delay = self._delay(q[slow : slow + 2], inputs).tolist()
                    row_cost -= slow_delay - fastest_delay
                if is_skipped or row_cost >= min_cost:
                    continue
                if row not in claims:
                    claims[row] = self._find_violated_claim(q[row], inputs)
                violation = claims[row]
                claim = claim or violation
                if row_cost + _VIOLATION_COSTS[violation] < min_cost:
                    min_cost = row_cost + _VIOLATION_COSTS[violation]
                    k = row - len(options)
                    selected = options[row] if k < 0 else _evasion(evasions, k)
        return replace(selected, claim=claim, obstacle=model.nearest)

    def _find_violated_claim(self, q: FloatArray, inputs: GuardInputs) -> Claim:
        """Finds the claim of passive motion safety that the arm violates if it follows a trajectory
        for one decision period and then brakes.

        Args:
            q: (T, n) configurations along the trajectory [rad].
            inputs: state of the arm, scene and verified motion for the guard's decision.

        Returns:
            "A": the arm approaches a moving obstacle that may reach it; "B": a point of the arm is
            too fast toward unobserved space; "": no claim is violated, or checks are switched off.
        """
        p, m = self._parameters, self._until_next
        if p.obstacle_speed == 0.0:
            return ""
        followed = np.vstack([inputs.q, q[: m + 1]])
        v = (followed[m + 1] - followed[m]) / self._interval
        brake = self.brake(followed[m], v)
        legs = Legs(brake.target[None], brake.speed[None], np.array([math.inf]))
        braking = roll_out_legs(
            np.array(followed[m]), v, legs, self.acceleration, self._step, self._every,
            _BRAKE_SAMPLES,
        )  # fmt: skip
        t = inputs.begin + self._interval * np.arange(float(m + 1 + _BRAKE_SAMPLES))
        motion = np.concatenate([followed[: m + 1], braking[0]])
        return violated_claim(
            self._chain, self._arm_spheres.arrays, t, motion, inputs.scene, inputs.free_space,
            V=p.obstacle_speed, v_unseen=p.v_unseen, may_move=inputs.may_move,
        )  # fmt: skip

    def _evaluate(self, model: _GuardModel, q: FloatArray) -> MotionCosts:
        """Computes the costs of contact and proximity of N trajectories, without their weights.

        Args:
            model: collision models of the decision.
            q: (N, T, n) configurations along the trajectories [rad].

        Returns:
            Costs and times of the first contact, (N,) each [s].
        """
        margin = self._parameters.margin_moving
        return evaluate_motions(model.resting, model.moving, q, self._interval, margin)

    def _obstacle_cost(self, model: _GuardModel, q: FloatArray) -> FloatArray:
        """Computes the weighted costs (N,) [s] of contact and proximity of N trajectories.

        The cost is w_c contact + w_m near_moving + w_r near_resting, with the costs of the first
        contact and of proximity to moving and resting obstacles.

        Args:
            model: collision models of the decision.
            q: (N, T, n) configurations along the trajectories [rad].
        """
        costs = self._evaluate(model, q)
        cost = _CONTACT_WEIGHT * costs.contact + _MOVING_WEIGHT * costs.near_moving
        return cost + _RESTING_WEIGHT * costs.near_resting

    def _maneuver_cost(self, model: _GuardModel, q: FloatArray) -> FloatArray:
        """Computes the costs (N,) [s] of N maneuvers: the weighted sum of the costs of contact,
        proximity, turning the tool, and delay.

        The cost is inf if the tool turns too far away from its orientation on the verified motion
        (checked by simulation). The maximum angle is the larger one of `turn_limit` and the present
        angle.

        Args:
            model: collision models of the decision.
            q: (N, T, n) configurations along the maneuvers [rad].
        """
        angle = self._turns(q, model.inputs)
        turn = self._times[-1] * angle.mean(axis=1)
        cost = self._obstacle_cost(model, q) + self._delay(q, model.inputs) + _TURN_WEIGHT * turn
        limit = np.maximum(self._turn_limit, angle[:, 0]) + _DISTANCE_SLACK
        return np.where(angle[:, 1:].max(axis=1) > limit, math.inf, cost)

    def _delay(self, q: FloatArray, inputs: GuardInputs) -> FloatArray:
        """Computes the costs (N,) of the delay of N maneuvers, the time lost on the verified motion
        (checked by simulation) [s].

        At time t of the maneuver, joint i requires the time d_i(t) to return to its position in
        `q_path`, a configuration on the verified motion, at the maximum speed of maneuvers. With
        the horizon H, the cost is

            H + max_i d_i(H) + 0.3 mean_i d_i(H) + integral of max_i d_i(t) dt / (1 second)

        Args:
            q: (N, T, n) configurations along the maneuvers [rad].
            inputs: inputs of the guard's decision, of which `q_path` is used.
        """
        deviation = np.abs(q - inputs.q_path) / self.speed
        return_time = deviation.max(axis=2)
        delay = self._times[-1] + return_time[:, -1] + 0.3 * deviation[:, -1].mean(axis=1)
        return np.asarray(delay + self._interval * return_time.sum(axis=1))

    def _turns(self, q: FloatArray, inputs: GuardInputs) -> FloatArray:
        """Computes the angles between the tool's orientation along N trajectories and its
        orientation on the verified motion (checked by simulation) [rad].

        Args:
            q: (N, T, n) configurations along the trajectories [rad].
            inputs: inputs of the guard's decision; `q_path` determines the orientation on the
                verified motion.

        Returns:
            (N, 1 + T / 2) angles: first at `inputs.q`, then at every second configuration of q.
        """
        n = q.shape[2]
        samples = np.insert(q[:, _TURN_STRIDE - 1 :: _TURN_STRIDE], 0, inputs.q, axis=1)
        configurations = np.vstack([samples.reshape(-1, n), inputs.q_path])
        R_WE = tool_poses(self._chain, configurations)[:, :9]
        cosine = 0.5 * (R_WE[:-1] @ R_WE[-1] - 1.0)
        return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)).reshape(len(q), -1))

    # --- candidates ------------------------------------------------------------------------

    def _rates(self, inputs: GuardInputs, scale: float) -> FloatArray:
        """Predicts the rates ds/dt (T,) of normalized time [1/s] at the T samples of the horizon,
        while the speed on the verified motion (checked by simulation) changes to a new value.

        Args:
            inputs: inputs of the guard's decision, with the current rate.
            scale: new value of the speed, as a fraction of full speed, in [0, 1].
        """
        max_change = inputs.full_rate / self._hold_time * self._times
        target = scale * inputs.full_rate
        return inputs.rate + np.clip(target - inputs.rate, -max_change, max_change)

    def _followed_motion(self, inputs: GuardInputs, scale: float) -> FloatArray:
        """Predicts the configurations (T, n) [rad] of an arm that follows the verified motion
        (checked by simulation) at a fraction of full speed.

        Args:
            inputs: inputs of the guard's decision; without a verified motion the arm rests.
            scale: fraction of full speed, in [0, 1].
        """
        motion = inputs.motion
        if not len(motion.q):
            return np.tile(inputs.q, (_SAMPLES, 1))
        s = inputs.s + self._interval * np.cumsum(self._rates(inputs, scale))
        offset = inputs.q - motion.joints(inputs.s)
        return np.asarray(motion.joints(s) + np.exp(-_OFFSET_DECAY * self._times)[:, None] * offset)

    def _roll_out(self, legs: Legs, inputs: GuardInputs) -> FloatArray:
        """Simulates N maneuvers, starting from the joint state of the inputs.

        Args:
            legs: N maneuvers.
            inputs: state of the arm, scene and verified motion for the guard's decision.

        Returns:
            (N, T, n) configurations [rad].
        """
        return roll_out_legs(
            np.array(inputs.q), np.array(inputs.v), legs, self.acceleration, self._step,
            self._every, _SAMPLES,
        )  # fmt: skip

    def stop(self, q: FloatArray, v: FloatArray) -> FloatArray:
        """Computes the configuration q + sign(v) v^2 / (2 a) (n,) [rad] in which all joints rest
        after braking at the maximum joint acceleration a of maneuvers.

        The configuration is clipped to a range that ends 0.03 rad before the joint limits.

        Args:
            q, v: (n,) positions [rad] and velocities [rad/s] at which braking begins.
        """
        q_rest = q + np.sign(v) * v**2 / (2.0 * self.acceleration)
        return np.asarray(np.clip(q_rest, self._lower, self._upper))

    def advance(self, maneuver: GuardDecision, x: FloatArray, time: float) -> None:
        """Advances a joint state, in place, by one time step of a maneuver.

        Args:
            maneuver: maneuver of two legs.
            x: (2n,) positions [rad] and velocities [rad/s].
            time: simulation time at the start of the step [s].
        """
        q, v = np.split(x, 2)
        leg = int(time >= maneuver.switch)
        target, speed = np.array(maneuver.target[leg]), np.array(maneuver.speed[leg])
        advance_leg(q, v, target, speed, self.acceleration, self._step)

    def brake(self, q: FloatArray, v: FloatArray, *, speed_fraction: float = 1.0) -> GuardDecision:
        """Returns the maneuver in which all joints brake to rest from positions q (n,) [rad] and
        velocities v (n,) [rad/s].

        Args:
            q, v: joint positions and velocities.
            speed_fraction: maximum joint speeds, as a fraction of those of maneuvers.
        """
        q_rest, speed = self.stop(q, v), speed_fraction * self.speed
        return GuardDecision("brake", 0.0, np.array([q_rest, q_rest]), np.array([speed, speed]))

    def _candidates(self, maneuvers: list[GuardDecision], inputs: GuardInputs) -> Legs:
        """Generates the candidate maneuvers of a decision: given ones, the return to the verified
        motion (checked by simulation), and random ones.

        Six candidates return: four at once, at different speeds, and two after 0.3 s and 0.6 s of
        braking. The target of a random maneuver is near the configuration in which the arm comes to
        rest, in all joints or in some; near the motion from there to the verified motion; or
        anywhere within the joint limits. About half of the random maneuvers return to the verified
        motion in the second leg.

        Args:
            maneuvers: first candidates: the active maneuver, if any, and braking.
            inputs: state of the arm, scene and verified motion for the guard's decision.
        """
        p, max_speed = self._parameters, self.speed * inputs.speed_fraction
        q_rest, q_path = self.stop(inputs.q, inputs.v), inputs.q_path
        rows = [(m.target, m.speed, m.switch - inputs.begin) for m in maneuvers]
        fastest = _synchronized_speeds(inputs.q, q_path, max_speed, 1.0)
        begin = np.array([inputs.q, inputs.q + self._step * np.sign(q_path - inputs.q) * fastest])
        for fraction in (self._slow_fraction(begin), *_RETURN_FRACTIONS):
            speed = _synchronized_speeds(inputs.q, q_path, max_speed, fraction)
            rows.append((np.array([q_path, q_path]), np.array([speed, speed]), math.inf))
        speed = np.array([max_speed, _synchronized_speeds(q_rest, q_path, max_speed, 0.9)])
        rows += [(np.array([q_rest, q_path]), speed, wait) for wait in (0.3, 0.6)]
        rng = np.random.default_rng([p.seed, inputs.decision_count])
        N, n = max(p.candidates - len(rows), 0), len(q_rest)
        kind = rng.integers(len(_SPREADS), size=(N, 1))
        spread = np.choose(kind, [rng.choice(spreads, (N, 1)) for spreads in _SPREADS])
        is_moved = (kind != 1) | (rng.random((N, n)) < 0.5)
        center = q_rest + (kind == 2) * rng.uniform(0.0, 0.6, (N, 1)) * (q_path - q_rest)
        target = center + spread * is_moved * rng.normal(size=(N, n))
        anywhere = rng.uniform(self._lower, self._upper, (N, n))
        target = np.clip(np.where(kind == 3, anywhere, target), self._lower, self._upper)
        fractions = rng.choice([0.5, 1.0], (N, 1))
        return_speed = _synchronized_speeds(target, q_path, max_speed, fractions)
        returns = rng.random((N, 1)) < 0.5
        targets = np.stack([target, np.where(returns, q_path, target)], axis=1)
        return_speed = np.where(returns, return_speed, max_speed)
        speeds = np.stack([np.broadcast_to(max_speed, (N, n)), return_speed], axis=1)
        switch = np.where(returns[:, 0], rng.uniform(0.1, 0.9, N), math.inf)
        first = [np.array(column) for column in zip(*rows, strict=True)]
        return Legs(*map(np.concatenate, zip(first, (targets, speeds, switch), strict=True)))

    def _slow_fraction(self, q: FloatArray) -> float:
        """Computes the factor that slows a motion down so that no point of the arm is faster than
        0.9 `v_unseen`, with the maximum speed `v_unseen` toward unobserved space; at most 0.9.

        Args:
            q: (2, n) configurations of the motion before it is slowed down, one time step apart
                [rad].
        """
        step = np.diff(sphere_centers(self._chain, self._arm_spheres.arrays, q), axis=0)
        point_speed = float(np.linalg.norm(step, axis=2).max()) / self._step
        return _SLOW_FRACTION * min(1.0, self._parameters.v_unseen / max(point_speed, 1e-9))

    def _refine(self, legs: Legs, cost: FloatArray, inputs: GuardInputs) -> Legs:
        """Generates random variations of the eight maneuvers of least cost, as further candidates
        of a decision.

        Args:
            legs: N candidate maneuvers.
            cost: (N,) costs of the maneuvers [s].
            inputs: state of the arm, scene and verified motion for the guard's decision.
        """
        rng = np.random.default_rng([self._parameters.seed, inputs.decision_count, 1])
        N, n = self._parameters.refinements, len(inputs.q)
        parents = legs.rows(np.resize(cost.argsort()[:_N_PARENTS], N))
        first, last = parents.target.swapaxes(0, 1)
        target = first + rng.normal(size=(N, n)) * rng.choice([0.05, 0.2], (N, 1))
        target = np.clip(target, self._lower, self._upper)
        last = np.where((first == last).all(axis=1, keepdims=True), target, last)
        switch = np.maximum(parents.switch + 0.1 * rng.normal(size=N), 0.0)
        return Legs(np.stack([target, last], axis=1), parents.speed, switch)


def _evasion(legs: Legs, k: int) -> GuardDecision:
    """Returns maneuver k of N maneuvers as a decision of the motion guard with the action "evade".

    Args:
        legs: N maneuvers, with simulation times [s] as switch times.
        k: index of the maneuver.
    """
    return GuardDecision("evade", 0.0, legs.target[k], legs.speed[k], float(legs.switch[k]))


def _synchronized_speeds(
    q: FloatArray, target: FloatArray, speed: FloatArray, fraction: FloatArray | float
) -> FloatArray:
    """Computes joint speeds (..., n) [rad/s] at which all joints of the arm reach a target at the
    same time; at least 0.02 rad/s.

    Args:
        q, target: (..., n) current and target configuration [rad].
        speed: (n,) maximum joint speeds [rad/s].
        fraction: ratio of the result to the highest such speeds, in (0, 1].
    """
    distance = np.abs(target - q)
    seconds = np.maximum((distance / speed).max(axis=-1, keepdims=True), 1e-3) / fraction
    return np.asarray(np.clip(distance / seconds, 0.02, speed))


def _sample_motion(motion: PlannedMotion) -> FloatArray:
    """Returns about 80 configurations (M, n), or all if there are fewer, along a planned motion of
    the arm [rad].
    """
    return motion.q[:: max(len(motion.q) // 80, 1)]


def achievable_distance(required: float, present: FloatArray) -> FloatArray:
    """Computes the distances between arm and obstacles, or between links, that are required in a
    maneuver. Where the present distance is small, the required distance is reduced.

    r(d) = min(r_0, max(d - 2 mm, min(d, r_0 / 2))): close to r_0, a maneuver may reduce the
    distance by 2 mm, but no sequence of maneuvers reduces it below r_0 / 2.

    Args:
        required: distance r_0 that is required if the present one is larger [m].
        present: (...) present distances d [m].

    Returns:
        (...) required distances r(d) [m].
    """
    least = np.minimum(present - _ROUNDING, 0.5 * required)
    return np.minimum(required, np.maximum(present - _DISTANCE_SLACK, least))


class _GuardModel:
    """Collision models of one decision of the motion guard: one model for resting and one for
    moving obstacles.

    The required clearance is 4 mm from resting obstacles, and 12 mm plus `padding` from moving
    ones, with their position uncertainty `padding`. It is reduced where the arm is already closer
    in the current configuration q_now. It is also reduced where the verified motion (checked by
    simulation) passes closer to resting obstacles. The arm is covered by spheres in groups, one
    group per body. Let d_gk(q) be the distance of group g to geometry k, and protrusion_g the
    distance by which the spheres extend beyond their body. The required clearances are

        resting:  min( r(d_gk(q_now)),
                       max( min over verified motion of d_gk - 5 mm, -protrusion_g ) )
        moving:   min( padding + 12 mm, d_gk(q_now) - 2 mm )

    with r(d) = min(r_0, max(d - 2 mm, min(d, r_0 / 2))) for r_0 = 4 mm. Between links the required
    distance is the smaller of r(d), for r_0 = 5 mm and the smaller distance d at q_now and at the
    verified configuration, and of the minimum distance along the verified motion minus 2 mm.

    Attributes:
        inputs: state of the arm, scene and verified motion for the guard's decision.
        resting, moving: collision models with these required clearances.
    """

    def __init__(
        self,
        chain: Chain,
        arm_spheres: ArmSpheres,
        inputs: GuardInputs,
        padding: float,
        verified_self_distance: float,
    ) -> None:
        """Computes the required clearances, and builds both collision models.

        Args:
            chain, arm_spheres: kinematics of the arm, and spheres that cover it.
            inputs: state of the arm, scene and verified motion for the guard's decision.
            padding: position uncertainty of moving obstacles [m].
            verified_self_distance: minimum distance between links along the verified motion [m].
        """
        self.inputs = inputs
        spheres, geometries = arm_spheres.arrays, inputs.scene.geometries
        is_moving = geometries.moving
        self._distances = group_distances(
            chain, spheres, geometries, np.array(inputs.q)[None], inputs.begin, math.inf
        )
        is_fixed = spheres.group_joint < 0
        resting = achievable_distance(_RESTING_CONTACT_DISTANCE, self._distances)
        path = _sample_motion(inputs.motion).reshape(-1, len(inputs.q))
        path = np.ascontiguousarray(np.vstack([inputs.q_path[None], path]))
        max_distance = _RESTING_CONTACT_DISTANCE + 0.1
        verified_distances = group_distances(
            chain, spheres, geometries, path, inputs.begin, max_distance
        )
        resting = np.minimum(
            resting,
            np.maximum(verified_distances - _VERIFIED_SLACK, -arm_spheres.protrusion[:, None]),
        )
        resting[:, is_moving] = -np.inf
        moving = np.minimum(padding + _MOVING_CONTACT_DISTANCE, self._distances - _DISTANCE_SLACK)
        moving[:, ~is_moving] = -np.inf
        resting[is_fixed] = moving[is_fixed] = -np.inf
        present = [self_distance(chain, spheres, np.array(q)) for q in (inputs.q, inputs.q_path)]
        of_self = float(achievable_distance(_SELF_CLEARANCE, np.array(min(present))))
        of_self = min(of_self, verified_self_distance - _DISTANCE_SLACK)
        is_tool = np.zeros(len(is_fixed), dtype=bool)
        self.resting, self.moving = (
            ArmCollisionModel(chain, spheres, geometries, required, inputs.begin)
            for required in (
                ClearanceRequirements(resting, of_self, is_tool),
                ClearanceRequirements(moving, -np.inf, is_tool),
            )
        )
        self._is_moving, self._is_fixed = is_moving, is_fixed

    @cached_property
    def nearest(self) -> str:
        """Label of the moving obstacle that is nearest to the arm in its current configuration; "":
        no obstacle moves.
        """
        if not self._is_moving.any():
            return ""
        distances = self._distances[~self._is_fixed].min(axis=0, initial=math.inf)
        row = int(np.where(self._is_moving, distances, np.inf).argmin())
        return self.inputs.scene.labels[row]
