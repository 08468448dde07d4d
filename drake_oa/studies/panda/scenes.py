"""Random scenes for the whole Panda; each is a scenario.

The motion is 0.5 to 1.0 m long, along a straight line that the arm can follow, tool down, within
its joint limits. In all kinds but moving_hard the camera has the obstacles' middles in view, and
the whole robot keeps 5 cm to every obstacle at start and goal. Scene i of a seed depends on nothing
else, and not on perception or method. Kinds:

`tabletop`: 1 to 6 things on the table. The number is drawn once; the rest is drawn again until

- no two obstacles are nearer to each other than 2 cm (circles round them, seen from above),
  and none stands on the robot's base;
- start and goal are free: the whole robot, posed there, keeps 5 cm to every obstacle and
  does not touch the table;
- the pre-planned motion is not clear: followed along the straight line, some link of the
  robot goes at least 5 mm into an obstacle (by SceneGraph, with the joints that the arm
  takes there).

`clutter6`: the same with exactly six things, three or more of them beside the way.

`elbow`: the hand's way is free and the elbow's is not. One or two tall things stand, or hang as a
shelf's board does, where the arm's middle links go, ahead of the base: a post, a board in the air,
a box on a stand. They are drawn again until, on the straight motion in the controller's own
posture,

- hand and fingers keep 5 cm to everything, the wrist 3 cm, and
- one of the links 2 to 5 goes at least 5 mm into something;
- start and goal are free (5 cm of the whole robot), and so is the base;
- the camera, which looks less steeply down, has the middle and the top of each in view;
- another posture is free all along: with the elbow swung aside in the null space, and the
  tool on the same way, the whole robot keeps 2.5 cm.

`moving`: 1 or 2 things cross the way, one of them into the planned motion; `moving_hard`: 2 to 4
larger and faster things enter, change speed, turn, stop and come back: see `moving_scenes`.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.shapes import Box, Cylinder, Sphere
from drake_oa.perception.config import GroundTruth
from drake_oa.scenario.obstacles import Obstacle
from drake_oa.scenario.scenario import Scenario
from drake_oa.studies.cameras import with_opposite
from drake_oa.studies.panda.moving_scenes import draw_hard, draw_moving
from drake_oa.studies.panda.scene_parts import (
    BASE_RADIUS,
    COLORS,
    ENDS_TAKEN,
    FREE,
    LIKE,
    NOT_FOLLOWED,
    ON_BASE,
    OUT_OF_VIEW,
    TOO_NEAR,
    TOUCH,
    TOUCHES_TABLE,
    Drawn,
    base_scenario,
    draw_ends,
    draw_obstacles,
    drawing,
    ends_are_free,
    first_drawn,
    first_on_motion,
    footprint_radius,
    half_height,
    height,
    in_view,
    planning_scene,
    stands_apart,
)
from drake_oa.studies.results import Tally

MOST_OBSTACLES = 6
NEAR, NEAR_OBSTACLES = 0.25, 3
"""In clutter so many obstacles are nearer than this to the straight line [m]."""

_ARM_WIDTH = 0.15
"""How far the arm may be aside of the triangle of base, start and goal [m]."""
_MOTIONS = 12
"""Motions tried among the same obstacles."""
_MOST_ATTEMPTS = 2000
_SAMPLES = 41
"""Of the straight line."""

Condition = Callable[[FloatArray, FloatArray, Sequence[Obstacle]], str]
"""Why start, goal and obstacles are no scene; "": they may be one."""


def draw_tabletop(random: np.random.Generator, tally: Tally) -> Drawn:
    """A scene of 1 to 6 obstacles, see `first_drawn`."""
    return _draw_on_table(
        random, tally, int(random.integers(1, MOST_OBSTACLES + 1)), _no_table_scene
    )


def draw_clutter(random: np.random.Generator, tally: Tally) -> Drawn:
    """A scene of six obstacles, see `first_drawn`."""
    return _draw_on_table(random, tally, MOST_OBSTACLES, _no_clutter)


def _draw_on_table(
    random: np.random.Generator, tally: Tally, count: int, no_scene: Condition
) -> Drawn:
    def attempt() -> Drawn | None:
        obstacles = draw_obstacles(random, count, tally)
        if obstacles is None:
            return None
        planning_scene().put(obstacles)
        for _ in range(_MOTIONS):
            ends = draw_ends(random, tally)
            if ends is not None and tally.takes("scenes", no_scene(*ends, obstacles)):
                return obstacles, *ends
        return None

    return first_drawn(attempt, _MOST_ATTEMPTS, f"{count} obstacles")


def _no_clutter(start: FloatArray, goal: FloatArray, obstacles: Sequence[Obstacle]) -> str:
    near = sum(distance_to_line(start, goal, obstacle) < NEAR for obstacle in obstacles)
    if near < NEAR_OBSTACLES:
        return "fewer than three things within 25 cm of the way"
    return _no_table_scene(start, goal, obstacles)


def distance_to_line(start: FloatArray, goal: FloatArray, obstacle: Obstacle) -> float:
    """Least distance of the upright cylinder round an obstacle to the line of the tool [m]."""
    line = np.linspace(start, goal, _SAMPLES)
    aside = np.linalg.norm(line[:, :2] - obstacle.translation[:2], axis=1)
    aside = np.maximum(aside - footprint_radius(obstacle), 0.0)
    above = np.maximum(line[:, 2] - height(obstacle), 0.0)
    return float(np.hypot(aside, above).min())


def _no_table_scene(start: FloatArray, goal: FloatArray, obstacles: Sequence[Obstacle]) -> str:
    """Why not; "": start and goal are free and the straight motion is feasible, but not clear."""
    clear = "the planned motion is clear"
    if _line_is_far(start, goal, obstacles):
        return clear
    cell = planning_scene()
    motion = cell.straight_motion(start, goal)
    if motion is None:
        return NOT_FOLLOWED
    touched = [hit for q in motion for hit in cell.contacts(q)]
    if not any(thing and depth >= TOUCH for _, thing, depth in touched):
        return clear
    if not all(thing for _, thing, _ in touched):
        return TOUCHES_TABLE
    return "" if ends_are_free(motion, goal) else ENDS_TAKEN


def _line_is_far(start: FloatArray, goal: FloatArray, obstacles: Sequence[Obstacle]) -> bool:
    """Whether neither the tool nor the arm above the line can come near an obstacle.

    Seen from above, the arm stays in the triangle of base, start and goal, about its own
    width aside.
    """
    corners = np.array([[0.0, 0.0], start[:2], goal[:2]])
    return all(
        _distance_to_triangle(np.asarray(o.translation[:2]), corners)
        > footprint_radius(o) + _ARM_WIDTH
        for o in obstacles
    )


def _distance_to_triangle(p: FloatArray, corners: FloatArray) -> float:
    following = np.roll(corners, -1, axis=0)
    edges = following - corners
    to_p = p - corners
    turn = edges[:, 0] * to_p[:, 1] - edges[:, 1] * to_p[:, 0]
    if (turn >= 0.0).all() or (turn <= 0.0).all():
        return 0.0
    share = np.clip((to_p * edges).sum(1) / (edges**2).sum(1), 0.0, 1.0)
    return float(np.linalg.norm(to_p - share[:, None] * edges, axis=1).min())


HAND_FREE = 0.05
"""What hand and fingers keep on the straight motion [m]."""
SWUNG_FREE = 0.025
"""What the whole robot keeps on the motion with its elbow aside [m]."""
WRIST_FREE = 0.03
"""What links 6 and 7 keep there [m]: the tool holds them, whatever the elbow does."""
ELBOW, WRIST = slice(1, 5), slice(5, 7)
"""Links of the arm of which one touches, and those that the tool holds."""
SWINGS = (1.0, -1.0, 2.0, -2.0, 3.0, -3.0)
"""How the elbow may swing, see `PlanningScene.straight_motion` [rad]."""

ELBOW_LIKE = "shelf_elbow"
"""The shipped scenario whose camera the scenes have: it looks higher than the table-top ones'."""
ELBOW_THINGS = ("post", "board", "stand")
MOST_ELBOW_THINGS = 2

