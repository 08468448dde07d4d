"""Random scenes for the whole Panda; each is a scenario.

Kinds:

  tabletop   1 to 6 things on the table, some of them in the way: `panda_tabletop_scenes`
  moving     1 or 2 things cross the way, one of them into the planned motion:
             `panda_moving_scenes`
  elbow      the hand's way is free and the elbow's is not: `panda_elbow_scenes`
  clutter6   six things on the table, three or more beside the way: `panda_clutter_scenes`
  moving_hard
             2 to 4 larger and faster things enter, change speed, turn, stop and come back:
             `panda_hard_scenes`

The motion is 0.5 to 1.0 m long, along a straight line that the arm can follow, tool down, within
its joint limits. In all but moving_hard the camera has the obstacles' middles in view; that of
the elbow's kind, which looks less steeply down, their tops too; and the whole robot keeps 5 cm
to every obstacle at start and goal.

Scene i of a seed depends on nothing else, and not on perception or method.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drake_oa.perception.config import GroundTruth
from drake_oa.scenario.scenario import Scenario
from drake_oa.studies.cameras import with_opposite
from drake_oa.studies.panda.elbow_scenes import ELBOW_LIKE, draw_elbow
from drake_oa.studies.panda.moving_scenes import draw_hard, draw_moving
from drake_oa.studies.panda.scene_parts import LIKE, Drawn, base_scenario, drawing
from drake_oa.studies.panda.table_scenes import draw_clutter, draw_tabletop
from drake_oa.studies.tally import Tally

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
