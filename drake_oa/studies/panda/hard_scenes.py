"""Random scenes among things that move as nobody arranged.

Two to four boxes, spheres and cylinders of 5 to 30 cm move level, on the table or in the air;
none to two things besides stand on the table. Each that moves does one to five of these, in a
random order: it

- enters from outside the camera's image, and is on its way from the outset;
- changes its speed, within 0.1 to 0.8 m/s, at 1 to 3 m/s^2, as it does at its begin and end;
- turns, by 30 to 120 degrees, on an arc of 20 to 50 cm radius, less on a short way;
- stops for 0.5 to 2 s, and goes on;
- comes back the way that it went.

The course of the first is aimed at where a link will be on the pre-planned motion, those of the
others pass anywhere over the table. Each ends within 15 s, with the thing at rest, in the image
or outside it. What a thing is and which of these it does is drawn once; its course, the motion
and what rests are drawn again until

- the first meets the pre-planned motion in time: some link of the robot, followed along the
  straight line as it is planned, goes at least 5 mm into it while its course lasts;
- what rests leaves the robot's start and goal free (5 cm of the whole robot), and what moves
  leaves the start free at time 0, and at no other time is that asked;
- nothing moves through the robot's base, above 0.6 m (its middle), or nearer than 2 cm to
  another thing at any time (spheres round the shapes).

Nothing else is asked. A thing may come at the arm where it cannot get away, press it to the
table, or come to rest where the goal is: not every scene has a solution, and the planner's
share tells how many have one for certain.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.shapes import bounding_radius
from drake_oa.scenario.obstacles import Obstacle
from drake_oa.studies.panda.moving_scenes import (
    AIMED_ASIDE,
    HIGHEST,
    HIT_LINKS,
    MET,
    MOST_RESTING,
    NOT_MET,
    TOO_HIGH,
    course_gap,
    course_tracks,
    draw_shape,
    is_met,
    level_height,
    number_things,
    touches_no_table,
)
from drake_oa.studies.panda.obstacles import COLORS
from drake_oa.studies.panda.scene_parts import (
    BASE_RADIUS,
    ENDS_TAKEN,
    FREE,
    GAP,
    ON_BASE,
    TABLE_X,
    TABLE_Y,
    TOO_NEAR,
    TOUCHES_TABLE,
    Drawn,
    base_scenario,
    draw_motion,
    draw_obstacles,
    ends_are_free,
    in_view,
    is_outside_image,
    scene_cell,
)
from drake_oa.studies.tally import Tally

SMALLEST, LARGEST = 0.05, 0.30
"""Least and largest dimension of a thing that moves [m]."""
SLOWEST, FASTEST = 0.1, 0.8
"""Between its begin, its stops and its end [m/s]."""
FEWEST_MOVING, MOST_MOVING = 2, 4
LONGEST = 15.0
"""When all courses have ended [s]."""
ENTERS, CHANGES_SPEED, TURNS, STOPS, COMES_BACK = range(5)

_CHANGE = 0.15
"""Least change of the speed [m/s]."""
_ACCELERATION = (1.0, 3.0)
"""[m/s^2]."""
_LEG = (0.4, 2.0)
"""How long a thing goes at a speed [s]."""
_WAY = (0.6, 1.6)
"""How far it goes at its last speed, and one that enters at its first [m]."""
_STOP = (0.5, 2.0)
"""[s]."""
_BEGIN = (0.0, 2.0)
"""When one that does not enter sets out [s]."""
_TURN = (math.radians(30.0), math.radians(120.0))
"""[rad]."""
_RADIUS = (0.2, 0.5)
"""Of the arc of a turn [m]."""
_STEP = 0.05
"""Of time on a course where it bends or changes its speed [s]."""
_FINE = 0.01
"""Of length on a course [m]."""
_COURSES = 60
"""Courses tried for a thing among the same others."""
_MOST_MOTIONS = 2000


@dataclass(frozen=True)
class _Mover:
    """A thing that moves, without its course.

    Attributes:
        thing: with one shape.
        does: which of `ENTERS` to `COMES_BACK`.
    """

    thing: Obstacle
    does: frozenset[int]


def draw_hard(random: np.random.Generator, tally: Tally) -> Drawn:
    """A scene with two to four moving things.

    Raises:
        RuntimeError: if none was found for `_MOST_MOTIONS` motions.
    """
    moving = int(random.integers(FEWEST_MOVING, MOST_MOVING + 1))
    resting = int(random.integers(MOST_RESTING + 1))
    movers = [_draw_mover(random, number) for number in range(moving)]
    for _ in range(_MOST_MOTIONS):
        drawn = draw_motion(random, tally)
        if drawn is None:
            continue
        start, goal, motion = drawn
        standing = draw_obstacles(random, resting, tally) if resting else []
        if standing is None:
            continue
        number_things(standing, moving)
        reason, moved = _no_place(motion, goal, standing), None
        if not reason:
            moved = _draw_courses(random, tally, movers, motion, standing)
            reason = "" if moved else "no course found for one of its things"
        if tally.takes("scenes", reason) and moved:
            return [*moved, *standing], start, goal
    raise RuntimeError(
        f"no scene of {moving} moving and {resting} resting things found for "
        f"{_MOST_MOTIONS} motions"
    )


def _draw_mover(random: np.random.Generator, number: int) -> _Mover:
    does = random.permutation(5)[: random.integers(1, 6)]
    thing = Obstacle(
        name=f"moving{number}",
        shapes=[draw_shape(random, SMALLEST, LARGEST)],
        rpy=[0.0, 0.0, float(random.uniform(-math.pi, math.pi))],
        color=list(COLORS[number % len(COLORS)]),
    )
    return _Mover(thing, frozenset(does.tolist()))


def _no_place(motion: FloatArray, goal: FloatArray, standing: Sequence[Obstacle]) -> str:
    """Why the motion will not do among what rests."""
    if not touches_no_table(motion):
        return TOUCHES_TABLE
    scene_cell().put(standing)
    return "" if ends_are_free(motion, goal) else ENDS_TAKEN


def _draw_courses(
    random: np.random.Generator,
    tally: Tally,
    movers: Sequence[_Mover],
    motion: FloatArray,
    standing: Sequence[Obstacle],
) -> list[Obstacle] | None:
    """The things with their courses, or None where no course was found for one."""
    moved: list[Obstacle] = []
    for mover in movers:
        for _ in range(_COURSES):
            thing = _on_course(random, mover, motion, first=not moved)
            others = [*moved, *standing]
            if tally.takes("courses", _misfit(thing, mover.does, motion, others, not moved)):
                moved.append(thing)
                break
        else:
            return None
    return moved


def _on_course(
    random: np.random.Generator, mover: _Mover, motion: FloatArray, *, first: bool
) -> Obstacle:
    """The thing on a course, the first's past the middle of a link when the link is there."""
    t, along = _draw_speeds(random, mover.does)
    if ENTERS not in mover.does:
        t = t + round(float(random.uniform(*_BEGIN)), 2)
    if first:
        row = int(random.uniform(*MET) * (len(motion) - 1))
        passed = row * base_scenario().task.duration / (len(motion) - 1)
        points = scene_cell().shape_centers(motion[row], HIT_LINKS)
        point = points[random.integers(len(points))] + random.uniform(*AIMED_ASIDE, 3)
    else:
        passed = random.uniform(t[0], t[-1])
        point = np.array([random.uniform(*side) for side in (TABLE_X, TABLE_Y, (0.0, HIGHEST))])
    p = _draw_way(random, along, bends=TURNS in mover.does)
    p += point[:2] - [np.interp(passed, t, axis) for axis in p.T]
    # Between two rows that are kept it goes straight on at the same speed.
    velocity = np.diff(p, axis=0) / _STEP
    changed = np.linalg.norm(np.diff(velocity, axis=0), axis=1) > 1e-6
    kept = np.concatenate([[True], changed, [True]])
    z = level_height(mover.thing.shapes[0], float(point[2]))
    begin = np.round(p[0], 4)
    return replace(
        mover.thing,
        translation=[*map(float, begin), round(z, 4)],
        waypoints=[
            [round(float(time), 2), *(round(float(v), 4) for v in place - begin), 0.0]
            for time, place in zip(t[kept], p[kept], strict=True)
        ],
    )


