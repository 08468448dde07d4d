"""URDFs with meshes, joints and packages that Drake does not take as they are."""

from pathlib import Path

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant

from drake_oa.common.config import ScenarioError
from drake_oa.robot.config import Robot
from drake_oa.robot.formats.meshes import as_objs
from drake_oa.robot.plant import add_robot, make_robot_plant

_FACES = [(0, 2, 1), (1, 2, 3), (4, 5, 6), (5, 7, 6), (0, 1, 4), (1, 5, 4)]
_FACES += [(2, 6, 3), (3, 6, 7), (0, 4, 2), (2, 4, 6), (1, 3, 5), (3, 7, 5)]
_FINGER = """<link name="{0}"><inertial><mass value="0.1"/><inertia ixx="0.01" iyy="0.01"
    izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="{0}" type="revolute">
    <parent link="link6"/><child link="{0}"/><axis xyz="0 0 1"/>{1}
    <limit effort="1" lower="0" upper="1" velocity="1"/></joint>"""


@pytest.fixture(autouse=True)
def _cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def box(low: list[float], high: list[float], faces=_FACES) -> str:
    corners = [[(low, high)[i >> k & 1][k] for k in range(3)] for i in range(8)]
    return "\n".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {' '.join(map(str, corners[i]))}\n" for i in face)
        + "endloop\nendfacet"
        for face in faces
    )


def stl(file: Path, *parts: str) -> Path:
    file.write_text("solid a\n" + "\n".join(parts) + "\nendsolid a\n")
    return file


def volumes(files: list[Path]) -> list[float]:
    def volume(file: Path) -> float:
        rows = [line.split() for line in file.read_text().splitlines()]
        v = np.array([row[1:] for row in rows if row[0] == "v"], dtype=float)
        f = [[word.split("/")[0] for word in row[1:]] for row in rows if row[0] == "f"]
        f = np.array(f, dtype=int) - 1
        # Triangles of a hull face any way.
        a, b, c = (v[f[:, k]] - v.mean(axis=0) for k in range(3))
        return float(np.abs(np.einsum("ij,ij->i", a, np.cross(b, c))).sum() / 6.0)

    return sorted(map(volume, files))


