"""What the hand holds: in every plant, part of the tool, and out of its own way."""

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder

from drake_oa.geometry.shapes import Box, Sphere
from drake_oa.robot.config import Robot
from drake_oa.robot.plant import make_robot_plant, tool_link_corners
from drake_oa.runs.metrics import robot_metrics
from drake_oa.scenario.end_poses import start_positions
from drake_oa.scenario.obstacles import Obstacle
from drake_oa.scenario.scenario import Scenario
from drake_oa.world.station import make_station

BAR = Box(size=[0.02, 0.5, 0.02], translation=[0.0, 0.0, 0.12])
# Between the fingers, through the fingertips.
STEM = Box(size=[0.02, 0.012, 0.05], translation=[0.0, 0.0, 0.1])


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    found = Scenario()
    assert found.robot is not None
    found.robot.carried = [BAR, STEM]
    found.robot.carried_mass = 0.6
    return found


def test_the_tool_reaches_as_far_as_the_bar(scenario: Scenario) -> None:
    corners = np.concatenate(tool_link_corners(scenario.robot))
    bare = np.concatenate(tool_link_corners(Robot()))
    # Fingers open along the world's x.
    np.testing.assert_allclose(np.abs(corners[:, 0]).max(), 0.25, atol=1e-9)
    np.testing.assert_allclose(corners[:, 1].max(), bare[:, 1].max(), atol=1e-9)
    np.testing.assert_allclose(corners[:, 2].min(), 0.1034 - 0.13, atol=1e-9)


def test_it_is_in_the_plant_with_its_mass_and_in_every_list_of_shapes(scenario: Scenario) -> None:
    held, bare = make_robot_plant(scenario.robot), make_robot_plant(Robot())
    masses = [p.plant.CalcTotalMass(p.plant.CreateDefaultContext()) for p in (held, bare)]
    assert masses[0] - masses[1] == pytest.approx(0.6)
    assert held.plant.num_positions() == bare.plant.num_positions()
    station = make_station(DiagramBuilder(), scenario, render=False)
    assert station.plant.HasBodyNamed("carried1", station.robot)


def test_what_is_held_does_not_touch_what_holds_it(scenario: Scenario) -> None:
    held = make_robot_plant(scenario.robot)
    root = held.diagram.CreateDefaultContext()
    plant = held.plant.GetMyMutableContextFromRoot(root)
    held.plant.SetPositions(plant, held.instance, start_positions(scenario))
    query = held.scene_graph.get_query_output_port().Eval(
        held.scene_graph.GetMyContextFromRoot(root)
    )
    inspector = held.scene_graph.model_inspector()
    names = [
        inspector.GetName(hit.id_A) + inspector.GetName(hit.id_B)
        for hit in query.ComputePointPairPenetration()
    ]
    assert not any("carried" in name for name in names)


def test_what_it_touches_counts_as_the_tool(scenario: Scenario) -> None:
    ball = Obstacle(name="ball", shapes=[Sphere(radius=0.02)])
    start = np.array(scenario.task.start)
    ball.translation = [*(start + [0.3, 0.0, -0.0166])]
    here = Scenario()
    here.robot, here.obstacles = scenario.robot, [ball]
    q = start_positions(here)
    found = robot_metrics(here, q[None])
    # The bar ends 5 cm from the middle of the ball.
    np.testing.assert_allclose(found.tool_clearance, [0.03], atol=2e-3)
    assert found.contacts == ()
