"""Spheres of robots enclose what SceneGraph has, and little more; pairs are found."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from pydrake.math import RigidTransform, RollPitchYaw

from drake_oa.common.files import read_arrays
from drake_oa.common.messages import FloatArray
from drake_oa.geometry import solids as solid
from drake_oa.geometry.shapes import Cylinder as HeldCylinder
from drake_oa.planning.arm_world import placed, self_distance
from drake_oa.robot.arm import chain_poses, make_chain
from drake_oa.robot.config import BasePose, Robot, SphereParameters
from drake_oa.robot.grasped_object import tool_links
from drake_oa.robot.plant import (
    RobotPlant,
    home_positions,
    make_robot_plant,
)
from drake_oa.robot.sphere_cover import (
    SHIPPED,
    balls_of,
    cover,
    cover_key,
    known_cover,
)
from drake_oa.robot.spheres import ArmSpheres, make_arm_spheres

COARSE = SphereParameters(overshoot=0.015, tool_overshoot=0.012, fixed_overshoot=0.03, postures=200)
_WEDGE = [[0, 0, 0], [0.1, 0, 0], [0, 0.08, 0], [0, 0, 0.06], [0.1, 0, 0.02]]


def one_of(kind: str, size: tuple[float, float, float]) -> solid.Solid:
    a, b, c = size
    return {
        "sphere": lambda: solid.sphere(a),
        "capsule": lambda: solid.capsule(a, b),
        "cylinder": lambda: solid.cylinder(a, b),
        "box": lambda: solid.box(size),
        "ellipsoid": lambda: solid.ellipsoid(size),
        "hull": lambda: solid.hull(np.array(_WEDGE) * 10 * [a, b, c]),
    }[kind]()


def points_in(shape: solid.Solid, seed: int) -> FloatArray:
    """Points of a convex shape: those on its surface, and mixtures of them."""
    on_shape = shape.placed(solid.surface_points(shape, 3000))
    random = np.random.default_rng(seed)
    share = random.uniform(size=(3000, 1))
    one, other = random.choice(on_shape, 3000), random.choice(on_shape, 3000)
    return np.concatenate([on_shape, share * one + (1.0 - share) * other])


def distances(scene: solid.Solids, points: FloatArray) -> FloatArray:
    return solid.least_distances(scene, points, 0.0, np.inf, -np.inf)


@settings(max_examples=12, phases=[Phase.generate])
@given(
    kind=st.sampled_from(["sphere", "capsule", "cylinder", "box", "ellipsoid", "hull"]),
    size=st.tuples(*[st.floats(0.02, 0.1)] * 3),
    rpy=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    seed=st.integers(0, 1000),
)
def test_a_cover_encloses_and_sticks_out_no_farther_than_it_says(
    kind: str, size: tuple[float, float, float], rpy: tuple[float, float, float], seed: int
) -> None:
    X = RigidTransform(RollPitchYaw(*rpy), [0.1, -0.2, 0.3]).GetAsMatrix4()
    shape = replace(one_of(kind, size), X_WO=X)
    found = cover([shape], 0.012)
    assert distances(balls_of(found.centers, found.radii), points_in(shape, seed)).max() <= 1e-9
    directions = np.random.default_rng(seed).normal(size=(len(found.radii), 300, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    outermost = (found.centers[:, None] + found.radii[:, None, None] * directions).reshape(-1, 3)
    assert distances(solid.solids_of([shape]), outermost).max() <= found.overshoot + 1e-9
    if kind != "hull":
        # A target: a flat wedge takes more.
        assert found.overshoot <= 0.012 * 1.3


def test_what_was_found_is_read_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    solids = [solid.box((0.05, 0.1, 0.06))]
    expected = cover(solids, 0.01)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for _ in range(2):
        found = known_cover(solids, 0.01)
        for name in ("centers", "radii", "overshoot"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
        (file,) = (tmp_path / "drake_oa" / "spheres").iterdir()
    assert known_cover(solids, 0.012).overshoot != expected.overshoot
    # What cannot be read is made anew, and what cannot be written is not kept.
    file.write_bytes(b"PK")
    np.testing.assert_array_equal(known_cover(solids, 0.01).radii, expected.radii)
    monkeypatch.setenv("XDG_CACHE_HOME", str(file))
    np.testing.assert_array_equal(known_cover(solids, 0.01).radii, expected.radii)


def test_the_shipped_spheres_are_of_the_pandas_bodies_and_enclose_them(panda: RobotPlant) -> None:
    plant, inspector = panda.plant, panda.scene_graph.model_inspector()
    shipped, asked = read_arrays(SHIPPED), SphereParameters()
    for body in map(plant.get_body, plant.GetBodyIndices(panda.instance)):
        geometries = plant.GetCollisionGeometriesForBody(body)
        if not geometries:
            continue
        overshoot = asked.overshoot
        if body.name() == "panda_link0":
            overshoot = asked.fixed_overshoot
        elif body.name() in Robot().tool_links:
            overshoot = asked.tool_overshoot
        solids = [solid.read_solid(inspector, geometry) for geometry in geometries]
        # Removed, so that none is left that no body has.
        balls = shipped.pop(cover_key(solids, overshoot))
        scene = balls_of(balls[:, :3], balls[:, 3])
        for shape in solids:
            assert distances(scene, points_in(shape, 0)).max() <= 1e-9
        assert known_cover(solids, overshoot).overshoot <= 1.25 * overshoot
    assert not shipped


def arm_of_links(
    path: Path, joints: str = "rrrrrr", *, collision: bool = True, folded: bool = False
) -> RobotPlant:
    """Links of a box and a cylinder in a row, bent by turns; its base leans.

    Folded, joints 1 and 2 turn about almost one point.
    """
    shape = (
        '<collision><origin xyz="0 0 0.1"/><geometry><box size="0.05 0.06 0.16"/></geometry>'
        '</collision><collision><geometry><cylinder radius="0.04" length="0.09"/></geometry>'
        "</collision>"
    )
    inertial = (
        '<inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" '
        'iyz="0"/></inertial>'
    )
    text = ['<robot name="links">']
    for k in range(len(joints) + 1):
        text.append(f'<link name="link{k}">{inertial}{shape if collision else ""}</link>')
    for k, kind in enumerate(joints):
        name = {"r": "revolute", "p": "prismatic", "f": "fixed"}[kind]
        text.append(
            f'<joint name="joint{k}" type="{name}"><parent link="link{k}"/>'
            f'<child link="link{k + 1}"/><origin rpy="0 0 {0.5 * k}" '
            f'xyz="0 0 {0.01 if folded and k in (1, 2) else 0.22}"/>'
            f'<axis xyz="{1 - k % 2} {k % 2} 0"/>'
            '<limit lower="-2.2" upper="2.2" velocity="1" effort="10"/></joint>'
        )
    text.append("</robot>")
    path.write_text("".join(text))
    base = BasePose(translation=[0.5, -1.0, 0.7], rpy=[0.3, -0.2, 1.0])
    hand = f"link{len(joints)}"
    config = Robot(
        model=str(path),
        base_link="link0",
        hand_link=hand,
        tool_links=[hand],
        p_HE=[0.0, 0.0, 0.2],
        X_WB=base,
        q_seed=[0.0] * (len(joints) - joints.count("f")),
    )
    return make_robot_plant(config)


@pytest.fixture(scope="module")
def spheres(panda: RobotPlant) -> ArmSpheres:
    return make_arm_spheres(panda, home_positions(Robot()), Robot().tool_links, COARSE)


def check_against_scene_graph(
    robot: RobotPlant, q: np.ndarray, spheres: ArmSpheres, seed: int, count: int
) -> None:
    """Distances to points and to itself are at most SceneGraph's, and by no more than is said."""
    plant, arrays = robot.plant, spheres.arrays
    chain = make_chain(plant, robot.tool_frame, q)
    n = len(chain.lower)
    X, full = np.empty((n + 2, 12)), q.copy()
    root = robot.diagram.CreateDefaultContext()
    context = plant.GetMyMutableContextFromRoot(root)
    of_scene = robot.scene_graph.GetMyContextFromRoot(root)
    random = np.random.default_rng(seed)
    geometries = [
        plant.GetCollisionGeometriesForBody(plant.GetBodyByName(name)) for name in spheres.bodies
    ]
    arm, moves = arrays.joint >= 0, arrays.group_joint >= 0
    moving = {g for of, m in zip(geometries, moves, strict=True) if m for g in of}
    for _ in range(count):
        full[:n] = random.uniform(chain.lower, chain.upper)
        plant.SetPositions(context, full)
        query = robot.scene_graph.get_query_output_port().Eval(of_scene)
        chain_poses(full[:n].copy(), chain.X_PJ, X)
        rows = enumerate(arrays.joint)
        centers = np.array([placed(X, joint + 1, arrays.p_JS, row) for row, joint in rows])
        for p_WQ in X[-1, 9:] + random.uniform(-0.5, 0.5, (5, 3)):
            by_spheres = (np.linalg.norm(centers - p_WQ, axis=1) - arrays.radius)[arm].min()
            found = query.ComputeSignedDistanceToPoint(p_WQ)
            true = min(each.distance for each in found if each.id_G in moving)
            assert by_spheres <= true + 1e-6
            if true > 0.0:
                assert true <= by_spheres + spheres.overshoot[moves].max() + 1e-6
        for g, joint in enumerate(arrays.group_joint):
            mine = slice(arrays.first[g], arrays.first[g + 1])
            away = np.linalg.norm(centers[mine] - placed(X, joint + 1, arrays.bound, g), axis=1)
            assert (away + arrays.radius[mine]).max() <= arrays.bound[g, 3]
        true = min(
            query.ComputeSignedDistancePairClosestPoints(a, b).distance
            for i, j in arrays.pairs
            for a in geometries[i]
            for b in geometries[j]
        )
        assert self_distance(chain, arrays, full[:n].copy()) <= true + 1e-4


