"""Text of the panel on the viewer's web page: time, method, clearances and contacts of a motion,
and the reason for which it is held at rest.
"""

from __future__ import annotations

import math

import numpy as np
from pydrake.systems.framework import Context

from drake_oa.common.messages import FloatArray
from drake_oa.inference.config import Paper
from drake_oa.perception.config import CameraSource, GroundTruth
from drake_oa.planning.search import SOURCES
from drake_oa.runs.metrics import clearance_evaluator
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.simulation import MotionMonitor, motion_state
from drake_oa.scenario.scenario import Scenario
from drake_oa.viewing.panel import LivePage, Reading, panel_page

_PERIOD = 0.1
"""Simulated time between two updates of the text in the panel of the viewer's page [s]."""


def motion_name(is_avoiding: bool) -> str:
    """Returns the name of a motion, with or without obstacle avoidance, for the title of a viewer
    page.
    """
    return "avoiding motion" if is_avoiding else "nominal motion (without avoidance)"


class PanelReadings:
    """Generator of the texts (readings) that the panel of the viewer's page displays during one
    motion.

    Minimum clearances and contacts accumulate over the calls of `read`.
    """

    def __init__(self, scenario: Scenario, is_avoiding: bool) -> None:
        """Creates the evaluator that computes clearances and contacts on the true geometry.

        Args:
            scenario: scenario of the motion.
            is_avoiding: whether the motion avoids obstacles.
        """
        self._method = motion_name(is_avoiding)
        if is_avoiding:
            source = type(scenario.perception).__name__
            if isinstance(scenario.perception, CameraSource | GroundTruth):
                source = "ground truth" if source == "GroundTruth" else "camera"
            chain = type(scenario.inference).__name__.lower()
            self._method += f": {chain}, obstacles from {source}"
        self._requested = [f", requested {scenario.task.clearance:g}", ""]
        if not isinstance(scenario.inference, Paper):
            self._requested[1] = f", requested {scenario.inference.link_clearance:g}"
        self._evaluator = clearance_evaluator(scenario) if scenario.robot else None
        self._min_clearances = np.full(2, math.inf)
        self._contacts: dict[str, None] = {}

    def read(
        self, now: float, state: str, q: FloatArray, q_world: FloatArray, source: float = -1.0
    ) -> Reading:
        """Computes the text of the panel at one time of the motion.

        Args:
            now: simulated time [s].
            state: last line of the text: reason of a hold, or state of the motion.
            q: (N, nq) positions of the robot since the previous reading, N at least 1 [rad, m]; the
                last row is the present configuration.
            q_world: (N, n) all positions of the plant of robot and world [rad, m], or (N, 0): only
                the robot moves.
            source: source of the motion: 0 nominal motion, 1 regressor chain, 2 search, 3 path in
                joint space; -1: none.
        """
        lines = [f"t = {now:.1f} s", self._method]
        if source >= 0.0:
            lines.append(f"motion source: {SOURCES[int(source)]}")
        if self._evaluator is not None and q.shape[1]:
            metrics = self._evaluator.metrics(q, q_world)
            self._contacts |= dict.fromkeys((*metrics.contacts, *metrics.self_contacts))
            clearance = np.stack([metrics.tool_clearance, metrics.robot_clearance])
            self._min_clearances = np.minimum(self._min_clearances, clearance.min(axis=1))
            columns = ("tool", "whole arm"), clearance[:, -1], self._min_clearances, self._requested
            for name, present, minimum, requested in zip(*columns, strict=True):
                is_finite = math.isfinite(present)
                value = f"{present:.3f} m (min {minimum:.3f}{requested})" if is_finite else "-"
                lines.append(f"{name}: clearance {value}")
        alert = f"contact: {', '.join(self._contacts)}" if self._contacts else ""
        return Reading(now, "\n".join([*lines, state]), alert)


def readings(scenario: Scenario, log: MotionLog) -> list[Reading]:
    """Returns the texts of the viewer's panel for a logged motion: a reading every 0.1 s, at least
    one.

    Args:
        scenario: scenario of the log.
        log: log of the motion.
    """
    if not len(log.t):
        return [Reading(0.0, "")]
    panel = PanelReadings(scenario, log.avoid_obstacles)
    result, first = [], 0
    for time in np.arange(0.0, log.t[-1] + _PERIOD, _PERIOD):
        last = min(int(np.searchsorted(log.t, time)), len(log.t) - 1)
        rows = slice(min(first, last), last + 1)
        now, first = float(log.t[last]), last + 1
        source = float(log.motion_source[last]) if len(log.motion_source) else -1.0
        state = _logged_state(log, now)
        result.append(panel.read(round(now, 3), state, log.q[rows], log.q_world[rows], source))
    return result


def _logged_state(log: MotionLog, now: float) -> str:
    """Returns the state of a logged motion at a simulated time [s] in words: reason of a hold,
    action of the motion guard, or "running".
    """
    row = int(np.searchsorted(log.supervision_time, now, side="right"))
    supervision = ("run", *log.supervision_action)[row], ("", *log.supervision_reason)[row]
    row = int(np.searchsorted(log.event_time, now, side="right"))
    return motion_state(supervision, ("", *log.event)[row])


def label_page(page: str, name: str, scenario: Scenario, log: MotionLog) -> str:
    """Adds the panel with title and readings to the HTML page of a recorded motion, and returns the
    page.

    Args:
        page: HTML of a Meshcat page that contains the recording of the motion.
        name: name of the scenario.
        scenario: scenario of the log.
        log: log of the recorded motion.
    """
    title = f"{name}: {motion_name(log.avoid_obstacles)}"
    return panel_page(page, title, scenario.description, readings(scenario, log))


class LivePanel:
    """Callable that updates the text panel of a live viewer page during a simulation."""

    def __init__(self, page: LivePage, scenario: Scenario, is_avoiding: bool = True) -> None:
        """Creates the generator of the panel's texts for one motion.

        Args:
            page: live page with the panel.
            scenario: scenario of the motion.
            is_avoiding: whether the motion avoids obstacles.
        """
        self._page, self._readings = page, PanelReadings(scenario, is_avoiding)
        self._next, self._state = 0.0, ""

    def __call__(self, monitor: MotionMonitor, root: Context, state: str = "") -> None:
        """Updates the panel every 0.1 s of simulated time and at changes of state.

        At every call, the method waits if the page has not drawn the previous frame within 0.15 s.

        Args:
            monitor: monitor of the motion.
            root: root Context of the diagram.
            state: text to display in place of the state from the monitor; empty: no replacement.
        """
        self._page.pace()
        now, state = root.get_time(), state or monitor.state
        if now < self._next and state == self._state:
            return
        self._next, self._state = now + _PERIOD, state
        self._page.reading = self._readings.read(
            now, state, *monitor.positions(root), monitor.source(root)
        )
