"""Models of SDF and MJCF, with .dae, and of packages of Python, as Drake takes them."""

from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from drake_oa.common.config import ScenarioError
from drake_oa.common.files import installed_package
from drake_oa.robot.config import Robot
from drake_oa.robot.formats.meshes import as_objs
from drake_oa.robot.plant import RobotPlant, home_positions, make_robot_plant

SIZE = np.array([0.1, 0.2, 0.3])


@pytest.fixture(autouse=True)
def _cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def stl(file: Path) -> Path:
    import open3d

    mesh = open3d.geometry.TriangleMesh.create_box(*SIZE).compute_triangle_normals()
    open3d.io.write_triangle_mesh(str(file), mesh)
    return file


def dae(file: Path, meter: str = "0.001") -> Path:
    """The same box in millimetres, moved by its node by 1 m along x."""
    corners = [[x, y, z] for z in (0, 300) for y in (0, 200) for x in (0, 100)]
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    text = " ".join(str(v) for corner in corners for v in corner)
    file.write_text(f"""<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><created>2020-01-01T00:00:00</created><modified>2020-01-01T00:00:00</modified>
<unit name="u" meter="{meter}"/><up_axis>Y_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="24">{text}</float_array><technique_common>
<accessor source="#a" count="8" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<polylist count="6"><input semantic="VERTEX" source="#v" offset="0"/>
<vcount>4 4 4 4 4 4</vcount><p>{" ".join(str(i) for quad in quads for i in quad)}</p></polylist>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node><translate>1000 0 0</translate>
<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>""")
    return file


def corners(obj: Path) -> np.ndarray:
    rows = [line.split()[1:] for line in obj.read_text().splitlines() if line.startswith("v ")]
    return np.array(rows, dtype=float)


def tool(robot: RobotPlant, config: Robot) -> RigidTransform:
    context = robot.plant.CreateDefaultContext()
    robot.plant.SetPositions(context, home_positions(config))
    return robot.tool_frame.CalcPoseInWorld(context)


