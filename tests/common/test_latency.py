"""Decisions that take simulated time: when they are in force, and when they are dropped."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator

from drake_oa.common.latency import LatencyModel, count, counted
from drake_oa.common.messages import (
    DECIDING,
    CouplingParameters,
    PolicyState,
)
from drake_oa.geometry.collision_scene import CollisionScene
from drake_oa.planning.motion_search import PlanningInputs, SelectedMotion
from drake_oa.planning.motion_verifier import MotionVerifier

START, GOAL = np.array([0.0, 0.0, 0.3]), np.array([1.0, 0.0, 0.3])
ELSEWHERE = np.array([0.5, 0.0, 0.3])
PERIOD, STEP = 0.1, 0.01
SLOW = LatencyModel(decision=0.01, search=0.02, step=0.0, configuration=0.0)


class Scripted:
    """A search that answers what it is told to, with so much work."""

    def __init__(self, searches: int, *answers: SelectedMotion) -> None:
        self.searches, self.answers = searches, answers
        self.requested: list[SelectedMotion] = []
        self.late: tuple[float, ...] = ()

    def decide(self, before: SelectedMotion, inputs: PlanningInputs) -> SelectedMotion:
        self.requested.append(before)
        count(searches=self.searches)
        found = self.answers[min(len(self.requested), len(self.answers)) - 1]
        return replace(found, p_WS=inputs.policy.p_WS, p_WG=inputs.p_WG)

    def still_holds(self, made: SelectedMotion, inputs: PlanningInputs) -> bool:
        return made.command.tau not in self.late


class Bench:
    """The selector alone, with a scripted search."""

    def __init__(self, search: Scripted, compute_latency: LatencyModel | None = SLOW) -> None:
        self.system = MotionVerifier(
            search,  # type: ignore[arg-type]
            (0,),
            2,
            period=PERIOD,
            compute_latency=compute_latency,
            step=STEP,
        )
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.policy = PolicyState(p_WE=START, p_WS=START, p_WG=GOAL, speed=0.2)
        self.system.GetInputPort("goal").FixValue(self.context, GOAL)
        self.system.GetInputPort("robot_state").FixValue(self.context, np.zeros(2))
        self.fix(collision_scene_W=CollisionScene(), policy_state=self.policy)

    def fix(self, **inputs: object) -> None:
        for name, value in inputs.items():
            self.system.GetInputPort(name).FixValue(self.context, Value(value))

    def at(self, time: float) -> CouplingParameters:
        self.simulator.AdvanceTo(time)
        return self.system.GetOutputPort("coupling_parameters").Eval(self.context)

    @property
    def decision(self) -> list[float]:
        return self.system.GetOutputPort("decision").Eval(self.context).tolist()


def choice(tau: float) -> SelectedMotion:
    return SelectedMotion().changed(command={"tau": tau})


def choices(*taus: float) -> list[SelectedMotion]:
    return [choice(tau) for tau in taus]


def test_work_is_counted_where_an_account_is_open() -> None:
    count(searches=1)
    with counted() as outer:
        count(searches=2, steps=10)
        with counted() as inner:
            count(searches=3)
        count(configurations=4)
    assert outer == {"searches": 5, "steps": 10, "configurations": 4}
    assert inner == {"searches": 3}
    costs = LatencyModel(decision=1.0, search=0.1, step=0.01, configuration=0.5)
    assert costs.seconds(outer) == pytest.approx(1.0 + 0.5 + 0.1 + 2.0)


def test_a_decision_is_in_force_when_its_work_is_done() -> None:
    # 0.01 s + 2 x 0.02 s.
    bench = Bench(Scripted(2, *choices(1.1, 1.2, 1.3)))
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


def test_without_a_cost_a_decision_is_in_force_at_once() -> None:
    bench = Bench(Scripted(12, *choices(1.1, 1.2)), compute_latency=None)
    bench.simulator.Initialize()
    found = bench.at(0.0)
    assert (found.tau, found.note) == (1.1, "")
    assert bench.at(0.102).tau == 1.2
    assert np.isnan(bench.decision[0])


@pytest.mark.parametrize("what", ["goal", "start", "obstacles"])
def test_a_decision_that_no_longer_fits_is_dropped(what: str) -> None:
    search = Scripted(2, *choices(1.1, 1.2, 1.3))
    bench = Bench(search)
    bench.at(0.12)
    if what == "goal":
        bench.system.GetInputPort("goal").FixValue(bench.context, ELSEWHERE)
    elif what == "start":
        bench.fix(policy_state=replace(bench.policy, p_WS=ELSEWHERE))
    else:
        search.late = (1.2,)
    assert bench.at(0.195).tau == 1.1
    assert len(search.requested) == 2
    # It is made again, from what is in force.
    assert bench.at(0.245).tau == 1.1
    assert search.requested[2].command.tau == 1.1
    assert bench.at(0.27).tau == 1.3
