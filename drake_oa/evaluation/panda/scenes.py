"""Random scenes in which avoidance methods are evaluated on the Panda; each scene is a scenario.

The nominal motion (without avoidance) is a straight tool motion of 0.5 to 1.0 m with the tool
pointing down. The arm can follow it within its joint limits. At start and goal the whole robot,
represented by spheres that enclose its links (`scene_arm`), has 5 cm clearance to every obstacle
that neither moves nor appears.
The centers of the obstacles are in the view of a camera at the table, also if another source
perceives them. The condition on the view does not apply to moving_hard, moving_high and drp_LEVEL.

The number of obstacles is drawn once; motions and obstacles are drawn until the conditions of the
kind of scenes hold. Scene i of a seed does not depend on perception or method. The kinds are:

`tabletop`: 1 to 6 objects on the table.

- No two obstacles are within 2 cm of each other, and none is within 16 cm of the axis of the
  robot's base (horizontal circles around the obstacles).
- On the nominal motion some link of the robot penetrates an obstacle by at least 5 mm.

`clutter6`: as `tabletop`, with exactly six objects, at least three of them within 25 cm of the hand
on the nominal motion.

`elbow`: the hand's path is free and the elbow's is blocked. One or two obstacles (a post, a board
in the air, or a box on a stand) are in the path of the arm's middle links, in front of the base.

- On the nominal motion the clearance of hand and fingers is at least 5 cm, that of the wrist at
  least 3 cm.
- On the nominal motion one of the links 2 to 5 penetrates an obstacle by at least 5 mm.
- The camera, which has a smaller downward tilt than in other kinds, has the center of each obstacle
  in view.
- Another posture is free: with the elbow moved aside in the null space and the same tool path, the
  clearance of the whole robot is at least 2.5 cm.

`moving`: 1 or 2 objects cross the nominal motion, and one of them hits the robot. `moving_hard`: 2
to 4 larger and faster objects enter the view, change speed, turn, stop and reverse. `moving_high`:
as `moving_hard`, at heights of up to 1.0 m. See `moving_scenes`.

`drp_LEVEL`: boxes move or appear by the parameters of a level of the benchmark DRPBench. Distances
from start to goal, and orientations of the tool, may differ from those above; see `drp_scenes`.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.random import Generator
from scipy.spatial import cKDTree

from drake_oa.common.config import check_choice
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
"""Maximum number of obstacles in scenes of the kind `tabletop`, and their exact number in scenes of
the kind `clutter6`."""
NEAR = 0.25
"""Distance from the hand on the nominal motion (without avoidance) below which an obstacle counts
as near in scenes of the kind `clutter6` [m], in which at least three of six obstacles must be near.
"""
NEAR_OBSTACLES = 3
"""Minimum number of obstacles near (within 25 cm of) the path of the hand in a scene of the kind
`clutter6`."""
_MAX_MOTIONS = 5000
"""Maximum number of nominal motions drawn for a scene before `draw_panda_scene` raises an error."""


def table_objects(random: Generator, *, cluttered: bool) -> DrawObjects:
    """Returns a function that draws obstacles on the table, for scenes of the kinds `tabletop` and
    `clutter6`.

    The number of obstacles is drawn here, once for a scene: 1 to 6, or exactly six if cluttered.

    Args:
        random: source of random numbers.
        cluttered: whether at least three obstacles must be near the path of the hand (`clutter6`).

    Returns:
        Function from a nominal motion to obstacles; it returns None if not all of them could be
        placed, the nominal motion is free, the robot has less than 5 cm clearance at start or goal,
        or (`clutter6`) fewer than three obstacles are within 25 cm of the hand's path.
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
"""Minimum clearance between hand or fingers and obstacles on the nominal motion in scenes of the
kind `elbow`, where only the elbow may collide [m]."""
SWUNG_CLEARANCE = 0.025
"""Minimum clearance of the whole robot in scenes of the kind `elbow` if the arm moves its elbow
aside along the same tool path [m]. It shows that the scene has a solution."""
WRIST_CLEARANCE = 0.03
"""Minimum clearance between the links 6 and 7 and obstacles on the nominal motion in scenes of the
kind `elbow` [m]. Moving the elbow aside could not free these links, since they follow the tool."""
MAX_ELBOW_OBJECTS = 2
"""Maximum number of obstacles in a scene of the kind `elbow`, in which obstacles block the path of
the elbow."""

