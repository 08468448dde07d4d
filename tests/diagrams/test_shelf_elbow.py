"""The hand's path is free and the elbow's is not: with the posture planned the arm passes."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.perception.config import GroundTruth
from drake_oa.regulation.regulation import Regulation
from drake_oa.runs.metrics import robot_metrics
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario
from drake_oa.studies.panda.run import run_and_judge
from drake_oa.studies.panda.scenes import draw_panda_scene

GROUND_TRUTH = "perception=!GroundTruth {}"


@pytest.mark.slow
def test_without_a_planned_posture_the_elbow_is_held_at_the_board() -> None:
    scenario = load_scenario("shelf_elbow", [GROUND_TRUTH, "robot.posture=null"])
    log = simulate(scenario)
    assert log.stop_reason.startswith("stopped: panda_link3 within")
    assert not build_avoidance(scenario).HasSubsystemNamed("posture_follower")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "kept"),
    [
        ([], 0.08),
        ([GROUND_TRUTH], 0.08),
        # The paper's reaction of the links, without a plan.
        ([GROUND_TRUTH, "robot.posture={plan: false, coupling: {}}"], 0.05),
    ],
    ids=["depth with noise", "ground truth", "reaction"],
)
def test_with_it_the_arm_goes_round(overrides: list[str], kept: float) -> None:
    scenario = load_scenario("shelf_elbow", overrides)
    log = simulate(scenario)
    metrics = robot_metrics(scenario, log.q)
    assert log.stop_reason == "goal"
    assert log.supervision_action == () or overrides != [GROUND_TRUTH]
    assert metrics.contacts == ()
    assert metrics.robot_clearance.min() > kept
    assert np.linalg.norm(log.p_WE[-1] - scenario.task.goal) < 1e-3
    assert (np.abs(log.v) < log.velocity_limit).all()


def test_where_no_posture_passes_on_the_straight_line_another_is_taken() -> None:
    # The tool's way is free; a board leaves no posture of the arm along it.
    scenario = draw_panda_scene(0, 69, kind="elbow")
    scenario.perception = GroundTruth()
    scenario.thinking = None
    diagram = build_avoidance(scenario)
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.01)
    chain = diagram.GetSubsystemByName("regressor_chain")
    state = chain.GetMyContextFromRoot(simulator.get_context()).get_abstract_state()
    chosen: Regulation = state.get_value(0).get_value().regulation
    assert chosen.for_arm
    assert chosen.shortfall == 0.0
    assert chosen.way.plan.works
    assert chosen.way.concern == ""


@pytest.mark.slow
def test_and_the_arm_passes_on_it() -> None:
    scenario = draw_panda_scene(0, 69, kind="elbow")
    result = run_and_judge(scenario, "verified", "depth").result
    assert result["outcome"] == "success"
    assert result["contacts"] == []
