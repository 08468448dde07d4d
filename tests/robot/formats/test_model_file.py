"""Conversion of models with meshes, joints and packages that Drake cannot read."""

from pathlib import Path

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant

from drake_oa.common.config import ScenarioError
from drake_oa.common.files import installed_package
from drake_oa.robot.config import Robot
from drake_oa.robot.formats.meshes import convert_to_objs
from drake_oa.robot.plant import add_robot, home_positions, make_robot_plant

BOX = [0.04, 0.04, 0.04]


@pytest.fixture(autouse=True)
def _cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Uses a temporary cache folder for converted meshes."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def stl(file: Path, *boxes: tuple[list[float], list[float]], missing: int = 0) -> Path:
    """Writes a mesh of boxes, given by corner and size [m], without some of its triangles."""
    import open3d

    mesh = open3d.geometry.TriangleMesh()
    for corner, size in boxes or (([0.0] * 3, BOX),):
        mesh += open3d.geometry.TriangleMesh.create_box(*size).translate(corner)
    mesh.remove_triangles_by_index(list(range(missing)))
    open3d.io.write_triangle_mesh(str(file), mesh.compute_triangle_normals())
    return file


def dae(file: Path) -> Path:
    """Writes a box of 0.1 x 0.2 x 0.3 m in millimeters, in a node translated by 1 m along x."""
    corners = [[x, y, z] for z in (0, 300) for y in (0, 200) for x in (0, 100)]
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    text = " ".join(str(v) for corner in corners for v in corner)
    file.write_text(f"""<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><created>2020-01-01T00:00:00</created><modified>2020-01-01T00:00:00</modified>
<unit name="u" meter="0.001"/><up_axis>Y_UP</up_axis></asset>
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
    """Returns the vertices (N, 3) of an .obj file [m]."""
    rows = [line.split()[1:] for line in obj.read_text().splitlines() if line.startswith("v ")]
    return np.array(rows, dtype=float)


INERTIAL = """<inertial><mass value="1"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>"""
FINGER = """<link name="{0}">{1}</link><joint name="{0}" type="revolute"><parent link="link6"/>
    <child link="{0}"/><axis xyz="0 0 1"/>{2}<limit effort="1" lower="0" upper="1" velocity="1"/>
    </joint>"""

HEAD = FINGER.format("head", INERTIAL, "").replace("link6", "link0")


def arm(folder: Path, mesh: str, more: str = "") -> Robot:
    """Writes an arm of six joints, fixed to a link `world`, without transmissions."""
    links = "".join(
        f"""<link name="link{i}">{INERTIAL}
        <visual><geometry><mesh filename="{mesh}"/></geometry></visual>
        <collision><geometry><mesh filename="{mesh}"/></geometry></collision></link>"""
        for i in range(7)
    )
    joints = "".join(
        f"""<joint name="joint{i}" type="revolute"><parent link="link{i - 1}"/>
        <child link="link{i}"/><origin xyz="0 0 0.2"/><axis xyz="{i % 2} 0 {1 - i % 2}"/>
        <limit effort="{10 * i}" lower="-3" upper="3" velocity="3"/></joint>"""
        for i in range(1, 7)
    )
    base = """<link name="world"/><joint name="fixed" type="fixed"><parent link="world"/>
        <child link="link0"/></joint>"""
    file = folder / "arm.urdf"
    file.write_text(f'<robot name="arm">{base}{links}{joints}{more}</robot>')
    return Robot(
        model=str(file), base_link="link0", hand_link="link6", tool_links=["link6"],
        q_seed=[0.1] * 6,
    )  # fmt: skip


def test_meshes_are_converted_joints_actuated_and_the_base_placed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # URLs of Drake contain paths as they are.
    tmp_path = tmp_path / "my häuser"
    tmp_path.mkdir()
    config = arm(tmp_path, stl(tmp_path / "link 1.stl").name)
    config.X_WB.translation = [1.0, 2.0, 3.0]
    config.joint_speed = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    robot = make_robot_plant(config)
    plant, inspector = robot.plant, robot.scene_graph.model_inspector()
    assert plant.num_positions() == plant.num_actuators() == 6
    np.testing.assert_allclose(robot.limits.effort_limit, [10, 20, 30, 40, 50, 60])
    np.testing.assert_allclose(robot.limits.velocity_limit, [1.0, 2.0, 3.0, 3.0, 3.0, 3.0])
    for i in range(7):
        body = plant.GetBodyByName(f"link{i}")
        (shape,) = plant.GetCollisionGeometriesForBody(body)
        assert inspector.GetConvexHull(shape).num_vertices() == 8
        assert len(plant.GetVisualGeometriesForBody(body)) == 1
    base = plant.GetBodyByName("link0").EvalPoseInWorld(plant.CreateDefaultContext())
    np.testing.assert_allclose(base.translation(), [1.0, 2.0, 3.0])
    assert capsys.readouterr().err == f"converting meshes of {tmp_path} (first use only) ...\n"
    assert make_robot_plant(config) is robot
    config.joint_speed = [1.0]
    with pytest.raises(ScenarioError, match=r"robot\.joint_speed: expected 6 numbers"):
        make_robot_plant(config)


def test_transmissions_of_the_model_are_kept_and_a_linkage_is_fixed(tmp_path: Path) -> None:
    mesh = stl(tmp_path / "link.stl").name
    more = FINGER.format("left", INERTIAL, "")
    more += FINGER.format("right", INERTIAL, '<mimic joint="left"/>')
    for joint in (*(f"joint{k}" for k in range(1, 7)), "left"):
        more += f"""<transmission name="t{joint}">
        <type>transmission_interface/SimpleTransmission</type><joint name="{joint}"/>
        <actuator name="m{joint}"/></transmission>"""
    plant = make_robot_plant(arm(tmp_path, mesh, more)).plant
    assert (plant.num_positions(), plant.num_actuators()) == (6, 6)
    assert plant.HasJointActuatorNamed("mjoint3")
    for name in ("left", "right"):
        assert plant.GetJointByName(name).type_name() == "weld"


def test_a_dae_is_read_with_its_unit_and_its_nodes(tmp_path: Path) -> None:
    pytest.importorskip("collada", reason="pip install 'drake_oa[robots]'")
    for hulls in (True, False):
        (converted,) = convert_to_objs(dae(tmp_path / "box.dae"), hulls=hulls)
        np.testing.assert_allclose(corners(converted).min(axis=0), [1.0, 0.0, 0.0], atol=1e-9)
        np.testing.assert_allclose(corners(converted).max(axis=0), [1.1, 0.2, 0.3], atol=1e-6)
    # Drake's renderers reject a mesh without normals.
    assert "\nvn " in converted.read_text()


def test_mesh_is_split_if_one_hull_would_add_much_volume(tmp_path: Path) -> None:
    size = [0.1] * 3
    one, beside = ([0.0] * 3, size), ([0.3, 0.0, 0.0], size)
    between = [0.1, 0.0, 0.0], [0.2, *size[:2]]
    assert len(convert_to_objs(stl(tmp_path / "a.stl", one, beside), hulls=True)) == 2
    assert len(convert_to_objs(stl(tmp_path / "b.stl", one, between, beside), hulls=True)) == 1
    assert len(convert_to_objs(stl(tmp_path / "c.stl", one, beside, missing=1), hulls=True)) == 1
    # A changed file is converted again.
    (changed,) = convert_to_objs(stl(tmp_path / "a.stl", one), hulls=True)
    np.testing.assert_allclose(np.ptp(corners(changed), axis=0), size)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("link.stl", "no mesh", "of link0: .*cannot be read as a mesh"),
        ("link.stl", None, "of link0: .*No such file"),
        ("link.dae", "<a/>", "of link0: .*cannot be read as a mesh"),
        (
            "package://nowhere/link.stl",
            None,
            r"'nowhere' is neither .* pip install 'drake_oa\[robots\]'",
        ),
    ],
)
def test_error_of_an_unreadable_mesh_names_the_mesh(
    tmp_path: Path, name: str, content: str | None, message: str
) -> None:
    if name.endswith(".dae"):
        pytest.importorskip("collada", reason="pip install 'drake_oa[robots]'")
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(ScenarioError, match=message):
        make_robot_plant(arm(tmp_path, name))


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ('effort="10"', 'effort="0"', "'joint1' moves without an actuator"),
        ('velocity="3"', 'velocity="0"', "'joint1' has no speed"),
        (INERTIAL, "", "move without mass: link1, .* link6;"),
        ('<link name="link0">', f'{HEAD}<link name="link0">', "'joint1' .* must precede all other"),
        ('type="revolute"', 'type="fixed"', "no joint between .* and robot.hand_link moves"),
    ],
)
def test_error_of_joints_that_cannot_be_controlled(
    tmp_path: Path, before: str, after: str, message: str
) -> None:
    robot = arm(tmp_path, stl(tmp_path / "link.stl").name)
    file = Path(robot.model)
    file.write_text(file.read_text().replace(before, after))
    with pytest.raises(ScenarioError, match=f"^robot.model: .*{message}"):
        make_robot_plant(robot)


def test_errors_and_warnings_of_drake_name_the_file(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    mesh = stl(tmp_path / "link.stl").name
    robot = arm(tmp_path, mesh, FINGER.format("left", INERTIAL, '<dynamics friction="1"/>'))
    for _ in range(2):
        add_robot(MultibodyPlant(0.001), robot)
    (warning,) = (text for text in caplog.messages if "friction" in text)
    assert warning.startswith(str(tmp_path / "arm.urdf"))
    broken = arm(tmp_path, mesh, '<joint name="j" type="fixed"/>')
    with pytest.raises(ScenarioError, match=r"cannot load .*: .*arm\.urdf: error"):
        add_robot(MultibodyPlant(0.001), broken)


# The second joint inherits its axis from the outer class.
_MJCF = """<mujoco model="two"><compiler angle="radian" autolimits="true" meshdir="meshes"/>
<default><general forcerange="-150 150"/>
<default class="arm"><joint axis="0 1 0" range="-2 2"/>
<default class="weak"><general forcerange="-28 28"/></default>
<default class="seen"><geom type="mesh" contype="0" conaffinity="0" group="2"/></default>
</default></default>
<asset><mesh file="box.stl"/></asset>
<worldbody><light pos="0 0 1"/><body name="base" childclass="arm">
<inertial mass="1" pos="0 0 0" diaginertia="0.1 0.1 0.1"/>
<body name="one" pos="0 0 0.5"><inertial mass="1" pos="0 0 0" diaginertia="0.1 0.1 0.1"/>
<joint name="j1"/><geom class="seen" mesh="box"/><geom type="capsule" size="0.05 0.1"/>
<body name="two" pos="0 0 0.5"><inertial mass="1" pos="0 0 0" diaginertia="0.1 0.1 0.1"/>
<joint name="j2" class="weak"/><geom type="mesh" mesh="box"/></body></body></body></worldbody>
<actuator><position name="m1" joint="j1"/><position name="m2" class="weak" joint="j2"/>
</actuator><keyframe><key name="home" qpos="0 0"/></keyframe></mujoco>"""


def test_mjcf_keeps_inherited_attributes(tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    stl(tmp_path / "meshes" / "box.stl")
    (tmp_path / "two.xml").write_text(_MJCF)
    config = Robot(
        model=str(tmp_path / "two.xml"), base_link="base", hand_link="two", tool_links=["two"],
        q_seed=[0.3, 0.4], p_HE=[0.0, 0.0, 0.1],
    )  # fmt: skip
    config.X_WB.translation = [1.0, 0.0, 0.0]
    robot = make_robot_plant(config)
    np.testing.assert_allclose(robot.limits.effort_limit, [150.0, 28.0])
    assert robot.limits.note == "robot.model: no limit of speed of j1, speed of j2"
    np.testing.assert_allclose(robot.limits.position_upper, [2.0, 2.0])
    # Both joints rotate about y.
    x, z = 0.5 * np.sin(0.3) + 0.1 * np.sin(0.7), 0.5 + 0.5 * np.cos(0.3) + 0.1 * np.cos(0.7)
    p_WE = robot.tool_path(home_positions(config)[None])[0]
    np.testing.assert_allclose(p_WE, [1.0 + x, 0.0, z], atol=1e-9)
    one, two = (robot.plant.GetBodyByName(name) for name in ("one", "two"))
    assert len(robot.plant.GetCollisionGeometriesForBody(one)) == 1
    (shape,) = robot.plant.GetCollisionGeometriesForBody(two)
    assert robot.scene_graph.model_inspector().GetConvexHull(shape).num_vertices() == 8


def test_model_in_a_python_package_is_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "some_arms"
    package.mkdir()
    (package / "__init__.py").write_text("raise RuntimeError('it is not imported')")
    config = arm(package, stl(package / "link.stl").name)
    monkeypatch.syspath_prepend(tmp_path)
    assert installed_package("some_arms") == package
    config.model = "package://some_arms/arm.urdf"
    assert make_robot_plant(config).plant.num_positions() == 6
    assert installed_package("no_such_arms") is None
