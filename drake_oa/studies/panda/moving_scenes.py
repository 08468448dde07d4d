"""Random scenes in which things move, on the table or in the air, while the robot does.

In both kinds what moves goes level, the first of it is aimed at where a link will be on the
pre-planned motion, and none to two things besides stand on the table. All is drawn again until

- the first meets the pre-planned motion in time: some link of the robot, followed along the
  straight line as it is planned, goes at least 5 mm into it while its course lasts;
- nothing moves through the robot's base, above 0.6 m (its middle), or nearer than 2 cm to
  another thing at any time (spheres round the shapes).

`moving`: one or two boxes, spheres and cylinders of 5 to 15 cm at 0.1 to 0.4 m/s, each along a
straight course; they rest before and after. Besides the above

- where they rest at first, and for the first second, they leave the robot's start free (5 cm
  of the whole robot), and where they rest at last, the robot's goal;
- no course leaves the camera's view.

`moving_hard`: two to four of 5 to 30 cm, each of which does one to five of these, in a random
order: it

- enters from outside the camera's image, and is on its way from the outset;
- changes its speed, within 0.1 to 0.8 m/s, at 1 to 3 m/s^2, as it does at its begin and end;
- turns, by 30 to 120 degrees, on an arc of 20 to 50 cm radius, less on a short way;
- stops for 0.5 to 2 s, and goes on;
- comes back the way that it went.

The courses of the others pass anywhere over the table. Each ends within 15 s, with the thing at
rest, in the image or outside it. What a thing is and which of these it does is drawn once. What
rests leaves the robot's start and goal free, and what moves leaves the start free at time 0, and
at no other time is that asked.

Nothing else is asked. A thing may come at the arm where it cannot get away, press it to the
table, or come to rest where the goal is: not every scene has a solution, and the planner's
share tells how many have one for certain.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.shapes import Box, Cylinder, Sphere, bounding_radius, pose
from drake_oa.scenario.obstacles import Obstacle
from drake_oa.studies.panda.scene_parts import (
    BASE_RADIUS,
    COLORS,
    ENDS_TAKEN,
    FREE,
    GAP,
    ON_BASE,
    OUT_OF_VIEW,
    TABLE_X,
    TABLE_Y,
    TOO_NEAR,
    TOUCH,
    TOUCHES_TABLE,
    Drawn,
    base_scenario,
    draw_obstacles,
    ends_are_free,
    first_on_motion,
    half_height,
    in_view,
    is_outside_image,
    planning_scene,
)
from drake_oa.studies.results import Tally

MOST_RESTING = 2
QUIET = 1.0
"""So long nothing touches the robot where it stands at the start [s]."""
LONGEST = 15.0
"""When all courses of `moving_hard` have ended [s]."""

_SIZE, _HARD_SIZE = (0.05, 0.15), (0.05, 0.30)
"""Of the dimensions of a thing that moves [m]."""
_MOVING, _HARD_MOVING = (1, 2), (2, 4)
"""How many things move."""
_SPEED, _HARD_SPEED = (0.1, 0.4), (0.1, 0.8)
"""In `moving_hard` between begin, stops and end [m/s]."""
_MET = (0.25, 0.75)
"""When the robot is met, as a share of the planned duration."""
_BEFORE, _AFTER = (0.5, 2.5), (0.5, 2.5)
"""How long a thing moves before and after it meets the robot [s]."""
_AIMED_ASIDE = (-0.05, 0.05)
"""How far the middle of its course is from that of a link then, along each axis [m]."""
_NEAR_TABLE = 0.05
"""What is aimed at no higher than this over its lowest place slides on the table [m]."""
_OFF_TABLE = 2e-3
"""How high a thing slides over the table [m]: it does not rub."""
_HIGHEST = 0.6
"""Of the middle of anything [m]."""
_HIT = slice(4, 7)
"""Links of the arm of which one is met, or the hand: those that reach out."""
_SAMPLE = 0.05
"""Between the instants at which courses are looked at, and bend or change their speed [s]."""
_SETS = 12
"""Sets of things tried for the same motion."""
_COURSES = 60
"""Courses tried for a thing among the same others."""
_MOST_MOTIONS, _HARD_MOST_MOTIONS = 1000, 2000

# What a thing of `moving_hard` may do.
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
_FINE = 0.01
"""Of length on a course [m]."""

# Why candidates are dropped.
TOO_HIGH = "above 0.6 m"
NOT_MET = "the first thing that moves does not touch the planned motion"

_Does = frozenset[int]


def draw_moving(random: np.random.Generator, tally: Tally) -> Drawn:
    """A scene with one or two moving things, see `first_drawn`."""
    moving, resting = _draw_numbers(random, _MOVING)

    def draw_things(
        _start: FloatArray, goal: FloatArray, motion: FloatArray
    ) -> list[Obstacle] | None:
        for _ in range(_SETS):
            things = _draw_set(random, tally, motion, moving, resting)
            if things is not None and tally.takes("scenes", _no_scene(motion, goal, things)):
                return things
        return None

    what = f"{moving} moving and {resting} resting things"
    return first_on_motion(random, tally, draw_things, _MOST_MOTIONS, what)


def draw_hard(random: np.random.Generator, tally: Tally) -> Drawn:
    """A scene with two to four moving things, see `first_drawn`."""
    moving, resting = _draw_numbers(random, _HARD_MOVING)
    movers = [_draw_mover(random, number) for number in range(moving)]

    def draw_things(
        _start: FloatArray, goal: FloatArray, motion: FloatArray
    ) -> list[Obstacle] | None:
        standing = draw_obstacles(random, resting, tally)
        if standing is None:
            return None
        _number(standing, moving)
        reason, moved = _no_place(motion, goal, standing), None
        if not reason:
            moved = _draw_courses(random, tally, movers, motion, standing)
            reason = "" if moved else "no course found for one of its things"
        return [*moved, *standing] if tally.takes("scenes", reason) and moved else None

    what = f"{moving} moving and {resting} resting things"
    return first_on_motion(random, tally, draw_things, _HARD_MOST_MOTIONS, what)


def _draw_numbers(random: np.random.Generator, moving: tuple[int, int]) -> tuple[int, int]:
    """How many things move, and how many rest."""
    fewest, most = moving
    return int(random.integers(fewest, most + 1)), int(random.integers(MOST_RESTING + 1))


def _draw_mover(random: np.random.Generator, number: int) -> tuple[Obstacle, _Does]:
    """A thing that moves, without its course, and what it does on it."""
    does = random.permutation(5)[: random.integers(1, 6)]
    thing = Obstacle(
        name=f"moving{number}",
        shapes=[_draw_shape(random, *_HARD_SIZE)],
        rpy=[0.0, 0.0, float(random.uniform(-math.pi, math.pi))],
        color=list(COLORS[number % len(COLORS)]),
    )
    return thing, frozenset(does.tolist())


def _draw_set(
    random: np.random.Generator, tally: Tally, motion: FloatArray, moving: int, resting: int
) -> list[Obstacle] | None:
    """Things that keep off each other, or None where there is no room for all."""
    crossing = [_draw_crossing(random, motion, number) for number in range(moving)]
    fit = [tally.takes("courses", _crossing_misfit(obstacle)) for obstacle in crossing]
    if not all(fit):
        return None
    standing = draw_obstacles(random, resting, tally)
    if standing is None:
        return None
    _number(standing, moving)
    things = [*crossing, *standing]
    apart = all(
        _course_gap(one, other) >= GAP
        for row, one in enumerate(crossing)
        for other in things[row + 1 :]
    )
    return things if tally.takes("sets of things", "" if apart else TOO_NEAR) else None


def _number(things: Sequence[Obstacle], start: int) -> None:
    """Names and colours things by their number from `start` on."""
    for number, thing in enumerate(things, start=start):
        thing.name = f"{thing.name.rstrip('0123456789')}{number}"
        thing.color = list(COLORS[number % len(COLORS)])


def _draw_crossing(random: np.random.Generator, motion: FloatArray, number: int) -> Obstacle:
    """A thing whose course passes the middle of a link when the robot is there."""
    row = int(random.uniform(*_MET) * len(motion))
    met = row * base_scenario().task.duration / (len(motion) - 1)
    point = _aimed(random, motion[row])
    shape = _draw_shape(random, *_SIZE)
    z = _level_height(shape, float(point[2]))
    speed, heading = random.uniform(*_SPEED), random.uniform(-math.pi, math.pi)
    velocity = speed * np.array([math.cos(heading), math.sin(heading)])
    begins = max(met - float(random.uniform(*_BEFORE)), 0.0)
    ends = met + float(random.uniform(*_AFTER))
    begins, ends = round(begins, 2), round(ends, 2)
    x, y = point[:2] - velocity * (met - begins)
    way = np.round(velocity * (ends - begins), 4)
    return Obstacle(
        name=f"moving{number}",
        shapes=[shape],
        translation=[round(float(x), 4), round(float(y), 4), round(z, 4)],
        rpy=[0.0, 0.0, float(random.uniform(-math.pi, math.pi))],
        color=list(COLORS[number % len(COLORS)]),
        waypoints=[[begins, 0.0, 0.0, 0.0], [ends, *map(float, way), 0.0]],
    )


def _aimed(random: np.random.Generator, q: FloatArray) -> FloatArray:
    """(3,) a point about the middle of a link at (nq,) positions q [m]."""
    robot = base_scenario().robot
    hand = () if robot is None else (robot.hand_link,)
    links = (*planning_scene().arm_links[_HIT], *hand)
    points = planning_scene().shape_centers(q, links)
    return np.asarray(points[random.integers(len(points))] + random.uniform(*_AIMED_ASIDE, 3))


def _level_height(shape: Box | Cylinder | Sphere, z: float) -> float:
    """Height of a shape's middle on a course at about height z [m]: near the table it slides."""
    lowest = half_height(shape) + _OFF_TABLE
    return z if z > lowest + _NEAR_TABLE else lowest


