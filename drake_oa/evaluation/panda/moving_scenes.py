"""Random scenes with obstacles that move while the robot moves, on the table or in the air.

Obstacles move horizontally. The first obstacle passes the position of a link on the nominal motion
(the straight tool motion without avoidance) at the same time as the link. Up to two further
obstacles rest on the table. Motions and trajectories are drawn until

- the first obstacle hits the robot on the nominal motion: during its trajectory some link
  penetrates it by at least 5 mm;
- no obstacle passes through the robot's base or within 2 cm of another obstacle (distance of the
  enclosing balls), and no center of one is higher than 0.6 m (1.0 m in `moving_high`);
- the whole robot has at least 5 cm clearance to resting obstacles at start and goal, and to moving
  obstacles at the start at time 0;
- each trajectory ends within 15 s; the obstacle then rests.

`moving`: one or two boxes, spheres and cylinders of 5 to 15 cm at 0.1 to 0.4 m/s. Each moves along
a straight line past a link, inside the camera's field of view, and rests before and after. The
start is free of moving obstacles for the first second, and the goal after their trajectories.

`moving_hard`: two to four obstacles of 5 to 30 cm. Each one has one to five of these maneuvers, in
random order:

- enters from outside the camera's image, moving from time 0;
- changes its speed, within 0.1 to 0.8 m/s;
- turns by 30 to 120 degrees on an arc with a radius of 20 to 50 cm, less on a short path;
- stops for 0.5 to 2 s and continues;
- reverses along its path.

`moving_high`: as `moving_hard`, and the center of at least one obstacle moves above 0.6 m.

In `moving_hard` and `moving_high`, all obstacles but the first pass anywhere above the table.
Shapes and maneuvers are drawn once for a scene. No further condition is imposed: an obstacle may
hit the arm where the arm cannot avoid it, press the arm against the table, or come to rest at the
goal. Hence not every scene has a solution.
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
    MIN_END_CLEARANCE,
    MIN_GAP,
    MIN_PENETRATION,
    TABLE_X,
    TABLE_Y,
    DrawObjects,
    bounding_ball,
    draw_obstacles,
    draw_shape,
    ends_are_free,
    extent,
    make_obstacle,
    view_margin,
)
from drake_oa.scenario.obstacles import Obstacle

MAX_RESTING = 2
"""Maximum number of resting obstacles in a random scene that also has moving ones."""
START_FREE_TIME = 1.0
"""Duration from time 0 for which moving obstacles stay clear of the start configuration in scenes
of the kind `moving` [s]."""
MAX_DURATION = 15.0
"""Latest time at which the trajectory of a moving obstacle ends [s]."""

_SIZES = (0.05, 0.15)
"""Range of the dimensions of moving obstacles in scenes of the kind `moving` [m]."""
_HARD_SIZES = (0.05, 0.30)
"""Range of the dimensions of moving obstacles in scenes of the kinds `moving_hard` and
`moving_high` [m]."""
_COUNTS = (1, 2)
"""Minimum and maximum number of moving obstacles in scenes of the kind `moving`."""
_HARD_COUNTS = (2, 4)
"""Minimum and maximum number of moving obstacles in scenes of the kinds `moving_hard` and
`moving_high`."""
_SPEEDS = (0.1, 0.4)
"""Range of the speeds of moving obstacles in scenes of the kind `moving` [m/s]."""
_HARD_SPEEDS = (0.1, 0.8)
"""Range of the speeds, except during stops, of obstacles that change speed, turn, stop or reverse
[m/s]."""
_MEETING_PHASES = (0.25, 0.75)
"""Range of the time at which an obstacle passes its target point (near a link, or random above the
table), as a fraction of the nominal motion's duration [-]."""
_APPROACH_TIMES = (0.5, 2.5)
"""Range of the time between an obstacle's departure and its passage of its target point (near a
link, or random above the table) [s]. It is shorter where the departure would precede time 0."""
_TARGET_JOINTS = range(4, 7)
"""Indices of the joints that move the links 5 to 7, near which moving obstacles have their target
points."""
_MAX_OFFSET = 0.05
"""Maximum offset of an obstacle's target point from the center of a sphere that encloses a part of
a link, along each axis [m]."""
_SLIDING_HEIGHT = 0.05
"""Maximum distance by which an obstacle near the table is lowered so that it slides on the table
[m]."""
_TABLE_GAP = 2e-3
"""Gap between the table and an obstacle that slides on the table, to avoid their contact [m]."""
_MAX_HEIGHT = 0.6
"""Maximum height of a moving obstacle's center, except in scenes of the kind `moving_high` [m]."""
MAX_HIGH_HEIGHT = 1.0
"""Maximum height of a moving obstacle's center in scenes of the kind `moving_high` [m]."""
_SAMPLE_TIME = 0.05
"""Time between two samples of a moving obstacle's trajectory [s]."""
_ATTEMPTS = 60
"""Maximum number of trajectories drawn for one obstacle before the nominal motion is rejected."""

