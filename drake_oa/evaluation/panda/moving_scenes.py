"""Random scenes in which things move, on the table or in the air, while the robot does.

What moves goes level, the first of it is aimed at where a link will be on the nominal motion,
and none to two things besides stand on the table. Motions and courses are drawn until

- the first meets the nominal motion in time: some link of the robot, followed along the
  straight line as it is planned, goes at least 5 mm into it while its course lasts;
- nothing moves through the robot's base, above 0.6 m (its middle; in `moving_high` 1.0 m), or
  nearer than 2 cm to another thing at any time (spheres round them);
- what rests leaves the robot's start and goal free (5 cm of the whole robot), and what moves
  leaves the start free at time 0;
- each course ends within 15 s; the thing then rests.

`moving`: one or two boxes, spheres and cylinders of 5 to 15 cm at 0.1 to 0.4 m/s, each along a
straight course, aimed at a link and in the camera's view; they rest before and after. What moves
leaves the start free for the first second, and the goal where it rests at last.

`moving_hard`: two to four of 5 to 30 cm, each of which does one to five of these, in a random
order: it

- enters from outside the camera's image, and is on its way from the outset;
- changes its speed, within 0.1 to 0.8 m/s;
- turns, by 30 to 120 degrees, on an arc of 20 to 50 cm radius, less on a short way;
- stops for 0.5 to 2 s, and goes on;
- comes back the way that it went.

`moving_high`: as `moving_hard`, and the middle of one of them at least passes above 0.6 m.

The courses of the others pass anywhere over the table. What a thing is and which of these it does
is drawn once. Nothing else is asked. A thing may come at the arm where it cannot get away, press it
to the table, or come to rest where the goal is: not every scene has a solution.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.random import Generator

from drake_oa.common.messages import FloatArray
from drake_oa.evaluation.panda.scene_arm import Motion, scene_arm
from drake_oa.evaluation.panda.scene_parts import (
    BASE_RADIUS,
    FREE,
    GAP,
    TABLE_X,
    TABLE_Y,
    TOUCH,
    DrawThings,
    bounding_ball,
    draw_obstacles,
    draw_shape,
    ends_are_free,
    extent,
    make_obstacle,
    view_margin,
)
from drake_oa.scenario.obstacles import Obstacle

MOST_RESTING = 2
QUIET = 1.0
"""Time for which moving obstacles leave the start free in `moving` [s]."""
LONGEST = 15.0
"""Time by which all courses have ended [s]."""

_SIZE, _HARD_SIZE = (0.05, 0.15), (0.05, 0.30)
"""Dimensions of a moving obstacle [m]."""
_MOVING, _HARD_MOVING = (1, 2), (2, 4)
"""Number of moving obstacles."""
_SPEED, _HARD_SPEED = (0.1, 0.4), (0.1, 0.8)
"""Speeds between begin, stops and end [m/s]."""
_MET = (0.25, 0.75)
"""Time at which an aimed obstacle meets the robot, as a share of the planned duration."""
_BEFORE = (0.5, 2.5)
"""Time for which an obstacle that does not enter moves before it meets the robot [s]."""
_HIT = range(4, 7)
"""Joints of the links that obstacles are aimed at: those that reach out."""
_AIMED_ASIDE = 0.05
"""Maximum distance of its course from a point of a link then, along each axis [m]."""
_NEAR_TABLE = 0.05
"""Height over its lowest place up to which an obstacle slides on the table [m]."""
_OFF_TABLE = 2e-3
"""Height of a sliding obstacle over the table [m], so that it does not rub."""
_HIGHEST, HIGHEST = 0.6, 1.0
"""Maximum height of the middle of an obstacle, and the same in `moving_high` [m]."""
_SAMPLE = 0.05
"""Time between samples of a course [s]."""
_TRAJECTORIES = 60
"""Courses tried for an obstacle among the same others."""

ENTERS, CHANGES_SPEED, TURNS, STOPS, COMES_BACK = range(5)
_CHANGE = 0.15
"""Minimum change of the speed [m/s]."""
_ACCELERATION = (1.0, 3.0)
"""Acceleration along a course [m/s^2]."""
_LEG = (0.4, 2.0)
"""Duration at a speed [s]."""
_WAY = (0.6, 1.6)
"""Length at the last speed, and of an obstacle that enters at the first [m]."""
_STOP = (0.5, 2.0)
"""Duration of a stop [s]."""
_TURN = (math.radians(30.0), math.radians(120.0))
"""Angle of a turn [rad]."""
_RADIUS = (0.2, 0.5)
"""Radius of the arc of a turn [m]."""
_FINE = 0.01
"""Length between samples of a way [m]."""


def moving_objects(random: Generator, *, hard: bool, highest: float = _HIGHEST) -> DrawThings:
    """Prepares moving obstacles up to a height [m], and none to two at rest."""
    fewest, most = _HARD_MOVING if hard else _MOVING
    count, resting = random.integers(fewest, most + 1), int(random.integers(MOST_RESTING + 1))
    smallest, largest = _HARD_SIZE if hard else _SIZE
    objects = []
    for number in range(count):
        shape = draw_shape(random, smallest, largest, largest)
        does = random.permutation(5)[: random.integers(1, 6)].tolist() if hard else []
        objects.append((make_obstacle(random, "moving", number, [shape]), frozenset(does)))

    def draw(motion: Motion) -> list[Obstacle] | None:
        standing = draw_obstacles(random, resting, first=len(objects))
        if standing is None or not ends_are_free(motion, standing):
            return None
        moved: list[Obstacle] = []
        for object, does in objects:
            for _ in range(_TRAJECTORIES):
                placed = _on_trajectory(random, object, does, motion, highest, first=not moved)
                if _trajectory_fits(placed, does, motion, [*moved, *standing], highest) and (
                    moved or _is_met(placed, motion)
                ):
                    moved.append(placed)
                    break
            else:
                return None
        low = max(placed.translation[2] for placed in moved) <= _HIGHEST < highest
        return None if low else [*moved, *standing]

    return draw


def _on_trajectory(
    random: Generator,
    object: Obstacle,
    does: frozenset[int],
    motion: Motion,
    highest: float,
    *,
    first: bool,
) -> Obstacle:
    """Draws a course of an obstacle.

    The first obstacle, and each one without maneuvers, passes a point of a link when that is there.
    """
    arm, row = scene_arm(), int(random.uniform(*_MET) * len(motion.t))
    met = motion.t[row]
    if first or not does:
        point = random.choice(arm.centers(motion.q[row : row + 1], _HIT))
        point = point + random.uniform(-_AIMED_ASIDE, _AIMED_ASIDE, 3)
    else:
        point = np.array([random.uniform(*side) for side in (TABLE_X, TABLE_Y, (0.0, highest))])
    t, along = _draw_speeds(random, does, *(_HARD_SPEED if does else _SPEED))
    if ENTERS not in does:
        t = t + round(max(met - random.uniform(*_BEFORE), 0.0), 2)
    p = _draw_way(random, along, bends=TURNS in does)
    p += point[:2] - [np.interp(met, t, axis) for axis in p.T]
    # Between two rows that are kept it goes straight on at the same speed.
    velocity = np.diff(p, axis=0) / _SAMPLE
    changed = np.linalg.norm(np.diff(velocity, axis=0), axis=1) > 1e-6
    kept = np.concatenate([[True], changed, [True]])
    lowest, begin = extent(object.shapes[0])[1] + _OFF_TABLE, np.round(p[0], 4)
    z = point[2] if point[2] > lowest + _NEAR_TABLE else lowest
    trajectory = np.column_stack([np.round(t, 2), np.round(p - begin, 4), np.zeros(len(t))])
    return replace(
        object,
        translation=[*begin.tolist(), round(float(z), 4)],
        waypoints=trajectory[kept].tolist(),
    )


def _draw_speeds(
    random: Generator, does: frozenset[int], slowest: float, fastest: float
) -> tuple[FloatArray, FloatArray]:
    """Draws (T,) times from 0 [s], `_SAMPLE` apart, and (T,) lengths along the way then [m]."""
    speed, sense = random.uniform(slowest, fastest), 1.0
    legs = [(speed, random.uniform(*_LEG))]
    if ENTERS in does:
        legs = [(speed, random.uniform(*_WAY) / speed)]
    for event in random.permutation([CHANGES_SPEED, STOPS, COMES_BACK]):
        if event not in does:
            continue
        if event == CHANGES_SPEED:
            span = fastest - slowest
            step = random.uniform(_CHANGE, span - _CHANGE)
            speed = slowest + (speed - slowest + step) % span
        elif event == STOPS:
            legs.append((0.0, random.uniform(*_STOP)))
        else:
            sense = -sense
        legs.append((sense * speed, random.uniform(*_LEG)))
    legs[-1] = (sense * speed, random.uniform(*_WAY) / speed)
    rate = random.uniform(*_ACCELERATION)
    t, v = [0.0], [0.0]
    for target, seconds in [*legs, (0.0, 0.0)]:
        t += [t[-1] + abs(target - v[-1]) / rate]
        t += [t[-1] + seconds]
        v += [target, target]
    times = _SAMPLE * np.arange(math.ceil(t[-1] / _SAMPLE) + 1, dtype=float)
    speeds = np.interp(times, t, v)
    steps = 0.5 * _SAMPLE * (speeds[1:] + speeds[:-1])
    return times, np.concatenate([[0.0], np.cumsum(steps)])


def _draw_way(random: Generator, along: FloatArray, *, bends: bool) -> FloatArray:
    """Draws (T, 2) places, seen from above, at (T,) lengths along a way [m].

    The way is straight, or bends once between two lengths that are reached.
    """
    length = np.arange(along.min() - _FINE, along.max() + 2.0 * _FINE, _FINE)
    heading = np.full(len(length), random.uniform(-math.pi, math.pi))
    if bends:
        turn = random.uniform(*_TURN) * random.choice([-1.0, 1.0])
        arc = min(random.uniform(*_RADIUS) * abs(turn), np.ptp(along))
        begin = random.uniform(along.min(), max(along.max() - arc, along.min()))
        heading += turn * np.clip((length - begin) / arc, 0.0, 1.0)
    steps = _FINE * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    places = np.cumsum(steps, axis=0)
    return np.stack([np.interp(along, length, axis) for axis in places.T], axis=1)


def _trajectory_fits(
    object: Obstacle,
    does: frozenset[int],
    motion: Motion,
    others: Sequence[Obstacle],
    highest: float,
) -> bool:
    """Checks a course among others: its end, height, distances, visibility and the ends' room."""
    end = max(item.last_change for item in [object, *others])
    if end > LONGEST or object.translation[2] > highest:
        return False
    t, arm = np.arange(0.0, end + _SAMPLE, _SAMPLE), scene_arm()
    p, radius = _track(object, t)
    seen = view_margin(p)
    if np.hypot(p[:, 0], p[:, 1]).min() < radius + BASE_RADIUS:
        return False
    if ENTERS in does and (seen[0] > -radius or seen.max() < 0.0):
        return False
    if not does and seen.min() < 0.0:
        return False
    for other in others:
        p_other, other_radius = _track(other, t)
        if np.linalg.norm(p - p_other, axis=1).min() < radius + other_radius + GAP:
            return False
    quiet = t[t <= (0.0 if does else QUIET)]
    if arm.distances(motion.ends[:1], [object], quiet).min() < FREE:
        return False
    return bool(does) or bool(arm.distances(motion.ends[1:], [object], end).min() >= FREE)


def _track(obstacle: Obstacle, t: FloatArray) -> tuple[FloatArray, float]:
    """Computes (T, 3) centers at (T,) times, and the radius, of a ball around an obstacle [m]."""
    center, radius = bounding_ball(obstacle)
    return np.array([center + obstacle.offset_at(time) for time in t]), radius


def _is_met(object: Obstacle, motion: Motion) -> bool:
    """Checks that an obstacle touches the robot on the planned motion while its course lasts."""
    rows = (motion.t >= object.waypoints[0][0]) & (motion.t <= object.waypoints[-1][0])
    found = scene_arm().distances(motion.q[rows], [object], motion.t[rows])
    return bool(found.min(initial=np.inf) <= -TOUCH)
