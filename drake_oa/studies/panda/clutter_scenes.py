"""Random clutter: exactly six things on the table, at least three of them beside the way.

All else is as in the table-top scenes: apart from each other, start and goal free, and the
straight motion not clear.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.scenario.obstacles import Obstacle
from drake_oa.studies.panda.obstacles import footprint_radius, height
from drake_oa.studies.panda.scene_parts import Drawn
from drake_oa.studies.panda.tabletop_scenes import draw_on_table
from drake_oa.studies.tally import Tally

OBSTACLES = 6
NEAR, NEAR_OBSTACLES = 0.25, 3
"""So many obstacles are nearer than this to the straight line [m]."""

_SAMPLES = 41


def draw_clutter(random: np.random.Generator, tally: Tally) -> Drawn:
    """A scene of six obstacles.

    Raises:
        RuntimeError: if none was found.
    """
    return draw_on_table(random, tally, OBSTACLES, _uncluttered)


def _uncluttered(start: FloatArray, goal: FloatArray, obstacles: Sequence[Obstacle]) -> str:
    near = sum(distance_to_line(start, goal, obstacle) < NEAR for obstacle in obstacles)
    return "" if near >= NEAR_OBSTACLES else "fewer than three things within 25 cm of the way"


def distance_to_line(start: FloatArray, goal: FloatArray, obstacle: Obstacle) -> float:
    """Least distance of the upright cylinder round an obstacle to the line of the tool [m]."""
    line = np.linspace(start, goal, _SAMPLES)
    aside = np.linalg.norm(line[:, :2] - obstacle.translation[:2], axis=1)
    aside = np.maximum(aside - footprint_radius(obstacle), 0.0)
    above = np.maximum(line[:, 2] - height(obstacle), 0.0)
    return float(np.hypot(aside, above).min())