_HIGHEST = 0.9
"""Of anything [m]."""
_LOWEST = 0.2
"""Of the points of the arm at which things are put [m]."""
_OFF = 0.06
"""What such a point keeps from what is to stay free of the robot [m], see `_places`."""
_FROM_AXIS = 0.2
"""What it keeps from the axis of the base [m]."""
_AHEAD = 0.0
"""How far ahead of the base it is at least [m]: behind it the arm hides what the camera sees."""
_AWAY = (0.0, 0.10)
"""How much further off a thing is put [m]."""
_ASIDE = 0.04
"""How far from there, along each axis [m]."""
_PLACES = 160
"""Things tried for the same motion."""
_MOST_MOTIONS = 1000

# Why candidates are dropped.
NOT_SWUNG = "the arm cannot follow with its elbow aside"
NOWHERE = "nowhere passes the elbow alone"


def draw_elbow(random: np.random.Generator, tally: Tally) -> Drawn:
    """A scene with a thing in the elbow's way, and a second where it finds room: `first_drawn`."""

    def draw_things(
        start: FloatArray, goal: FloatArray, motion: FloatArray
    ) -> list[Obstacle] | None:
        swung = planning_scene().straight_motion(start, goal, float(random.choice(SWINGS)))
        places = np.empty((0, 2, 3)) if swung is None else _places(motion, swung)
        nowhere = NOT_SWUNG if swung is None else NOWHERE if not len(places) else ""
        if not tally.takes("elbow motions", nowhere) or swung is None:
            return None
        obstacles: list[Obstacle] = []
        for _ in range(_PLACES):
            obstacle = _draw_elbow_thing(random, places, len(obstacles))
            tried = [*obstacles, obstacle]
            misfit = _elbow_misfit(obstacle, obstacles)
            misfit = misfit or _no_elbow_scene(motion, swung, goal, tried)
            if tally.takes("things for the elbow", misfit):
                obstacles = tried
            if len(obstacles) == MOST_ELBOW_THINGS:
                break
        return obstacles or None

    what = "things that only the elbow meets"
    return first_on_motion(random, tally, draw_things, _MOST_MOTIONS, what)