def _draw_shape(
    random: np.random.Generator, smallest: float, largest: float
) -> Box | Cylinder | Sphere:
    """A box, a cylinder or a sphere whose dimensions are within two lengths [m]."""
    x, y, z = (float(v) for v in random.uniform(smallest, largest, 3))
    kind = random.integers(3)
    if kind == 0:
        return Box(size=[x, y, z])
    return Cylinder(radius=0.5 * x, length=z) if kind == 1 else Sphere(radius=0.5 * x)


def _no_place(motion: FloatArray, goal: FloatArray, standing: Sequence[Obstacle]) -> str:
    """Why the motion will not do among what rests."""
    if not _touches_no_table(motion):
        return TOUCHES_TABLE
    planning_scene().put(standing)
    return "" if ends_are_free(motion, goal) else ENDS_TAKEN


def _draw_courses(
    random: np.random.Generator,
    tally: Tally,
    movers: Sequence[tuple[Obstacle, _Does]],
    motion: FloatArray,
    standing: Sequence[Obstacle],
) -> list[Obstacle] | None:
    """The things with their courses, or None where no course was found for one."""
    moved: list[Obstacle] = []
    for mover, does in movers:
        for _ in range(_COURSES):
            thing = _on_course(random, mover, does, motion, first=not moved)
            others = [*moved, *standing]
            if tally.takes("courses", _hard_misfit(thing, does, motion, others, not moved)):
                moved.append(thing)
                break
        else:
            return None
    return moved


