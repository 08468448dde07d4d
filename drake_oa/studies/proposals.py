"""What leads the search, compared: networks, a constant, chance and nothing, at few roll-outs.

A decision from rest of few roll-outs, led by each of `PROPOSERS`, beside the full search: in scenes
of ellipsoids (`drake_oa.studies.scenes.suites`), judged on the whole motion, and for the arm in the
scenes of `evaluate panda`, where what decides is what the whole arm keeps of the true solids.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydrake.systems.analysis import Simulator

from drake_oa.common.console import TextTable
from drake_oa.common.messages import BoolArray, FloatArray
from drake_oa.common.wires import Wires
from drake_oa.diagrams.avoidance import Layers, build_avoidance
from drake_oa.diagrams.planning import make_motion_selector
from drake_oa.diagrams.regulation import add_regulation
from drake_oa.diagrams.station import Cell
from drake_oa.planning.motion_search import Choice, Sight
from drake_oa.planning.motion_selector import MotionSelector
from drake_oa.regulation.config import SearchParameters, Verified
from drake_oa.scenario.scenario import Scenario
from drake_oa.studies.panda.run import with_method
from drake_oa.studies.panda.scenes import draw_panda_scene
from drake_oa.studies.scenes.judge import judge
from drake_oa.studies.scenes.methods import Setting
from drake_oa.studies.scenes.suites import draw_scenes
from drake_oa.studies.scenes.verified import PROPOSERS, run_led
from drake_oa.studies.tables import text_table

ELLIPSOIDS = ("novel", "posed", "hit", "head-on", "clutter")
ARM = ("tabletop", "clutter6")
"""The suites: scenes of ellipsoids, and scenes before the whole robot."""

_FEW = {"candidates": 15, "rounds": 1, "polish": 1}
"""The unmodulated motion and twice 15 others: 31 roll-outs."""
_TURN = 20
"""Scenes that each way has its turn with."""
_FULL = "full"


@dataclass(frozen=True)
class Led:
    """One way to decide: what leads the search, and whether it is the full one."""

    by: str
    full: bool = False

    @property
    def name(self) -> str:
        """As tables have it."""
        return f"{_FULL}, {self.by}" if self.full else self.by


LED = (Led("trained", True), Led("chain", True), *(Led(name) for name in PROPOSERS))
"""All that are compared; the first is what the others are measured by."""


@dataclass(frozen=True, eq=False)
class Decisions:
    """What N decisions came to.

    Attributes:
        kept: (N,) whether the motion keeps what is asked, as far as start and goal leave it, and
            arrives.
        length: (N,) of the path [m].
        seconds: (N,) that the decision took.
        rollouts: in all; None: not counted.
    """

    kept: BoolArray
    length: FloatArray
    seconds: FloatArray
    rollouts: float | None = None

    @staticmethod
    def joined(parts: Sequence[Decisions]) -> Decisions:
        """Decisions after one another."""
        kept, length, seconds = (
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("kept", "length", "seconds")
        )
        return Decisions(kept, length, seconds, sum(part.rollouts or 0.0 for part in parts))

    def figures(self, full: Decisions) -> dict[str, Any]:
        """Beside those of the full search."""
        both = self.kept & full.kept
        ratio = self.length[both] / full.length[both]
        return {
            "kept": float(self.kept.mean()),
            "kept_of_full": float(self.kept[full.kept].mean()) if full.kept.any() else None,
            "path_ratio": float(ratio.mean()) if len(ratio) else None,
            "rollouts": self.rollouts / len(self.kept) if self.rollouts else None,
            "decision_ms": 1e3 * float(np.median(self.seconds)),
            "times_cheaper": float(np.median(full.seconds) / np.median(self.seconds)),
        }


def compare(
    suite: str, scenes: int, seed: int, report: Callable[[float], None] = lambda done: None
) -> dict[str, dict[str, Any]]:
    """The figures of each of `LED` in a suite, by name.

    Raises:
        ValueError: for an unknown suite, or no scene.
    """
    if suite not in (*ELLIPSOIDS, *ARM):
        raise ValueError(f"unknown suite {suite!r}; proposals has: {', '.join(ELLIPSOIDS + ARM)}")
    if scenes < 1:
        raise ValueError(f"--scenes must be at least 1, not {scenes}")
    decide = _before_the_arm if suite in ARM else _among_ellipsoids
    found = decide(suite, scenes, seed, report)
    return {led.name: found[led].figures(found[LED[0]]) for led in LED}


def _among_ellipsoids(
    suite: str, scenes: int, seed: int, report: Callable[[float], None]
) -> dict[Led, Decisions]:
    drawn = draw_scenes(suite, scenes, seed)
    parts: dict[Led, list[Decisions]] = {led: [] for led in LED}
    led_by = {name: lead() for name, lead in PROPOSERS.items()}
    # In turns, so that what else the machine does falls to all alike.
    for first in range(0, scenes, _TURN):
        some = drawn.rows(slice(first, first + _TURN))
        for led in LED:
            parameters = SearchParameters() if led.full else SearchParameters(**_FEW)
            motions = run_led(some, Setting(), led_by[led.by], parameters, each=True)
            judged = judge(some, motions)
            kept = ~judged.short & ~judged.collided
            parts[led].append(
                Decisions(kept, judged.path_length, motions.decisions, motions.rollouts)
            )
        report(min(first + _TURN, scenes) / scenes)
    return {led: Decisions.joined(of) for led, of in parts.items()}


def _before_the_arm(
    suite: str, scenes: int, seed: int, report: Callable[[float], None]
) -> dict[Led, Decisions]:
    rows: dict[Led, list[tuple[bool, float, float]]] = {led: [] for led in LED}
    for index in range(scenes):
        scenario = with_method(
            draw_panda_scene(seed, index, kind=suite, perception="truth"), "verified"
        )
        for led, row in _first_decisions(scenario, warm=index > 0):
            rows[led].append(row)
        report((index + 1) / scenes)
    found = {}
    for led, of in rows.items():
        kept, length, seconds = (np.array(column) for column in zip(*of, strict=True))
        found[led] = Decisions(kept, length, seconds)
    return found


def _first_decisions(
    scenario: Scenario, *, warm: bool
) -> Iterator[tuple[Led, tuple[bool, float, float]]]:
    """Whether what is asked is kept, length and seconds, of each way to decide in one scene."""
    cell, sight = _first_sight(scenario)
    # As if a path in the joints had just been looked for: what the terms can do is compared.
    here = Choice(planned=sight.time)
    for led in LED:
        regulation = Verified()
        for name, value in ({} if led.full else _FEW).items():
            setattr(regulation, name, value)
        other = replace(scenario, regulation=regulation)
        search = make_motion_selector(other, cell, PROPOSERS[led.by]()).search
        if not warm:
            search.decide(here, sight)
        begun = time.perf_counter()
        choice = search.decide(here, sight)
        seconds = time.perf_counter() - begun
        steps = np.diff(choice.motion.p_WE, axis=0)
        kept = choice.follows and choice.short == 0.0
        yield led, (kept, float(np.linalg.norm(steps, axis=1).sum()), seconds)


def _first_sight(scenario: Scenario) -> tuple[Cell, Sight]:
    """What a motion is chosen by at the beginning."""
    cells: list[Cell] = []

    def regulation(wires: Wires, scenario: Scenario, cell: Cell | None) -> None:
        cells.extend([] if cell is None else [cell])
        add_regulation(wires, scenario, cell)

    diagram = build_avoidance(scenario, layers=replace(Layers(), regulation=regulation))
    simulator = Simulator(diagram)
    simulator.Initialize()
    selector = diagram.GetSubsystemByName("motion_selector")
    if not isinstance(selector, MotionSelector):
        raise TypeError("motion_selector is no MotionSelector")
    return cells[0], selector.sight(selector.GetMyContextFromRoot(simulator.get_context()))


_COLUMNS = (
    ("kept", "kept", "{:.4f}", 1.0),
    ("kept_of_full", "of what the full one keeps", "{:.4f}", 1.0),
    ("path_ratio", "path, of the full one's", "{:.4f}", 1.0),
    ("rollouts", "roll-outs", "{:.0f}", 1.0),
    ("decision_ms", "decision [ms]", "{:.2f}", 1.0),
    ("times_cheaper", "times cheaper", "{:.1f}", 1.0),
)


def proposals_table(suite: str, figures: Mapping[str, Mapping[str, Any]]) -> TextTable:
    """A suite's table, a row a way to decide."""
    return text_table(suite, list(figures.items()), _COLUMNS)
