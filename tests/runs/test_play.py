"""A played scenario: what its controls change, without a browser."""

import math
from collections.abc import Iterator

import numpy as np
import pytest

from drake_oa.common.config import ScenarioError
from drake_oa.runs.play import TICK, PlaySession, movables
from drake_oa.scenario.loading import load_scenario, parse_scenario
from drake_oa.viewing.viewer import open_page, start_viewer
from drake_oa.world.world_model import flat_directives

SCENARIO = """
task: {start: [0.45, -0.3, 0.3], goal: [0.45, 0.3, 0.3], duration: 1.5, clearance: 0.05}
thinking: null
obstacles:
- {name: post, shapes: [!Cylinder {radius: 0.03, length: 0.4}], translation: [0.7, 0.0, 0.2]}
"""


@pytest.fixture(scope="module")
def session() -> Iterator[PlaySession]:
    session = play(SCENARIO)
    yield session
    session.finish()


def play(text: str) -> PlaySession:
    meshcat = start_viewer(browser=False)
    return PlaySession(parse_scenario(text), meshcat, open_page(meshcat, "played", ""))


def ticks(session: PlaySession, seconds: float) -> None:
    for _ in range(round(seconds / TICK)):
        session.tick()


def test_what_is_changed_is_what_moves(session: PlaySession) -> None:
    meshcat = session.controls.meshcat
    begin = session.tool_point()
    ticks(session, 0.4)
    assert math.dist(session.tool_point(), begin) > 0.005
    assert session.status() == "running"
    apart = session.kept
    assert "\nwhole arm: clearance 0." in session.page.reading.text

    # The post is put elsewhere: nothing happens until the slider rests, then it is there.
    meshcat.SetSliderValue("post: y [m]", 0.4)
    session.tick()
    assert session.kept == pytest.approx(apart, abs=0.02)
    ticks(session, 0.5)
    assert abs(session.kept - apart) > 0.05
    assert math.dist(session.tool_point(), begin) > 0.01  # It went on from where it was.

    # What cannot be is refused: the sliders go back, and the motion there is goes on.
    meshcat.SetSliderValue("goal x [m]", 0.75)
    meshcat.SetSliderValue("goal y [m]", 0.7)
    meshcat.SetSliderValue("goal z [m]", 0.8)
    ticks(session, 0.5)
    assert "refused: task.goal: out of reach" in session.status()
    assert session.page.reading.text.endswith(session.status())
    assert meshcat.GetSliderValue("goal z [m]") == pytest.approx(0.3)
    assert meshcat.GetSliderValue("post: y [m]") == pytest.approx(0.4)

    # To the goal, and back.
    nearest = math.inf
    while not session.homeward:
        session.tick()
        nearest = min(nearest, math.dist(session.tool_point(), [0.45, 0.3, 0.3]))
    assert nearest < 5e-3
    ticks(session, 0.5)
    assert session.tool_point()[1] < 0.29


def test_an_obstacle_inside_the_robot_is_refused(
    session: PlaySession, monkeypatch: pytest.MonkeyPatch
) -> None:
    meshcat = session.controls.meshcat
    monkeypatch.setattr(session.controls, "clicks", lambda button: int(button == "pause"))
    x, y, _ = session.tool_point()
    meshcat.SetSliderValue("post: x [m]", x)
    meshcat.SetSliderValue("post: y [m]", y)
    ticks(session, 0.4)
    assert "refused: obstacle inside the robot (panda_" in session.status()
    assert meshcat.GetSliderValue("post: x [m]") == pytest.approx(0.7)
    assert session.kept > 0.0


def test_each_motion_has_a_log(session: PlaySession) -> None:
    logs = session.finish()
    assert list(logs) == [f"leg_{n + 1}" for n in range(len(logs))]
    assert len(logs) >= 3
    assert logs["leg_1"].stop_reason == "begun anew"


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
    with pytest.raises(ScenarioError, match="robot: must be set"):
        play(text)