@pytest.mark.parametrize("hulls", [True, False])
def test_a_dae_counts_with_its_unit_and_its_nodes(tmp_path: Path, hulls: bool) -> None:
    pytest.importorskip("collada", reason="pip install 'drake_oa[robots]'")
    (made,) = as_objs(dae(tmp_path / "box.dae"), hulls=hulls)
    found = corners(made)
    assert len(found) == 8
    np.testing.assert_allclose(found.min(axis=0), [1.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(found.max(axis=0), SIZE + [1.0, 0.0, 0.0], atol=1e-7)
    # Cameras refuse a mesh without normals.
    assert made.read_text().count("vn ") == made.read_text().count("f ") == 12


def test_a_dae_that_nothing_reads_names_what_would(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "collada", None)
    with pytest.raises(ValueError, match=r"takes the package pycollada: .*drake_oa\[robots\]"):
        as_objs(dae(tmp_path / "box.dae"), hulls=True)


_SDF = """<sdf version="1.9"><model name="six">
<joint name="stand" type="fixed"><parent>world</parent><child>link0</child></joint>"""


def sdf(folder: Path) -> Robot:
    text = _SDF
    for i in range(7):
        text += f"""<link name="link{i}"><pose>0 0 {0.2 * i} 0 0 0</pose>
<inertial><mass>1</mass></inertial><collision name="c"><geometry><mesh><uri>box.stl</uri></mesh>
</geometry></collision><visual name="v"><geometry><mesh><uri>no.dae</uri></mesh></geometry>
</visual></link>"""
    for i in range(1, 7):
        axis = "1 0 0" if i % 2 else "0 0 1"
        text += f"""<joint name="j{i}" type="revolute"><parent>link{i - 1}</parent>
<child>link{i}</child><axis><xyz>{axis}</xyz><limit><lower>-2</lower><upper>2</upper>
<effort>50</effort><velocity>3</velocity></limit></axis></joint>"""
    (folder / "six.sdf").write_text(text + "</model></sdf>")
    stl(folder / "box.stl")
    return Robot(
        model=str(folder / "six.sdf"), base_link="link0", hand_link="link6",
        tool_links=["link6"], q_seed=[0.1] * 6,
    )  # fmt: skip


def test_an_sdf_with_meshes_is_taken(tmp_path: Path) -> None:
    config = sdf(tmp_path)
    config.X_WB.translation = [1.0, 2.0, 3.0]
    robot = make_robot_plant(config)
    plant, inspector = robot.plant, robot.scene_graph.model_inspector()
    assert plant.num_positions() == plant.num_actuators() == 6
    for i in range(7):
        body = plant.GetBodyByName(f"link{i}")
        (shape,) = plant.GetCollisionGeometriesForBody(body)
        assert inspector.GetConvexHull(shape).num_vertices() == 8
        assert len(plant.GetVisualGeometriesForBody(body)) == 1
    base = plant.GetBodyByName("link0").EvalPoseInWorld(plant.CreateDefaultContext())
    np.testing.assert_allclose(base.translation(), [1.0, 2.0, 3.0])
    assert not list(tmp_path.glob("*.obj"))


def test_speeds_that_the_model_has_not_are_of_the_scenario(tmp_path: Path) -> None:
    config = sdf(tmp_path)
    config.joint_speed = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    robot = make_robot_plant(config)
    limits = robot.limits
    np.testing.assert_allclose(limits.velocity_limit, [1.0, 2.0, 3.0, 3.0, 3.0, 3.0])
    config.joint_speed = [1.0]
    with pytest.raises(ScenarioError, match=r"robot\.joint_speed: expected 6 numbers"):
        make_robot_plant(config)


# The second joint's axis is that of the outer class, which its own class says nothing of.
_MJCF = """<mujoco model="two"><compiler angle="radian" autolimits="true" meshdir="meshes"/>
<option integrator="implicitfast"/>
<default><default class="arm"><joint axis="0 1 0" range="-2 2"/>
<general forcerange="-150 150"/><default class="weak"><general forcerange="-28 28"/></default>
<default class="seen"><geom type="mesh" contype="0" conaffinity="0" group="2"/></default>
</default></default>
<asset><mesh file="box.stl"/></asset>
<worldbody><light pos="0 0 1"/><body name="base" childclass="arm">
<inertial mass="1" pos="0 0 0" diaginertia="0.1 0.1 0.1"/>
<body name="one" pos="0 0 0.5"><inertial mass="1" pos="0 0 0" diaginertia="0.1 0.1 0.1"/>
<joint name="j1"/><geom class="seen" mesh="box"/><geom type="capsule" size="0.05 0.1"/>
<body name="two" pos="0 0 0.5"><inertial mass="1" pos="0 0 0" diaginertia="0.1 0.1 0.1"/>
<joint name="j2" class="weak"/><geom type="mesh" mesh="box"/></body></body></body></worldbody>
<actuator><general name="m1" class="arm" joint="j1"/><general name="m2" class="weak" joint="j2"/>
</actuator><keyframe><key name="home" qpos="0 0"/></keyframe></mujoco>"""


def test_an_mjcf_keeps_what_its_classes_inherit(tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    stl(tmp_path / "meshes" / "box.stl")
    file = tmp_path / "two.xml"
    file.write_text(_MJCF)
    config = Robot(
        model=str(file), base_link="base", hand_link="two", tool_links=["two"],
        q_seed=[0.3, 0.4], p_HE=[0.0, 0.0, 0.1],
    )  # fmt: skip
    config.X_WB.translation = [1.0, 0.0, 0.0]
    robot = make_robot_plant(config)
    limits = robot.limits
    assert limits.actuator_name == ("j1", "j2")
    np.testing.assert_allclose(limits.effort_limit, [150.0, 28.0])
    np.testing.assert_allclose(limits.position_upper, [2.0, 2.0])
    X_WE = tool(robot, config)
    # Both turn about y.
    turn = RollPitchYaw(0.0, 0.7, 0.0).ToRotationMatrix().matrix()
    np.testing.assert_allclose(X_WE.rotation().matrix(), turn, atol=1e-9)
    x, z = 0.5 * np.sin(0.3) + 0.1 * np.sin(0.7), 0.5 + 0.5 * np.cos(0.3) + 0.1 * np.cos(0.7)
    np.testing.assert_allclose(X_WE.translation(), [1.0 + x, 0.0, z], atol=1e-9)
    plant = robot.plant
    one, two = (plant.GetBodyByName(name) for name in ("one", "two"))
    assert len(plant.GetCollisionGeometriesForBody(one)) == 1
    (shape,) = plant.GetCollisionGeometriesForBody(two)
    assert robot.scene_graph.model_inspector().GetConvexHull(shape).num_vertices() == 8


def test_a_model_of_a_package_of_python_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "some_arms"
    (package / "six").mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('it is not imported')")
    config = sdf(package / "six")
    monkeypatch.syspath_prepend(tmp_path)
    assert installed_package("some_arms") == package
    config.model = "package://some_arms/six/six.sdf"
    assert make_robot_plant(config).plant.num_positions() == 6


def test_a_package_that_is_not_there_is_named() -> None:
    assert installed_package("no_such_arms") is None
    with pytest.raises(ScenarioError, match=r"'no_such_arms', .* pip install 'drake_oa\[robots\]'"):
        make_robot_plant(Robot(model="package://no_such_arms/arm.urdf"))