def test_the_pandas_bodies(spheres: ArmSpheres) -> None:
    links, arrays = tuple(f"panda_link{k}" for k in range(8)), spheres.arrays
    assert spheres.bodies == (*links, *Robot().tool_links)
    assert arrays.group_joint.tolist() == [-1, 0, 1, 2, 3, 4, 5, 6, 6, 6, 6]
    assert len(spheres) < 150
    assert not arrays.of_tool[: arrays.first[len(links)]].any()
    assert arrays.of_tool[arrays.first[len(links)] :].all()
    names = {tuple(spheres.bodies[g] for g in pair) for pair in spheres.arrays.pairs}
    assert ("panda_link0", "panda_hand") in names
    # Neighbours; fixed to one another; excluded by the model.
    for absent in (
        ("panda_link3", "panda_link4"),
        ("panda_link6", "panda_hand"),
        ("panda_hand", "panda_leftfinger"),
        ("panda_link5", "panda_link7"),
    ):
        assert absent not in names


def test_what_is_held_is_of_the_tool() -> None:
    robot = Robot(carried=[HeldCylinder(radius=0.02, length=0.2, translation=[0.0, 0.0, 0.12])])
    panda = make_robot_plant(robot)
    found = make_arm_spheres(panda, home_positions(robot), tool_links(robot), COARSE)
    held = found.bodies.index("carried0")
    assert found.arrays.of_tool[found.arrays.first[held]]
    names = {frozenset(found.bodies[g] for g in pair) for pair in found.arrays.pairs}
    assert {"panda_link0", "carried0"} in names
    assert {"panda_hand", "carried0"} not in names


