"""Decisions of the motion guard: whole-arm joint motions in time among moving obstacles.

Each decision compares joint motions over a horizon of 1.4 s: the verified motion at several shares
of its speed (follow, slow, wait), and maneuvers of two legs that leave it: brake, returns,
refuges, via points, and refinements of the best of them. The one with the least cost

    J = w_c contact + w_m near_moving + w_r near_resting + w_o turn + lost

is selected, with hysteresis for the motion in use: `turn` is the integral of the angle by which the
tool is turned away from the verified motion, `lost` the time by which the arm arrives later on it.
Obstacles move at constant velocity; the margin to them grows with time. Every motion ends at rest:
the phase of a followed motion stops within `hold_time`, and each leg of a maneuver ends at its
target.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, get_args

import numpy as np

from drake_oa.common.messages import FloatArray, Frozen, PlannedMotion, zeros
from drake_oa.common.thinking import count
from drake_oa.geometry.solids import SolidScene
from drake_oa.perception.depth_perception import FreeSpace
from drake_oa.planning.arm_world import ArmWorld, Asked, group_distances, self_distance
from drake_oa.robot.arm import tool_poses
from drake_oa.safety.config import GuardParameters
from drake_oa.safety.guarded_arm import GuardedArm
from drake_oa.safety.joint_motions import judge_motions, roll_out_legs
from drake_oa.safety.passive_safety import Claim, violated_claim

Action = Literal["follow", "slow", "wait", "evade", "brake"]
ACTIONS: tuple[Action, ...] = get_args(Action)

_SCALES: dict[float, Action] = {1.0: "follow", 0.6: "slow", 0.3: "slow", 0.15: "slow", 0.0: "wait"}
"""Shares of full speed at which the verified motion is tried."""
HORIZON, _SAMPLES = 1.4, 28
"""Time over which motions are predicted [s], and configurations of each that are judged."""
_CONTACT, _NEAR_MOVING, _NEAR_RESTING = 60.0, 6.0, 2.0
"""Weights w_c, w_m and w_r of the cost."""
_TURN, _TURN_EVERY = 0.1, 4
"""Weight w_o [1/rad], and number of samples from one tool pose to the next."""
_HYSTERESIS = 0.1
"""Delay by which another maneuver must be better than the one in use [s]."""
_TOUCH_MOVING, _TOUCH_RESTING = 0.012, 0.004
"""Distances to moving and resting obstacles below which a motion counts as contact, unless the
verified motion keeps less [m]."""
_SLACK = 2e-3
"""Distance by which the arm may come nearer to anything than it is or would be on its path [m], and
angle by which the tool may turn farther than its limit or than it is turned [rad]."""
_KEPT = 5e-3
"""Distance by which the verified motion may come nearer than it was verified to [m]."""
_SELF = 5e-3
"""Required distance of the arm to itself [m]."""
_CLEAR = 0.02
"""Cost of nearness up to which the verified motion is followed without alternatives [s]."""
_SETTLED = 4.0
"""Rate at which an offset from the verified motion decays [1/s]."""
_INSIDE, _AT_LIMIT = 0.03, 1e-3
"""Distance of targets to the joints' limits, and distance beyond a limit that is only an error of
interpolation [rad]."""
_PARENTS = 8
"""Number of motions that are refined."""
_TRIES = 40
"""Number of motions of least cost that are checked for passive motion safety."""
_VIOLATION: dict[Claim, float] = {"": 0.0, "A": 6.0, "B": 4.0}
"""Costs of the violation of a claim, less than that of any predicted contact [s]."""
_REST = 8
"""Samples after a period in which the arm brakes."""
ARRIVED, AT_REST = 0.01, 0.1
"""Largest distance [rad] and speed [rad/s] of the joints at which the path is followed again."""


@dataclass(frozen=True, eq=False)
class GuardDecision(Frozen):
    """Motion that the guard has selected.

    Attributes:
        action: "follow" the verified motion; "slow": follow it at a fraction of its speed; "wait":
            let its phase rest; "evade": leave it by a maneuver; "brake": come to rest.
        scale: share of full speed at which the phase runs.
        target: (2, n) ends of the two legs of a maneuver [rad]; (0, n): the motion is followed.
        speed: (2, n) limits of the joint speeds in the legs [rad/s].
        switch: time at which the second leg begins [s].
        contact: time of the first contact that is predicted on the verified motion at full speed
            [s]; inf: none is.
        obstacle: label of the moving obstacle that is nearest; "": none moves.
        claim: claim of passive motion safety that a motion of less cost would violate; "": none.
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
    def follows(self) -> bool:
        """Whether the verified motion is followed."""
        return not len(self.target)


