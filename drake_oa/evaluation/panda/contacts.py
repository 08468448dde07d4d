"""Contacts of a finished run: closing speeds, and whether a motion of the arm could have avoided
them.

A contact of a link with an object ends when they have been apart for 0.1 s. Its closing speed is
the speed of the arm's contact point along the contact normal, positive into the object. It is
computed from the logged velocities one instant earlier, before the impact has changed them.

- Avoidable by physics: at least one of 500 random joint motions from the logged joint state 0.2 s
  before the contact is collision-free until 1.5 s after the contact. A motion has one or two legs,
  each time-optimal to a random configuration within the limits of position, velocity and
  acceleration. Collisions are checked with spheres that enclose the links. A collision-free motion
  proves that the arm could avoid the contact; that none is found proves nothing.
- Avoidable by view: the arm could avoid the contact after perception had observed the obstacle's
  velocity. Random joint motions start at several times, 0.05 to 0.5 s (`LEADS`) before the contact.
  At least one of them is collision-free, and 0.1 to 0.3 s before the latest start of such a motion
  the obstacle's velocity was observed. The error of the velocity was at most 20 % of the true speed
  or 0.02 m/s, whichever is larger.

A contact that begins before, or within 1 s after, the end of an earlier one is not assessed itself.
It has the avoidability of the earlier one, since the obstacle may still press the arm.
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

MOTION_COUNT = 500
"""Number of random joint motions from one joint state among which a collision-free one is searched.
"""
LEAD = 0.2
"""Time before a contact at which a collision-free joint motion must start for the contact to count
as avoidable by physics [s]."""
LEADS = (0.05, 0.1, LEAD, 0.3, 0.5)
"""Times before a contact at which random joint motions start, to find the latest start of a motion
that avoids the contact [s]."""
CLEAR_TIME = 1.5
"""Time after a contact until which a random joint motion must be collision-free to prove that the
contact was avoidable [s]."""
WARNING = 0.1
"""Minimum time between the observation of an obstacle's velocity and the start of a motion that
avoids the obstacle, for a contact to count as avoidable by view [s]."""
VELOCITY_AGE = 0.2
"""Duration of the interval in which perception must observe the obstacle's velocity at least once
for a contact to count as avoidable by view, that is, from the observations before it [s].

