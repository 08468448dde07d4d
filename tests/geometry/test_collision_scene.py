"""Tests of collision geometries: distances against Drake, samples, and scenes."""

from dataclasses import replace

import numpy as np
import pydrake.geometry as drake
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from scipy.optimize import nnls
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from drake_oa.geometry import collision_scene as geom
from drake_oa.geometry.collision_scene import geometries_of
from drake_oa.geometry.distance_field import field_of
from drake_oa.geometry.shapes import Box, Cylinder, Sphere
from tests.builders import hinged_shapes

RNG = np.random.default_rng(5)
POINTS = RNG.uniform(-0.4, 0.4, (400, 3)) + [0.5, 0.1, 0.2]
X_WG = np.eye(4)
X_WG[:3, :3], X_WG[:3, 3] = Rotation.random(random_state=3).as_matrix(), [0.5, 0.1, 0.2]
CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * [0.1, 0.2, 0.05]
ROUND = RNG.normal(size=(80, 3))
ROUND *= 0.15 / np.linalg.norm(ROUND, axis=1)[:, None]


class World:
    """Scene graph of one body with collision geometries, for reference distances."""

    def __init__(self, shapes):
        pose = RigidTransform(RotationMatrix(X_WG[:3, :3]), X_WG[:3, 3])
        self.diagram, self.plant, graph, self.body = hinged_shapes(shapes, pose)
        self.root = self.diagram.CreateDefaultContext()
        self.inner = self.plant.GetMyContextFromRoot(self.root)
        self.query = self.plant.get_geometry_query_input_port().Eval(self.inner)
        self.inspector = graph.model_inspector()

    def geometries(self):
        """Reads the collision geometries of the body."""
        geometry_ids = self.plant.GetCollisionGeometriesForBody(self.body)
        return [geom.read_geometry(self.inspector, geometry_id) for geometry_id in geometry_ids]


SHAPES = {
    "sphere": drake.Sphere(0.1),
    "box": drake.Box(0.1, 0.3, 0.2),
    "capsule": drake.Capsule(0.06, 0.2),
    "cylinder": drake.Cylinder(0.1, 0.25),
    "ellipsoid": drake.Ellipsoid(0.1, 0.2, 0.05),
    "half-space": drake.HalfSpace(),
    "cube": drake.Convex(CUBE.T, "cube"),
}


@pytest.mark.parametrize("name", SHAPES)
def test_distances_equal_those_of_drake(name):
    shape = drake.Box(*np.ptp(CUBE, axis=0)) if name == "cube" else SHAPES[name]
    reference = World([shape])
    scene = geometries_of(World([SHAPES[name]]).geometries())
    # Distances to ellipsoids in Drake are iterative, with errors up to 0.6 mm.
    tolerance = 1e-3 if name == "ellipsoid" else 1e-9
    for p in POINTS:
        if name == "half-space":
            expected = X_WG[:3, 2] @ (p - X_WG[:3, 3])
        else:
            (near,) = reference.query.ComputeSignedDistanceToPoint(p)
            expected = near.distance
        assert geom.geometry_distance(scene, 0, *p, 0.0) == pytest.approx(expected, abs=tolerance)


def test_the_distance_to_a_hull_is_that_to_its_nearest_point():
    scene = geometries_of(World([drake.Convex(ROUND.T, "round")]).geometries())
    for p in POINTS[:150]:
        (d,) = geom.least_distances(scene, p[None], 0.0, np.inf, -np.inf)
        # Outside, the nearest point is a convex combination of vertices, by least squares.
        q = X_WG[:3, :3].T @ (p - X_WG[:3, 3])
        rows = np.vstack([ROUND.T, np.full(len(ROUND), 1e3)])
        weights, _ = nnls(rows, np.append(q, 1e3))
        nearest = ROUND.T @ weights / weights.sum()
        assert max(d, 0.0) == pytest.approx(np.linalg.norm(q - nearest), abs=1e-9)


def test_coplanar_points_have_a_hull():
    scene = geometries_of([geom.hull(CUBE[:4] * [0.0, 1.0, 1.0])])
    assert geom.geometry_distance(scene, 0, 0.3, 0.0, 0.0, 0.0) == pytest.approx(0.3, abs=1e-8)
    assert geom.geometry_distance(scene, 0, 0.0, 0.5, 0.0, 0.0) == pytest.approx(0.3, abs=1e-8)


def scene_of_all():
    """Returns one moving geometry of each kind in a row along x, and the ground."""
    cloud = np.concatenate([CUBE, 0.5 * CUBE]) + [3.5, 0.0, 0.0]
    names = ("sphere", "box", "capsule", "cylinder", "ellipsoid")
    kinds = [*(geom.geometry_of(SHAPES[name]) for name in names), geom.hull(ROUND)]
    items = []
    for number, kind in enumerate(kinds):
        X = np.eye(4)
        X[:3, :3] = X_WG[:3, :3]
        X[:3, 3] = 0.5 * number, 0.0, 0.0
        v_WO = RNG.uniform(-0.3, 0.3, 3)
        items.append(replace(kind, X_WO=X, v_WO=v_WO, stamp=1.0, name=10 + number))
    v_WO = np.array([0.1, 0.2, -0.1])
    items.append(geom.cloud_geometry(field_of(cloud), v_WO=v_WO, stamp=2.0, name=16))
    ground = np.eye(4)
    ground[2, 3] = -0.3
    items.append(replace(geom.geometry_of(drake.HalfSpace()), X_WO=ground, name=17))
    return items


