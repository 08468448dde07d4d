"""Contacts of a finished run: closing speeds, and whether they could have been avoided.

A contact of a link with an object lasts until they have been apart for 0.1 s. Its speeds are those
of the arm's contact point along the contact normal, positive into the object, at the logged
velocities of one instant before: at the instant itself the impact has already changed them.

- Avoidable by physics: at least one of 500 bang motions from the logged joint state 0.2 s before
  the contact stays clear of all true solids and of the arm itself until 1.5 s after it
  (`true_world`: enclosing spheres, limits of position, velocity and acceleration). A motion has one
  or two legs, each time-optimal to a random configuration. What is found is a proof, its lack none.
- Avoidable by view: in the 0.2 s until the deadline an observation had arrived with the obstacle's
  velocity within 20 % of the true one. The deadline is 0.1 s before the latest of those leads from
  which there is such a motion.

A contact that begins within 1 s of another one has the verdicts of the first of them: by then the
arm is pressed.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.evaluation.panda.scene_parts import bounding_ball
from drake_oa.evaluation.panda.true_world import STEP, TrueWorld, bang_motions, clear_steps
from drake_oa.runs.metrics import ClearanceEvaluator, clearance_evaluator
from drake_oa.runs.motion_log import MotionLog
from drake_oa.scenario.end_poses import end_positions
from drake_oa.scenario.obstacles import OBSTACLE_PREFIX, Obstacle, last_change
from drake_oa.scenario.scenario import Scenario

MOTIONS = 500
"""Number of bang motions from a state."""
LEAD, LEADS = 0.2, (0.05, 0.1, 0.2, 0.3, 0.5)
"""Times before a contact from which they are tried: for `avoidable_by_physics`, and all [s]."""
AFTER = 1.5
"""Time after a contact until which they are to stay clear [s]."""
WARNING = 0.1
"""Time from the deadline for the obstacle's velocity to the latest escape [s]."""
RECENT = 0.2
"""Time before the deadline from which on a known velocity counts [s]."""
KNOWN = 0.2
"""Maximum error of a known velocity, as a share of the true one."""
AT_REST = 0.02
"""Speed of the joints below which the arm rests, and error of a velocity that counts as none
[rad/s, m/s]."""
_APART = 0.1
"""Time apart after which a pair's next touch is another contact [s]."""
_SAME_EVENT = 1.0
"""Time after a contact within which others have its verdicts [s]."""


def contact_events(scenario: Scenario, log: MotionLog, world: TrueWorld) -> list[dict[str, Any]]:
    """Judges each contact of a run with an obstacle or the surroundings.

    Args:
        scenario: the scenario that was run, with a robot.
        log: of the run.
        world: the scenario's true world.

    Returns:
        Of each contact, in order of time: `time` of the first touch [s]; `link`; `obstacle`, the
        model instance; `closing_speed` at the first touch and its maximum until they part,
        `closing_speed_max` [m/s]; `arm_at_rest`, all joints slower than 0.02 rad/s; `receding`,
        closing speed not positive; `energy`, the whole robot's kinetic energy [J];
        `avoidable_by_physics`; `avoidable_by_view`; and `parked_contact`, those of "start", "goal"
        and "first_sight" (where the arm was when the obstacle was first observed, from then on)
        at which anything touches an arm that stays there.
    """
    end, q_goal = last_change(scenario.obstacles), end_positions(scenario)[1]
    trajectories = {f"{OBSTACLE_PREFIX}_{item.name}": item for item in scenario.obstacles}
    evaluator = clearance_evaluator(scenario)
    until, verdicts, events = -math.inf, dict[str, bool](), _touches(evaluator, log)
    for event in events:
        # The velocity of what is no obstacle is always known: zero.
        seen, known = 0.0, log.t
        if event["obstacle"] in trajectories:
            seen, known = sightings(log, trajectories[event["obstacle"]])
        if event["time"] > until + _SAME_EVENT:
            verdicts = _verdicts(world, log, event["time"], known)
        until = max(until, event.pop("end"))
        parked = {"start": (log.q[0], 0.0), "goal": (q_goal, 0.0)}
        if seen < event["time"]:
            parked["first_sight"] = log.q[np.searchsorted(log.t, seen)], seen
        event |= verdicts
        event["parked_contact"] = [
            name
            for name, (q, start) in parked.items()
            if _is_touched(evaluator, q, np.arange(start, end + STEP, STEP))
        ]
    return events


