"""Plots of logged runs."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from drake_oa.runs.motion_log import MotionLog, pack_ellipsoids
from drake_oa.runs.plots import plot_run
from drake_oa.scenario.loading import load_scenario
from tests.builders import balls


@pytest.mark.parametrize("instants", [1, 51])
def test_runs_with_holds_and_moving_obstacles_are_plotted(
    straight_log: Callable[..., MotionLog], instants: int, tmp_path: Path
) -> None:
    frames = [balls((0.5, 0.02 * k, 0.0), (0.2, 0.3, 0.0), stamp=0.1 * k) for k in range(20)]
    log = straight_log(
        instants,
        supervision_time=np.array([1.0, 2.0]),
        supervision_action=("hold", "stop"),
        supervision_reason=("camera stopped", "obstacle over the goal"),
        event_time=np.array([0.2]),
        event=("blocked",),
        event_hold=("obstacles",),
        observation_time=0.1 * np.arange(20),
        **pack_ellipsoids(frames),
    )
    logs = {"nominal": straight_log(instants), "avoiding": log}
    plot_run(tmp_path / "run.png", "title", load_scenario("free_space"), logs)
    assert (tmp_path / "run.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "run.png").stat().st_size > 10_000
