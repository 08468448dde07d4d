"""A log as a function of time."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import Context

from drake_oa.common.config import ScenarioError
from drake_oa.runs.motion_log import MotionLog, pack_ellipsoids
from drake_oa.runs.replay import (
    LoggedMotion,
    LogPlayer,
    choose_motion,
    logged_scenario,
    planned_path,
    world_positions,
)
from drake_oa.scenario.loading import load_scenario, parse_scenario, scenario_text
from drake_oa.world.station import add_world
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
def motion(log_of: Callable[..., MotionLog]) -> LoggedMotion:
    return LoggedMotion(FREE, log_of())


@given(row=st.integers(0, 50), early=st.floats(-1e-10, 1e-10))
def test_a_logged_instant_is_found_despite_rounding(
    motion: LoggedMotion, row: int, early: float
) -> None:
    assert motion.row(PERIOD * row + early) == row


@given(time=st.floats(-1.0, 10.0))
def test_between_instants_the_last_one_counts(motion: LoggedMotion, time: float) -> None:
    log, row = motion.log, motion.row(time)
    assert row == 0 or log.t[row] <= time + 1e-9
    assert row == len(log.t) - 1 or log.t[row + 1] > time


@pytest.mark.parametrize(("time", "x"), [(0.0, None), (0.01, 0.5), (0.095, 0.5), (9.0, 0.6)])
def test_obstacles_are_those_that_had_arrived(
    motion: LoggedMotion, time: float, x: float | None
) -> None:
    seen = motion.ellipsoids(time)
    assert seen.p_WO[:, 0].tolist() == ([] if x is None else [x])


def test_the_policy_is_where_it_was_and_says_what_it_said(motion: LoggedMotion) -> None:
    state = motion.policy_state(0.1)
    np.testing.assert_allclose(state.p_WE, [0.5, 0.0, 0.0])
    np.testing.assert_array_equal(state.p_WG, FREE.task.goal)
    assert state.stamp == pytest.approx(0.1)
    assert [motion.policy_state(t).note for t in (0.0, 0.1, 0.2)] == ["", "blocked", ""]


def test_a_log_without_an_instant_is_refused(log_of: Callable[..., MotionLog]) -> None:
    with pytest.raises(ValueError, match="no instant: KeyboardInterrupt"):
        LoggedMotion(FREE, log_of(0, stop_reason="KeyboardInterrupt"))


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


@pytest.fixture(scope="module")
def played(straight_log: Callable[..., MotionLog]) -> LoggedMotion:
    return LoggedMotion(load_scenario("free_space"), straight_log(11))


def at(player: LogPlayer, time: float) -> Context:
    context = player.CreateDefaultContext()
    context.SetTime(time)
    return context


@pytest.mark.parametrize("speed", [0.5, 1.0, 4.0])
def test_each_port_says_what_was_logged_then(played: LoggedMotion, speed: float) -> None:
    positions = np.arange(22.0).reshape(11, 2)
    player = LogPlayer(played, positions, speed=speed)
    context = at(player, 0.4 / speed)
    assert player.GetOutputPort("positions").Eval(context).tolist() == [8.0, 9.0]
    state = player.GetOutputPort("policy_state").Eval(context)
    np.testing.assert_allclose(state.p_WE, [0.4, 0.0, 0.0])
    (pose,) = player.GetOutputPort("body_poses").Eval(context)
    np.testing.assert_allclose(pose.translation(), [0.4, 0.0, 0.0])
    assert len(player.GetOutputPort("ellipsoids_W").Eval(context)) == 0


def test_it_has_no_state_and_stays_at_the_end(played: LoggedMotion) -> None:
    player = LogPlayer(played, np.zeros((11, 0)))
    context = at(player, 100.0)
    assert context.num_total_states() == 0
    assert context.num_abstract_states() == 0
    assert player.GetOutputPort("policy_state").Eval(context).stamp == pytest.approx(1.0)


@pytest.mark.parametrize(("rows", "speed"), [(11, 0.0), (11, np.inf), (11, np.nan), (10, 1.0)])
def test_what_does_not_fit_is_refused(played: LoggedMotion, rows: int, speed: float) -> None:
    with pytest.raises(ValueError, match=r"speed must be|rows for the 11 instants"):
        LogPlayer(played, np.zeros((rows, 2)), speed=speed)