def _touches(evaluator: ClearanceEvaluator, log: MotionLog) -> list[dict[str, Any]]:
    """Finds the contacts, their last instants, and all that the log alone tells of them."""
    events = list[dict[str, Any]]()
    current: dict[str, dict[str, Any]] = {}
    for row, time in enumerate(log.t.tolist()):
        v = log.v[max(row - 1, 0)]
        speeds, energy = evaluator.contact_speeds(log.q[row], v, log.q_world[row])
        for pair, speed in speeds.items():
            if pair not in current or time > current[pair]["end"] + _APART:
                link, obstacle = pair.split(" - ")
                current[pair] = {
                    "time": time,
                    "link": link,
                    "obstacle": obstacle,
                    "closing_speed": speed,
                    "closing_speed_max": speed,
                    "arm_at_rest": bool(np.abs(v).max() < AT_REST),
                    "receding": speed <= 0.0,
                    "energy": energy,
                }
                events.append(current[pair])
            fastest = max(current[pair]["closing_speed_max"], speed)
            current[pair] |= {"closing_speed_max": fastest, "end": time}
    return events


def _is_touched(evaluator: ClearanceEvaluator, q: FloatArray, times: FloatArray) -> bool:
    """Checks whether anything touches an arm that stays at q (nq,) at some of the times [s]."""
    return any(
        evaluator.contact_speeds(q, 0.0 * q, evaluator.positions_at(time))[0] for time in times
    )


def _verdicts(world: TrueWorld, log: MotionLog, time: float, known: FloatArray) -> dict[str, bool]:
    """Finds whether a contact was avoidable.

    Args:
        world: the scenario's true world.
        log: of the run.
        time: of the contact [s].
        known: times at which the obstacle's velocity was observed right [s].
    """
    index, found = world.arm.chain.q_index, {}
    for lead in LEADS:
        first = max(math.floor((time - lead) / STEP), 0)
        row = np.searchsorted(log.t, first * STEP - 1e-6)
        steps = math.ceil((time + AFTER) / STEP) - first
        found[lead] = escapes(world, log.q[row, index], log.v[row, index], first, steps)
    latest = min((lead for lead, count in found.items() if count), default=math.inf)
    age = time - latest - WARNING - known
    return {
        "avoidable_by_physics": found[LEAD] > 0,
        "avoidable_by_view": bool(((age >= 0.0) & (age <= RECENT)).any()),
    }


def escapes(
    world: TrueWorld, q: FloatArray, v: FloatArray, first: int, steps: int, seed: int = 0
) -> int:
    """Counts those of `MOTIONS` bang motions that stay clear; the first of them brakes.

    Args:
        world: the arm, its clearance and the solids.
        q: (n,) joint positions at the start [rad].
        v: (n,) joint velocities then [rad/s].
        first: sample of the courses at the start.
        steps: number of steps for which they are to stay clear.
        seed: of the random targets, half of them anywhere, half about where the arm would stop.
    """
    random, chain, shape = np.random.default_rng(seed), world.arm.chain, (MOTIONS, 2, len(q))
    stop = q + np.sign(v) * v**2 / (2.0 * world.acceleration)
    # About half of the joints go away from there, by 0.2 to 1 rad.
    about = stop + random.normal(size=shape) * random.choice([0.0, 0.0, 0.2, 0.5, 1.0], shape)
    anywhere = random.uniform(chain.lower, chain.upper, shape)
    legs = np.where(random.random((MOTIONS, 2, 1)) < 0.5, anywhere, about)
    legs[0] = stop
    legs = np.clip(legs, chain.lower, chain.upper)
    # A second leg from step 0 on is the only one.
    switch = random.integers(0, steps, MOTIONS) * random.integers(0, 2, MOTIONS)
    motions = bang_motions(world, q, v, legs, switch, steps)
    return int((clear_steps(world, motions, np.full(MOTIONS, first)) > steps).sum())


def sightings(log: MotionLog, obstacle: Obstacle) -> tuple[float, FloatArray]:
    """Computes when an obstacle was first observed, and when its velocity was observed right.

    An ellipsoid is of an obstacle if its center is in the ball around the obstacle's true shapes
    at the stamp; its velocity is right within 20 % of the true one, or 0.02 m/s.

    Returns:
        Time at which the first observation arrived, inf without one, and times at which right
        velocities arrived [s].
    """
    seen, known = math.inf, []
    center, radius = bounding_ball(obstacle)
    for row, time in enumerate(log.observation_time.tolist()):
        observed = log.observation(row)
        offset = obstacle.offset_at(observed.stamp)
        velocity = (offset - obstacle.offset_at(observed.stamp - STEP)) / STEP
        is_own = np.linalg.norm(observed.p_WO - center - offset, axis=1) <= radius
        error = np.linalg.norm(observed.v_WO[is_own] - velocity, axis=1)
        seen = min(seen, time) if is_own.any() else seen
        if error.min(initial=np.inf) <= max(KNOWN * float(np.linalg.norm(velocity)), AT_REST):
            known.append(time)
    return seen, np.array(known)