def _on_course(
    random: np.random.Generator, thing: Obstacle, does: _Does, motion: FloatArray, *, first: bool
) -> Obstacle:
    """The thing on a course, the first's past the middle of a link when the link is there."""
    t, along = _draw_speeds(random, does)
    if ENTERS not in does:
        t = t + round(float(random.uniform(*_BEGIN)), 2)
    if first:
        row = int(random.uniform(*_MET) * (len(motion) - 1))
        passed = row * base_scenario().task.duration / (len(motion) - 1)
        point = _aimed(random, motion[row])
    else:
        passed = random.uniform(t[0], t[-1])
        point = np.array([random.uniform(*side) for side in (TABLE_X, TABLE_Y, (0.0, _HIGHEST))])
    p = _draw_way(random, along, bends=TURNS in does)
    p += point[:2] - [np.interp(passed, t, axis) for axis in p.T]
    # Between two rows that are kept it goes straight on at the same speed.
    velocity = np.diff(p, axis=0) / _SAMPLE
    changed = np.linalg.norm(np.diff(velocity, axis=0), axis=1) > 1e-6
    kept = np.concatenate([[True], changed, [True]])
    z = _level_height(thing.shapes[0], float(point[2]))
    begin = np.round(p[0], 4)
    return replace(
        thing,
        translation=[*map(float, begin), round(z, 4)],
        waypoints=[
            [round(float(time), 2), *(round(float(v), 4) for v in place - begin), 0.0]
            for time, place in zip(t[kept], p[kept], strict=True)
        ],
    )


