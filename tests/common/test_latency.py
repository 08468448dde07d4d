"""Tests of decisions with compute latency: when they become active, and when they are discarded."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from drake_oa.common.latency import LatencyModel, count, counted
from drake_oa.common.messages import DECIDING, CouplingParameters, PolicyState
from drake_oa.geometry.collision_scene import CollisionScene
from drake_oa.planning.motion_search import PlanningInputs, SelectedMotion
from drake_oa.planning.motion_verifier import MotionVerifier
from tests.builders import fix

START, GOAL = np.array([0.0, 0.0, 0.3]), np.array([1.0, 0.0, 0.3])
ELSEWHERE = np.array([0.5, 0.0, 0.3])
PERIOD, STEP = 0.1, 0.01
SLOW = LatencyModel(decision=0.01, search=0.02, step=0.0, configuration=0.0)


class Scripted:
    """Search that returns given motions one after the other, with a given amount of work each."""

    def __init__(self, searches: int, *answers: SelectedMotion) -> None:
        self.searches, self.answers = searches, answers
        self.requested: list[SelectedMotion] = []
        self.invalid_taus: tuple[float, ...] = ()

    def decide(self, before: SelectedMotion, inputs: PlanningInputs) -> SelectedMotion:
        self.requested.append(before)
        count(searches=self.searches)
        answer = self.answers[min(len(self.requested), len(self.answers)) - 1]
        return replace(answer, p_WS=inputs.policy.p_WS, p_WG=inputs.p_WG)

    def is_still_valid(self, motion: SelectedMotion, inputs: PlanningInputs) -> bool:
        return motion.command.tau not in self.invalid_taus


class Bench:
    """Simulation of a `MotionVerifier` with a scripted search."""

    def __init__(self, search: Scripted, compute_latency: LatencyModel | None = SLOW) -> None:
        times = {"period": PERIOD, "compute_latency": compute_latency, "step": STEP}
        self.system = MotionVerifier(search, (0,), 2, **times)  # type: ignore[arg-type]
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.policy = PolicyState(p_WE=START, p_WS=START, p_WG=GOAL, speed=0.2)
        self.fix = partial(fix, self.system, self.context)
        self.fix(goal=GOAL, robot_state=np.zeros(2))
        self.fix(collision_scene_W=CollisionScene(), policy_state=self.policy)

    def at(self, time: float) -> CouplingParameters:
        self.simulator.AdvanceTo(time)
        return self.system.GetOutputPort("coupling_parameters").Eval(self.context)

    @property
    def decision(self) -> list[float]:
        return self.system.GetOutputPort("decision").Eval(self.context).tolist()


def choices(*taus: float) -> list[SelectedMotion]:
    return [SelectedMotion().with_changes(command={"tau": tau}) for tau in taus]


def test_work_is_added_to_all_enclosing_counters() -> None:
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


def test_a_decision_is_active_after_its_latency() -> None:
    # The latency is 0.01 s + 2 x 0.02 s.
    bench = Bench(Scripted(2, *choices(1.1, 1.2, 1.3)))
    output = bench.at(0.045)
    assert (output.tau, output.note) == (0.0, DECIDING)
    assert bench.decision == pytest.approx([0.0, 0.05])
    # The first step of the policy after t = 0.05.
    output = bench.at(0.06)
    assert (output.tau, output.note) == (1.1, "")
    # The next decision starts with the next period; the first one stays active meanwhile.
    assert bench.at(0.145).tau == 1.1
    assert bench.decision == pytest.approx([0.101, 0.05])
    assert bench.at(0.16).tau == 1.2


def test_without_a_latency_model_a_decision_is_active_at_once() -> None:
    bench = Bench(Scripted(12, *choices(1.1, 1.2)), compute_latency=None)
    output = bench.at(0.0)
    assert (output.tau, output.note) == (1.1, "")
    assert bench.at(0.102).tau == 1.2
    assert np.isnan(bench.decision[0])


@pytest.mark.parametrize("change", ["goal", "start", "obstacles"])
def test_a_pending_decision_is_discarded_after_a_change(change: str) -> None:
    search = Scripted(2, *choices(1.1, 1.2, 1.3))
    bench = Bench(search)
    bench.at(0.12)
    if change == "goal":
        bench.fix(goal=ELSEWHERE)
    elif change == "start":
        bench.fix(policy_state=replace(bench.policy, p_WS=ELSEWHERE))
    else:
        search.invalid_taus = (1.2,)
    assert bench.at(0.195).tau == 1.1
    assert len(search.requested) == 2
    # The next decision starts from the active one.
    assert bench.at(0.245).tau == 1.1
    assert search.requested[2].command.tau == 1.1
    assert bench.at(0.27).tau == 1.3


def test_a_pending_restart_of_a_resting_motion_is_not_discarded() -> None:
    restart = SelectedMotion().with_changes(command={"tau": 1.2, "restart": True})
    search = Scripted(2, *choices(1.1), restart)
    search.invalid_taus, bench = (1.2,), Bench(search)
    bench.fix(policy_state=replace(bench.policy, speed=0.0))
    assert bench.at(0.195).tau == 1.2
