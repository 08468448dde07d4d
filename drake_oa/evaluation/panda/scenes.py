"""Random scenes of the Panda, each of which is a scenario.

The nominal motion is a straight line of 0.5 to 1.0 m that the arm can follow within its joint
limits with the tool down. In all kinds but moving_hard, moving_high and drp_LEVEL, obstacles'
centers are in the view of the camera at the table, also if another source perceives them. At start
and goal the whole robot has 5 cm clearance to every obstacle. The robot is represented by its
enclosing spheres (`scene_arm`). The number of obstacles is drawn once; motions and obstacles are
drawn until the conditions of the kind hold. Scene i of a seed does not depend on perception or
method. Kinds:

`tabletop`: 1 to 6 objects on the table.

- No two obstacles are within 2 cm of each other (horizontal circles around them), and none is at
  the robot's base.
- On the nominal motion some link of the robot penetrates an obstacle by at least 5 mm.

`clutter6`: as `tabletop` with exactly six objects, at least three of them within 25 cm of the hand
on the nominal motion.

`elbow`: the hand's path is free and the elbow's is blocked. One or two obstacles (a post, a board
in the air, or a box on a stand) are in the path of the arm's middle links, in front of the base. On
the straight motion with the nominal posture of the start,

- the clearance of hand and fingers is at least 5 cm, that of the wrist at least 3 cm, and
- one of the links 2 to 5 penetrates an obstacle by at least 5 mm;
- the camera, which has a smaller downward tilt, has the center of each obstacle in view;
- another posture is free: with the elbow moved aside in the null space and the same tool path, the
  clearance of the whole robot is at least 2.5 cm.

`moving`: 1 or 2 objects cross the nominal motion, one of them hits it; `moving_hard`: 2 to 4 larger
and faster objects enter the view, change speed, turn, stop and reverse; `moving_high`: the same at
heights of up to 1.0 m; see `moving_scenes`.

`drp_LEVEL`: boxes move or appear by the parameters of a level of DRPBench, see `drp_scenes`.
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
from drake_oa.evaluation.cameras import ONE_CAMERA, TWO_CAMERAS, with_workspace_cameras
from drake_oa.evaluation.panda.drp_scenes import LEVELS, SPEED_LEVELS, drp_objects
from drake_oa.evaluation.panda.moving_scenes import MAX_HIGH_HEIGHT, moving_objects
from drake_oa.evaluation.panda.scene_arm import (
    DEFAULT_SCENARIO,
    ELBOW_SCENARIO,
    Motion,
    base_scenario,
    scene_arm,
)
from drake_oa.evaluation.panda.scene_parts import (
    MIN_PENETRATION,
    DrawObjects,
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

MAX_OBSTACLES = 6
"""Maximum number of obstacles in `tabletop`, and their number in `clutter6`."""
NEAR = 0.25
"""Distance from the hand on the nominal motion below which an obstacle counts as near [m]."""
NEAR_OBSTACLES = 3
"""Minimum number of near obstacles in `clutter6`."""
_MAX_MOTIONS = 5000
"""Maximum number of motions drawn for a scene."""


def table_objects(random: Generator, *, cluttered: bool) -> DrawObjects:
    """Draws the number of obstacles of `tabletop`, or uses six for `clutter6`.

    Returns:
        A function that draws the obstacles on the table for a nominal motion.
    """
    count = MAX_OBSTACLES if cluttered else int(random.integers(1, MAX_OBSTACLES + 1))

    def draw(motion: Motion) -> list[Obstacle] | None:
        obstacles = draw_obstacles(random, count)
        if obstacles is None:
            return None
        arm = scene_arm()
        apart = [arm.distances(motion.q, [item]) for item in obstacles]
        near = sum(d[:, arm.tool].min() < NEAR for d in apart)
        is_scene = (
            (near >= NEAR_OBSTACLES or not cluttered)
            and min(d.min() for d in apart) <= -MIN_PENETRATION
            and ends_are_free(motion, obstacles)
        )
        return obstacles if is_scene else None

    return draw


HAND_CLEARANCE = 0.05
"""Minimum clearance of hand and fingers on the nominal motion of `elbow` [m]."""
SWUNG_CLEARANCE = 0.025
"""Minimum clearance of the whole robot on the motion with the elbow moved aside [m]."""
WRIST_CLEARANCE = 0.03
"""Minimum clearance of links 6 and 7 on the nominal motion of `elbow` [m]; their motion is
determined by the tool, not by the elbow."""
MAX_ELBOW_OBJECTS = 2
"""Maximum number of obstacles in `elbow`."""

_ELBOW_JOINTS = range(1, 5)
"""Joints of the links 2 to 5, one of which collides on the nominal motion of `elbow`."""
_WRIST_JOINTS = range(5, 7)
"""Joints of the links 6 and 7, whose motion the tool determines."""
_HEIGHTS = (0.2, 0.9)
"""Range of the heights of obstacles in `elbow` [m]."""
_MIN_FREE_DISTANCE = 0.06
"""Minimum distance of a blocked point of the elbow from all points that must remain free [m]."""
_MIN_AXIS_DISTANCE = 0.2
"""Minimum distance of a blocked point of the elbow from the base's axis [m]."""
_AWAY_DISTANCES = (0.0, 0.10)
"""Range of an obstacle's distance from a blocked point, away from points that remain free [m]."""
_MAX_OFFSET = 0.04
"""Maximum additional offset of an obstacle from a blocked point, along each axis [m]."""
_ATTEMPTS = 60
"""Number of obstacles drawn for one nominal motion in `elbow`."""