def _draw_speeds(
    random: np.random.Generator, does: frozenset[int]
) -> tuple[FloatArray, FloatArray]:
    """(T,) times from 0 [s], `_STEP` apart, and (T,) how far along its way it is then [m]."""
    speed, sense = float(random.uniform(SLOWEST, FASTEST)), 1.0
    legs = [(speed, float(random.uniform(*_LEG)))]
    if ENTERS in does:
        legs = [(speed, float(random.uniform(*_WAY)) / speed)]
    for event in random.permutation([CHANGES_SPEED, STOPS, COMES_BACK]):
        if event not in does:
            continue
        if event == CHANGES_SPEED:
            span = FASTEST - SLOWEST
            step = random.uniform(_CHANGE, span - _CHANGE)
            speed = SLOWEST + float((speed - SLOWEST + step) % span)
        elif event == STOPS:
            legs.append((0.0, float(random.uniform(*_STOP))))
        else:
            sense = -sense
        legs.append((sense * speed, float(random.uniform(*_LEG))))
    legs[-1] = (sense * speed, float(random.uniform(*_WAY)) / speed)
    rate = random.uniform(*_ACCELERATION)
    t, v = [0.0], [0.0]
    for target, seconds in [*legs, (0.0, 0.0)]:
        t += [t[-1] + abs(target - v[-1]) / rate]
        t += [t[-1] + seconds]
        v += [target, target]
    times = _STEP * np.arange(math.ceil(t[-1] / _STEP) + 1, dtype=float)
    speeds = np.interp(times, t, v)
    steps = 0.5 * _STEP * (speeds[1:] + speeds[:-1])
    return times, np.concatenate([[0.0], np.cumsum(steps)])


