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
from pydrake.multibody.tree import ModelInstanceIndex

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


@given(row=st.integers(0, 50), early=st.floats(-1e-10, 1e-10))
def test_a_logged_instant_is_found_despite_rounding(
    player: LogPlayer, row: int, early: float
) -> None:
    time = max(PERIOD * row + early, 0.0)
    assert read(player, "positions", time).tolist() == [row]


@given(time=st.floats(0.0, 10.0))
def test_between_instants_the_last_one_counts(player: LogPlayer, time: float) -> None:
    (row,) = read(player, "positions", time)
    assert row == 0 or PERIOD * row <= time + 1e-9
    assert row == 50 or PERIOD * (row + 1) > time


@pytest.mark.parametrize(("time", "x"), [(0.0, None), (0.01, 0.5), (0.095, 0.5), (9.0, 0.6)])
def test_obstacles_are_those_that_had_arrived(
    player: LogPlayer, time: float, x: float | None
) -> None:
    seen = read(player, "ellipsoids_W", time)
    assert seen.p_WO[:, 0].tolist() == ([] if x is None else [x])


@pytest.mark.parametrize("speed", [0.5, 1.0, 4.0])
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
    path = planned_path(shown, {"preplanned": log_of()}, points=20)
    assert path is not None
    assert 10 < len(path) <= 20
    assert planned_path(shown, {"preplanned": log_of(ended="cut short")}) is None
    assert planned_path(shown, {"modulated": log_of()}) is None


@pytest.fixture(scope="module")
def world() -> tuple[MultibodyPlant, ModelInstanceIndex]:
    plant = MultibodyPlant(0.001)
    robot = add_world(plant, load_scenario("tabletop_box"))
    plant.Finalize()
    return plant, robot


def test_the_world_is_posed_by_what_the_log_has(
    world: tuple[MultibodyPlant, ModelInstanceIndex], log_of: Callable[..., MotionLog]
) -> None:
    q = np.random.default_rng(0).normal(size=(4, 9))
    n = world[0].num_positions()
    robot_only = log_of(4, q=q)
    np.testing.assert_array_equal(
        world[0].GetPositionsFromArray(world[1], world_positions(*world, robot_only)[2]), q[2]
    )
    whole = np.random.default_rng(1).normal(size=(4, n))
    np.testing.assert_array_equal(
        world_positions(*world, replace(robot_only, q_world=whole)), whole
    )
    for changes in ({"q": q[:, :7]}, {"q": q, "q_world": np.zeros((4, n + 7))}):
        with pytest.raises(ValueError, match="was the robot's model changed"):
            world_positions(*world, log_of(4, **changes))


@pytest.mark.parametrize(
    ("name", "override"),
    [("free_space", "seed=3"), ("tabletop_box", "table_height=null"), ("tabletop_box", "seed=4")],
)
def test_the_scenario_of_a_log_is_that_of_the_run(
    name: str, override: str, log_of: Callable[..., MotionLog]
) -> None:
    scenario = load_scenario(name, [override])
    log = log_of(scenario=scenario_text(scenario))
    back = logged_scenario(Path("run.npz"), log)
    assert (back.robot, back.table_height, back.seed) == (
        scenario.robot,
        scenario.table_height,
        scenario.seed,
    )
    assert scenario_text(back) == log.scenario
    with pytest.raises(ScenarioError, match=r"the scenario in run.npz \(made with drake_oa 0.1.0"):
        logged_scenario(Path("run.npz"), log_of(scenario="sead: 3"))
