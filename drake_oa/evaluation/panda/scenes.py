"""Random scenes for the whole Panda; each is a scenario.

The motion is 0.5 to 1.0 m long, along a straight line that the arm can follow, tool down, within
its joint limits. In all kinds but moving_hard the camera at the table, by whose image scenes are
drawn whatever perceives them, has the obstacles' middles in view, and the whole robot keeps 5 cm to
every obstacle at start and goal. The robot is the spheres that enclose its links (`scene_arm`). How
many obstacles there are is drawn once; motions and obstacles are drawn until the conditions of the
kind hold. Scene i of a seed depends on nothing else, and not on perception or method. Kinds:

`tabletop`: 1 to 6 things on the table.

- no two obstacles are nearer to each other than 2 cm (circles round them, seen from above),
  and none stands on the robot's base;
- the nominal motion is not clear: followed along the straight line, some link of the
  robot goes at least 5 mm into an obstacle.

`clutter6`: the same with exactly six things, three or more of them within 25 cm of the hand on the
nominal motion.

`elbow`: the hand's way is free and the elbow's is not. One or two tall things stand, or hang as a
shelf's board does, where the arm's middle links go, ahead of the base: a post, a board in the air,
a box on a stand. On the straight motion in the posture of the start,

- hand and fingers keep 5 cm to everything, the wrist 3 cm, and
- one of the links 2 to 5 goes at least 5 mm into something;
- the camera, which looks less steeply down, has the middle of each in view;
- another posture is free all along: with the elbow led aside in the null space, and the
  tool on the same way, the whole robot keeps 2.5 cm.

`moving`: 1 or 2 things cross the way, one of them into the planned motion; `moving_hard`: 2 to 4
larger and faster things enter, change speed, turn, stop and come back; `moving_high`: the same, up
to 1.0 m: see `moving_scenes`.

`drp_LEVEL`: boxes move or appear by the parameters of a level of DRPBench: see `drp_scenes`.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.random import Generator
from scipy.spatial import cKDTree

from drake_oa.common.messages import FloatArray
from drake_oa.evaluation.cameras import ONE, TWO, seen_from
from drake_oa.evaluation.panda.drp_scenes import LEVELS, SPEED_LEVELS, drp_things
from drake_oa.evaluation.panda.moving_scenes import HIGHEST, moving_objects
from drake_oa.evaluation.panda.scene_arm import ELBOW_LIKE, LIKE, Motion, base_scenario, scene_arm
from drake_oa.evaluation.panda.scene_parts import (
    TOUCH,
    DrawThings,
    Shape,
    draw_motion,
    draw_obstacles,
    ends_are_free,
    fits,
    make_obstacle,
)
from drake_oa.geometry.shapes import Box, Cylinder
from drake_oa.perception.config import GroundTruth
from drake_oa.scenario.obstacles import Obstacle
from drake_oa.scenario.scenario import Scenario

MOST_OBSTACLES = 6
NEAR, NEAR_OBSTACLES = 0.25, 3
"""Minimum number of obstacles in clutter nearer to the moving hand than this [m]."""
_MOST_MOTIONS = 5000


def table_objects(random: Generator, *, cluttered: bool) -> DrawThings:
    """Prepares 1 to 6 obstacles on the table, or six in clutter."""
    count = MOST_OBSTACLES if cluttered else int(random.integers(1, MOST_OBSTACLES + 1))

    def draw(motion: Motion) -> list[Obstacle] | None:
        obstacles = draw_obstacles(random, count)
        if obstacles is None:
            return None
        arm = scene_arm()
        apart = [arm.distances(motion.q, [item]) for item in obstacles]
        near = sum(d[:, arm.tool].min() < NEAR for d in apart)
        is_scene = (
            (near >= NEAR_OBSTACLES or not cluttered)
            and min(d.min() for d in apart) <= -TOUCH
            and ends_are_free(motion, obstacles)
        )
        return obstacles if is_scene else None

    return draw


HAND_FREE = 0.05
"""Minimum clearance of hand and fingers on the straight motion [m]."""
SWUNG_FREE = 0.025
"""Minimum clearance of the whole robot on the motion with its elbow aside [m]."""
WRIST_FREE = 0.03
"""Minimum clearance of links 6 and 7 [m]: the tool fixes their motion, whatever the elbow does."""
MAX_ELBOW_OBJECTS = 2

_ELBOW, _WRIST = range(1, 5), range(5, 7)
"""Joints of the links of which one touches an obstacle, and of those that the tool fixes."""
_HEIGHTS = (0.2, 0.9)
"""Heights of obstacles [m]."""
_OFF, _FROM_AXIS = 0.06, 0.2
"""Minimum distances of a point of the elbow to the links kept free and to the base's axis [m]."""
_AWAY = (0.0, 0.10)
"""Distance of an obstacle from there, away from the links kept free [m]."""
_ASIDE = 0.04
"""Maximum distance of an obstacle from there, along each axis [m]."""
_PLACES = 60
"""Obstacles tried for the same motion."""