@dataclass(frozen=True, eq=False)
class GuardSight(Frozen):
    """Input of a decision.

    Attributes:
        begin: time at which the decision comes into force [s].
        q, v: (n,) joint state at that time [rad, rad/s].
        q_path: (n,) configuration on the verified motion at its phase [rad].
        on_path: whether the arm is there.
        s: normalised time of the verified motion.
        rate, full_rate: ds/dt now and at full speed [1/s].
        motion: the verified motion.
        scene: collision geometry of the world.
        free_space: space that the cameras saw free; None: all outside the solids.
        speed_share: share of the speed limits that the arm may use.
        number: of this decision, which seeds its random candidates.
    """

    begin: float
    q: FloatArray
    v: FloatArray
    q_path: FloatArray
    on_path: bool
    s: float
    rate: float
    full_rate: float
    motion: PlannedMotion
    scene: SolidScene
    speed_share: float = 1.0
    number: int = 0
    free_space: FreeSpace | None = None


class GuardSearch:
    """Selection of joint motions among moving obstacles."""

    def __init__(
        self,
        arm: GuardedArm,
        *,
        step: float,
        hold_time: float,
        period: float,
        padding: float,
        turn_limit: float | None,
        parameters: GuardParameters,
    ) -> None:
        """Keeps the constants.

        Args:
            arm: the arm.
            step: time step of the commanded motion [s].
            hold_time: time in which the phase comes to rest from full speed [s].
            period: time between decisions [s].
            padding: distance by which moving obstacles may be nearer than observed [m].
            turn_limit: maximum angle by which a maneuver turns the tool [rad]; None: any.
            parameters: of the search.
        """
        self._turn_limit = math.pi if turn_limit is None else turn_limit
        self._arm, self._step, self._hold_time = arm, step, hold_time
        self._padding, self._parameters = padding, parameters
        self._every = max(round(HORIZON / _SAMPLES / step), 1)
        self._interval = self._every * step
        self._times = self._interval * np.arange(1, _SAMPLES + 1)
        self._until_next = math.ceil(period / self._interval)
        self.acceleration = parameters.acceleration
        self.speed = np.array(arm.chain.speed) * parameters.speed_share
        self._lower, self._upper = arm.chain.lower + _INSIDE, arm.chain.upper - _INSIDE

    def decide(self, before: GuardDecision, sight: GuardSight) -> GuardDecision:
        """Selects the motion from `sight.begin` on.

        Args:
            before: motion in use.
            sight: input.
        """
        look = self._look(sight)
        options = [GuardDecision(a, scale) for scale, a in _SCALES.items() if sight.on_path]
        claim: Claim = ""
        found, contact = self._evaluated(look, options), math.inf
        if found:
            contact = found[0].first
            is_clear = contact == math.inf and found[0].near_moving <= _CLEAR
            if is_clear and not self._violated(found[0].q, sight):
                return replace(found[0].motion, contact=contact, obstacle=look.nearest)
        if sight.scene.moves or not sight.on_path:
            legs = self._evaluated(look, self._maneuvers(before, sight))
            if not before.follows:
                # The first maneuver is the one in use.
                back = float((np.abs(sight.q - sight.q_path) / self.speed).max())
                bonus = _HYSTERESIS * min(1.0, 2.0 * back)
                legs[0] = legs[0]._replace(cost=legs[0].cost - bonus)
            found += legs + self._evaluated(look, self._refined(legs, sight))
        least, motion = math.inf, self.brake(sight.q, sight.v)
        for one in sorted(found, key=_cost)[:_TRIES]:
            if one.cost < least:
                violated = self._violated(one.q, sight)
                claim = claim or violated
                if one.cost + _VIOLATION[violated] < least:
                    least, motion = one.cost + _VIOLATION[violated], one.motion
        return replace(motion, contact=contact, claim=claim, obstacle=look.nearest)

    def _look(self, sight: GuardSight) -> _Look:
        """Computes the required clearances.

        Of group g and resting solid k: the least of `_TOUCH_RESTING`, the present distance less
        a slack, and what the verified motion keeps less a slack, or the depth by which the
        spheres stick out if that is less; likewise of the arm to itself. Of moving solids:
        `padding + _TOUCH_MOVING`, or the present distance less a slack.
        """
        arm, scene = self._arm, sight.scene
        chain, spheres, solids = arm.chain, arm.spheres, scene.solids
        moves, fixed = solids.moving, spheres.group_joint < 0
        now = group_distances(
            chain, spheres, solids, np.array(sight.q)[None], sight.begin, math.inf
        )
        # Up to about 80 configurations along the verified motion.
        q_motion = sight.motion.q[:: max(len(sight.motion.q) // 80, 1)]
        path = np.array([sight.q_path, *q_motion])
        most = _TOUCH_RESTING + 0.1
        kept = group_distances(chain, spheres, solids, path, sight.begin, most)
        rest = np.minimum(_TOUCH_RESTING, now - _SLACK)
        rest = np.minimum(rest, np.maximum(kept - _KEPT, -arm.overshoot[:, None]))
        near = np.minimum(self._padding + _TOUCH_MOVING, now - _SLACK)
        rest[:, moves] = near[:, ~moves] = -np.inf
        rest[fixed] = near[fixed] = -np.inf
        own = min(self_distance(chain, spheres, q) for q in (np.array(sight.q), *path))
        of_self = min(_SELF, own - _SLACK)
        tool = np.zeros(len(fixed), dtype=bool)
        nearest = ""
        if moves.any():
            distance = now[~fixed].min(axis=0, initial=math.inf)
            nearest = scene.labels[int(np.where(moves, distance, np.inf).argmin())]
        return _Look(
            sight,
            ArmWorld(chain, spheres, solids, Asked(rest, of_self, tool), sight.begin),
            ArmWorld(chain, spheres, solids, Asked(near, -np.inf, tool), sight.begin),
            nearest,
        )

    def _violated(self, q: FloatArray, sight: GuardSight) -> Claim:
        """Returns the claim that a motion q (T, n) violates that is braked after one period."""
        p, m = self._parameters, self._until_next
        if p.obstacle_speed == 0.0:
            return ""
        follows = np.vstack([sight.q, q[: m + 1]])
        v = (follows[m + 1] - follows[m]) / self._interval
        rest = self._rolled(self.brake(follows[m], v), follows[m], v, 0.0, _REST)
        course = np.concatenate([follows[: m + 1], rest])
        t = sight.begin + self._interval * np.arange(float(len(course)))
        count(configurations=len(t))
        return violated_claim(
            self._arm, t, course, sight.scene, sight.free_space, V=p.obstacle_speed,
            v_unseen=p.v_unseen,
        )  # fmt: skip

    def _evaluated(self, look: _Look, options: list[GuardDecision]) -> list[_Candidate]:
        """Rolls motions out, and computes their costs."""
        sight, horizon = look.sight, self._times[-1]
        q = np.empty((len(options), _SAMPLES, len(sight.q)))
        for row, option in enumerate(options):
            if option.follows:
                q[row] = self._followed(sight, option.scale)
            else:
                q[row] = self._rolled(option, sight.q, sight.v, sight.begin, _SAMPLES)
        judged = judge_motions(
            look.resting, look.moving, q, self._interval, self._parameters.margin_moving
        )
        cost = _CONTACT * judged.contact + _NEAR_MOVING * judged.near_moving
        cost = cost + _NEAR_RESTING * judged.near_resting + horizon
        chain, away = self._arm.chain, np.abs(q - sight.q_path) / self.speed
        beyond = np.maximum(chain.lower - q, q - chain.upper).max(axis=(1, 2), initial=0.0)
        cost[beyond > _AT_LIMIT] += _CONTACT
        turn, found = self._turns(q, sight), []
        for row, option in enumerate(options):
            lost = cost[row]
            if option.follows:
                rates = self._rates(sight, option.scale)
                lost -= float(rates.sum()) * self._interval / sight.full_rate
            else:
                back = away[row].max(axis=1)
                lost += back[-1] + 0.3 * away[row, -1].mean() + float(back.sum()) * self._interval
                lost += _TURN * horizon * turn[row].mean()
                if turn[row, 1:].max() > max(self._turn_limit, turn[row, 0]) + _SLACK:
                    lost = math.inf
            first = sight.begin + float(judged.first[row])
            found.append(_Candidate(option, q[row], lost, first, judged.near_moving[row]))
        return found

    def _turns(self, q: FloatArray, sight: GuardSight) -> FloatArray:
        """Returns angles (N, 1 + T / 4) of the tool to its orientation on the verified motion.

        The first is that of `sight.q`, the others those along motions q (N, T, n) [rad].
        """
        n = q.shape[2]
        some = np.insert(q[:, _TURN_EVERY - 1 :: _TURN_EVERY], 0, sight.q, axis=1)
        postures = np.vstack([some.reshape(-1, n), sight.q_path])
        R_WE = tool_poses(self._arm.chain, postures)[:, :9]
        count(steps=len(postures))
        cosine = 0.5 * (R_WE[:-1] @ R_WE[-1] - 1.0)
        return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)).reshape(some.shape[:2]))

    # --- candidates ------------------------------------------------------------------------

    def _rates(self, sight: GuardSight, scale: float) -> FloatArray:
        """Returns the rates ds/dt (T,) while the phase goes over to a share of full speed."""
        change = sight.full_rate / self._hold_time * self._times
        wanted = scale * sight.full_rate
        return sight.rate + np.clip(wanted - sight.rate, -change, change)

    def _followed(self, sight: GuardSight, scale: float) -> FloatArray:
        """Returns configurations (T, n) along the verified motion at a share of its speed."""
        motion = sight.motion
        if not len(motion.q):
            return np.tile(sight.q, (_SAMPLES, 1))
        s = sight.s + self._interval * np.cumsum(self._rates(sight, scale))
        away = sight.q - motion.joints(sight.s)
        return np.asarray(motion.joints(s) + np.exp(-_SETTLED * self._times)[:, None] * away)

    def _rolled(
        self, maneuver: GuardDecision, q: FloatArray, v: FloatArray, begin: float, samples: int
    ) -> FloatArray:
        """Returns configurations (samples, n) along a maneuver from a joint state at a time."""
        count(steps=samples * self._every)
        arrays = (np.array(of) for of in (q, v, maneuver.target, maneuver.speed))
        return roll_out_legs(
            *arrays, maneuver.switch - begin, self.acceleration, self._step, self._every, samples
        )

    def stop(self, q: FloatArray, v: FloatArray) -> FloatArray:
        """Returns the configuration (n,) in which full braking ends [rad]."""
        rest = q + np.sign(v) * v**2 / (2.0 * self.acceleration)
        return np.asarray(np.clip(rest, self._lower, self._upper))

    def advance(self, maneuver: GuardDecision, x: FloatArray, time: float) -> None:
        """Moves joints x (2n,) by a step of a maneuver, in place.

        Args:
            maneuver: with its two legs.
            x: positions [rad] and velocities [rad/s].
            time: beginning of the step [s].
        """
        legs = np.array(maneuver.target), np.array(maneuver.speed), maneuver.switch - time
        roll_out_legs(*np.split(x, 2), *legs, self.acceleration, self._step, 1, 1)

    def brake(self, q: FloatArray, v: FloatArray) -> GuardDecision:
        """Returns the maneuver that brings the arm to rest from a joint state (n,), (n,)."""
        return _legs("brake", self.stop(q, v), self.speed)

    def _maneuvers(self, before: GuardDecision, sight: GuardSight) -> list[GuardDecision]:
        """Returns maneuvers, the one in use first if there is one."""
        p, begin = self._parameters, sight.begin
        rng = np.random.default_rng([p.seed, sight.number])
        full = self.speed * sight.speed_share
        rest, path = self.stop(sight.q, sight.v), sight.q_path
        found = [] if before.follows else [before]
        found.append(_legs("brake", rest, full))
        found += [
            _legs("evade", path, _synchronized(sight.q, path, full, share))
            for share in (1.0, 0.6, 0.3, 0.12)
        ]
        while len(found) < p.candidates:
            target = rest + rng.choice([0.0, 0.6]) * rng.random() * (path - rest)
            target = target + rng.normal(size=len(rest)) * rng.choice([0.15, 0.4, 0.9])
            target = np.clip(target, self._lower, self._upper)
            back = _synchronized(target, path, full, rng.choice([0.5, 1.0]))
            switch = begin + rng.choice([rng.uniform(0.1, 0.9), math.inf])
            found.append(_legs("evade", target, full, path, back, switch))
        return found

    def _refined(self, maneuvers: list[_Candidate], sight: GuardSight) -> list[GuardDecision]:
        """Returns variations of the best maneuvers."""
        rng = np.random.default_rng([self._parameters.seed, sight.number, 1])
        best, found = sorted(maneuvers, key=_cost)[:_PARENTS], []
        for i in range(self._parameters.refinements):
            parent = best[i % len(best)].motion
            target = parent.target[0] + rng.normal(size=len(sight.q)) * rng.choice([0.05, 0.2])
            target = np.clip(target, self._lower, self._upper)
            switch = max(sight.begin, parent.switch + 0.1 * rng.normal())
            found.append(
                _legs("evade", target, parent.speed[0], parent.target[1], parent.speed[1], switch)
            )
        return found