def elbow_objects(random: Generator) -> DrawObjects:
    """Returns a function that draws one or two obstacles in the elbow's path for a motion."""

    def draw(motion: Motion) -> list[Obstacle] | None:
        arm, start, goal = scene_arm(), motion.start, motion.goal
        aside = random.choice(arm.postures(0.5 * (start + goal)))
        swung = arm.straight_motion(start, goal, aside)
        places = np.zeros((0, 2, 3)) if swung is None else _elbow_places(motion, swung)
        if swung is None or not len(places):
            return None
        obstacles: list[Obstacle] = []
        for _ in range(_ATTEMPTS):
            object = _draw_elbow_object(random, places, len(obstacles))
            if fits(object, obstacles, ELBOW_SCENARIO) and _is_in_elbow_way(
                object, motion, swung, first=not obstacles
            ):
                obstacles.append(object)
            if len(obstacles) == MAX_ELBOW_OBJECTS:
                break
        return obstacles or None

    return draw


def _elbow_places(motion: Motion, swung: Motion) -> FloatArray:
    """Computes points that the elbow passes and no other part of the robot.

    Points must remain free if the robot occupies them at start or goal or on the motion with the
    elbow moved aside, or if wrist or hand occupy them on the nominal motion.

    Returns:
        (N, 2, 3) points of the elbow on the nominal motion [m], and unit vectors to them from the
        nearest point that must remain free.
    """
    arm, whole = scene_arm(), range(len(motion.q[0]))
    passed = arm.centers(motion.q[::2], _ELBOW_JOINTS)
    free = [arm.centers(q, whole) for q in (motion.ends, swung.q[::2])]
    tree = cKDTree(np.concatenate([*free, arm.centers(motion.q[::2], _WRIST_JOINTS)]))
    distance, nearest = tree.query(passed)
    is_place = (distance > _MIN_FREE_DISTANCE) & (passed[:, 0] > 0.0) & (passed[:, 2] > _HEIGHTS[0])
    is_place &= np.hypot(passed[:, 0], passed[:, 1]) > _MIN_AXIS_DISTANCE
    away = (passed - tree.data[nearest])[is_place] / distance[is_place, None]
    return np.stack([passed[is_place], away], axis=1)


def _draw_elbow_object(random: Generator, places: FloatArray, number: int) -> Obstacle:
    """Draws a post, a board in the air or a box on a stand near one of the `_elbow_places`."""
    point, away = random.choice(places)
    x, y, z = (
        point
        + random.uniform(*_AWAY_DISTANCES) * away
        + random.uniform(-_MAX_OFFSET, _MAX_OFFSET, 3)
    )
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
    """Checks the conditions of `elbow` on an obstacle; only the first one must touch the elbow."""
    arm = scene_arm()
    if not ends_are_free(motion, [object]):
        return False
    distance = arm.distances(motion.q, [object]).min(axis=2)
    wrist = np.isin(arm.joint, _WRIST_JOINTS) & ~arm.tool
    if first and distance[:, np.isin(arm.joint, _ELBOW_JOINTS)].min() > -MIN_PENETRATION:
        return False
    if distance[:, arm.tool].min() < HAND_CLEARANCE or distance[:, wrist].min() < WRIST_CLEARANCE:
        return False
    return bool(arm.distances(swung.q, [object]).min() >= SWUNG_CLEARANCE)


PERCEPTIONS = ("depth", "depth2", "truth")
"""Perception of a scene: its depth camera, two cameras beside the robot, or ground truth."""