# Maneuvers of an obstacle; random draws of scenes depend on the order of these numbers.
ENTERS, CHANGES_SPEED, TURNS, STOPS, COMES_BACK = range(5)
_MIN_SPEED_CHANGE = 0.15
"""Minimum change of an obstacle's speed in the maneuver CHANGES_SPEED [m/s]."""
_ACCELERATIONS = (1.0, 3.0)
"""Range of the magnitude of an obstacle's acceleration along its path [m/s^2]."""
_LEG_TIMES = (0.4, 2.0)
"""Range of the time for which an obstacle moves at one speed before its next maneuver [s]."""
_LAST_LENGTHS = (0.6, 1.6)
"""Range of the path length that an obstacle travels at its last speed, and at its first speed if it
enters from outside the image [m]."""
_STOP_TIMES = (0.5, 2.0)
"""Range of the duration for which an obstacle stops before it continues [s]."""
_TURN_ANGLES = (math.radians(30.0), math.radians(120.0))
"""Range of the angle by which an obstacle turns on an arc [rad]."""
_TURN_RADII = (0.2, 0.5)
"""Range of the radius of the arc on which an obstacle turns [m]."""
_SPACING = 0.01
"""Path length between two points of an obstacle's path, from which its positions over time are
interpolated [m]."""


def moving_objects(
    random: Generator, *, hard: bool, max_height: float = _MAX_HEIGHT
) -> DrawObjects:
    """Returns a function that draws the moving and resting obstacles of a scene for a nominal
    motion.

    Number, shapes and maneuvers of the moving obstacles, and the number of resting ones, are drawn
    here, once for a scene.

    Args:
        random: source of random numbers.
        hard: whether obstacles have maneuvers, as in the kind `moving_hard`: they enter the image
            from outside, change speed, turn, stop or reverse.
        max_height: maximum z of a moving obstacle's center in the world frame [m].

    Returns:
        Function from a nominal motion to obstacles. It returns None if no drawn placement satisfies
        the conditions in the module's docstring, for example that the first obstacle hits the robot
        on the nominal motion, and that no obstacle passes through the base.
    """
    fewest, most = _HARD_COUNTS if hard else _COUNTS
    count, resting = random.integers(fewest, most + 1), int(random.integers(MAX_RESTING + 1))
    smallest, largest = _HARD_SIZES if hard else _SIZES
    objects = []
    for number in range(count):
        shape = draw_shape(random, smallest, largest, largest)
        maneuvers = random.permutation(5)[: random.integers(1, 6)].tolist() if hard else []
        objects.append((make_obstacle(random, "moving", number, [shape]), frozenset(maneuvers)))

    def draw(motion: Motion) -> list[Obstacle] | None:
        standing = draw_obstacles(random, resting, first=len(objects))
        if standing is None or not ends_are_free(motion, standing):
            return None
        moving: list[Obstacle] = []
        for object, maneuvers in objects:
            for _ in range(_ATTEMPTS):
                obstacle = _draw_trajectory(
                    random, object, maneuvers, motion, max_height, first=not moving
                )
                if _trajectory_fits(
                    obstacle, maneuvers, motion, [*moving, *standing], max_height
                ) and (moving or _hits_motion(obstacle, motion)):
                    moving.append(obstacle)
                    break
            else:
                return None
        low = max(obstacle.translation[2] for obstacle in moving) <= _MAX_HEIGHT < max_height
        return None if low else [*moving, *standing]

    return draw


