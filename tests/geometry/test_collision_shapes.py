import numpy as np
import pytest
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    HalfSpace,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw
from scipy.spatial import ConvexHull

from drake_oa.geometry.collision_shapes import collect_collision_shapes, surface_points
from tests.builders import hinged_shapes

TETRAHEDRON = np.array([[0.2, 0.0, 0.0], [0.0, 0.3, 0.0], [0.0, 0.0, 0.4], [-0.1, -0.1, -0.1]])
X_BG = RigidTransform(RollPitchYaw(0.3, -0.5, 1.0), [0.1, 0.2, 0.3])
VOLUMES = {
    Box: 0.2 * 0.3 * 0.4,
    Sphere: 4 / 3 * np.pi * 0.1**3,
    Ellipsoid: 4 / 3 * np.pi * 0.1 * 0.2 * 0.3,
    Cylinder: np.pi * 0.1**2 * 0.4,
    Capsule: np.pi * 0.1**2 * 0.4 + 4 / 3 * np.pi * 0.1**3,
    Convex: ConvexHull(TETRAHEDRON).volume,
}


def shapes():
    return [
        Box(0.2, 0.3, 0.4),
        Sphere(0.1),
        Ellipsoid(0.1, 0.2, 0.3),
        Cylinder(0.1, 0.4),
        Capsule(0.1, 0.4),
        Convex(points=TETRAHEDRON.T, label="tetrahedron"),
    ]


def arm_with(shape_list):
    """A body on a hinge about z, with the shapes at X_BG."""
    diagram, plant, scene_graph, body = hinged_shapes(shape_list, X_BG)
    geometries = plant.GetCollisionGeometriesForBody(body)
    return diagram, plant, scene_graph, body.model_instance(), geometries


@pytest.mark.parametrize("shape", shapes(), ids=lambda shape: type(shape).__name__)
def test_samples_lie_on_the_surface_and_span_the_shape(shape):
    diagram, plant, scene_graph, _, (geometry,) = arm_with([shape])
    points = surface_points(scene_graph.model_inspector(), geometry, 300)
    assert 150 <= len(points) <= 450
    context = diagram.CreateDefaultContext()
    query = plant.get_geometry_query_input_port().Eval(plant.GetMyContextFromRoot(context))
    hull = ConvexHull(points)
    assert 0.93 < hull.volume / VOLUMES[type(shape)] < 1.0 + 1e-6
    if not isinstance(shape, (Convex, Ellipsoid)):
        for point in points:
            (found,) = query.ComputeSignedDistanceToPoint(point)
            assert abs(found.distance) < 1e-9
    again = surface_points(scene_graph.model_inspector(), geometry, 300)
    np.testing.assert_array_equal(points, again)


@pytest.mark.parametrize("shape", shapes()[:2] + shapes()[3:5], ids=lambda s: type(s).__name__)
def test_the_self_filter_agrees_with_scene_graph(shape):
    diagram, plant, scene_graph, instance, _ = arm_with([shape])
    robot = collect_collision_shapes(plant, scene_graph.model_inspector(), instance)
    context = diagram.CreateDefaultContext()
    plant_context = plant.GetMyMutableContextFromRoot(context)
    plant.SetPositions(plant_context, [0.7])
    query = plant.get_geometry_query_input_port().Eval(plant_context)
    points = np.random.default_rng(0).uniform(-0.5, 0.8, (500, 3))
    distance = [query.ComputeSignedDistanceToPoint(p)[0].distance for p in points]
    found = robot.posed(np.array([0.7, 0.0])).contains(points, 0.05)
    np.testing.assert_array_equal(found, np.array(distance) <= 0.05)
    assert found.any()


def test_other_shapes_are_enclosed():
    _, plant, scene_graph, instance, geometries = arm_with([shapes()[2], shapes()[5]])
    inspector = scene_graph.model_inspector()
    robot = collect_collision_shapes(plant, inspector, instance)
    assert len(robot.shapes) == 2
    for geometry in geometries:
        points = surface_points(inspector, geometry)
        assert robot.posed(np.zeros(2)).contains(points, 1e-9).all()


def test_a_half_space_is_neither_robot_nor_obstacle():
    _, plant, scene_graph, instance, (geometry,) = arm_with([HalfSpace()])
    inspector = scene_graph.model_inspector()
    with pytest.raises(ValueError, match="HalfSpace"):
        collect_collision_shapes(plant, inspector, instance)
    with pytest.raises(ValueError, match="HalfSpace"):
        surface_points(inspector, geometry)


def test_bodies_without_geometry_are_left_out():
    _, plant, scene_graph, instance, _ = arm_with([])
    robot = collect_collision_shapes(plant, scene_graph.model_inspector(), instance)
    assert len(robot.shapes) == 0
    assert not robot.posed(np.zeros(2)).contains(np.zeros((4, 3)), 1.0).any()
