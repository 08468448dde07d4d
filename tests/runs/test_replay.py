"""A log as a function of time."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.multibody.plant import MultibodyPlant

from drake_oa.common.config import ScenarioError
from drake_oa.runs.motion_log import MotionLog, pack_ellipsoids
from drake_oa.runs.replay import (
    LogPlayer,
    choose_motion,
    logged_scenario,
    planned_path,
    world_positions,
)
from drake_oa.scenario.loading import load_scenario, parse_scenario, scenario_text
from drake_oa.world.world_model import add_world
from tests.builders import balls

FREE = load_scenario("free_space")
PERIOD = 0.004


@pytest.fixture(scope="module")
def log_of(straight_log: Callable[..., MotionLog]) -> Callable[..., MotionLog]:
    """The same with what was seen and said, 4 ms a step."""

    def make(count: int = 51, **changes: object) -> MotionLog:
        log = straight_log(
            count,
            t=PERIOD * np.arange(count),
            observation_time=np.array([0.01, 0.1]),
            event_time=np.array([0.05, 0.15]),
            event=("blocked", ""),
            event_hold=("obstacles", "none"),
            **pack_ellipsoids([balls((x, 0, 0), stamp=t) for t, x in ((0.0, 0.5), (0.09, 0.6))]),
        )
        return replace(log, **changes)

    return make


@pytest.fixture(scope="module")
def player(log_of: Callable[..., MotionLog]) -> LogPlayer:
    return LogPlayer(FREE, log_of(), np.arange(51.0)[:, None])


def read(player: LogPlayer, port: str, time: float) -> Any:
    context = player.CreateDefaultContext()
    context.SetTime(time)
    return player.GetOutputPort(port).Eval(context)


@given(row=st.integers(0, 60), late=st.floats(-1e-10, 0.9 * PERIOD))
def test_the_last_logged_instant_is_found_despite_rounding(
    player: LogPlayer, row: int, late: float
) -> None:
    assert read(player, "positions", max(PERIOD * row + late, 0.0)).tolist() == [min(row, 50)]


def test_obstacles_are_those_that_had_arrived(player: LogPlayer) -> None:
    for time, seen in ((0.0, []), (0.01, [0.5]), (0.095, [0.5]), (9.0, [0.6])):
        assert read(player, "ellipsoids_W", time).p_WO[:, 0].tolist() == seen


@pytest.mark.parametrize("speed", [1.0, 4.0])
def test_the_policy_is_where_it_was_and_says_what_it_said(
    log_of: Callable[..., MotionLog], speed: float
) -> None:
    player = LogPlayer(FREE, log_of(), np.zeros((51, 0)), speed=speed)
    assert player.CreateDefaultContext().num_total_states() == 0
    state = read(player, "policy_state", 0.1 / speed)
    np.testing.assert_allclose(state.p_WE, [0.5, 0.0, 0.0])
    np.testing.assert_array_equal(state.p_WG, FREE.task.goal)
    assert state.stamp == pytest.approx(0.1)
    (pose,) = read(player, "body_poses", 0.1 / speed)
    np.testing.assert_allclose(pose.translation(), [0.5, 0.0, 0.0])
    notes = [read(player, "policy_state", t / speed).note for t in (0.0, 0.1, 0.2)]
    assert notes == ["", "blocked", ""]


def test_a_log_without_an_instant_is_refused(log_of: Callable[..., MotionLog]) -> None:
    with pytest.raises(ValueError, match="no instant: KeyboardInterrupt"):
        LogPlayer(FREE, log_of(0, stop_reason="KeyboardInterrupt"), np.zeros((0, 0)))


def test_the_motion_is_the_modulated_one_unless_asked(log_of: Callable[..., MotionLog]) -> None:
    file, logs = Path("run.npz"), {"preplanned": log_of(), "modulated": log_of()}
    assert choose_motion(file, logs, None) == "modulated"
    assert choose_motion(file, {"preplanned": log_of()}, None) == "preplanned"
    assert choose_motion(file, logs, "preplanned") == "preplanned"
    with pytest.raises(ValueError, match=r"run.npz has no motion 'x'; it has preplanned, modul"):
        choose_motion(file, logs, "x")


def test_a_demonstrated_path_is_that_of_the_preplanned_motion(
    log_of: Callable[..., MotionLog],
) -> None:
    shown = parse_scenario(f"{scenario_text(FREE)}")
    assert planned_path(shown, {"preplanned": log_of()}) is None
    shown.task.demonstration = ["path.npz"]
    path = planned_path(shown, {"preplanned": log_of(450)})
    assert path is not None
    assert 100 < len(path) <= 200
    assert planned_path(shown, {"preplanned": log_of(ended="cut short")}) is None
    assert planned_path(shown, {"modulated": log_of()}) is None


def test_the_world_is_posed_by_what_the_log_has(log_of: Callable[..., MotionLog]) -> None:
    plant = MultibodyPlant(0.001)
    robot = add_world(plant, load_scenario("tabletop_box"))
    plant.Finalize()
    rng, n = np.random.default_rng(0), plant.num_positions()
    q, whole = rng.normal(size=(4, 9)), rng.normal(size=(4, n))
    found = world_positions(plant, robot, log_of(4, q=q))
    np.testing.assert_array_equal(plant.GetPositionsFromArray(robot, found[2]), q[2])
    found = world_positions(plant, robot, log_of(4, q=q, q_world=whole))
    np.testing.assert_array_equal(found, whole)
    for changes in ({"q": q[:, :7]}, {"q": q, "q_world": np.zeros((4, n + 7))}):
        with pytest.raises(ValueError, match="was the robot's model changed"):
            world_positions(plant, robot, log_of(4, **changes))


def test_the_scenario_of_a_log_is_that_of_the_run(log_of: Callable[..., MotionLog]) -> None:
    log = log_of(scenario=scenario_text(load_scenario("tabletop_box", ["table_height=null"])))
    assert scenario_text(logged_scenario(Path("run.npz"), log)) == log.scenario
    with pytest.raises(ScenarioError, match=r"the scenario in run.npz \(made with drake_oa 0.1.0"):
        logged_scenario(Path("run.npz"), log_of(scenario="sead: 3"))
