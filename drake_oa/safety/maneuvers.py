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
from functools import cached_property, lru_cache
from typing import Literal, get_args

import numpy as np

from drake_oa.common.latency import count
from drake_oa.common.messages import FloatArray, Frozen, PlannedMotion, zeros
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
from drake_oa.robot.spheres import ArmSpheres
from drake_oa.safety.config import GuardParameters
from drake_oa.safety.joint_motions import (
    Judged,
    Legs,
    advance_leg,
    check_motions,
    roll_out_legs,
)
from drake_oa.safety.passive_safety import CLAIMS, Claim, violated_claim

Action = Literal["follow", "slow", "wait", "evade", "brake"]
ACTIONS: tuple[Action, ...] = get_args(Action)

_FOLLOWED: tuple[tuple[Action, float], ...] = (
    ("follow", 1.0), ("slow", 0.6), ("slow", 0.3), ("slow", 0.15), ("wait", 0.0),
)  # fmt: skip
"""Actions, and shares of full speed, by which the verified motion is tried."""
HORIZON, _SAMPLES = 1.4, 28
"""Time over which motions are predicted [s], and configurations of each that are judged."""
_CONTACT, _NEAR_MOVING, _NEAR_RESTING = 60.0, 6.0, 2.0
"""Weights w_c, w_m and w_r of the cost."""
_TURN, _TURN_EVERY = 0.1, 2
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
_INSIDE = 0.03
"""Distance of targets to the joints' limits [rad]."""
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
    def action_number(self) -> int:
        """Row of `ACTIONS`."""
        return ACTIONS.index(self.action)

    @property
    def claim_number(self) -> int:
        """Row of `CLAIMS`."""
        return CLAIMS.index(self.claim)

    @property
    def follows(self) -> bool:
        """Whether the verified motion is followed."""
        return not len(self.target)