def _draw_speeds(random: np.random.Generator, does: _Does) -> tuple[FloatArray, FloatArray]:
    """(T,) times from 0 [s], `_SAMPLE` apart, and (T,) how far along its way it is then [m]."""
    slowest, fastest = _HARD_SPEED
    speed, sense = float(random.uniform(slowest, fastest)), 1.0
    legs = [(speed, float(random.uniform(*_LEG)))]
    if ENTERS in does:
        legs = [(speed, float(random.uniform(*_WAY)) / speed)]
    for event in random.permutation([CHANGES_SPEED, STOPS, COMES_BACK]):
        if event not in does:
            continue
        if event == CHANGES_SPEED:
            span = fastest - slowest
            step = random.uniform(_CHANGE, span - _CHANGE)
            speed = slowest + float((speed - slowest + step) % span)
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
    times = _SAMPLE * np.arange(math.ceil(t[-1] / _SAMPLE) + 1, dtype=float)
    speeds = np.interp(times, t, v)
    steps = 0.5 * _SAMPLE * (speeds[1:] + speeds[:-1])
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
        begin = random.uniform(along.min(), max(along.max() - arc, along.min()))
        heading += turn * np.clip((length - begin) / arc, 0.0, 1.0)
    steps = _FINE * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    places = np.cumsum(steps, axis=0)
    return np.stack([np.interp(along, length, axis) for axis in places.T], axis=1)


def _crossing_misfit(obstacle: Obstacle) -> str:
    """Why its course will not do; "": it stays in view, off the base and low enough."""
    begin, end = (obstacle.translation + np.asarray(obstacle.waypoints[k][1:]) for k in (0, -1))
    line, radius = np.linspace(begin, end, 11), bounding_radius(obstacle.shapes[0])
    if (line[:, 2] > _HIGHEST).any():
        return TOO_HIGH
    if _over_base(line, radius):
        return ON_BASE
    return "" if all(map(in_view, line)) else OUT_OF_VIEW


def _over_base(p: FloatArray, radius: float) -> bool:
    """Whether a ball at one of (T, 3) places is over the robot's base."""
    return bool((np.hypot(p[:, 0], p[:, 1]) < radius + BASE_RADIUS).any())


