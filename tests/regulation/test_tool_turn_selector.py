"""The system that chooses the turn of the tool, and the least of speeds."""

import logging
import math
from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from drake_oa.common.messages import FloatArray, ObstacleClouds, PolicyState
from drake_oa.control.min_speed_scale import MinSpeedScale
from drake_oa.regulation.tool_turn import TurnChoice
from drake_oa.regulation.tool_turn_selector import ToolTurnSelector

GOAL = np.array([1.0, 0.0, 0.3])
PERIOD = 1.0 / 30.0


class Turner:
    """Plans what it is told to, and notes what it was asked."""

    def __init__(self, *planned: float, blocked: bool = False) -> None:
        self.planned, self.blocked = list(planned), blocked
        self.largest = math.pi / 2.0
        self.now: list[float] = []

    def update(
        self,
        before: TurnChoice,
        policy: PolicyState,
        p_WG: FloatArray,
        obstacles: ObstacleClouds,
        now: float,
    ) -> TurnChoice:
        np.testing.assert_array_equal(p_WG, GOAL)
        self.now.append(now)
        planned = self.planned[min(len(self.now), len(self.planned)) - 1]
        return replace(
            before, planned=planned, turn=0.5 * planned, speed_scale=0.25, blocked=self.blocked
        )


def bench(turner: Turner) -> tuple[ToolTurnSelector, Simulator, Context]:
    system = ToolTurnSelector(turner, period=PERIOD)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.GetInputPort("goal").FixValue(context, GOAL)
    system.GetInputPort("policy_state").FixValue(context, Value(PolicyState()))
    system.GetInputPort("obstacles_W").FixValue(context, Value(ObstacleClouds()))
    return system, simulator, context


def outputs(system: ToolTurnSelector, context: Context) -> list[float]:
    names = ("turn", "planned_turn", "speed_scale")
    return [float(system.GetOutputPort(name).Eval(context)[0]) for name in names]


def test_says_what_was_chosen_from_the_first_period_on() -> None:
    turner = Turner(0.8)
    system, simulator, context = bench(turner)
    simulator.Initialize()
    assert outputs(system, context) == [0.0, 0.0, 1.0]
    simulator.AdvanceTo(0.9 * PERIOD)
    assert outputs(system, context) == [0.4, 0.8, 0.25]
    assert turner.now == [0.0]


def test_without_a_port_the_tool_has_what_was_asked_of_it() -> None:
    turner = Turner(0.8)
    _, simulator, _ = bench(turner)
    simulator.AdvanceTo(1.5 * PERIOD)
    assert turner.now == [0.0, 0.4]


def test_the_turn_of_the_tool_comes_by_a_port() -> None:
    turner = Turner(0.8)
    system, simulator, context = bench(turner)
    system.GetInputPort("tool_turn").FixValue(context, [0.1])
    simulator.AdvanceTo(1.5 * PERIOD)
    assert turner.now == [0.1, 0.1]


def test_another_turn_and_the_lack_of_one_are_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "drake_oa")
    _, simulator, _ = bench(Turner(math.pi / 4.0, math.pi / 4.0, 0.0, blocked=True))
    simulator.AdvanceTo(4.5 * PERIOD)
    said = [record.getMessage() for record in caplog.records]
    assert [text.partition(": ")[2] for text in said] == [
        "passes with the tool turned by 45 degrees",
        "no turn of the tool within 90 degrees lets it pass",
        "passes with the tool turned by 0 degrees",
    ]


def test_the_choice_is_in_the_context() -> None:
    system, simulator, context = bench(Turner(0.8))
    before = context.Clone()
    simulator.AdvanceTo(0.9 * PERIOD)
    assert outputs(system, before) == [0.0, 0.0, 1.0]
    assert outputs(system, context.Clone()) == [0.4, 0.8, 0.25]


@pytest.mark.parametrize("period", [0.0, -1.0, math.inf])
def test_refuses_a_period_that_is_none(period: float) -> None:
    with pytest.raises(ValueError, match="period"):
        ToolTurnSelector(Turner(0.0), period=period)


def test_the_slowest_is_the_least_of_what_is_connected() -> None:
    system = MinSpeedScale()
    context = system.CreateDefaultContext()
    system.GetInputPort("speed_scale").FixValue(context, [0.6])
    assert system.get_output_port().Eval(context) == [0.6]
    system.GetInputPort("turn_speed_scale").FixValue(context, [0.2])
    assert system.get_output_port().Eval(context) == [0.2]
    system.GetInputPort("turn_speed_scale").FixValue(context, [1.0])
    assert system.get_output_port().Eval(context) == [0.6]