def test_geometries_move_with_their_velocity():
    items = scene_of_all()
    scene = geometries_of(items)
    for t in (-1.0, 1.0, 3.5):
        for k, item in enumerate(items):
            for p in 5.0 * POINTS[:40]:
                shift = item.v_WO * (t - item.stamp)
                then = geom.geometry_distance(scene, k, *(p - shift), item.stamp)
                assert geom.geometry_distance(scene, k, *p, t) == pytest.approx(then, abs=1e-12)


def test_least_distances_are_those_of_the_nearest_geometry_with_any_culling():
    items = scene_of_all()
    scene, t = geometries_of(items), 2.0
    points = RNG.uniform([-0.5, -1, -0.5], [4, 1, 1], (300, 3))
    each = [[geom.geometry_distance(scene, k, *p, t) for k in range(len(items))] for p in points]
    least = np.min(each, axis=1)
    for bound in (np.inf, 0.1):
        distances = geom.least_distances(scene, points, t, bound, -np.inf)
        np.testing.assert_array_equal(distances, np.minimum(least, bound))
    bounds = [[geom.ball_bound(scene, k, *p, t) for k in range(len(items))] for p in points]
    # A field's distance is up to a voxel and an offset less than that of its points.
    assert (np.array(bounds) <= np.array(each) + 0.01).all()


VOLUMES = {
    "sphere": 4 / 3 * np.pi * 0.1**3,
    "box": 0.1 * 0.3 * 0.2,
    "capsule": np.pi * 0.06**2 * 0.2 + 4 / 3 * np.pi * 0.06**3,
    "cylinder": np.pi * 0.1**2 * 0.25,
    "ellipsoid": 4 / 3 * np.pi * 0.1 * 0.2 * 0.05,
    "cube": 8 * 0.1 * 0.2 * 0.05,
}


@pytest.mark.parametrize("name", VOLUMES)
def test_surface_points_are_on_the_surface_and_span_the_shape(name):
    (one,) = World([SHAPES[name]]).geometries()
    points = geom.surface_points(one, 300)
    assert 150 <= len(points) <= 450
    assert 0.93 < ConvexHull(points).volume / VOLUMES[name] < 1.0 + 1e-6
    distances = geom.least_distances(geometries_of([one]), one.placed(points), 0.0, np.inf, -np.inf)
    np.testing.assert_allclose(distances, 0.0, atol=3e-3)
    outline = geom.hull(geom.outline_corners(one))
    assert geom.least_distances(geometries_of([outline]), points, 0.0, np.inf, -np.inf).max() < 1e-9


def test_geometries_of_a_robot_have_the_poses_of_the_scene_graph():
    world = World([SHAPES[name] for name in VOLUMES])
    instance = world.body.model_instance()
    robot = geom.robot_geometries(world.plant, world.inspector, instance)
    states = [np.array([0.7, 0.0]), np.array([-2.0, 0.0])]
    reference = []
    for state in states:
        world.plant.SetPositionsAndVelocities(world.inner, state)
        query = world.plant.get_geometry_query_input_port().Eval(world.inner)
        rows = (query.ComputeSignedDistanceToPoint(p) for p in POINTS)
        reference.append([[each.distance for each in row] for row in rows])
    result = geom.least_distances(robot.posed(states), POINTS, 0.0, np.inf, -np.inf)
    # Distances to ellipsoids in Drake are iterative.
    np.testing.assert_allclose(result, np.min(reference, axis=(0, 2)), atol=1e-3)
    with pytest.raises(ValueError, match="2 finite numbers"):
        robot.posed([np.zeros(3)])


def test_a_robot_without_shapes_is_valid_and_with_a_half_space_is_rejected():
    bare, grounded = World([]), World([drake.HalfSpace()])
    args = bare.plant, bare.inspector, bare.body.model_instance()
    empty = geom.robot_geometries(*args).posed([np.zeros(2)])
    assert geom.least_distances(empty, POINTS, 0.0, 0.1, 0.1).min() == 0.1
    with pytest.raises(ValueError, match="half-space"):
        geom.robot_geometries(grounded.plant, grounded.inspector, grounded.body.model_instance())
    with pytest.raises(ValueError, match="is not bounded"):
        geom.surface_points(geom.geometry_of(drake.HalfSpace()))


def test_shapes_of_a_scenario_have_their_poses():
    shapes = [Box([0.1, 0.2, 0.3], [0.2, 0, 0]), Cylinder(0.1, 0.2), Sphere(0.1, [0, 0, 1.0])]
    result = geom.shape_geometries(shapes, X_WG, name=4, v_WO=np.array([0.1, 0.0, 0.0]), stamp=2.0)
    scene = geometries_of(result)
    assert scene.layout[:, 5].tolist() == [4, 4, 4]
    centers = [X_WG[:3, :3] @ c + X_WG[:3, 3] for c in ([0.2, 0, 0], [0, 0, 0], [0, 0, 1.0])]
    for k, (center, depth) in enumerate(zip(centers, (-0.05, -0.1, -0.1), strict=True)):
        assert geom.geometry_distance(scene, k, *center, 2.0) == pytest.approx(depth)


def test_a_scene_at_rest_has_no_moving_geometry():
    resting = replace(geom.geometry_of(drake.Box(0.1, 0.1, 0.1)), label="box")
    v_WO = np.array([0.0, 0.1, 0.0])
    moving = replace(geom.geometry_of(drake.Sphere(0.1)), label="ball", v_WO=v_WO)
    scene = geom.CollisionScene.of(1.0, [moving, resting])
    rest = scene.at_rest()
    assert (rest.labels, rest.stamp, rest.moves) == (("box",), 1.0, False)
    assert rest.same_as(geom.CollisionScene.of(1.0, [resting]))
    assert rest.at_rest() is rest