def _legs(
    action: Action,
    first: FloatArray,
    speed: FloatArray,
    last: FloatArray | None = None,
    last_speed: FloatArray | None = None,
    switch: float = math.inf,
) -> GuardDecision:
    """Returns a maneuver of one leg, or of two."""
    target = np.stack([first, first if last is None else last])
    speeds = np.stack([speed, speed if last_speed is None else last_speed])
    return GuardDecision(action, 0.0, target, speeds, switch)


def _synchronized(q: FloatArray, target: FloatArray, speed: FloatArray, share: float) -> FloatArray:
    """Returns speeds (n,) at which all joints arrive together, at a share of the fastest."""
    way = np.abs(target - q)
    seconds = max(float((way / speed).max()), 1e-3) / share
    return np.asarray(np.clip(way / seconds, 0.02, speed))


class _Candidate(NamedTuple):
    """Motion with its prediction.

    Attributes:
        motion: the decision.
        q: (T, n) configurations along it [rad].
        cost: without violated claims [s].
        first: time of the first contact [s]; inf: there is none.
        near_moving: cost of nearness to moving obstacles [s].
    """

    motion: GuardDecision
    q: FloatArray
    cost: float
    first: float
    near_moving: float


def _cost(candidate: _Candidate) -> float:
    return candidate.cost


class _Look(NamedTuple):
    """Arm among the solids of one observation.

    Attributes:
        sight: input of the decision.
        resting, moving: the arm, with the clearances required of both kinds of solids.
        nearest: label of the moving solid that is nearest to the arm now; "": none moves.
    """

    sight: GuardSight
    resting: ArmWorld
    moving: ArmWorld
    nearest: str
