"""A bar that does not fit between two posts is turned to pass."""

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant

from drake_oa.common.config import ScenarioError
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.robot.plant import TOOL_FRAME, make_robot_plant
from drake_oa.runs.metrics import robot_metrics
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario

QUICK = ["perception=!GroundTruth {}", "task.duration=4"]


def tool_poses(scenario: Scenario, log: MotionLog, rows: list[int]) -> list[RigidTransform]:
    robot = make_robot_plant(scenario.robot)
    plant: MultibodyPlant = robot.plant
    context = plant.CreateDefaultContext()
    poses = []
    for row in rows:
        plant.SetPositions(context, robot.instance, log.q[row])
        poses.append(plant.GetFrameByName(TOOL_FRAME).CalcPoseInWorld(context))
    return poses


def passes(scenario: Scenario) -> None:
    log = simulate(scenario)
    assert log.stop_reason == "goal"
    found = robot_metrics(scenario, log.q[::4])
    assert found.contacts == ()
    # The supervisor stops at 25 mm.
    assert found.tool_clearance.min() > 0.03
    assert found.robot_clearance.min() > 0.03
    first, last = tool_poses(scenario, log, [0, -1])
    assert np.linalg.norm(last.translation() - scenario.task.goal) < 1e-3
    away = (first.rotation().inverse() @ last.rotation()).ToAngleAxis().angle()
    assert away < 5e-3
    # It had to turn: between the posts are 0.23 m, and the bar has 0.7 m.
    between = np.abs(log.p_WE[:, 1]) < 0.02
    assert between.any()
    assert (np.abs(log.tool_turn[between]) > np.deg2rad(60.0)).all()
    # The other way round the last joint would be beyond its limit.
    assert set(np.unique(log.planned_turn).round(3)) == {-1.571, 0.0}
    rate = np.diff(log.tool_turn) / np.diff(log.t)
    assert np.abs(rate).max() <= scenario.policy.turn.speed * (1.0 + 1e-6)


@pytest.mark.slow
def test_passes_turned() -> None:
    passes(load_scenario("long_tool", QUICK))


@pytest.mark.slow
def test_goes_astray_otherwise() -> None:
    scenario = load_scenario("long_tool", [*QUICK, "policy.turn=null"])
    log = simulate(scenario, duration=6.0)
    # Turned, it is there by then.
    assert np.linalg.norm(log.p_WE[-1] - scenario.task.goal) > 0.5
    assert log.tool_turn.shape == log.planned_turn.shape == (0,)


@pytest.mark.slow
@pytest.mark.parametrize("seen", [QUICK, []])
def test_does_not_pass_otherwise(seen: list[str]) -> None:
    scenario = load_scenario("long_tool", [*seen, "policy.turn=null"])
    log = simulate(scenario)
    assert log.stop_reason.startswith(("stopped:", "held"))
    assert np.linalg.norm(log.p_WE[-1] - scenario.task.goal) > 0.3
    assert robot_metrics(scenario, log.q[::20]).contacts == ()


def test_the_bar_touches_a_post_on_the_planned_way() -> None:
    scenario = load_scenario("long_tool", QUICK)
    log = simulate(scenario, modulated=False, duration=2.6)
    found = robot_metrics(scenario, log.q[::20])
    assert any("carried0" in contact for contact in found.contacts)


@pytest.mark.slow
def test_passes_turned_by_what_a_noisy_camera_sees() -> None:
    passes(load_scenario("long_tool"))


def test_the_turn_needs_what_verifies_and_sees() -> None:
    with pytest.raises(ScenarioError, match=r"policy\.turn: needs 'regulation: !Verified"):
        build_avoidance(load_scenario("long_tool", [*QUICK, "regulation=!Regressor {}"]))
    with pytest.raises(ScenarioError, match=r"policy\.turn: needs a robot, and perception"):
        build_avoidance(
            load_scenario("long_tool", ["perception=!GivenEllipsoids {}"]), modulated=True
        )


def test_without_a_supervisor_the_turn_itself_slows_the_motion() -> None:
    diagram = build_avoidance(load_scenario("long_tool", [*QUICK, "supervisor=null"]))
    assert not diagram.HasSubsystemNamed("slowest")
    policy = diagram.GetSubsystemByName("dmp_integrator")
    root = diagram.CreateDefaultContext()
    assert policy.GetInputPort("speed_scale").HasValue(policy.GetMyContextFromRoot(root))
