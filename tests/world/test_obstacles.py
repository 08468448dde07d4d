"""Obstacles written in a scenario, and what the station makes of them."""

import numpy as np
import pytest
from pydrake.geometry import Role
from pydrake.math import RollPitchYaw
from pydrake.systems.framework import DiagramBuilder

from drake_oa.common.schema_check import ScenarioError
from drake_oa.geometry.shapes import Box, Cylinder, Sphere, bounding_radius
from drake_oa.runs.metrics import robot_metrics
from drake_oa.scenario.loading import parse_scenario, scenario_text
from drake_oa.world.station import make_station

_TEXT = """
directives:
- add_directives: {file: package://drake_oa/scenes/table.dmd.yaml}
obstacles:
- name: pile
  shapes:
  - !Box {size: [0.2, 0.1, 0.06], translation: [0, 0, 0.03]}
  - !Cylinder {radius: 0.03, length: 0.2, translation: [0, 0, 0.16]}
  - !Sphere {radius: 0.05, translation: [0, 0.05, 0.11], rpy: [0, 0, 1]}
  translation: [0.5, 0.1, 0]
  rpy: [0, 0, 0.5]
  color: [0.1, 0.2, 0.3, 1.0]
- name: ball
  shapes: [!Sphere {radius: 0.04, translation: [0, 0, 0.04]}]
  translation: [0.4, -0.3, 0]
"""


def _station(text):
    builder = DiagramBuilder()
    station = make_station(builder, parse_scenario(text), render=False)
    return station, builder.Build()


def test_each_obstacle_is_a_welded_model_instance_with_both_geometries():
    station, diagram = _station(_TEXT)
    plant = station.plant
    names = [plant.GetModelInstanceName(i) for i in station.obstacles]
    assert names == ["obstacle_pile", "obstacle_ball"]
    body = plant.get_body(plant.GetBodyIndices(station.obstacles[0])[0])
    assert plant.IsAnchored(body)
    context = plant.GetMyContextFromRoot(diagram.CreateDefaultContext())
    X_WO = plant.EvalBodyPoseInWorld(context, body)
    np.testing.assert_allclose(X_WO.translation(), [0.5, 0.1, 0.0])
    np.testing.assert_allclose(RollPitchYaw(X_WO.rotation()).vector(), [0, 0, 0.5], atol=1e-12)
    inspector = station.scene_graph.model_inspector()
    frame = plant.GetBodyFrameIdOrThrow(body.index())
    for role in (Role.kProximity, Role.kIllustration, Role.kPerception):
        assert inspector.NumGeometriesForFrameWithRole(frame, role) == 3
    visual = plant.GetVisualGeometriesForBody(body)[0]
    color = inspector.GetIllustrationProperties(visual).GetProperty("phong", "diffuse")
    assert (color.r(), color.g(), color.b()) == (0.1, 0.2, 0.3)


def test_metrics_see_them():
    scenario = parse_scenario(_TEXT)
    q = np.array([[0.0, 0.6, 0.0, -1.8, 0.0, 2.4, 0.8, 0.005, 0.005]])
    there = robot_metrics(scenario, q).robot_clearance[0]
    scenario.obstacles = []
    assert np.isfinite(there)
    assert robot_metrics(scenario, q).robot_clearance[0] == np.inf


def test_the_text_of_a_scenario_brings_them_back():
    text = scenario_text(parse_scenario(_TEXT))
    assert scenario_text(parse_scenario(text)) == text
    first, second = parse_scenario(text).obstacles
    assert [type(shape) for shape in first.shapes] == [Box, Cylinder, Sphere]
    assert first.shapes[0].size == [0.2, 0.1, 0.06]
    assert second.name == "ball"


@pytest.mark.parametrize(
    ("block", "message"),
    [
        ("[{name: a}]", r"obstacles\[0\].shapes: is empty"),
        ("[{shapes: [!Sphere {}]}]", r"obstacles\[0\].name: is empty"),
        (
            "[{name: a, shapes: [!Sphere {}]}, {name: a, shapes: [!Sphere {}]}]",
            r"obstacles\[1\].name: two obstacles are named 'a'",
        ),
        ("[{name: a, shapes: [!Ball {}]}]", "tag !Ball is not one of !Box, !Cylinder, !Sphere"),
        ("[{name: a, shapes: [!Sphere {radius: 0}]}]", r"radius: 0 is outside \(0, 10\] \[m\]"),
        ("[{name: a, shapes: [!Box {size: [0.1, -1, 0.1]}]}]", r"size: .* is outside \(0, 10\]"),
        ("[{name: a, shapes: [!Box {size: [0.1, 1]}]}]", "expected 3 numbers, not 2"),
        ("[{name: a, shapes: [!Box {}], color: [2, 0, 0, 1]}]", r"color: .* is outside \[0, 1\]"),
        ("[{name: a, shapes: [!Box {}], place: 1}]", "place is not a field"),
    ],
)
def test_what_is_wrong_is_said(block, message):
    with pytest.raises(ScenarioError, match=message):
        parse_scenario(f"obstacles: {block}")


def test_a_name_of_the_directives_is_taken():
    text = """
directives:
- add_directives: {file: package://drake_oa/scenes/tabletop_box.dmd.yaml}
obstacles: [{name: box, shapes: [!Sphere {}]}]
"""
    with pytest.raises(ScenarioError, match="already has a model instance 'obstacle_box'"):
        _station(text)


@pytest.mark.parametrize(
    ("shape", "radius"),
    [
        (Box(size=[0.2, 0.2, 0.1]), 0.15),
        (Cylinder(radius=0.3, length=0.8), 0.5),
        (Sphere(radius=0.2), 0.2),
    ],
)
def test_bounding_radius(shape, radius):
    assert bounding_radius(shape) == pytest.approx(radius)