def _draw_way(random: np.random.Generator, along: FloatArray, *, bends: bool) -> FloatArray:
    """(T, 2) places, seen from above, at (T,) lengths along a way in a random heading [m].

    The way is straight, or bends once between two lengths that are reached.
    """
    length = np.arange(along.min() - _FINE, along.max() + 2.0 * _FINE, _FINE)
    heading = np.full(len(length), random.uniform(-math.pi, math.pi))
    if bends:
        turn = random.uniform(*_TURN) * random.choice([-1.0, 1.0])
        arc = min(random.uniform(*_RADIUS) * abs(turn), np.ptp(along))
        begin = random.uniform(along.min(), along.max() - arc)
        heading += turn * np.clip((length - begin) / arc, 0.0, 1.0)
    steps = _FINE * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    places = np.cumsum(steps, axis=0)
    return np.stack([np.interp(along, length, axis) for axis in places.T], axis=1)


def _misfit(
    thing: Obstacle,
    does: frozenset[int],
    motion: FloatArray,
    others: Sequence[Obstacle],
    first: bool,
) -> str:
    """Why its course will not do; "": it will."""
    end = thing.waypoints[-1][0]
    if end > LONGEST:
        return "longer than 15 s"
    if thing.translation[2] > HIGHEST:
        return TOO_HIGH
    ((shape, p),) = course_tracks(thing, np.arange(0.0, end + _STEP, _STEP))
    radius = bounding_radius(shape)
    if (np.hypot(p[:, 0], p[:, 1]) < radius + BASE_RADIUS).any():
        return ON_BASE
    if ENTERS in does and not (is_outside_image(p[0], radius) and any(map(in_view, p))):
        return "does not enter from outside the image"
    if any(course_gap(thing, other) < GAP for other in others):
        return TOO_NEAR
    if not _start_is_free(motion[0], thing):
        return "at the outset the start leaves the robot less than 5 cm"
    return NOT_MET if first and not is_met(motion, [thing]) else ""


def _start_is_free(q: FloatArray, thing: Obstacle) -> bool:
    cell = scene_cell()
    cell.put([thing])
    return not cell.nearby(q, FREE)