def _draw_trajectory(
    random: Generator,
    object: Obstacle,
    maneuvers: frozenset[int],
    motion: Motion,
    max_height: float,
    *,
    first: bool,
) -> Obstacle:
    """Draws a trajectory of a moving obstacle past a target point.

    The first obstacle, and each one without maneuvers, passes the position of a link on the
    nominal motion at the same time as the link. Others pass a random point above the table.

    Args:
        random: source of random numbers.
        object: obstacle whose shape is given.
        maneuvers: subset of ENTERS (the image from outside), CHANGES_SPEED, TURNS, STOPS and
            COMES_BACK (reverses).
        motion: nominal motion.
        max_height: maximum height of a random target point [m].
        first: whether the obstacle is the first one of the scene.

    Returns:
        A copy of the obstacle with initial position and waypoints.
    """
    arm, row = scene_arm(), int(random.uniform(*_MEETING_PHASES) * len(motion.t))
    met = motion.t[row]
    if first or not maneuvers:
        point = random.choice(arm.centers(motion.q[row : row + 1], _TARGET_JOINTS))
        point = point + random.uniform(-_MAX_OFFSET, _MAX_OFFSET, 3)
    else:
        point = np.array([random.uniform(*side) for side in (TABLE_X, TABLE_Y, (0.0, max_height))])
    t, along = _draw_speeds(random, maneuvers, *(_HARD_SPEEDS if maneuvers else _SPEEDS))
    if ENTERS not in maneuvers:
        t = t + round(max(met - random.uniform(*_APPROACH_TIMES), 0.0), 2)
    p = _draw_path(random, along, bends=TURNS in maneuvers)
    p += point[:2] - [np.interp(met, t, axis) for axis in p.T]
    # Only samples with a change of velocity are waypoints: between them the velocity is constant.
    velocity = np.diff(p, axis=0) / _SAMPLE_TIME
    is_change = np.linalg.norm(np.diff(velocity, axis=0), axis=1) > 1e-6
    is_waypoint = np.concatenate([[True], is_change, [True]])
    lowest, begin = extent(object.shapes[0])[1] + _TABLE_GAP, np.round(p[0], 4)
    z = point[2] if point[2] > lowest + _SLIDING_HEIGHT else lowest
    trajectory = np.column_stack([np.round(t, 2), np.round(p - begin, 4), np.zeros(len(t))])
    return replace(
        object,
        translation=[*begin.tolist(), round(float(z), 4)],
        waypoints=trajectory[is_waypoint].tolist(),
    )


def _draw_speeds(
    random: Generator, maneuvers: frozenset[int], slowest: float, fastest: float
) -> tuple[FloatArray, FloatArray]:
    """Draws the motion of an obstacle along its path, with bounded speed and acceleration.

    Args:
        random: source of random numbers.
        maneuvers: subset of ENTERS (the image from outside), CHANGES_SPEED, TURNS, STOPS and
            COMES_BACK (reverses).
        slowest: minimum speed, except during stops [m/s].
        fastest: maximum speed [m/s].

    Returns:
        (T,) times from 0, 0.05 s (`_SAMPLE_TIME`) apart [s], and (T,) path lengths from the initial
        position at these times, which decrease while the obstacle moves back [m].
    """
    speed, sense = random.uniform(slowest, fastest), 1.0
    legs = [(speed, random.uniform(*_LEG_TIMES))]
    if ENTERS in maneuvers:
        legs = [(speed, random.uniform(*_LAST_LENGTHS) / speed)]
    for event in random.permutation([CHANGES_SPEED, STOPS, COMES_BACK]):
        if event not in maneuvers:
            continue
        if event == CHANGES_SPEED:
            span = fastest - slowest
            step = random.uniform(_MIN_SPEED_CHANGE, span - _MIN_SPEED_CHANGE)
            speed = slowest + (speed - slowest + step) % span
        elif event == STOPS:
            legs.append((0.0, random.uniform(*_STOP_TIMES)))
        else:
            sense = -sense
        legs.append((sense * speed, random.uniform(*_LEG_TIMES)))
    legs[-1] = (sense * speed, random.uniform(*_LAST_LENGTHS) / speed)
    rate = random.uniform(*_ACCELERATIONS)
    t, v = [0.0], [0.0]
    for target, seconds in [*legs, (0.0, 0.0)]:
        t += [t[-1] + abs(target - v[-1]) / rate]
        t += [t[-1] + seconds]
        v += [target, target]
    times = _SAMPLE_TIME * np.arange(math.ceil(t[-1] / _SAMPLE_TIME) + 1, dtype=float)
    speeds = np.interp(times, t, v)
    steps = 0.5 * _SAMPLE_TIME * (speeds[1:] + speeds[:-1])
    return times, np.concatenate([[0.0], np.cumsum(steps)])