_ELBOW_JOINTS = range(1, 5)
"""Indices of the joints that move the links 2 to 5, one of which must collide on the nominal motion
in scenes of the kind `elbow`."""
_WRIST_JOINTS = range(5, 7)
"""Indices of the joints that move the links 6 and 7, which follow the tool and must not collide in
scenes of the kind `elbow`."""
_HEIGHTS = (0.2, 0.9)
"""Range of the height above the table, in scenes of the kind `elbow`, of the top of a post and of
the center of a board or of a box on a stand [m]."""
_MIN_FREE_DISTANCE = 0.06
"""Minimum distance between a place where an obstacle may block the elbow and the points that must
remain free [m]. These are the centers of the arm's spheres at start and goal and with the elbow
moved aside, and the centers of the spheres of wrist and hand on the nominal motion."""
_MIN_AXIS_DISTANCE = 0.2
"""Minimum horizontal distance between a place where an obstacle may block the elbow and the
vertical axis of the robot's base [m]."""
_AWAY_DISTANCES = (0.0, 0.10)
"""Range of the random distance by which an obstacle is shifted from a point of the elbow's path, in
the direction away from the nearest point that must remain free [m]."""
_MAX_OFFSET = 0.04
"""Maximum additional random offset of an obstacle from the elbow's path, along each axis [m]."""
_ATTEMPTS = 60
"""Maximum number of obstacles drawn for one nominal motion in scenes of the kind `elbow`. Drawing
ends as soon as two obstacles meet the conditions of `_is_in_elbow_way`: the first blocks the elbow
on the nominal motion, and neither blocks the hand, the wrist, or the robot with the elbow moved
aside."""