def elbow_things(random: Generator) -> DrawThings:
    """Prepares an obstacle in the elbow's way, and a second one where there is room."""

    def draw(motion: Motion) -> list[Obstacle] | None:
        arm, start, goal = scene_arm(), motion.start, motion.goal
        aside = random.choice(arm.postures(0.5 * (start + goal)))
        swung = arm.straight_motion(start, goal, aside)
        places = np.zeros((0, 2, 3)) if swung is None else _elbow_places(motion, swung)
        if swung is None or not len(places):
            return None
        obstacles: list[Obstacle] = []
        for _ in range(_PLACES):
            object = _draw_elbow_object(random, places, len(obstacles))
            if fits(object, obstacles, ELBOW_LIKE) and _is_in_elbow_way(
                object, motion, swung, first=not obstacles
            ):
                obstacles.append(object)
            if len(obstacles) == MAX_ELBOW_OBJECTS:
                break
        return obstacles or None

    return draw


def _elbow_places(motion: Motion, swung: Motion) -> FloatArray:
    """Computes where the elbow passes and nothing else of the robot.

    Returns:
        (N, 2, 3) points of the elbow [m], and unit vectors to them from the nearest point that must
        stay free: of the robot at both ends and on the other motion, and of wrist and hand.
    """
    arm, whole = scene_arm(), range(len(motion.q[0]))
    passed = arm.centers(motion.q[::2], _ELBOW)
    free = [arm.centers(q, whole) for q in (motion.ends, swung.q[::2])]
    tree = cKDTree(np.concatenate([*free, arm.centers(motion.q[::2], _WRIST)]))
    distance, nearest = tree.query(passed)
    found = (distance > _OFF) & (passed[:, 0] > 0.0) & (passed[:, 2] > _HEIGHTS[0])
    found &= np.hypot(passed[:, 0], passed[:, 1]) > _FROM_AXIS
    away = (passed - tree.data[nearest])[found] / distance[found, None]
    return np.stack([passed[found], away], axis=1)


def _draw_elbow_object(random: Generator, places: FloatArray, number: int) -> Obstacle:
    """Draws a post, a board in the air or a box on a stand near one of the `_elbow_places`."""
    point, away = random.choice(places)
    x, y, z = point + random.uniform(*_AWAY) * away + random.uniform(-_ASIDE, _ASIDE, 3)
    z = np.clip(z, *_HEIGHTS)
    edges = random.uniform(0.05, 0.12, 3).tolist()
    kind = ("post", "board", "stand")[random.integers(3)]
    if kind == "post":
        width, depth = 0.67 * edges[0], 0.67 * edges[1]
        at = [0.0, 0.0, 0.5 * z]
        shapes: list[Shape] = [Box(size=[width, depth, z], translation=at)]
        if random.random() < 0.5:
            shapes = [Cylinder(radius=0.5 * width, length=z, translation=at)]
    elif kind == "board":
        size = [edges[0], 2.0 * edges[1], 0.025]
        shapes = [Box(size=size, translation=[0.0, 0.0, z])]
    else:
        foot = z - 0.5 * edges[2]
        shapes = [
            Box(size=edges, translation=[0.0, 0.0, z]),
            Cylinder(radius=0.02, length=foot, translation=[0.0, 0.0, 0.5 * foot]),
        ]
    return make_obstacle(random, kind, number, shapes, (x, y, 0.0))


def _is_in_elbow_way(object: Obstacle, motion: Motion, swung: Motion, *, first: bool) -> bool:
    """Checks that an obstacle is in the elbow's way alone."""
    arm = scene_arm()
    if not ends_are_free(motion, [object]):
        return False
    distance = arm.distances(motion.q, [object]).min(axis=2)
    wrist = np.isin(arm.joint, _WRIST) & ~arm.tool
    if first and distance[:, np.isin(arm.joint, _ELBOW)].min() > -TOUCH:
        return False
    if distance[:, arm.tool].min() < HAND_FREE or distance[:, wrist].min() < WRIST_FREE:
        return False
    return bool(arm.distances(swung.q, [object]).min() >= SWUNG_FREE)