def test_six_joints_and_a_base_that_leans(tmp_path: Path) -> None:
    robot = arm_of_links(tmp_path / "arm.urdf")
    q = np.zeros(6)
    found = make_arm_spheres(robot, q, ["link6"], COARSE)
    check_against_scene_graph(robot, q, found, 5, 15)
    assert [0, 6] in found.arrays.pairs.tolist()
    # The same postures are found each time.
    again = make_arm_spheres(robot, q, ["link6"], COARSE).arrays
    np.testing.assert_array_equal(again.pairs, found.arrays.pairs)
    np.testing.assert_array_equal(again.p_JS, found.arrays.p_JS)


def test_overlap_that_means_nothing_is_allowed_for(tmp_path: Path) -> None:
    # Spheres so coarse that links meet which are kept apart by the one between them.
    robot = arm_of_links(tmp_path / "arm.urdf")
    coarse = SphereParameters(overshoot=0.05, tool_overshoot=0.05, postures=1000)
    found = make_arm_spheres(robot, np.zeros(6), ["link6"], coarse)
    assert (found.arrays.allowance > 0.0).any()
    # In postures that were not looked at either.
    check_against_scene_graph(robot, np.zeros(6), found, 7, 10)


def test_what_always_touches_is_left_out(tmp_path: Path) -> None:
    # Links 1 and 3 overlap whatever the joints.
    robot = arm_of_links(tmp_path / "arm.urdf", folded=True)
    found = make_arm_spheres(robot, np.zeros(6), ["link6"], COARSE)
    names = {tuple(found.bodies[g] for g in pair) for pair in found.arrays.pairs}
    assert ("link1", "link3") not in names


def test_robots_that_cannot_be_served_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"'joint2'.*prismatic.*must be revolute"):
        make_arm_spheres(arm_of_links(tmp_path / "p.urdf", "rrprrr"), np.zeros(6), [], COARSE)
    with pytest.raises(ValueError, match=r"link1.*has collision geometry"):
        make_arm_spheres(
            arm_of_links(tmp_path / "b.urdf", collision=False), np.zeros(6), [], COARSE
        )
    with pytest.raises(ValueError, match="no joint moves 'link2'"):
        make_arm_spheres(arm_of_links(tmp_path / "f.urdf", "ff"), np.zeros(0), [], COARSE)