@dataclass(frozen=True)
class _Kind:
    """Recipe of one kind of random scenes.

    Attributes:
        objects: function that prepares the drawing of obstacles.
        stream: numbers that select the kind's stream of random numbers.
        like: shipped scenario whose camera, robot and parameters the scenes have.
        motion: function that draws the nominal motion.
    """

    objects: Callable[[Generator], DrawObjects]
    stream: tuple[int, ...]
    like: str = DEFAULT_SCENARIO
    motion: Callable[..., Motion | None] = draw_motion


OBSTACLE_SPEED = 0.8
"""Maximum obstacle speed for which passive motion safety is claimed in moving scenes [m/s]."""
DRP = "drp"
"""Name of the suite of all levels of DRPBench."""
_KINDS = {
    "tabletop": _Kind(partial(table_objects, cluttered=False), ()),
    "moving": _Kind(partial(moving_objects, hard=False), (1,)),
    "elbow": _Kind(elbow_objects, (2,), ELBOW_SCENARIO),
    "clutter6": _Kind(partial(table_objects, cluttered=True), (3,)),
    "moving_hard": _Kind(partial(moving_objects, hard=True), (4,)),
    "moving_high": _Kind(partial(moving_objects, hard=True, max_height=MAX_HIGH_HEIGHT), (5,)),
    # Levels that differ only in speed have the same random numbers, hence the same scenes.
    **{
        f"{DRP}_{name}": _Kind(
            partial(drp_objects, level=level),
            (6, *name.partition("_at_")[0].encode()),
            motion=level.draw_motion,
        )
        for name, level in (LEVELS | SPEED_LEVELS).items()
    },
}
"""Kind of scenes -> recipe."""
KINDS = tuple(_KINDS)
"""Names of all kinds of scenes."""
MOVING_KINDS = tuple(kind for kind in KINDS if kind.startswith(("moving", DRP)))
"""Names of the kinds of scenes with moving obstacles."""


def suite_kinds(suites: Sequence[str], levels: Sequence[str]) -> list[str]:
    """Returns the kinds of scenes in a list of suites, without duplicates.

    Args:
        suites: kinds of scenes, or `drp` for levels of DRPBench.
        levels: names of levels; empty: all levels of DRPBench's authors.

    Raises:
        ValueError: if there are levels and no suite `drp`.
    """
    if levels and DRP not in suites:
        raise ValueError(f"--level requires --suite {DRP}, not {', '.join(suites)}")
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
        seed: seed of the evaluation, >= 0.
        index: index of the scene, >= 0.
        kind: kind of scenes, from `KINDS`.
        perception: "depth", one camera: that of the shipped scenario with resting obstacles,
            `cameras.ONE_CAMERA` with moving ones; "depth2", the pair `cameras.TWO_CAMERAS`; or
            "truth", ground truth.

    Raises:
        RuntimeError: if no scene is found within the maximum number of motions.
    """
    of_kind = _KINDS[kind]
    scenario = copy.deepcopy(base_scenario(of_kind.like))
    if kind in MOVING_KINDS:
        scenario.guard = replace(scenario.guard, obstacle_speed=OBSTACLE_SPEED)
        scenario = with_workspace_cameras(scenario, ONE_CAMERA)
    random = np.random.default_rng(np.random.SeedSequence([seed, index, *of_kind.stream]))
    scenario.seed = int(random.integers(2**31))
    draw_objects_for = of_kind.objects(random)
    for _ in range(_MAX_MOTIONS):
        motion = of_kind.motion(random)
        obstacles = None if motion is None else draw_objects_for(motion)
        if motion is not None and obstacles is not None:
            break
    else:
        raise RuntimeError(f"no {kind} scene found in {_MAX_MOTIONS} attempts")
    scenario.obstacles = obstacles
    scenario.task.start, scenario.task.goal = motion.start.tolist(), motion.goal.tolist()
    scenario.task.rpy_start = scenario.task.rpy_goal = motion.rpy_WE
    scenario.description = f"random {kind} scene {index} of seed {seed}"
    return with_perception(scenario, perception)


def with_perception(scenario: Scenario, perception: str) -> Scenario:
    """Returns a copy of a scene, drawn with "depth", with one of `PERCEPTIONS`."""
    if perception == "depth2":
        return with_workspace_cameras(scenario, TWO_CAMERAS)
    scenario = copy.deepcopy(scenario)
    if perception == "truth":
        scenario.perception = GroundTruth()
    return scenario
