"""The verified motion of the whole arm, in the whole diagram: it is the one that was rolled out."""

import math
import re

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from scipy.interpolate import make_interp_spline

from drake_oa.common.messages import PlannedMotion
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.regulation.regressor_chain import RegressorChain
from drake_oa.runs.metrics import robot_metrics
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.report import motion_report
from drake_oa.runs.simulation import LATEST_END, simulate
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario

GROUND_TRUTH = "perception=!GroundTruth {}"
SETTLED = 0.3
"""When the decisions that begin a motion are over [s]."""


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    # Thinking would let the motion begin later.
    return load_scenario("tabletop_box", [GROUND_TRUTH, "thinking=null"])


@pytest.fixture(scope="module")
def log(scenario: Scenario) -> MotionLog:
    return simulate(scenario)


def test_a_motion_begins() -> None:
    log = simulate(load_scenario("tabletop_box", [GROUND_TRUTH]), duration=0.05)
    assert np.isfinite(log.torque).all()
    assert log.shortfall.max() == 0.0
    assert not log.supervision_action


@pytest.mark.slow
def test_the_executed_motion_is_the_one_that_was_rolled_out(
    scenario: Scenario, log: MotionLog
) -> None:
    diagram = build_avoidance(scenario)
    simulator = Simulator(diagram)
    # The first will do; the best that was found meanwhile takes its place.
    simulator.AdvanceTo(SETTLED)
    selector = diagram.GetSubsystemByName("motion_selector")
    port = selector.GetOutputPort("motion")
    motion: PlannedMotion = port.Eval(selector.GetMyContextFromRoot(simulator.get_context()))
    # The samples are centimetres apart.
    s = np.linspace(motion.s[0], motion.s[-1], 1000)
    p_WE, q = (
        make_interp_spline(motion.s, motion.p_WE)(s),
        make_interp_spline(motion.s, motion.q)(s),
    )
    after = slice(int(np.searchsorted(log.t, SETTLED)), log.moving.stop)
    off = np.linalg.norm(log.p_WE[after, None] - p_WE, axis=2).min(axis=1)
    assert off.max() < 5e-3
    gone = log.q[after, : q.shape[1]]
    assert np.abs(gone[:, None] - q).max(axis=2).min(axis=1).max() < 0.03


@pytest.mark.slow
def test_it_keeps_what_is_asked_and_hardly_more(scenario: Scenario, log: MotionLog) -> None:
    found = robot_metrics(scenario, log.q, log.q_world)
    assert log.stop_reason == "goal"
    assert 0.150 <= found.tool_clearance.min() <= 0.165
    assert not found.contacts
    assert np.linalg.norm(log.p_WE[-1] - scenario.task.goal) < 5e-3
    report = motion_report(scenario, log)
    assert report["regulation"] == "Verified"
    assert report["believed_shortfall"] == 0.0


def test_the_chain_alone_is_the_paper_s() -> None:
    scenario = load_scenario("free_space")
    log = simulate(scenario, duration=0.1)
    assert log.regulation == "Paper"
    assert not log.shortfall.any()
    chain = build_avoidance(scenario).GetSubsystemByName("regressor_chain")
    assert isinstance(chain, RegressorChain)


def test_a_motion_ends_when_it_has_arrived_not_before() -> None:
    # A stiff spring overcomes a coarse forcing term after s = 1 and a slow phase does not fade.
    empty = "perception=!GivenEllipsoids {}"
    late = simulate(load_scenario("free_space", ["policy.n_basis=5", empty]))
    assert late.stop_reason == "goal"
    assert 1.0 < -math.log(late.phase[late.moving][-1]) / math.log(100.0) < LATEST_END
    assert np.linalg.norm(late.desired_position[-1] - [1.0, 0.0, 0.0]) < 1e-3
    slow = simulate(load_scenario("free_space", ["policy.n_basis=5", "policy.alpha_k=2.0", empty]))
    assert -math.log(slow.phase[slow.moving][-1]) / 2.0 == pytest.approx(LATEST_END, abs=0.02)
    left = slow.desired_position[slow.moving][-1] - [1.0, 0.0, 0.0]
    error = 1e3 * float(np.linalg.norm(left))
    assert error > 1.0
    said = re.fullmatch(r"goal missed by (\d+\.\d) mm at s = 2\.2", slow.stop_reason)
    assert said
    assert float(said[1]) == pytest.approx(error, rel=0.05)