@dataclass(frozen=True, eq=False)
class GuardInputs(Frozen):
    """Input of a decision.

    Attributes:
        begin: time at which the decision comes into force [s].
        q, v: (n,) joint state at that time [rad, rad/s].
        q_path: (n,) configuration on the verified motion at its phase [rad].
        on_path: whether the arm is there.
        s: normalized time of the verified motion.
        rate, full_rate: ds/dt now and at full speed [1/s].
        motion: the verified motion.
        scene: collision geometry of the world.
        free_space: space that the cameras saw free; None: all outside the solids.
        speed_fraction: share of the speed limits that the arm may use.
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
    scene: CollisionScene
    speed_fraction: float
    number: int
    free_space: FreeSpace | None


class GuardSearch:
    """Selection of joint motions among moving obstacles."""

    def __init__(
        self,
        chain: Chain,
        covered: ArmSpheres,
        *,
        config: Policy,
        period: float,
        padding: float,
        turn_limit: float | None,
        parameters: GuardParameters,
    ) -> None:
        """Keeps the constants.

        Args:
            chain, covered: the arm.
            config: of the policy.
            period: time between decisions [s].
            padding: distance by which moving obstacles may be nearer than observed [m].
            turn_limit: maximum angle by which a maneuver turns the tool [rad]; None: any.
            parameters: of the search.
        """
        self._turn_limit = math.pi if turn_limit is None else turn_limit
        self._chain, self._covered = chain, covered
        self._step, self._hold_time = config.period, config.hold_time
        self._padding, self._parameters = padding, parameters
        self._every = max(round(HORIZON / _SAMPLES / self._step), 1)
        self._interval = self._every * self._step
        self._times = self._interval * np.arange(1, _SAMPLES + 1)
        self._until_next = math.ceil(period / self._interval)
        self.acceleration = np.full(len(chain.speed), parameters.acceleration)
        self.speed = chain.speed * parameters.speed_fraction
        self._lower, self._upper = chain.lower + _INSIDE, chain.upper - _INSIDE
        # Of a verified motion, which is the same for many decisions.
        self._own = lru_cache(maxsize=2)(
            lambda motion: min(
                (self_distance(chain, covered.arrays, np.array(q)) for q in _samples(motion)),
                default=math.inf,
            )
        )

    def decide(self, before: GuardDecision, inputs: GuardInputs) -> GuardDecision:
        """Selects the motion from `inputs.begin` on.

        Args:
            before: motion in use.
            inputs: input.
        """
        look = _Look(self._chain, self._covered, inputs, self._padding, self._own(inputs.motion))
        moves = inputs.scene.moves
        followed = GuardDecision()
        if inputs.on_path:
            ahead = self._followed(inputs, 1.0)
            free = self._evaluator(look, ahead[None])
            contact = inputs.begin + float(free.first[0])
            followed = replace(followed, contact=contact, obstacle=look.nearest)
            clear = free.contact[0] == 0.0 and free.near_moving[0] <= _CLEAR
            if clear and not self._violated(ahead, inputs):
                return followed
        options = [GuardDecision(*tried) for tried in _FOLLOWED if inputs.on_path]
        followings, first = [self._followed(inputs, one.scale) for one in options], len(options)
        q = np.array(followings).reshape(-1, _SAMPLES, len(inputs.q))
        if moves or not inputs.on_path:
            legs = self._maneuvers(before, inputs)
            options += legs
            q = np.concatenate([q, self._rolled(legs, inputs)])
        judged = self._evaluator(look, q)
        cost = self._cost(judged, options, q, inputs)
        if not before.follows and len(options) > first:
            # The first maneuver is the one in use.
            back = float((np.abs(inputs.q - inputs.q_path) / self.speed).max())
            cost[first] -= _HYSTERESIS * min(1.0, 2.0 * back)
        if moves or not inputs.on_path:
            better = self._refined(options, cost, inputs)
            q_better = self._rolled(better, inputs)
            q = np.concatenate([q, q_better])
            judged_better = self._evaluator(look, q_better)
            cost = np.append(cost, self._cost(judged_better, better, q_better, inputs))
            options += better
        chosen = self._selected(look, options, q, cost)
        return replace(chosen, contact=followed.contact)

    def _selected(
        self,
        look: _Look,
        options: list[GuardDecision],
        q: FloatArray,
        cost: FloatArray,
    ) -> GuardDecision:
        """Returns the motion of least cost, that of violated claims included.

        Args:
            look: the arm among the solids.
            options: N motions.
            q: (N, T, n) configurations along them [rad].
            cost: (N,) without claims [s].
        """
        inputs, least = look.inputs, math.inf
        claim: Claim = ""
        chosen = self.brake(inputs.q, inputs.v)
        brakes = [row for row, option in enumerate(options) if option.action == "brake"]
        for row in [*cost.argsort()[:_TRIES].tolist(), *brakes]:
            if cost[row] >= least:
                continue
            violated = self._violated(q[row], inputs)
            claim = claim or violated
            if cost[row] + _VIOLATION[violated] < least:
                least = cost[row] + _VIOLATION[violated]
                chosen = options[row]
        return replace(chosen, claim=claim, obstacle=look.nearest)

    def _violated(self, q: FloatArray, inputs: GuardInputs) -> Claim:
        """Returns the claim that a motion q (T, n) violates that is braked after one period."""
        p, m = self._parameters, self._until_next
        if p.obstacle_speed == 0.0:
            return ""
        follows = np.vstack([inputs.q, q[: m + 1]])
        v = (follows[m + 1] - follows[m]) / self._interval
        stop = self.brake(follows[m], v)
        legs = Legs(stop.target[None], stop.speed[None], np.array([math.inf]))
        rest = roll_out_legs(
            np.array(follows[m]), v, legs, self.acceleration, self._step, self._every,
            _REST,
        )  # fmt: skip
        t = inputs.begin + self._interval * np.arange(float(m + 1 + _REST))
        course = np.concatenate([follows[: m + 1], rest[0]])
        count(configurations=len(course))
        return violated_claim(
            self._chain, self._covered.arrays, t, course, inputs.scene, inputs.free_space,
            V=p.obstacle_speed, v_unseen=p.v_unseen,
        )  # fmt: skip

    def _evaluator(self, look: _Look, q: FloatArray) -> Judged:
        margin = self._parameters.margin_moving
        return check_motions(look.resting, look.moving, q, self._interval, margin)

    def _cost(
        self, judged: Judged, options: list[GuardDecision], q: FloatArray, inputs: GuardInputs
    ) -> FloatArray:
        """Returns the costs (N,) of motions q (N, T, n) [s]."""
        horizon = self._times[-1]
        cost = _CONTACT * judged.contact + _NEAR_MOVING * judged.near_moving
        cost = cost + _NEAR_RESTING * judged.near_resting
        away = np.abs(q - inputs.q_path) / self.speed
        turn = self._turns(q, inputs)
        for row, option in enumerate(options):
            if option.follows:
                rates = self._rates(inputs, option.scale)
                cost[row] += horizon - float(rates.sum()) * self._interval / inputs.full_rate
            else:
                back = away[row].max(axis=1)
                left = back[-1] + 0.3 * away[row, -1].mean()
                cost[row] += horizon + left + float(back.sum()) * self._interval
                cost[row] += _TURN * horizon * turn[row].mean()
                if turn[row, 1:].max() > max(self._turn_limit, turn[row, 0]) + _SLACK:
                    cost[row] = math.inf
        return np.asarray(cost)

    def _turns(self, q: FloatArray, inputs: GuardInputs) -> FloatArray:
        """Returns angles (N, 1 + T / 2) of the tool to its orientation on the verified motion.

        The first is that of `inputs.q`, the others those along motions q (N, T, n) [rad].
        """
        n = q.shape[2]
        some = np.insert(q[:, _TURN_EVERY - 1 :: _TURN_EVERY], 0, inputs.q, axis=1)
        postures = np.vstack([some.reshape(-1, n), inputs.q_path])
        R_WE = tool_poses(self._chain, postures)[:, :9]
        count(steps=len(postures))
        cosine = 0.5 * (R_WE[:-1] @ R_WE[-1] - 1.0)
        return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)).reshape(len(q), -1))

    # --- candidates ------------------------------------------------------------------------

    def _rates(self, inputs: GuardInputs, scale: float) -> FloatArray:
        """Returns the rates ds/dt (T,) while the phase goes over to a share of full speed."""
        change = inputs.full_rate / self._hold_time * self._times
        wanted = scale * inputs.full_rate
        return inputs.rate + np.clip(wanted - inputs.rate, -change, change)

    def _followed(self, inputs: GuardInputs, scale: float) -> FloatArray:
        """Returns configurations (T, n) along the verified motion at a share of its speed."""
        motion = inputs.motion
        if not len(motion.q):
            return np.tile(inputs.q, (_SAMPLES, 1))
        s = inputs.s + self._interval * np.cumsum(self._rates(inputs, scale))
        away = inputs.q - motion.joints(inputs.s)
        return np.asarray(motion.joints(s) + np.exp(-_SETTLED * self._times)[:, None] * away)

    def _rolled(self, options: list[GuardDecision], inputs: GuardInputs) -> FloatArray:
        """Returns configurations (N, T, n) along maneuvers."""
        legs = Legs(
            np.stack([option.target for option in options]),
            np.stack([option.speed for option in options]),
            np.array([option.switch - inputs.begin for option in options]),
        )
        count(steps=len(options) * _SAMPLES * self._every)
        return roll_out_legs(
            np.array(inputs.q), np.array(inputs.v), legs, self.acceleration, self._step, self._every,
            _SAMPLES,
        )  # fmt: skip

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
        q, v = np.split(x, 2)
        leg = int(time >= maneuver.switch)
        target, speed = np.array(maneuver.target[leg]), np.array(maneuver.speed[leg])
        advance_leg(q, v, target, speed, self.acceleration, self._step)

    def brake(self, q: FloatArray, v: FloatArray) -> GuardDecision:
        """Returns the maneuver that brings the arm to rest from a joint state (n,), (n,)."""
        return _legs("brake", self.stop(q, v), self.speed)

    def _maneuvers(self, before: GuardDecision, inputs: GuardInputs) -> list[GuardDecision]:
        """Returns maneuvers, the one in use first if there is one."""
        p, begin = self._parameters, inputs.begin
        rng = np.random.default_rng([p.seed, inputs.number])
        full = self.speed * inputs.speed_fraction
        rest, path = self.stop(inputs.q, inputs.v), inputs.q_path
        found = [] if before.follows else [before]
        found.append(_legs("brake", rest, full))
        found += [
            _legs("evade", path, _synchronized(inputs.q, path, full, share))
            for share in (1.0, 0.6, 0.3, 0.12)
        ]
        for wait in (0.3, 0.6):
            back = _synchronized(rest, path, full, 0.9)
            found.append(_legs("evade", rest, full, path, back, begin + wait))
        n = len(rest)
        while len(found) < p.candidates:
            kind = rng.integers(4)
            if kind == 0:
                target = rest + rng.normal(size=n) * rng.choice([0.15, 0.4, 0.9])
            elif kind == 1:
                turned = rng.random(n) < 0.5
                target = rest + turned * rng.normal(size=n) * rng.choice([0.4, 1.0])
            elif kind == 2:
                target = rng.uniform(self._lower, self._upper)
            else:
                target = rest + rng.uniform(0.0, 0.6) * (path - rest)
                target = target + rng.normal(size=n) * rng.choice([0.2, 0.5])
            target = np.clip(target, self._lower, self._upper)
            if rng.random() < 0.5:
                found.append(_legs("evade", target, full))
            else:
                back = _synchronized(target, path, full, rng.choice([0.5, 1.0]))
                switch = begin + rng.uniform(0.1, 0.9)
                found.append(_legs("evade", target, full, path, back, switch))
        return found

    def _refined(
        self, options: list[GuardDecision], cost: FloatArray, inputs: GuardInputs
    ) -> list[GuardDecision]:
        """Returns variations of the best maneuvers."""
        rng = np.random.default_rng([self._parameters.seed, inputs.number, 1])
        ranked = [int(row) for row in np.argsort(cost) if not options[row].follows]
        n, found = len(inputs.q), []
        for i in range(self._parameters.refinements):
            parent = options[ranked[i % min(_PARENTS, len(ranked))]]
            target = parent.target[0] + rng.normal(size=n) * rng.choice([0.05, 0.2])
            target = np.clip(target, self._lower, self._upper)
            is_single = bool((parent.target[0] == parent.target[1]).all())
            last = target if is_single else parent.target[1]
            switch = parent.switch
            if math.isfinite(switch):
                switch = max(inputs.begin, switch + 0.1 * rng.normal())
            found.append(_legs("evade", target, parent.speed[0], last, parent.speed[1], switch))
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
    if last is None or last_speed is None:
        last, last_speed = first, speed
    return GuardDecision(
        action, 0.0, np.array([first, last]), np.array([speed, last_speed]), switch
    )


def _synchronized(q: FloatArray, target: FloatArray, speed: FloatArray, share: float) -> FloatArray:
    """Returns speeds (n,) at which all joints arrive together, at a share of the fastest."""
    way = np.abs(target - q)
    seconds = max(float((way / speed).max()), 1e-3) / share
    return np.asarray(np.clip(way / seconds, 0.02, speed))


def _samples(motion: PlannedMotion) -> FloatArray:
    """Returns up to about 80 configurations (M, n) along a motion [rad]."""
    return motion.q[:: max(len(motion.q) // 80, 1)]


class _Look:
    """Arm among the solids of one observation, with the clearances required of both kinds."""

    def __init__(
        self,
        chain: Chain,
        covered: ArmSpheres,
        inputs: GuardInputs,
        padding: float,
        least_own: float,
    ) -> None:
        """Computes the required clearances.

        Of group g and resting solid k: the least of `_TOUCH_RESTING`, the present distance less
        a slack, and what the verified motion keeps less a slack, or the depth by which the
        spheres stick out if that is less; likewise of the arm to itself, `least_own` being what the
        verified motion keeps. Of moving solids: `padding + _TOUCH_MOVING`, or the
        present distance less a slack.
        """
        self.inputs = inputs
        spheres, geometries = covered.arrays, inputs.scene.geometries
        moves = geometries.moving
        self._now = group_distances(
            chain, spheres, geometries, np.array(inputs.q)[None], inputs.begin, math.inf
        )
        fixed = spheres.group_joint < 0
        rest = np.minimum(_TOUCH_RESTING, self._now - _SLACK)
        path = _samples(inputs.motion).reshape(-1, len(inputs.q))
        path = np.ascontiguousarray(np.vstack([inputs.q_path[None], path]))
        most = _TOUCH_RESTING + 0.1
        kept = group_distances(chain, spheres, geometries, path, inputs.begin, most)
        rest = np.minimum(rest, np.maximum(kept - _KEPT, -covered.protrusion[:, None]))
        rest[:, moves] = -np.inf
        near = np.minimum(padding + _TOUCH_MOVING, self._now - _SLACK)
        near[:, ~moves] = -np.inf
        rest[fixed] = near[fixed] = -np.inf
        own = [float(self_distance(chain, spheres, np.array(q))) for q in (inputs.q, inputs.q_path)]
        of_self = min(_SELF, min(own) - 1e-3, least_own - _SLACK)
        tool = np.zeros(len(fixed), dtype=bool)
        self.resting = ArmCollisionModel(
            chain, spheres, geometries, ClearanceRequirements(rest, of_self, tool), inputs.begin
        )
        self.moving = ArmCollisionModel(
            chain, spheres, geometries, ClearanceRequirements(near, -np.inf, tool), inputs.begin
        )
        self._moves, self._fixed = moves, fixed

    @cached_property
    def nearest(self) -> str:
        """Label of the moving solid that is nearest to the arm now; "": none moves."""
        if not self._moves.any():
            return ""
        distance = self._now[~self._fixed].min(axis=0, initial=math.inf)
        row = int(np.where(self._moves, distance, np.inf).argmin())
        return self.inputs.scene.labels[row]