def _places(motion: FloatArray, swung: FloatArray) -> FloatArray:
    """(K, 2, 3) where the elbow passes and nothing else of the robot, and the way off there.

    The first are points [m] of the elbow's links on the motion, the second the unit vectors
    to them from the nearest point that is to stay free: of the robot at both ends, of its
    wrist and hand on the motion, and of all of it on the other motion.
    """
    cell = planning_scene()
    held = (*_hand_links(), *cell.arm_links[WRIST])
    passed = np.concatenate([cell.shape_centers(q, cell.arm_links[ELBOW]) for q in motion[::2]])
    free = [cell.shape_centers(q) for q in (*motion[[0, -1]], *swung[::2])]
    free += [cell.shape_centers(q, held) for q in motion[::2]]
    tree = cKDTree(np.concatenate(free))
    distance, nearest = tree.query(passed)
    from_axis = np.hypot(passed[:, 0], passed[:, 1])
    found = (distance >= _OFF) & (passed[:, 2] >= _LOWEST) & (from_axis >= _FROM_AXIS)
    found &= passed[:, 0] >= _AHEAD
    away = (passed - tree.data[nearest])[found] / distance[found, None]
    return np.stack([passed[found], away], axis=1)


def _draw_elbow_thing(random: np.random.Generator, places: FloatArray, number: int) -> Obstacle:
    """A post, a board in the air or a box on a stand at one of the places.

    Args:
        random: where the numbers come from.
        places: see `_places`.
        number: its place among the obstacles: name and colour follow from it.
    """
    point, away = places[random.integers(len(places))]
    point = point + random.uniform(*_AWAY) * away + random.uniform(-_ASIDE, _ASIDE, 3)
    kind = (
        ELBOW_THINGS[random.integers(len(ELBOW_THINGS))] if in_view(point, ELBOW_LIKE) else "post"
    )
    x, y, z = (round(float(v), 4) for v in point)
    shapes: list[Box | Cylinder | Sphere]
    if kind == "post":
        tall = min(z + float(random.uniform(0.02, 0.15)), _HIGHEST)
        width, depth = (float(v) for v in random.uniform(0.03, 0.08, 2))
        round_post = Cylinder(radius=0.5 * width, length=tall)
        shapes = [round_post if random.random() < 0.5 else Box(size=[width, depth, tall])]
        z = 0.5 * tall
    elif kind == "board":
        size = [random.uniform(0.06, 0.15), random.uniform(0.08, 0.25), random.uniform(0.02, 0.03)]
        shapes = [Box(size=[float(edge) for edge in size])]
    else:
        edges = [float(v) for v in random.uniform(0.05, 0.12, 3)]
        foot = max(z - 0.5 * edges[2], 0.05)
        z = foot + 0.5 * edges[2]
        stand = Cylinder(radius=float(random.uniform(0.015, 0.03)), length=foot)
        stand.translation = [0.0, 0.0, 0.5 * foot - z]
        shapes = [Box(size=edges), stand]
    return Obstacle(
        name=f"{kind}{number}",
        shapes=shapes,
        translation=[x, y, round(z, 4)],
        rpy=[0.0, 0.0, float(random.uniform(-math.pi, math.pi))],
        color=list(COLORS[number % len(COLORS)]),
    )