PERCEPTIONS = ("depth", "depth2", "truth")
"""The depth camera of the scene, two cameras beside the robot, or SceneGraph."""


@dataclass(frozen=True)
class _Kind:
    """Drawing of the scenes of a kind.

    Attributes:
        objects: prepares the drawing of obstacles.
        stream: its own random numbers.
        like: the shipped scenario whose camera, robot and constants they have.
        motion: draws the planned motion.
    """

    objects: Callable[[Generator], DrawThings]
    stream: tuple[int, ...]
    like: str = LIKE
    motion: Callable[..., Motion | None] = draw_motion


V = 0.8
"""Speed of obstacles for which moving scenes claim passive motion safety [m/s]."""
DRP = "drp"
"""Suite of all levels of DRPBench."""
_KINDS = {
    "tabletop": _Kind(partial(table_objects, cluttered=False), ()),
    "moving": _Kind(partial(moving_objects, hard=False), (1,)),
    "elbow": _Kind(elbow_things, (2,), ELBOW_LIKE),
    "clutter6": _Kind(partial(table_objects, cluttered=True), (3,)),
    "moving_hard": _Kind(partial(moving_objects, hard=True), (4,)),
    "moving_high": _Kind(partial(moving_objects, hard=True, highest=HIGHEST), (5,)),
    # Levels that differ in speed alone have the same random numbers, thus the same scenes.
    **{
        f"{DRP}_{name}": _Kind(
            partial(drp_things, level=level),
            (6, *name.partition("_at_")[0].encode()),
            motion=level.draw_motion,
        )
        for name, level in (LEVELS | SPEED_LEVELS).items()
    },
}
KINDS = tuple(_KINDS)
MOVING_KINDS = tuple(kind for kind in KINDS if kind.startswith(("moving", DRP)))
"""Kinds of scenes with moving obstacles."""


def suite_kinds(suites: Sequence[str], levels: Sequence[str]) -> list[str]:
    """Returns the kinds of scenes of suites, each once, with levels of DRPBench for `drp`.

    Args:
        suites: kinds of scenes, or `drp`.
        levels: names of levels; none: those that are its authors'.

    Raises:
        ValueError: for levels without the suite `drp`.
    """
    if levels and DRP not in suites:
        raise ValueError(f"--level needs --suite {DRP}, not {', '.join(suites)}")
    of_drp = [f"{DRP}_{level}" for level in levels or LEVELS]
    kinds = [kind for suite in suites for kind in (of_drp if suite == DRP else [suite])]
    return list(dict.fromkeys(kinds))


def draw_panda_scene(
    seed: int,
    index: int,
    *,
    kind: str = "tabletop",
    perception: str = "depth",
) -> Scenario:
    """Draws a random scene.

    Args:
        seed: of the evaluation, >= 0.
        index: of the scene, >= 0.
        kind: one of `KINDS`.
        perception: "depth", one camera: among obstacles at rest that of the shipped scenarios,
            among moving ones `cameras.ONE`; "depth2", the pair `cameras.TWO`; or "truth".

    Raises:
        RuntimeError: if no scene was found.
    """
    of_kind = _KINDS[kind]
    scenario = copy.deepcopy(base_scenario(of_kind.like))
    if kind in MOVING_KINDS:
        scenario.guard = replace(scenario.guard, obstacle_speed=V)
        scenario = seen_from(scenario, ONE)
    random = np.random.default_rng(np.random.SeedSequence([seed, index, *of_kind.stream]))
    scenario.seed = int(random.integers(2**31))
    draw_things = of_kind.objects(random)
    for _ in range(_MOST_MOTIONS):
        motion = of_kind.motion(random)
        obstacles = None if motion is None else draw_things(motion)
        if motion is not None and obstacles is not None:
            break
    else:
        raise RuntimeError(f"no {kind} scene found in {_MOST_MOTIONS} attempts")
    scenario.obstacles = obstacles
    scenario.task.start, scenario.task.goal = motion.start.tolist(), motion.goal.tolist()
    scenario.task.rpy_start = scenario.task.rpy_goal = motion.rpy_WE
    scenario.description = f"random {kind} scene {index} of seed {seed}"
    return seen_by(scenario, perception)


def seen_by(scenario: Scenario, perception: str) -> Scenario:
    """Returns a scenario that was drawn with "depth", seen by one of `PERCEPTIONS`."""
    if perception == "depth2":
        return seen_from(scenario, TWO)
    scenario = copy.deepcopy(scenario)
    if perception == "truth":
        scenario.perception = GroundTruth()
    return scenario
