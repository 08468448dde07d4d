"""Tests of sphere models: enclosure of collision geometry, protrusion, self-collision pairs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pydrake.geometry as drake
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from pydrake.math import RigidTransform, RollPitchYaw

from drake_oa.common.files import read_arrays
from drake_oa.common.messages import FloatArray
from drake_oa.geometry import collision_scene as geometry
from drake_oa.geometry.shapes import Cylinder as HeldCylinder
from drake_oa.planning.collision_model import self_distance
from drake_oa.robot.arm import make_chain
from drake_oa.robot.config import BasePose, Robot, SphereParameters
from drake_oa.robot.grasped_object import tool_links
from drake_oa.robot.plant import RobotPlant, home_positions, make_robot_plant
from drake_oa.robot.sphere_cover import SHIPPED, compute_cover, cover_key, load_cover
from drake_oa.robot.spheres import ArmSpheres, make_arm_spheres, sphere_centers
from tests.diagrams.six_arm import six_scenario

COARSE = SphereParameters(protrusion=0.015, max_tool_protrusion=0.012, max_fixed_protrusion=0.03)
_WEDGE = [[0, 0, 0], [0.1, 0, 0], [0, 0.08, 0], [0, 0, 0.06], [0.1, 0, 0.02]]


def geometry_of_kind(kind: str, size: tuple[float, float, float]) -> geometry.CollisionGeometry:
    a, b, c = size
    if kind == "hull":
        return geometry.hull(np.array(_WEDGE) * 10 * [a, b, c])
    shapes = {
        "sphere": drake.Sphere(a),
        "capsule": drake.Capsule(a, b),
        "cylinder": drake.Cylinder(a, b),
        "box": drake.Box(a, b, c),
        "ellipsoid": drake.Ellipsoid(a, b, c),
    }
    return geometry.geometry_of(shapes[kind])


def check_enclosed(shape: geometry.CollisionGeometry, spheres: FloatArray) -> None:
    """Checks that points on a shape are inside spheres (K, 4) of centers and radii [m]."""
    points = shape.placed(geometry.surface_points(shape, 3000))
    away = np.linalg.norm(points[:, None] - spheres[:, :3], axis=2) - spheres[:, 3]
    assert away.min(axis=1).max() <= 1e-9


@settings(max_examples=8, phases=[Phase.generate])
@given(
    kind=st.sampled_from(["sphere", "capsule", "cylinder", "box", "ellipsoid", "hull"]),
    size=st.tuples(*[st.floats(0.02, 0.1)] * 3),
    rpy=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
)
def test_a_cover_encloses_its_shape_with_the_stated_protrusion(
    kind: str, size: tuple[float, float, float], rpy: tuple[float, float, float]
) -> None:
    X = RigidTransform(RollPitchYaw(*rpy), [0.1, -0.2, 0.3]).GetAsMatrix4()
    shape = replace(geometry_of_kind(kind, size), X_WO=X)
    found = compute_cover([shape], 0.012)
    check_enclosed(shape, np.column_stack([found.centers, found.radii]))
    directions = np.random.default_rng(0).normal(size=(len(found.radii), 300, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    outermost = (found.centers[:, None] + found.radii[:, None, None] * directions).reshape(-1, 3)
    scene = geometry.geometries_of([shape])
    away = geometry.least_distances(scene, outermost, 0.0, np.inf, -np.inf)
    assert away.max() <= found.protrusion + 1e-9
    if kind != "hull":
        # A flat wedge requires a larger protrusion.
        assert found.protrusion <= 0.012 * 1.3


def test_a_cover_of_many_meshes_needs_few_spheres() -> None:
    along = [RigidTransform([0.08 * i, 0.0, 0.0]).GetAsMatrix4() for i in range(6)]
    shapes = [replace(geometry_of_kind("hull", (0.1, 0.1, 0.1)), X_WO=X) for X in along]
    cover = compute_cover(shapes, 0.012)
    spheres = np.column_stack([cover.centers, cover.radii])
    for shape in shapes:
        check_enclosed(shape, spheres)
    assert cover.protrusion <= 0.015
    assert len(spheres) <= 150


def test_covers_are_cached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    geometries = [geometry.geometry_of(drake.Box(0.05, 0.1, 0.06))]
    expected = compute_cover(geometries, 0.01)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for _ in range(2):
        found = load_cover(geometries, 0.01, 200, "covering")
        np.testing.assert_array_equal(found.radii, expected.radii)
        (file,) = (tmp_path / "drake_oa" / "spheres").iterdir()
    # Unreadable files are replaced; without a writable cache the cover is computed.
    file.write_bytes(b"PK")
    monkeypatch.setenv("XDG_CACHE_HOME", str(file))
    np.testing.assert_array_equal(load_cover(geometries, 0.01, 200, "").radii, expected.radii)


def test_the_shipped_covers_enclose_the_panda(panda: RobotPlant) -> None:
    plant, inspector = panda.plant, panda.scene_graph.model_inspector()
    shipped, requested = read_arrays(SHIPPED), SphereParameters()
    for body in map(plant.get_body, plant.GetBodyIndices(panda.instance)):
        geometry_ids = plant.GetCollisionGeometriesForBody(body)
        if not geometry_ids:
            continue
        protrusion = requested.protrusion
        if body.name() == "panda_link0":
            protrusion = requested.max_fixed_protrusion
        elif body.name() in Robot().tool_links:
            protrusion = requested.max_tool_protrusion
        geometries = [
            geometry.read_geometry(inspector, geometry_id) for geometry_id in geometry_ids
        ]
        # Remove each used cover: no unused cover may remain.
        spheres = shipped.pop(cover_key(geometries, protrusion))
        for shape in geometries:
            check_enclosed(shape, spheres)
        assert load_cover(geometries, protrusion, 200, "").protrusion <= 1.25 * protrusion
    assert not shipped


def six_plant(folder: Path, old: str = "", new: str = "") -> RobotPlant:
    """Builds an arm of six joints on a tilted base, with `old` replaced by `new` in its model."""
    config = six_scenario(folder, old, new).robot
    config.X_WB = BasePose(translation=[0.5, -1.0, 0.7], rpy=[0.3, -0.2, 1.0])
    return make_robot_plant(config)


@pytest.fixture(scope="module")
def spheres(panda: RobotPlant) -> ArmSpheres:
    return make_arm_spheres(panda, home_positions(Robot()), Robot().tool_links, COARSE)


def check_against_scene_graph(
    robot: RobotPlant, q: np.ndarray, spheres: ArmSpheres, seed: int, count: int
) -> None:
    """Checks distances to points and self-distances against SceneGraph in random configurations."""
    plant, arrays = robot.plant, spheres.arrays
    chain = make_chain(plant, robot.tool_frame, q)
    n, full = len(chain.lower), q.copy()
    root = robot.diagram.CreateDefaultContext()
    context = plant.GetMyMutableContextFromRoot(root)
    of_scene = robot.scene_graph.GetMyContextFromRoot(root)
    random = np.random.default_rng(seed)
    geometry_ids = [
        plant.GetCollisionGeometriesForBody(plant.GetBodyByName(name)) for name in spheres.bodies
    ]
    moves = arrays.group_joint >= 0
    moving = {g for of, m in zip(geometry_ids, moves, strict=True) if m for g in of}
    bounds = arrays._replace(joint=arrays.group_joint, p_JS=arrays.bound[:, :3].copy())
    for _ in range(count):
        full[:n] = random.uniform(chain.lower, chain.upper)
        plant.SetPositions(context, full)
        query = robot.scene_graph.get_query_output_port().Eval(of_scene)
        centers = sphere_centers(chain, arrays, full[None, :n].copy())[0]
        middles = sphere_centers(chain, bounds, full[None, :n].copy())[0]
        for p_WQ in centers[-1] + random.uniform(-0.5, 0.5, (5, 3)):
            away = np.linalg.norm(centers - p_WQ, axis=1) - arrays.radius
            by_spheres = away[arrays.joint >= 0].min()
            found = query.ComputeSignedDistanceToPoint(p_WQ)
            true = min(each.distance for each in found if each.id_G in moving)
            assert by_spheres <= max(true, 0.0) + 1e-6
            if true > 0.0:
                assert true <= by_spheres + spheres.protrusion[moves].max() + 1e-6
        for g, bound in enumerate(arrays.bound):
            mine = slice(arrays.first[g], arrays.first[g + 1])
            away = np.linalg.norm(centers[mine] - middles[g], axis=1)
            assert (away + arrays.radius[mine]).max() <= bound[3]
        true = min(
            query.ComputeSignedDistancePairClosestPoints(a, b).distance
            for i, j in arrays.pairs
            for a in geometry_ids[i]
            for b in geometry_ids[j]
        )
        assert self_distance(chain, arrays, full[:n].copy()) <= max(true, 0.0) + 1e-4


def test_groups_and_pairs_of_the_panda(spheres: ArmSpheres) -> None:
    links, arrays = tuple(f"panda_link{k}" for k in range(8)), spheres.arrays
    assert spheres.bodies == (*links, *Robot().tool_links)
    assert arrays.group_joint.tolist() == [-1, 0, 1, 2, 3, 4, 5, 6, 6, 6, 6]
    count = len(arrays.radius)
    assert count < 200
    assert (arrays.of_tool == (np.arange(count) >= arrays.first[len(links)])).all()
    names = {tuple(spheres.bodies[g] for g in pair) for pair in spheres.arrays.pairs}
    assert ("panda_link0", "panda_hand") in names
    # Adjacent bodies, fixed bodies, and pairs excluded by the model.
    for absent in (
        ("panda_link3", "panda_link4"),
        ("panda_link6", "panda_hand"),
        ("panda_hand", "panda_leftfinger"),
        ("panda_link5", "panda_link7"),
    ):
        assert absent not in names


def test_a_grasped_object_belongs_to_the_tool() -> None:
    robot = Robot(carried=[HeldCylinder(radius=0.02, length=0.2, translation=[0.0, 0.0, 0.12])])
    panda = make_robot_plant(robot)
    found = make_arm_spheres(panda, home_positions(robot), tool_links(robot), COARSE)
    held = found.bodies.index("carried0")
    assert found.arrays.of_tool[found.arrays.first[held]]
    names = {frozenset(found.bodies[g] for g in pair) for pair in found.arrays.pairs}
    assert {"panda_link0", "carried0"} in names
    assert {"panda_hand", "carried0"} not in names


def test_six_joints_and_a_tilted_base(tmp_path: Path) -> None:
    robot = six_plant(tmp_path)
    found = make_arm_spheres(robot, np.zeros(6), ["wrist3"], COARSE)
    check_against_scene_graph(robot, np.zeros(6), found, 5, 15)
    assert [0, 6] in found.arrays.pairs.tolist()
    # With coarse spheres, links separated by one other link overlap.
    coarse = SphereParameters(protrusion=0.05, max_tool_protrusion=0.05)
    found = make_arm_spheres(robot, np.zeros(6), ["wrist3"], coarse)
    assert (found.arrays.allowance > 0.0).any()
    # The allowance also holds in configurations that were not sampled.
    check_against_scene_graph(robot, np.zeros(6), found, 7, 10)


def test_pairs_always_in_contact_are_excluded(tmp_path: Path) -> None:
    # The elbow joint is in the middle of the box of the first link.
    robot = six_plant(tmp_path, "-0.425 0 0", "0 0 0")
    found = make_arm_spheres(robot, np.zeros(6), ["wrist3"], COARSE)
    names = {tuple(found.bodies[g] for g in pair) for pair in found.arrays.pairs}
    assert ("pan", "elbow") not in names
    assert ("pan", "wrist1") in names


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('elbow_joint" type="revolute', 'elbow_joint" type="prismatic', "prismatic.*must be rev"),
        ("<collision>.*?</collision>", "", "pan.*has collision geometry"),
    ],
)
def test_unsupported_robots_are_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_arm_spheres(six_plant(tmp_path, old, new), np.zeros(6), [], COARSE)
