"""A logged motion on ports."""

from collections.abc import Callable

import numpy as np
import pytest
from pydrake.systems.framework import Context

from drake_oa.runs.log_player import LogPlayer
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.replay import LoggedMotion
from drake_oa.scenario.loading import load_scenario


@pytest.fixture(scope="module")
def motion(straight_log: Callable[..., MotionLog]) -> LoggedMotion:
    return LoggedMotion(load_scenario("free_space"), straight_log(11))


def at(player: LogPlayer, time: float) -> Context:
    context = player.CreateDefaultContext()
    context.SetTime(time)
    return context


@pytest.mark.parametrize("speed", [0.5, 1.0, 4.0])
def test_each_port_says_what_was_logged_then(motion: LoggedMotion, speed: float) -> None:
    positions = np.arange(22.0).reshape(11, 2)
    player = LogPlayer(motion, positions, speed=speed)
    context = at(player, 0.4 / speed)
    assert player.GetOutputPort("positions").Eval(context).tolist() == [8.0, 9.0]
    state = player.GetOutputPort("policy_state").Eval(context)
    np.testing.assert_allclose(state.p_WE, [0.4, 0.0, 0.0])
    (pose,) = player.GetOutputPort("body_poses").Eval(context)
    np.testing.assert_allclose(pose.translation(), [0.4, 0.0, 0.0])
    assert len(player.GetOutputPort("ellipsoids_W").Eval(context)) == 0


def test_it_has_no_state_and_stays_at_the_end(motion: LoggedMotion) -> None:
    player = LogPlayer(motion, np.zeros((11, 0)))
    context = at(player, 100.0)
    assert context.num_total_states() == 0
    assert context.num_abstract_states() == 0
    assert player.GetOutputPort("policy_state").Eval(context).stamp == pytest.approx(1.0)


@pytest.mark.parametrize(("rows", "speed"), [(11, 0.0), (11, np.inf), (11, np.nan), (10, 1.0)])
def test_what_does_not_fit_is_refused(motion: LoggedMotion, rows: int, speed: float) -> None:
    with pytest.raises(ValueError, match=r"speed must be|rows for the 11 instants"):
        LogPlayer(motion, np.zeros((rows, 2)), speed=speed)


def test_the_documented_ports_are_the_declared_ones(motion: LoggedMotion) -> None:
    player = LogPlayer(motion, np.zeros((11, 2)))
    declared = [player.get_output_port(i).get_name() for i in range(player.num_output_ports())]
    documented = (LogPlayer.__doc__ or "").partition("output_ports:")[2].partition("\n\n")[0]
    assert [line.strip(" -") for line in documented.split("\n") if line.strip()] == declared
    assert player.num_input_ports() == 0
