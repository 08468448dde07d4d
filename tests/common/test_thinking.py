"""Decisions that take simulated time: when they are in force, and when they are dropped."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator

from drake_oa.common.messages import (
    DECIDING,
    CouplingParameters,
    EllipsoidSet,
    FloatArray,
    ObstacleClouds,
    PolicyState,
)
from drake_oa.common.thinking import Thinking, Work, count, counted
from drake_oa.policy.dmp import Dmp, imitate, minimum_jerk
from drake_oa.regulation.config import SearchParameters
from drake_oa.regulation.regressor import ChainWeights, load_chain
from drake_oa.regulation.regulation import Regulation
from drake_oa.regulation.tool_turn import TurnChoice
from drake_oa.regulation.tool_turn_selector import ToolTurnSelector
from drake_oa.regulation.verified_regressor_chain import VerifiedRegressorChain
from drake_oa.scenario.loading import package_file

START, GOAL = np.array([0.0, 0.0, 0.3]), np.array([1.0, 0.0, 0.3])
ELSEWHERE = np.array([0.5, 0.0, 0.3])
PERIOD, STEP = 0.1, 0.01
SLOW = Thinking(decision=0.01, search=0.02, step=0.0, posture=0.0, pose=0.0)
QUICK = SearchParameters(candidates=32, rounds=2, polish=0, steps=250)


@pytest.fixture(scope="module")
def weights() -> ChainWeights:
    return load_chain(package_file("package://drake_oa/weights/regressor_chain.safetensors"))


@pytest.fixture(scope="module")
def dmp() -> Dmp:
    return imitate(*minimum_jerk(START, GOAL, duration=5.0))


class Scripted:
    """A regulator that answers what it is told to, with so many searches."""

    def __init__(self, searches: int, *answers: Regulation) -> None:
        self.searches, self.answers = searches, answers
        self.asked: list[Regulation] = []

    def update(self, before: Regulation, *_: object) -> Regulation:
        self.asked.append(before)
        count(searches=self.searches)
        return self.answers[min(len(self.asked), len(self.answers)) - 1]


class Bench:
    """The regulation alone, with a scripted regulator."""

    def __init__(
        self, weights: ChainWeights, dmp: Dmp, regulator: Scripted, thinking: Thinking | None = SLOW
    ) -> None:
        self.system = VerifiedRegressorChain(
            weights, dmp, 0.15, period=PERIOD, parameters=QUICK, thinking=thinking, step=STEP
        )
        self.system._regulator = regulator  # type: ignore[assignment]
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.policy = PolicyState(p_WE=START, p_WS=START, p_WG=GOAL, speed=0.2)
        self.system.GetInputPort("goal").FixValue(self.context, GOAL)
        self.fix(ellipsoids_W=EllipsoidSet(stamp=0.0), policy_state=self.policy)

    def fix(self, **inputs: object) -> None:
        for name, value in inputs.items():
            self.system.GetInputPort(name).FixValue(self.context, Value(value))

    def at(self, time: float) -> CouplingParameters:
        self.simulator.AdvanceTo(time)
        return self.system.GetOutputPort("coupling_parameters").Eval(self.context)

    @property
    def decision(self) -> list[float]:
        return self.system.GetOutputPort("decision").Eval(self.context).tolist()


def regulations(*taus: float, **changes: object) -> list[Regulation]:
    return [replace(Regulation(tau=tau), **changes) for tau in taus]  # type: ignore[arg-type]


def test_work_is_counted_where_an_account_is_open() -> None:
    count(searches=1)
    with counted() as outer:
        count(searches=2, steps=10)
        with counted() as inner:
            count(poses=3)
        count(postures=4)
    assert outer == Work(searches=2, steps=10, postures=4)
    assert inner == Work(poses=3)
    costs = Thinking(decision=1.0, search=0.1, step=0.01, posture=0.5, pose=100.0)
    assert costs.seconds(outer) == pytest.approx(1.0 + 0.2 + 0.1 + 2.0)


def test_a_decision_is_in_force_when_its_work_is_done(weights: ChainWeights, dmp: Dmp) -> None:
    # 0.01 s + 2 x 0.02 s.
    bench = Bench(weights, dmp, Scripted(2, *regulations(1.1, 1.2, 1.3)))
    found = bench.at(0.045)
    assert (found.tau, found.note) == (0.0, DECIDING)
    assert bench.decision == pytest.approx([0.0, 0.05])
    # The first step of the policy after t = 0.05.
    found = bench.at(0.06)
    assert (found.tau, found.note) == (1.1, "")
    # The next one begins with the period, and what was in force stays so.
    assert bench.at(0.145).tau == 1.1
    assert bench.decision == pytest.approx([0.101, 0.05])
    assert bench.at(0.16).tau == 1.2


def test_one_decision_is_made_after_the_other(weights: ChainWeights, dmp: Dmp) -> None:
    # 0.25 s: longer than two periods.
    regulator = Scripted(12, *regulations(1.1, 1.2))
    bench = Bench(weights, dmp, regulator)
    assert bench.at(0.245).tau == 0.0
    assert len(regulator.asked) == 1
    assert bench.at(0.26).tau == 1.1
    assert bench.at(0.31).tau == 1.1
    assert len(regulator.asked) == 2
    assert regulator.asked[1].tau == 1.1
    assert bench.decision == pytest.approx([0.301, 0.25])
    assert bench.at(0.57).tau == 1.2


def test_without_a_cost_a_decision_is_in_force_at_once(weights: ChainWeights, dmp: Dmp) -> None:
    bench = Bench(weights, dmp, Scripted(12, *regulations(1.1, 1.2)), thinking=None)
    bench.simulator.Initialize()
    found = bench.at(0.0)
    assert (found.tau, found.note) == (1.1, "")
    assert bench.at(0.102).tau == 1.2
    assert np.isnan(bench.decision[0])


@pytest.mark.parametrize("what", ["goal", "start"])
def test_a_decision_on_another_motion_is_dropped(
    what: str, weights: ChainWeights, dmp: Dmp
) -> None:
    regulator = Scripted(2, *regulations(1.1, 1.2, 1.3))
    bench = Bench(weights, dmp, regulator)
    bench.at(0.12)
    if what == "goal":
        bench.system.GetInputPort("goal").FixValue(bench.context, ELSEWHERE)
    else:
        bench.fix(policy_state=replace(bench.policy, p_WS=ELSEWHERE))
    assert bench.at(0.195).tau == 1.1
    assert len(regulator.asked) == 2
    # It is made again, from what is in force.
    assert bench.at(0.245).tau == 1.1
    assert regulator.asked[2].tau == 1.1
    assert bench.at(0.27).tau == 1.3


def test_a_motion_begins_anew_once_and_waits_for_its_first_decision(
    weights: ChainWeights, dmp: Dmp
) -> None:
    anew = replace(regulations(1.2)[0], anew=True)
    bench = Bench(weights, dmp, Scripted(2, regulations(1.1)[0], anew, regulations(1.3)[0]))
    rests = replace(bench.policy, speed=0.0)
    bench.fix(policy_state=rests)
    assert not bench.at(0.145).anew
    seen: list[tuple[bool, str]] = []
    for number in range(16, 20):
        found = bench.at(number * STEP + 1e-6)
        seen.append((found.anew, found.note))
    # At one step of the policy only; from then on it is held.
    assert seen == [(True, ""), *[(False, DECIDING)] * 3]
    bench.fix(policy_state=replace(rests, p_WS=ELSEWHERE, p_WE=ELSEWHERE))
    found = bench.at(0.27)
    assert (found.tau, found.anew, found.note) == (1.3, False, "")


def test_a_motion_that_goes_on_again_does_not_begin_anew(weights: ChainWeights, dmp: Dmp) -> None:
    anew = replace(regulations(1.2)[0], anew=True)
    bench = Bench(weights, dmp, Scripted(2, regulations(1.1)[0], anew))
    assert [bench.at(number * STEP + 1e-6).anew for number in range(14, 19)] == [False] * 5
    assert bench.at(0.19).tau == 1.1


def test_the_cost_is_that_of_the_search_and_comes_out_the_same(
    weights: ChainWeights, dmp: Dmp
) -> None:
    ball = EllipsoidSet(
        stamp=0.0,
        p_WO=np.array([[0.5, 0.02, 0.3]]),
        R_WO=np.eye(3)[None],
        semi_axes=np.full((1, 3), 0.1),
        v_WO=np.zeros((1, 3)),
        ids=np.arange(1),
    )

    def run() -> Iterator[float]:
        system = VerifiedRegressorChain(
            weights, dmp, 0.15, period=PERIOD, parameters=QUICK, thinking=Thinking()
        )
        simulator = Simulator(system)
        context = simulator.get_mutable_context()
        policy = PolicyState(p_WE=START, p_WS=START, p_WG=GOAL, speed=0.2)
        system.GetInputPort("goal").FixValue(context, GOAL)
        system.GetInputPort("policy_state").FixValue(context, Value(policy))
        system.GetInputPort("ellipsoids_W").FixValue(context, Value(ball))
        for time in (0.0, 0.05, 0.15):
            simulator.AdvanceTo(time)
            yield from system.GetOutputPort("decision").Eval(context).tolist()

    first = list(run())
    assert first == list(run())
    # A search from rest takes some time; nothing has changed then.
    assert first[1] > 5 * Thinking().decision
    assert first[5] == Thinking().decision


class Turner:
    """Turns the tool a little more each time."""

    def update(
        self, before: TurnChoice, policy: PolicyState, p_WG: FloatArray, *_: object
    ) -> TurnChoice:
        count(searches=2)
        return replace(before, planned=before.planned + 0.1)


def test_a_turn_of_the_tool_is_in_force_when_it_is_chosen() -> None:
    system = ToolTurnSelector(Turner(), period=PERIOD, thinking=SLOW, step=STEP)  # type: ignore[arg-type]
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.GetInputPort("goal").FixValue(context, GOAL)
    system.GetInputPort("policy_state").FixValue(context, Value(PolicyState()))
    system.GetInputPort("obstacles_W").FixValue(context, Value(ObstacleClouds()))

    def planned(time: float) -> float:
        simulator.AdvanceTo(time)
        return float(system.GetOutputPort("planned_turn").Eval(context)[0])

    assert planned(0.045) == 0.0
    assert planned(0.065) == pytest.approx(0.1)
    assert system.GetOutputPort("decision").Eval(context)[1] == pytest.approx(0.05)
    system.GetInputPort("goal").FixValue(context, ELSEWHERE)
    assert planned(0.165) == pytest.approx(0.2)
    simulator.AdvanceTo(0.21)
    system.GetInputPort("goal").FixValue(context, GOAL)
    # On another goal: dropped.
    assert planned(0.29) == pytest.approx(0.2)
    assert planned(0.365) == pytest.approx(0.3)
