"""A run's log as one page to play and pause in a browser."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator

from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.replay_diagram import build_replay
from drake_oa.scenario.loading import parse_scenario
from drake_oa.viewing.viewer import recording, start_viewer


@lru_cache(maxsize=1)
def _viewer() -> Meshcat:
    return start_viewer(announce=False)


def write_page(path: Path, log: MotionLog) -> None:
    """Replays a log into a page.

    Args:
        path: the page to write.
        log: with at least one instant.
    """
    meshcat = _viewer()
    meshcat.Delete()
    diagram = build_replay(parse_scenario(log.scenario), log, meshcat)
    with recording(meshcat, path):
        Simulator(diagram).AdvanceTo(log.simulated_time)
