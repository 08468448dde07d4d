"""A played scenario: what its controls change, without a browser."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from pydrake.geometry import Meshcat, MeshcatParams

from drake_oa.common.config import ScenarioError
from drake_oa.runs.motion_log import load_logs, save_logs
from drake_oa.runs.play import TICK, PlaySession, flat_directives, movables
from drake_oa.scenario.loading import load_scenario, parse_scenario

SCENARIO = """
task: {start: [0.45, -0.3, 0.3], goal: [0.45, 0.3, 0.3], duration: 1.5, clearance: 0.05}
thinking: null
obstacles:
- {name: post, shapes: [!Cylinder {radius: 0.03, length: 0.3}], translation: [0.7, 0.0, 0.15]}
"""


@pytest.fixture(scope="module")
def session() -> Iterator[PlaySession]:
    meshcat = Meshcat(MeshcatParams(host="localhost"))
    session = PlaySession(parse_scenario(SCENARIO), meshcat)
    yield session
    session.finish()


def ticks(session: PlaySession, seconds: float) -> None:
    for _ in range(round(seconds / TICK)):
        session.tick()


def test_what_is_changed_is_what_moves(session: PlaySession) -> None:
    meshcat = session.controls.meshcat
    begin = session.tool_point()
    ticks(session, 0.4)
    assert math.dist(session.tool_point(), begin) > 0.005
    assert session.status() == "verified, ground truth: runs"
    apart = session.kept
    assert meshcat.GetSliderValue("kept clearance [m]") == pytest.approx(apart, abs=1e-3)

    # The post is put elsewhere: nothing happens until the slider rests, then it is there.
    meshcat.SetSliderValue("post y [m]", 0.4)
    session.tick()
    assert session.kept == pytest.approx(apart, abs=0.02)
    ticks(session, 0.5)
    assert abs(session.kept - apart) > 0.05
    assert math.dist(session.tool_point(), begin) > 0.01  # It went on from where it was.

    # What cannot be is said, and the motion there is goes on.
    meshcat.SetSliderValue("goal x [m]", 0.75)
    meshcat.SetSliderValue("goal y [m]", 0.7)
    meshcat.SetSliderValue("goal z [m]", 0.8)
    ticks(session, 0.5)
    assert "cannot be: task.goal: out of reach" in session.status()
    for axis, value in zip("xyz", (0.45, 0.3, 0.3), strict=True):
        meshcat.SetSliderValue(f"goal {axis} [m]", value)
    ticks(session, 0.5)
    assert "cannot be" not in session.status()

    # To the goal, and back.
    nearest = math.inf
    while not session.homeward:
        session.tick()
        nearest = min(nearest, math.dist(session.tool_point(), [0.45, 0.3, 0.3]))
    assert nearest < 5e-3
    ticks(session, 0.5)
    assert session.tool_point()[1] < 0.29

    logs = session.finish()
    assert list(logs) == [f"leg_{n + 1}" for n in range(len(logs))]
    assert len(logs) >= 4
    assert logs["leg_1"].stop_reason == "begun anew"


def test_its_log_is_a_log(session: PlaySession, tmp_path: Path) -> None:
    logs = session.finish()
    save_logs(tmp_path / "played.npz", logs)
    assert list(load_logs(tmp_path / "played.npz")) == list(logs)


def test_shipped_obstacles_have_sliders() -> None:
    scenario = load_scenario("tabletop_clutter")
    scenario.directives = flat_directives(scenario.directives)
    names = [thing.name for thing in movables(scenario)]
    assert len(names) >= 3
    thing = movables(scenario)[0]
    thing.put(scenario, np.array([0.5, 0.1, 0.2]), np.array([0.0, 0.0, 0.3]))
    moved = movables(scenario)[0]
    np.testing.assert_allclose(moved.p_WO, [0.5, 0.1, 0.2])
    np.testing.assert_allclose(moved.rpy, [0.0, 0.0, 0.3], atol=1e-12)


def test_a_free_point_is_refused() -> None:
    text = "{robot: null, perception: !GivenEllipsoids {ellipsoids: []}}"
    with pytest.raises(ScenarioError, match="nothing to play with without a robot"):
        PlaySession(parse_scenario(text), Meshcat(MeshcatParams(host="localhost")))
