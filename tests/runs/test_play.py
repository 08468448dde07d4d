"""Effects of the controls of an interactive run, without a browser."""

import math

import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from drake_oa.common.config import ScenarioError
from drake_oa.runs.play import TICK, PlaySession, move_obstacle, obstacle_poses
from drake_oa.scenario.loading import load_scenario, parse_scenario
from drake_oa.viewing.viewer import open_page, start_viewer
from drake_oa.world.world_model import flat_directives

SCENARIO = """
task: {start: [0.45, -0.3, 0.3], goal: [0.45, 0.3, 0.3], duration: 1.5, clearance: 0.05}
compute_latency: null
obstacles:
- {name: post, shapes: [!Cylinder {radius: 0.03, length: 0.4}], translation: [0.7, 0.0, 0.2]}
"""


def play(text: str, description: str = "") -> PlaySession:
    """Starts an interactive run of a scenario's YAML text."""
    meshcat = start_viewer(browser=False)
    return PlaySession(parse_scenario(text), meshcat, open_page(meshcat, "played", description))


def ticks(session: PlaySession, seconds: float) -> None:
    """Ticks for a simulated time [s]."""
    for _ in range(round(seconds / TICK)):
        session.tick()


def test_changes_become_active_and_invalid_ones_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    session = play(SCENARIO)
    meshcat, begin = session.meshcat, session.tool_point()
    ticks(session, 0.4)
    assert math.dist(session.tool_point(), begin) > 0.005
    assert session.status() == "running"
    apart = session.page.reading.text
    assert "\nwhole arm: clearance 0." in apart

    # A change becomes active when the slider rests; the motion starts at the present position.
    meshcat.SetSliderValue("post: y [m]", 0.4)
    session.tick()
    assert not session.logs
    ticks(session, 0.5)
    assert list(session.logs) == ["leg_1"]
    assert math.dist(session.tool_point(), begin) > 0.01

    # Controls return to their previous values when a change is refused.
    x, y, _ = session.tool_point()
    monkeypatch.setattr(session, "_clicks", lambda button: int(button == "pause"))
    for reason, values in (
        ("task.goal: out of reach", {"goal x [m]": 0.75, "goal y [m]": 0.7, "goal z [m]": 0.8}),
        ("obstacle inside the robot (panda_", {"post: x [m]": x, "post: y [m]": y}),
    ):
        before = {name: meshcat.GetSliderValue(name) for name in values}
        for name, value in values.items():
            meshcat.SetSliderValue(name, value)
        ticks(session, 0.4)
        assert f"refused: {reason}" in session.status()
        assert session.page.reading.text.endswith(session.status())
        assert {name: meshcat.GetSliderValue(name) for name in values} == before
    monkeypatch.undo()

    # The motion leads to the goal, and back.
    nearest = math.inf
    while not session.is_returning:
        session.tick()
        nearest = min(nearest, math.dist(session.tool_point(), [0.45, 0.3, 0.3]))
    assert nearest < 5e-3
    ticks(session, 0.5)
    assert session.tool_point()[1] < 0.29
    logs = session.finish()
    assert list(logs) == ["leg_1", "leg_2", "leg_3"]
    assert [logs[name].stop_reason for name in ("leg_1", "leg_3")] == ["restarted", "ended"]
    assert math.isfinite(logs["leg_3"].duration)


def test_obstacles_of_directives_can_be_moved() -> None:
    scenario = load_scenario("tabletop_clutter")
    scenario.directives = flat_directives(scenario.directives)
    assert len(obstacle_poses(scenario)) >= 3
    name = next(iter(obstacle_poses(scenario)))
    X_WO = RigidTransform(RollPitchYaw(0.0, 0.0, 0.3), [0.5, 0.1, 0.2])
    move_obstacle(scenario, name, X_WO)
    assert obstacle_poses(scenario)[name].IsNearlyEqualTo(X_WO, 1e-12)


def test_scenario_without_robot_is_refused() -> None:
    text = "{robot: null, perception: !GivenEllipsoids {ellipsoids: []}}"
    with pytest.raises(ScenarioError, match="robot: must be set"):
        play(text)
