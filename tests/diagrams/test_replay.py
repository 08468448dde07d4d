"""Tests of the diagram that replays a log."""

from collections.abc import Callable

import numpy as np
import pytest
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator

from drake_oa.robot.plant import TOOL_FRAME, make_robot_plant
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.replay import build_replay
from drake_oa.scenario.loading import load_scenario


@pytest.fixture(scope="module")
def meshcat() -> Meshcat:
    """Meshcat server for the replays."""
    return Meshcat()


def test_replayed_robot_has_the_logged_pose(
    meshcat: Meshcat, straight_log: Callable[..., MotionLog]
) -> None:
    scenario = load_scenario("tabletop_box")
    alone = make_robot_plant(scenario.robot)
    context = alone.plant.CreateDefaultContext()
    rng = np.random.default_rng(0)
    q = rng.uniform(-0.3, 0.3, (11, 9))
    diagram = build_replay(scenario, straight_log(11, q=q), meshcat)
    assert not diagram.HasSubsystemNamed("plant")
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.5)

    graph = diagram.GetSubsystemByName("scene_graph")
    query = graph.get_query_output_port().Eval(graph.GetMyContextFromRoot(simulator.get_context()))
    inspector = query.inspector()
    alone.plant.SetPositions(context, q[5])
    link = alone.plant.GetFrameByName(TOOL_FRAME).body()
    (frame,) = (
        f for f in inspector.GetAllFrameIds() if inspector.GetName(f).endswith(f"::{link.name()}")
    )
    np.testing.assert_allclose(
        query.GetPoseInWorld(frame).GetAsMatrix4(),
        alone.plant.EvalBodyPoseInWorld(context, link).GetAsMatrix4(),
        atol=1e-12,
    )


def test_replay_of_a_point_has_only_the_overlay(
    meshcat: Meshcat, straight_log: Callable[..., MotionLog]
) -> None:
    diagram = build_replay(load_scenario("free_space"), straight_log(), meshcat)
    assert [s.get_name() for s in diagram.GetSystems()] == ["log_player", "overlay"]
    Simulator(diagram).AdvanceTo(0.2)
    assert meshcat.HasPath("/drake_oa/motion/nominal/goal")
    assert meshcat.HasPath("/drake_oa/motion/executed")
