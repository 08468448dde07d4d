"""Replay of logged motions: LogPlayer, and its positions and paths."""

from collections.abc import Callable
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
    nominal_path,
    world_positions,
)
from drake_oa.scenario.loading import load_scenario, scenario_text
from drake_oa.world.world_model import add_world
from tests.builders import balls

LogOf = Callable[..., MotionLog]

FREE = load_scenario("free_space")
PERIOD = 0.004
FILE = Path("run.npz")


@pytest.fixture(scope="module")
def player(straight_log: LogOf) -> LogPlayer:
    """Player of a log with 51 instants and two observations."""
    observations = pack_ellipsoids(
        [balls((x, 0, 0), stamp=t) for t, x in ((0.0, 0.5), (0.09, 0.6))]
    )
    log = straight_log(
        t=PERIOD * np.arange(51), observation_time=np.array([0.01, 0.1]), **observations
    )
    return LogPlayer(FREE, log, np.arange(51.0)[:, None])


def read(player: LogPlayer, port: str, time: float) -> Any:
    """Returns the value of an output port at a time [s]."""
    context = player.CreateDefaultContext()
    context.SetTime(time)
    return player.GetOutputPort(port).Eval(context)


@given(row=st.integers(0, 60), late=st.floats(-1e-10, 0.9 * PERIOD))
def test_latest_logged_instant_is_output_despite_rounding(
    player: LogPlayer, row: int, late: float
) -> None:
    time = max(PERIOD * row + late, 0.0)
    assert read(player, "positions", time).tolist() == [min(row, 50)]
    state = read(player, "policy_state", time)
    np.testing.assert_allclose(state.p_WE, [min(row, 50) / 50.0, 0.0, 0.0])
    np.testing.assert_array_equal(state.p_WG, FREE.task.goal)


def test_ellipsoids_are_those_of_the_latest_observation(player: LogPlayer) -> None:
    for time, x in ((0.0, []), (0.01, [0.5]), (0.095, [0.5]), (9.0, [0.6])):
        assert read(player, "ellipsoids_W", time).p_WO[:, 0].tolist() == x


def test_avoiding_motion_is_the_default(straight_log: LogOf) -> None:
    logs = {"nominal": straight_log(), "avoiding": straight_log()}
    assert choose_motion(FILE, logs, None) == "avoiding"
    assert choose_motion(FILE, {"nominal": straight_log()}, None) == "nominal"
    assert choose_motion(FILE, logs, "nominal") == "nominal"
    with pytest.raises(ValueError, match=r"run.npz has no motion 'x'; it has nominal, avoid"):
        choose_motion(FILE, logs, "x")
    with pytest.raises(ValueError, match="terminated before its first instant: interrupted"):
        choose_motion(FILE, {"avoiding": straight_log(0, stop_reason="interrupted")}, None)


def test_nominal_path_is_that_of_the_nominal_motion(straight_log: LogOf) -> None:
    scenario = load_scenario("free_space")
    assert nominal_path(scenario, {"nominal": straight_log()}) is None
    scenario.task.demonstration = ["path.npz"]
    path = nominal_path(scenario, {"nominal": straight_log(450)})
    assert path is not None
    assert 100 < len(path) <= 200
    assert nominal_path(scenario, {"nominal": straight_log(ended="interrupted")}) is None


def test_world_positions_are_those_of_the_log(straight_log: LogOf) -> None:
    plant = MultibodyPlant(0.001)
    robot = add_world(plant, load_scenario("tabletop_box"))
    plant.Finalize()
    rng, n = np.random.default_rng(0), plant.num_positions()
    q, whole = rng.normal(size=(4, 9)), rng.normal(size=(4, n))
    found = world_positions(plant, robot, straight_log(4, q=q))
    np.testing.assert_array_equal(plant.GetPositionsFromArray(robot, found[2]), q[2])
    found = world_positions(plant, robot, straight_log(4, q=q, q_world=whole))
    np.testing.assert_array_equal(found, whole)
    with pytest.raises(ValueError, match="use the robot model of the logged run"):
        world_positions(plant, robot, straight_log(4, q=q[:, :7]))


def test_the_scenario_of_a_log_is_that_of_the_run(straight_log: LogOf) -> None:
    log = straight_log(scenario=scenario_text(load_scenario("tabletop_box", ["table_height=null"])))
    assert scenario_text(logged_scenario(FILE, log)) == log.scenario
    with pytest.raises(ScenarioError, match=r"scenario in run.npz \(written by drake_oa 0.1.0"):
        logged_scenario(FILE, straight_log(scenario="sead: 3"))