def arm(folder: Path, mesh: str, more: str = "") -> Robot:
    links = "".join(
        f"""<link name="link{i}"><inertial><mass value="1"/>
        <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
        <visual><geometry><mesh filename="there_is_none.dae"/></geometry></visual>
        <collision><geometry><mesh filename="{mesh}"/></geometry></collision></link>"""
        for i in range(7)
    )
    joints = "".join(
        f"""<joint name="joint{i}" type="revolute"><parent link="link{i - 1}"/>
        <child link="link{i}"/><origin xyz="0 0 0.2"/><axis xyz="{i % 2} 0 {1 - i % 2}"/>
        <limit effort="{10 * i}" lower="-3" upper="3" velocity="2"/></joint>"""
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


def test_meshes_are_converted_and_joints_driven(tmp_path):
    mesh = stl(tmp_path / "link.stl", box([-0.02] * 3, [0.02] * 3))
    robot = make_robot_plant(arm(tmp_path, mesh.name))
    plant = robot.plant
    assert plant.num_positions() == plant.num_actuators() == 6
    np.testing.assert_allclose(plant.GetEffortUpperLimits(), [10, 20, 30, 40, 50, 60])
    inspector = robot.scene_graph.model_inspector()
    for i in range(7):
        body = plant.GetBodyByName(f"link{i}")
        (shape,) = plant.GetCollisionGeometriesForBody(body)
        assert inspector.GetConvexHull(shape).num_vertices() == 8
        # In place of what cannot be read it is shown.
        assert len(plant.GetVisualGeometriesForBody(body)) == 1
    assert plant.IsAnchored(plant.GetBodyByName("link0"))


def test_transmissions_of_the_model_are_its_own(tmp_path):
    mesh = stl(tmp_path / "link.stl", box([-0.02] * 3, [0.02] * 3))
    only = """<transmission name="t"><type>transmission_interface/SimpleTransmission</type>
        <joint name="joint3"/><actuator name="m"/></transmission>"""
    assert make_robot_plant(arm(tmp_path, mesh.name, only)).plant.num_actuators() == 1


def test_a_mesh_is_split_where_a_hull_would_fill_much(tmp_path):
    one, beside = box([0.0] * 3, [0.1] * 3), box([0.3, 0.0, 0.0], [0.4, 0.1, 0.1])
    apart = as_objs(stl(tmp_path / "a.stl", one, beside), hulls=True)
    assert volumes(apart) == pytest.approx([1e-3, 1e-3])
    adjoining = box([0.1, 0.001, 0.0], [0.3, 0.1, 0.1])
    row = as_objs(stl(tmp_path / "b.stl", one, adjoining, beside), hulls=True)
    assert volumes(row) == pytest.approx([4e-3], rel=0.01)
    whole = as_objs(tmp_path / "a.stl", hulls=False)
    assert len(whole) == 1
    assert whole[0].read_text().count("f ") == 24


def test_what_is_not_closed_has_one_hull(tmp_path):
    one, beside = box([0.0] * 3, [0.1] * 3), box([0.3, 0.0, 0.0], [0.4, 0.1, 0.1], _FACES[1:])
    assert len(as_objs(stl(tmp_path / "a.stl", one, beside), hulls=True)) == 1


def test_what_is_in_the_cache_is_taken_until_the_mesh_changes(tmp_path):
    mesh = stl(tmp_path / "a.stl", box([0.0] * 3, [0.1] * 3))
    first = as_objs(mesh, hulls=True)
    written = [file.stat().st_mtime_ns for file in first]
    assert [file.stat().st_mtime_ns for file in as_objs(mesh, hulls=True)] == written
    stl(mesh, box([0.0] * 3, [0.2] * 3))
    assert volumes(as_objs(mesh, hulls=True)) == pytest.approx([8e-3])


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("link.stl", "no mesh", "<collision> of link0: .*cannot be read as a mesh"),
        ("link.stl", None, "<collision> of link0: .*No such file"),
        ("link.dae", "<a/>", "<collision> of link0: .*cannot be read as a mesh"),
        ("link.stl", box([0.0] * 3, [0.1, 0.1, 0.0], _FACES[:2]), "must enclose a volume"),
        ("package://nowhere/link.stl", None, "nowhere"),
    ],
)
def test_a_collision_mesh_that_cannot_be_taken_is_named(tmp_path, name, data, message):
    if name.endswith(".dae"):
        pytest.importorskip("collada", reason="pip install 'drake_oa[robots]'")
    if data is not None:
        stl(tmp_path / name, data)
    with pytest.raises(ScenarioError, match=message):
        make_robot_plant(arm(tmp_path, name))


def test_a_conversion_is_announced_and_kept_where_it_can_be(tmp_path, monkeypatch, capsys):
    mesh = stl(tmp_path / "link.stl", box([-0.02] * 3, [0.02] * 3))
    monkeypatch.setenv("XDG_CACHE_HOME", str(mesh))
    make_robot_plant(arm(tmp_path, mesh.name))
    told = capsys.readouterr().err
    assert "for this run only" in told
    assert "converting meshes of arm (first use only): 1 of 14\n" in told


def test_a_model_is_read_once_and_its_warnings_name_it_once(tmp_path, caplog):
    mesh = stl(tmp_path / "link.stl", box([-0.02] * 3, [0.02] * 3))
    robot = arm(tmp_path, mesh.name, _FINGER.format("left", '<dynamics friction="1"/>'))
    assert make_robot_plant(robot) is make_robot_plant(robot)
    add_robot(MultibodyPlant(0.001), robot)
    (warning,) = (text for text in caplog.messages if "friction" in text)
    assert warning.startswith(str(tmp_path / "arm.urdf"))


def test_a_model_that_cannot_be_parsed_is_named(tmp_path):
    mesh = stl(tmp_path / "link.stl", box([-0.02] * 3, [0.02] * 3))
    robot = arm(tmp_path, mesh.name, '<joint name="j" type="fixed"/>')
    with pytest.raises(ScenarioError, match=r"cannot load .*: .*arm\.urdf: error"):
        make_robot_plant(robot)


def test_a_model_that_drake_takes_stays_as_it_is(tmp_path):
    make_robot_plant(Robot())
    assert not (tmp_path / "cache").exists()


def test_a_linkage_is_fixed_where_it_is_open(tmp_path):
    mesh = stl(tmp_path / "link.stl", box([-0.02] * 3, [0.02] * 3))
    more = _FINGER.format("left", "") + _FINGER.format("right", '<mimic joint="left"/>')
    plant = make_robot_plant(arm(tmp_path, mesh.name, more)).plant
    assert plant.num_positions() == plant.num_actuators() == 6
    for name in ("left", "right"):
        assert plant.GetJointByName(name).type_name() == "weld"