def _hard_misfit(
    thing: Obstacle,
    does: _Does,
    motion: FloatArray,
    others: Sequence[Obstacle],
    first: bool,
) -> str:
    """Why its course will not do; "": it will."""
    end = thing.waypoints[-1][0]
    if end > LONGEST:
        return "longer than 15 s"
    if thing.translation[2] > _HIGHEST:
        return TOO_HIGH
    ((shape, p),) = _course_tracks(thing, np.arange(0.0, end + _SAMPLE, _SAMPLE))
    radius = bounding_radius(shape)
    if _over_base(p, radius):
        return ON_BASE
    if ENTERS in does and not (is_outside_image(p[0], radius) and any(map(in_view, p))):
        return "does not enter from outside the image"
    if any(_course_gap(thing, other) < GAP for other in others):
        return TOO_NEAR
    if not _are_free(motion[:1], [thing], [0.0]):
        return "at the outset the start leaves the robot less than 5 cm"
    return NOT_MET if first and not _is_met(motion, [thing]) else ""


def _course_gap(one: Obstacle, other: Obstacle) -> float:
    """Least distance in time of the spheres round the shapes of two things [m]."""
    end = max(item.waypoints[-1][0] for item in (one, other) if item.waypoints)
    times = np.arange(0.0, end + _SAMPLE, _SAMPLE)
    return min(
        float(np.linalg.norm(a - b, axis=1).min()) - bounding_radius(shape) - bounding_radius(thing)
        for shape, a in _course_tracks(one, times)
        for thing, b in _course_tracks(other, times)
    )


def _course_tracks(
    obstacle: Obstacle, times: FloatArray
) -> list[tuple[Box | Cylinder | Sphere, FloatArray]]:
    """The shapes and the (T, 3) places of their middles at (T,) times [m]."""
    X_WO, offsets = pose(obstacle), np.zeros((len(times), 3))
    if obstacle.waypoints:
        t, *axes = np.array(obstacle.waypoints).T
        offsets = np.stack([np.interp(times, t, axis) for axis in axes], axis=1)
    return [(shape, X_WO @ np.asarray(shape.translation) + offsets) for shape in obstacle.shapes]


def _no_scene(motion: FloatArray, goal: FloatArray, obstacles: Sequence[Obstacle]) -> str:
    if not _is_met(motion, obstacles):
        return NOT_MET
    if not _touches_no_table(motion):
        return TOUCHES_TABLE
    if not _are_free(motion[:1], obstacles, np.arange(0.0, QUIET + _SAMPLE, _SAMPLE)):
        return "in the first second the start leaves the robot less than 5 cm"
    end = max(item.waypoints[-1][0] for item in obstacles if item.waypoints)
    if not _are_free([motion[-1], planning_scene().tool_down(goal)], obstacles, [end]):
        return "at last the goal leaves the robot less than 5 cm"
    return ""


def _is_met(motion: FloatArray, obstacles: Sequence[Obstacle]) -> bool:
    """Whether the first thing hits the planned motion while it moves."""
    cell, first = planning_scene(), obstacles[0]
    begins, ends = first.waypoints[0][0], first.waypoints[-1][0]
    times = np.linspace(0.0, base_scenario().task.duration, len(motion))
    for q, time in zip(motion, times, strict=True):
        if begins <= time <= ends:
            cell.put([first], time)
            if any(distance <= -TOUCH for _, _, distance in cell.nearby(q, 0.0)):
                return True
    return False


def _touches_no_table(motion: FloatArray) -> bool:
    """Whether the planned motion keeps off the table and whatever else is not put."""
    cell = planning_scene()
    cell.put([])
    return not any(cell.contacts(q) for q in motion)


def _are_free(
    positions: Iterable[FloatArray], obstacles: Sequence[Obstacle], times: Iterable[float]
) -> bool:
    """Whether the robot keeps `FREE` to the obstacles at (nq,) positions and at times [s]."""
    cell = planning_scene()
    for time in times:
        cell.put(obstacles, float(time))
        if any(cell.nearby(q, FREE) for q in positions):
            return False
    return True
