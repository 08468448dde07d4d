"""A bar that does not fit between two posts passes by a plan that the primitives imitate."""

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant

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


@pytest.mark.slow
@pytest.mark.parametrize("overrides", [QUICK, []], ids=["ground truth", "depth with noise"])
def test_the_bar_passes(overrides: list[str]) -> None:
    scenario = load_scenario("long_tool", overrides)
    log = simulate(scenario)
    assert log.stop_reason == "goal"
    found = robot_metrics(scenario, log.q[::4])
    assert found.contacts == ()
    assert found.self_contacts == ()
    assert found.tool_clearance.min() >= scenario.task.clearance
    first, last = tool_poses(scenario, log, [0, -1])
    assert np.linalg.norm(last.translation() - scenario.task.goal) < 2e-3
    away = (first.rotation().inverse() @ last.rotation()).ToAngleAxis().angle()
    assert away < 5e-3


def test_the_bar_touches_a_post_on_the_planned_way() -> None:
    scenario = load_scenario("long_tool", QUICK)
    log = simulate(scenario, modulated=False, duration=2.6)
    found = robot_metrics(scenario, log.q[::20])
    assert any("carried0" in contact for contact in found.contacts)