def _draw_path(random: Generator, along: FloatArray, *, bends: bool) -> FloatArray:
    """Draws a horizontal path of an obstacle in a random direction, either straight or with one
    turn.

    Args:
        random: source of random numbers.
        along: (T,) path lengths, increasing or decreasing [m].
        bends: whether the path has a turn, within the range of `along`.

    Returns:
        (T, 2) x and y coordinates at the path lengths, relative to an arbitrary origin [m].
    """
    length = np.arange(along.min() - _SPACING, along.max() + 2.0 * _SPACING, _SPACING)
    heading = np.full(len(length), random.uniform(-math.pi, math.pi))
    if bends:
        turn = random.uniform(*_TURN_ANGLES) * random.choice([-1.0, 1.0])
        arc = min(random.uniform(*_TURN_RADII) * abs(turn), np.ptp(along))
        begin = random.uniform(along.min(), max(along.max() - arc, along.min()))
        heading += turn * np.clip((length - begin) / arc, 0.0, 1.0)
    steps = _SPACING * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    places = np.cumsum(steps, axis=0)
    return np.stack([np.interp(along, length, axis) for axis in places.T], axis=1)


def _trajectory_fits(
    object: Obstacle,
    maneuvers: frozenset[int],
    motion: Motion,
    others: Sequence[Obstacle],
    max_height: float,
) -> bool:
    """Checks whether an obstacle's trajectory satisfies the conditions on random scenes with moving
    obstacles.

    The trajectory ends within 15 s. The obstacle's center is at most at the maximum height. A ball
    around the obstacle does not overlap a circle of 16 cm around the robot's base, and is at least
    2 cm from the balls around other obstacles. Without maneuvers the obstacle's center is always in
    the camera's view, and the robot has 5 cm clearance at the start for the first second and at the
    goal after the trajectory. With maneuvers the robot has 5 cm clearance at the start at time 0.
    An obstacle that enters the image is initially outside the camera's view, and later in it.

    Args:
        object: obstacle with its trajectory.
        maneuvers: subset of ENTERS (the image from outside), CHANGES_SPEED, TURNS, STOPS and
            COMES_BACK (reverses); empty: the obstacle moves straight.
        motion: nominal motion.
        others: obstacles that are placed already.
        max_height: maximum height of the obstacle's center [m].
    """
    end = max(item.last_change for item in [object, *others])
    if end > MAX_DURATION or object.translation[2] > max_height:
        return False
    t, arm = np.arange(0.0, end + _SAMPLE_TIME, _SAMPLE_TIME), scene_arm()
    p, radius = _track(object, t)
    seen = view_margin(p)
    if np.hypot(p[:, 0], p[:, 1]).min() < radius + BASE_RADIUS:
        return False
    if ENTERS in maneuvers and (seen[0] > -radius or seen.max() < 0.0):
        return False
    if not maneuvers and seen.min() < 0.0:
        return False
    for other in others:
        p_other, other_radius = _track(other, t)
        if np.linalg.norm(p - p_other, axis=1).min() < radius + other_radius + MIN_GAP:
            return False
    start_times = t[t <= (0.0 if maneuvers else START_FREE_TIME)]
    if arm.distances(motion.ends[:1], [object], start_times).min() < MIN_END_CLEARANCE:
        return False
    return bool(maneuvers) or bool(
        arm.distances(motion.ends[1:], [object], end).min() >= MIN_END_CLEARANCE
    )


def _track(obstacle: Obstacle, t: FloatArray) -> tuple[FloatArray, float]:
    """Computes the trajectory of a ball that contains an obstacle.

    Args:
        obstacle: resting or moving obstacle.
        t: (T,) times [s].

    Returns:
        (T, 3) centers of the ball in the world, and its radius [m].
    """
    center, radius = bounding_ball(obstacle)
    return np.array([center + obstacle.offset_at(time) for time in t]), radius


def _hits_motion(object: Obstacle, motion: Motion) -> bool:
    """Checks whether a moving obstacle hits the robot on the nominal motion during the obstacle's
    trajectory: by at least 9 mm (`MIN_PENETRATION`) into the spheres that enclose the links.
    """
    rows = (motion.t >= object.waypoints[0][0]) & (motion.t <= object.waypoints[-1][0])
    found = scene_arm().distances(motion.q[rows], [object], motion.t[rows])
    return bool(found.min(initial=np.inf) <= -MIN_PENETRATION)