def _elbow_misfit(obstacle: Obstacle, others: Sequence[Obstacle]) -> str:
    """Why it cannot be there.

    "": it is in view, beside the others, and where it stands beside the robot's base.
    """
    place, radius = obstacle.translation[:2], footprint_radius(obstacle)
    in_air = len(obstacle.shapes) == 1 and half_height(obstacle.shapes[0]) < obstacle.translation[2]
    if not in_air and math.hypot(*place) < radius + BASE_RADIUS:
        return ON_BASE
    if obstacle.translation[2] + half_height(obstacle.shapes[0]) > _HIGHEST:
        return "above 0.9 m"
    if not stands_apart(obstacle, others):
        return TOO_NEAR
    return "" if all(in_view(point, ELBOW_LIKE) for point in _seen(obstacle)) else OUT_OF_VIEW


def _seen(obstacle: Obstacle) -> list[FloatArray]:
    """Its middle and its highest points: what sticks out of the image nobody can go round."""
    middle = np.asarray(obstacle.translation)
    radius, height = footprint_radius(obstacle), half_height(obstacle.shapes[0])
    corners = [(x, y, height) for x in (-radius, radius) for y in (-radius, radius)]
    return [middle, *(middle + np.asarray(corner) for corner in corners)]


def _hand_links() -> list[str]:
    robot = base_scenario().robot
    return robot.tool_links if robot is not None else []


def _no_elbow_scene(
    motion: FloatArray, swung: FloatArray, goal: FloatArray, obstacles: Sequence[Obstacle]
) -> str:
    """Why not; "": the elbow touches on the motion, and nothing does on the other one."""
    cell = planning_scene()
    cell.put(obstacles)
    if any(cell.nearby(q, FREE) for q in motion[[0, -1]]):
        return ENDS_TAKEN
    # A coarse look first: most sets fail at the hand or on the other motion.
    for step in (6, 1):
        if not all(cell.is_free(q, SWUNG_FREE) for q in swung[::step]):
            return "the motion with the elbow aside leaves less than 2.5 cm"
        if not all(map(_hand_is_free, motion[::step])):
            return "the planned motion leaves the hand less than 5 cm or the wrist 3 cm"
        if step > 1 and not any(map(_elbow_touches, motion[::2])):
            return "the elbow does not touch it"
    if not all(thing for q in motion for _, thing, _ in cell.contacts(q)):
        return TOUCHES_TABLE
    return "" if ends_are_free(motion, goal) else ENDS_TAKEN