def elbow_objects(random: Generator) -> DrawObjects:
    """Returns a function that draws one or two obstacles in the path of the elbow, for scenes of
    the kind `elbow`.

    Args:
        random: source of random numbers.

    Returns:
        Function from a nominal motion to obstacles. It returns None if the arm cannot move its
        elbow aside, or if no drawn obstacle meets the conditions: it blocks the elbow on the
        nominal motion, but neither hand nor wrist, nor the robot with the elbow moved aside.
    """

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
    """Computes points that the elbow passes on the nominal motion and that an obstacle may block.

    Some points must remain free: the centers of the arm's spheres at start and goal and with the
    elbow moved aside, and the centers of the spheres of wrist and hand on the nominal motion. An
    obstacle may block a point of the elbow that is more than 6 cm away from all of these points, in
    front of the robot's base (x > 0), more than 20 cm from the axis of the base, and higher than
    20 cm.

    Args:
        motion: nominal motion.
        swung: motion with the same tool path and the elbow moved aside.

    Returns:
        (N, 2, 3) for each of N points of the elbow: its position in the world [m], and the unit
        vector from the nearest point that must remain free toward it.
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
    """Draws an obstacle near the path of the elbow: a post, a board in the air, or a box on a
    stand.

    Args:
        random: source of random numbers.
        places: (N, 2, 3) for each of N points of the elbow's path that may be blocked: its position
            in the world [m], and the unit vector from the nearest point that must remain free
            toward it.
        number: number of the obstacle, which determines its name and color.
    """
    point, away = random.choice(places)
    point = point + random.uniform(*_AWAY_DISTANCES) * away
    x, y, z = point + random.uniform(-_MAX_OFFSET, _MAX_OFFSET, 3)
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
    """Checks the conditions on one obstacle in scenes of the kind `elbow`: clearances at start and
    goal, on the nominal motion, and with the elbow moved aside.

    The whole robot has 5 cm clearance at start and goal, and 2.5 cm with the elbow moved aside. On
    the nominal motion the hand has 5 cm and the wrist 3 cm clearance.

    Args:
        object: obstacle to check.
        motion: nominal motion.
        swung: motion with the same tool path and the elbow moved aside.
        first: whether the obstacle is the first one of the scene, which must collide with one of
            the links 2 to 5 on the nominal motion.
    """
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
"""Names of the sources that perceive the obstacles of a scene: its depth camera ("depth"), two
cameras beside the robot ("depth2"), or exact obstacles ("truth")."""


@dataclass(frozen=True)
class _Kind:
    """Recipe by which `draw_panda_scene` draws random scenes of one kind, for example `tabletop`.

    Attributes:
        objects: function of a source of random numbers. It draws what all attempts at a scene have
            in common, such as the number of obstacles, and returns the function that draws
            obstacles for a nominal motion.
        stream: numbers that identify the kind. Together with the seed of the evaluation and the
            index of a scene they seed the random numbers of the scene; they are equal for kinds
            that differ only in the speed of obstacles.
        like: name of the shipped scenario whose camera, robot and parameters the scenes have.
        motion: function that draws the nominal motion from a source of random numbers; it returns
            None if a draw is rejected.
    """

    objects: Callable[[Generator], DrawObjects]
    stream: tuple[int, ...]
    like: str = DEFAULT_SCENARIO
    motion: Callable[..., Motion | None] = draw_motion


OBSTACLE_SPEED = 0.8
"""Maximum obstacle speed for which passive motion safety is claimed in scenes with moving obstacles
[m/s]: the arm rests or recedes before such an obstacle can reach it."""
DRP = "drp"
"""Name that selects all levels of the benchmark DRPBench on the command line, and prefix of their
kinds of scenes."""
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
"""Name of each kind of random scenes -> recipe by which `draw_panda_scene` draws its scenes."""
KINDS = tuple(_KINDS)
"""Names of all kinds of random scenes, for example `tabletop`."""
MOVING_KINDS = tuple(kind for kind in KINDS if kind.startswith(("moving", DRP)))
"""Names of the kinds of random scenes with obstacles that move or appear. In these scenes cameras
that look at the workspace replace the camera of the shipped scenario. Passive motion safety is
claimed: the arm rests or recedes before an obstacle of up to 0.8 m/s can reach it, and is slow
toward unobserved space."""


def suite_kinds(suites: Sequence[str], levels: Sequence[str]) -> list[str]:
    """Returns the kinds of scenes that suites and levels on the command line select, without
    duplicates.

    Args:
        suites: kinds of scenes, or `drp` for levels of the benchmark DRPBench.
        levels: names of levels (sets of parameters) of DRPBench, for example "sudden1"; empty: all
            11 levels of its authors.

    Raises:
        ValueError: if there are levels but no suite `drp`.
    """
    if levels and DRP not in suites:
        raise ValueError(f"--level requires --suite {DRP}, not {', '.join(suites)}")
    of_drp = [f"{DRP}_{level}" for level in levels or LEVELS]
    kinds = [kind for suite in suites for kind in (of_drp if suite == DRP else [suite])]
    return list(dict.fromkeys(kinds))


def draw_panda_scene(seed: int, index: int, *, kind: str = "tabletop") -> Scenario:
    """Draws a random scene of the Panda and returns it as a scenario, the configuration of a
    simulation.

    The same arguments give the same scene. One depth camera observes it: that of the shipped
    scenario if obstacles rest, or one 2.1 m from the center of the workspace
    (`cameras.ONE_CAMERA`), nearly above it, if they move or appear.

    Args:
        seed: seed of the evaluation, >= 0.
        index: index of the scene, >= 0.
        kind: kind of scenes, from `KINDS`.

    Raises:
        RuntimeError: if the conditions of the kind hold for none of 5000 nominal motions.
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
    return scenario


def with_perception(scenario: Scenario, perception: str) -> Scenario:
    """Returns a copy of a scene whose obstacles are perceived by the named source, cameras or
    ground truth.

    Args:
        scenario: scene, drawn by `draw_panda_scene`.
        perception: name of the source: "depth" (the camera of the scene, unchanged), "depth2" (two
            cameras beside the robot) or "truth" (exact obstacles).

    Raises:
        ValueError: if the name is unknown.
    """
    check_choice("perception", PERCEPTIONS, perception)
    if perception == "depth2":
        return with_workspace_cameras(scenario, TWO_CAMERAS)
    scenario = copy.deepcopy(scenario)
    if perception == "truth":
        scenario.perception = GroundTruth()
    return scenario
