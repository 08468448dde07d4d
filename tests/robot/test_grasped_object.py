"""Grasped object: part of the tool in every plant, without contacts with the hand."""

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
    """Returns a scenario with a long bar and a stem as grasped object."""
    scenario = Scenario()
    scenario.robot.carried = [BAR, STEM]
    scenario.robot.carried_mass = 0.6
    return scenario


def test_tool_corners_include_the_grasped_object(scenario: Scenario) -> None:
    corners = np.concatenate(tool_link_corners(scenario.robot))
    bare = np.concatenate(tool_link_corners(Robot()))
    # The fingers open along the world's x axis.
    np.testing.assert_allclose(np.abs(corners[:, 0]).max(), 0.25, atol=1e-9)
    np.testing.assert_allclose(corners[:, 1].max(), bare[:, 1].max(), atol=1e-9)
    np.testing.assert_allclose(corners[:, 2].min(), 0.1034 - 0.13, atol=1e-9)


def test_grasped_object_is_part_of_plant_and_station_with_its_mass(scenario: Scenario) -> None:
    loaded, bare = make_robot_plant(scenario.robot), make_robot_plant(Robot())
    masses = [p.plant.CalcTotalMass(p.plant.CreateDefaultContext()) for p in (loaded, bare)]
    assert masses[0] - masses[1] == pytest.approx(0.6)
    assert loaded.plant.num_positions() == bare.plant.num_positions()
    station = make_station(DiagramBuilder(), scenario, render=False)
    assert station.plant.HasBodyNamed("carried1", station.robot)


def test_tool_clearance_includes_the_grasped_object_without_contacts_with_the_hand(
    scenario: Scenario,
) -> None:
    ball = Obstacle(name="ball", shapes=[Sphere(radius=0.02)])
    start = np.array(scenario.task.start)
    ball.translation = [*(start + [0.3, 0.0, -0.0166])]
    scene = Scenario()
    scene.robot, scene.obstacles = scenario.robot, [ball]
    q = start_positions(scene)
    metrics = robot_metrics(scene, q[None])
    # The bar ends 5 cm from the middle of the ball.
    np.testing.assert_allclose(metrics.tool_clearance, [0.03], atol=2e-3)
    assert metrics.contacts == metrics.self_contacts == ()