def _hand_is_free(q: FloatArray) -> bool:
    cell, tool_links = planning_scene(), _hand_links()
    wrist = cell.arm_links[WRIST]
    return not any(
        link in tool_links or (link in wrist and distance < WRIST_FREE)
        for link, _, distance in cell.nearby(q, HAND_FREE)
    )


def _elbow_touches(q: FloatArray) -> bool:
    cell = planning_scene()
    touched, elbow = cell.nearby(q, 0.0), cell.arm_links[ELBOW]
    return any(link in elbow and distance <= -TOUCH for link, _, distance in touched)


GENERATOR = 1
"""To be raised when the same seed draws another scene."""
PERCEPTIONS = ("depth", "depth2", "truth")
"""The depth camera of the scene, a second one opposite to it as well, or SceneGraph."""


@dataclass(frozen=True)
class _Kind:
    """How scenes of a kind are drawn, and what they are called.

    Attributes:
        draw: draws one, and counts what it drops.
        title: of the kind.
        stream: its own random numbers.
        like: the shipped scenario whose camera, robot and constants they have.
    """

    draw: Callable[[np.random.Generator, Tally], Drawn]
    title: str
    stream: tuple[int, ...]
    like: str = LIKE


_KINDS = {
    "tabletop": _Kind(draw_tabletop, "table-top", ()),
    "moving": _Kind(draw_moving, "moving", (1,)),
    "elbow": _Kind(draw_elbow, "elbow", (2,), ELBOW_LIKE),
    "clutter6": _Kind(draw_clutter, "clutter", (3,)),
    "moving_hard": _Kind(draw_hard, "hard moving", (4,)),
}
KINDS = tuple(_KINDS)
MOVING_KINDS = ("moving", "moving_hard")
"""Kinds of scenes with moving obstacles."""


def draw_panda_scene(
    seed: int,
    index: int,
    *,
    kind: str = "tabletop",
    perception: str = "depth",
    tally: Tally | None = None,
) -> Scenario:
    """One random scene.

    Args:
        seed: of the evaluation, >= 0.
        index: of the scene, >= 0.
        kind: one of `KINDS`.
        perception: "depth", the camera as the shipped scenarios have it, "depth2", a second one
            opposite to it too, or "truth".
        tally: counts the candidates, and why they were dropped; None: nobody asks.

    Raises:
        ValueError: for an unknown kind or perception.
        RuntimeError: if no scene was found.
    """
    check_kind(kind)
    check_perception(perception)
    of_kind = _KINDS[kind]
    scenario = copy.deepcopy(base_scenario(of_kind.like))
    random = np.random.default_rng(np.random.SeedSequence([seed, index, *of_kind.stream]))
    scenario.seed = int(random.integers(2**31))
    with drawing:
        scenario.obstacles, start, goal = of_kind.draw(random, tally or Tally())
    scenario.task.start = [round(float(v), 4) for v in start]
    scenario.task.goal = [round(float(v), 4) for v in goal]
    scenario.description = f"random {of_kind.title} scene {index} of seed {seed}"
    return seen_by(scenario, perception)


def seen_by(scenario: Scenario, perception: str) -> Scenario:
    """A scenario as drawn with "depth", seen by that or by something else of `PERCEPTIONS`."""
    check_perception(perception)
    if perception == "depth2":
        return with_opposite(scenario)
    scenario = copy.deepcopy(scenario)
    if perception == "truth":
        scenario.perception = GroundTruth()
    return scenario


def check_kind(kind: str) -> None:
    """Raises ValueError if there is no such kind of scenes."""
    if kind not in KINDS:
        raise ValueError(f"unknown kind of scenes '{kind}': it must be one of {', '.join(KINDS)}")


def check_perception(name: str) -> None:
    """Raises ValueError for what is no perception of the scenes."""
    if name not in PERCEPTIONS:
        raise ValueError(f"unknown perception '{name}': it must be one of {', '.join(PERCEPTIONS)}")