The interval ends 0.1 s (`WARNING`) before the latest start of a motion that avoids the contact."""
VELOCITY_TOLERANCE = 0.2
"""Maximum error of an observed obstacle velocity that counts as correct, as a fraction of the true
speed [-]."""
AT_REST = 0.02
"""Joint speed below which the arm counts as at rest [rad/s]. The same number is the error up to
which the observed velocity of an obstacle slower than 0.1 m/s counts as correct [m/s]."""
_SEPARATION_TIME = 0.1
"""Time without contact after which a new touch of the same link and object is another contact [s].
"""
_EVENT_DURATION = 1.0
"""Time after the end of a contact in which a further contact is not assessed itself, but counts as
avoidable if the earlier one does [s]."""


def contact_events(scenario: Scenario, log: MotionLog, world: TrueWorld) -> list[dict[str, Any]]:
    """Assesses each contact of a run with an obstacle or the environment: closing speed, energy and
    avoidability.

    A contact that begins before, or within 1 s after, the end of an earlier one has the
    avoidability of the earlier one.

    Args:
        scenario: scenario of the run, with a robot.
        log: log of the run.
        world: arm and true collision geometries of the scenario.

    Returns:
        A dictionary for each contact, in order of time, with these keys:

        - time: time of the first touch [s].
        - link: name of the robot's link.
        - obstacle: name of the touched model instance, for example "obstacle_box".
        - closing_speed, closing_speed_max: speed of the arm's contact point into the object at the
          first touch, and its maximum during the contact [m/s].
        - arm_at_rest: whether all joints are slower than 0.02 rad/s at the first touch.
        - receding: whether the closing speed at the first touch is not positive.
        - energy: kinetic energy of the robot at the first touch [J].
        - avoidable_by_physics: whether one of 500 random joint motions from the joint state 0.2 s
          before the contact avoids it.
        - avoidable_by_view: whether such a motion that starts 0.05 to 0.5 s before the contact
          avoids it, and the obstacle's velocity was observed 0.1 to 0.3 s before the latest start
          of a motion that avoids it.
        - parked_contact: names of the configurations at which an object would touch the arm if the
          arm rested there: "start" and "goal", if it rested from time 0 on, and "first_sight", if
          it rested from the first observation of `obstacle` on at its configuration of that time.
          Without an observation before the contact, "first_sight" is not checked.
    """
    end, q_goal = last_change(scenario.obstacles), end_positions(scenario)[1]
    trajectories = {f"{OBSTACLE_PREFIX}_{item.name}": item for item in scenario.obstacles}
    evaluator = clearance_evaluator(scenario)
    until, verdicts, events = -math.inf, dict[str, bool](), _find_contacts(evaluator, log)
    for event in events:
        # The environment is at rest, hence its velocity is known at all times.
        seen, known = 0.0, log.t
        if event["obstacle"] in trajectories:
            seen, known = observation_times(log, trajectories[event["obstacle"]])
        if event["time"] > until + _EVENT_DURATION:
            verdicts = _assess_avoidability(world, log, event["time"], known)
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


def _find_contacts(evaluator: ClearanceEvaluator, log: MotionLog) -> list[dict[str, Any]]:
    """Finds the contacts between links and objects in a log, in order of time.

    Args:
        evaluator: evaluator of contacts for the scenario of the run.
        log: log of the run.

    Returns:
        For each contact a dictionary with the keys time and end (first and last instant [s]), link,
        obstacle, closing_speed and closing_speed_max (speed of the arm's contact point into the
        object at the first instant, and its maximum until the end [m/s]), arm_at_rest, receding
        (whether closing_speed is not positive) and energy (kinetic energy of the robot at the first
        instant [J]).
    """
    events = list[dict[str, Any]]()
    current: dict[str, dict[str, Any]] = {}
    for row, time in enumerate(log.t.tolist()):
        v = log.v[max(row - 1, 0)]
        speeds, energy = evaluator.contact_speeds(log.q[row], v, log.q_world[row])
        for pair, speed in speeds.items():
            if pair not in current or time > current[pair]["end"] + _SEPARATION_TIME:
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
    """Checks whether any object on its true trajectory would touch the robot at one of several
    times, if the robot rested at a given configuration.

    Args:
        evaluator: evaluator of contacts for the scenario of the run.
        q: (nq,) configuration at which the robot rests [rad, m].
        times: (T,) times in the simulation [s].
    """
    return any(
        evaluator.contact_speeds(q, 0.0 * q, evaluator.positions_at(time))[0] for time in times
    )


def _assess_avoidability(
    world: TrueWorld, log: MotionLog, time: float, known: FloatArray
) -> dict[str, bool]:
    """Checks whether some joint motion could have avoided a contact (by physics), and whether the
    obstacle was observed in time (by view).

    Args:
        world: arm and true collision geometries of the scenario.
        log: log of the run.
        time: time of the contact [s].
        known: (N,) times at which correct velocities of the obstacle were observed [s].

    Returns:
        Two keys. "avoidable_by_physics": whether a random joint motion from the joint state 0.2 s
        before the contact is collision-free. "avoidable_by_view": whether a random joint motion
        that starts 0.05 to 0.5 s before the contact is collision-free, and `known` contains a time
        0.1 to 0.3 s before the latest start of a collision-free motion.
    """
    index, counts = world.arm.chain.q_index, {}
    for lead in LEADS:
        first = max(math.floor((time - lead) / STEP), 0)
        row = np.searchsorted(log.t, first * STEP - 1e-6)
        steps = math.ceil((time + CLEAR_TIME) / STEP) - first
        counts[lead] = count_escapes(world, log.q[row, index], log.v[row, index], first, steps)
    latest = min((lead for lead, count in counts.items() if count), default=math.inf)
    age = time - latest - WARNING - known
    return {
        "avoidable_by_physics": counts[LEAD] > 0,
        "avoidable_by_view": bool(((age >= 0.0) & (age <= VELOCITY_AGE)).any()),
    }


def count_escapes(
    world: TrueWorld, q: FloatArray, v: FloatArray, first: int, steps: int, seed: int = 0
) -> int:
    """Counts the random joint motions from a joint state, out of `MOTION_COUNT`, that are
    collision-free.

    Each motion moves to one random target configuration, or to two in turn. Half of the targets are
    uniform within the joint limits, half are near the configuration at which the arm stops if it
    brakes. The first motion only brakes.

    Args:
        world: the arm, its required clearance, and the collision geometries along their
            trajectories, sampled every `STEP` (8 ms).
        q: (n,) joint positions at the start [rad].
        v: (n,) joint velocities at the start [rad/s].
        first: index of the sample of `world` at the start.
        steps: number of steps of 8 ms for which a motion must be collision-free.
        seed: seed of the random targets.
    """
    random, chain, shape = np.random.default_rng(seed), world.arm.chain, (MOTION_COUNT, 2, len(q))
    stop = q + np.sign(v) * v**2 / (2.0 * world.acceleration)
    # About half of the joints deviate from the stop, with standard deviations of 0.2 to 1 rad.
    about = stop + random.normal(size=shape) * random.choice([0.0, 0.0, 0.2, 0.5, 1.0], shape)
    anywhere = random.uniform(chain.lower, chain.upper, shape)
    legs = np.where(random.random((MOTION_COUNT, 2, 1)) < 0.5, anywhere, about)
    legs[0] = stop
    legs = np.clip(legs, chain.lower, chain.upper)
    # For half of the motions the second leg begins at step 0, so that they have one leg.
    switch = random.integers(0, steps, MOTION_COUNT) * random.integers(0, 2, MOTION_COUNT)
    motions = bang_motions(world, q, v, legs, switch, steps)
    return int((clear_steps(world, motions, np.full(MOTION_COUNT, first)) > steps).sum())


def observation_times(log: MotionLog, obstacle: Obstacle) -> tuple[float, FloatArray]:
    """Computes the times of a run at which perception observed an obstacle, and those at which it
    observed the obstacle with a correct velocity.

    An observed ellipsoid belongs to the obstacle if its center is in the ball around the obstacle's
    true shapes at the time of measurement. The velocity of the ellipsoid is correct if its error is
    at most 20 % of the true speed or 0.02 m/s, whichever is larger.

    Args:
        log: log of the run.
        obstacle: true obstacle.

    Returns:
        Arrival time of the first observation [s], inf without one, and arrival times of the
        observations with a correct velocity [s].
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
        max_error = max(VELOCITY_TOLERANCE * float(np.linalg.norm(velocity)), AT_REST)
        if error.min(initial=np.inf) <= max_error:
            known.append(time)
    return seen, np.array(known)
