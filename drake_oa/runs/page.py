"""Readings of the panel: time, clearances, method, contacts and what holds a motion."""

from __future__ import annotations

import math

import numpy as np
from pydrake.systems.framework import Context

from drake_oa.common.messages import FloatArray
from drake_oa.inference.config import Paper
from drake_oa.perception.config import CameraSource
from drake_oa.planning.search import SOURCES
from drake_oa.runs.metrics import clearance_evaluator
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.simulation import MotionMonitor, motion_state
from drake_oa.scenario.scenario import Scenario
from drake_oa.viewing.panel import LivePage, Reading, panel_page

_PERIOD = 0.1
"""Time between two readings [s]."""


def motion_name(avoids: bool) -> str:
    """Names a motion in the title of a page."""
    return "avoiding motion" if avoids else "nominal motion (without avoidance)"


class PanelReadings:
    """Readings of one motion, instant after instant, with minima and contacts so far."""

    def __init__(self, scenario: Scenario, avoids: bool) -> None:
        """Takes what measures the clearances, by the true geometry.

        Args:
            scenario: what is run.
            avoids: whether the motion avoids obstacles.
        """
        self._method = motion_name(avoids)
        if avoids:
            source = "camera" if isinstance(scenario.perception, CameraSource) else "ground truth"
            chain = type(scenario.inference).__name__.lower()
            self._method += f": {chain}, obstacles from {source}"
        self._requested = [f", requested {scenario.task.clearance:g}", ""]
        if not isinstance(scenario.inference, Paper):
            self._requested[1] = f", requested {scenario.inference.link_clearance:g}"
        self._evaluator = clearance_evaluator(scenario) if scenario.robot else None
        self._least = np.full(2, math.inf)
        self._contacts: dict[str, None] = {}

    def at(
        self, now: float, state: str, q: FloatArray, q_world: FloatArray, source: float = -1.0
    ) -> Reading:
        """Reads the panel.

        Args:
            now: time [s].
            state: what holds the motion, or empty.
            q: (N, nq) positions of the robot since the last reading, at least one.
            q_world: (N, n) all positions of the world, or (N, 0): the rest stays.
            source: source of the motion, see `drake_oa.planning.search.SOURCES`; -1: none.
        """
        lines = [f"t = {now:.1f} s", self._method]
        if source >= 0.0:
            lines.append(f"motion source: {SOURCES[int(source)]}")
        if self._evaluator is not None and q.shape[1]:
            found = self._evaluator.metrics(q, q_world)
            self._contacts |= dict.fromkeys((*found.contacts, *found.self_contacts))
            clearance = np.stack([found.tool_clearance, found.robot_clearance])
            self._least = np.minimum(self._least, clearance.min(axis=1))
            for name, here, least, requested in zip(
                ("tool", "whole arm"), clearance[:, -1], self._least, self._requested, strict=True
            ):
                measured = math.isfinite(here)
                said = f"{here:.3f} m (min {least:.3f}{requested})" if measured else "-"
                lines.append(f"{name}: clearance {said}")
        alert = f"contact: {', '.join(self._contacts)}" if self._contacts else ""
        return Reading(now, "\n".join([*lines, state]), alert)


def readings(scenario: Scenario, log: MotionLog) -> list[Reading]:
    """Lists what the panel of a logged motion shows, one reading at least.

    Args:
        scenario: what the log was made from.
        log: the motion.
    """
    if not len(log.t):
        return [Reading(0.0, "")]
    panel = PanelReadings(scenario, log.avoid_obstacles)
    found, first = [], 0
    for time in np.arange(0.0, log.t[-1] + _PERIOD, _PERIOD):
        last = min(int(np.searchsorted(log.t, time)), len(log.t) - 1)
        rows = slice(min(first, last), last + 1)
        now, first = float(log.t[last]), last + 1
        source = float(log.motion_source[last]) if len(log.motion_source) else -1.0
        state = _logged_state(log, now)
        found.append(panel.at(round(now, 3), state, log.q[rows], log.q_world[rows], source))
    return found


def _logged_state(log: MotionLog, now: float) -> str:
    row = int(np.searchsorted(log.supervision_time, now, side="right")) - 1
    said = (log.supervision_action[row], log.supervision_reason[row]) if row >= 0 else ("run", "")
    row = int(np.searchsorted(log.event_time, now, side="right")) - 1
    return motion_state(said, log.event[row] if row >= 0 else "")


def label_page(page: str, name: str, scenario: Scenario, log: MotionLog) -> str:
    """Adds the panel to the page of a recording.

    Args:
        page: HTML of a viewer after `drake_oa.viewing.viewer.recording`.
        name: of the scenario.
        scenario: what the log was made from.
        log: the motion that the page shows.
    """
    title = f"{name}: {motion_name(log.avoid_obstacles)}"
    return panel_page(page, title, scenario.description, readings(scenario, log))


class LivePanel:
    """Fills the panel of a live page from a running diagram."""

    def __init__(self, page: LivePage, scenario: Scenario, avoids: bool = True) -> None:
        """Takes the page and the motion, see `PanelReadings`."""
        self._page, self._readings = page, PanelReadings(scenario, avoids)
        self._next, self._state = 0.0, ""

    def __call__(self, monitor: MotionMonitor, root: Context, state: str = "") -> None:
        """Ends a frame; renews the reading every 0.1 s and when the state changes.

        Args:
            monitor: of the motion.
            root: the diagram's Context.
            state: what to say in place of what the watcher says.
        """
        self._page.pace()
        now, state = root.get_time(), state or monitor.state
        if now < self._next and state == self._state:
            return
        self._next, self._state = now + _PERIOD, state
        self._page.reading = self._readings.at(
            now, state, *monitor.positions(root), monitor.source(root)
        )
