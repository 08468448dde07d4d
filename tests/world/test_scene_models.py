"""The scenes: what they contain, that the task in them makes sense, that the camera sees it."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from pydrake.geometry import (
    ClippingRange,
    DepthRange,
    DepthRenderCamera,
    MakeRenderEngineVtk,
    QueryObject,
    RenderCameraCore,
    RenderEngineVtkParams,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import LoadModelDirectives, Parser, ProcessModelDirectives
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import JacobianWrtVariable, ModelInstanceIndex
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraInfo

import drake_oa.models
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.task_joints import start_positions

MODELS = Path(next(iter(drake_oa.models.__path__)))
OBSTACLES = {"tabletop_box": 1, "tabletop_irregular": 4, "tabletop_clutter": 6}


class Scene:
    """A scene with the robot and the camera, its context, and its scenario's task."""

    def __init__(self, name: str) -> None:
        builder = DiagramBuilder()
        self.plant, self.scene_graph = AddMultibodyPlantSceneGraph(builder, 1e-3)
        self.scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(RenderEngineVtkParams()))
        parser = Parser(self.plant)
        parser.package_map().AddPackageXml(str(MODELS / "package.xml"))
        for part in (name, "panda", "camera_xtion"):
            directives = LoadModelDirectives(str(MODELS / "scenes" / f"{part}.dmd.yaml"))
            ProcessModelDirectives(directives, parser)
        self.plant.Finalize()
        self.diagram = builder.Build()
        self.root = self.diagram.CreateDefaultContext()
        self.context = self.plant.GetMyContextFromRoot(self.root)
        scenario = load_scenario(name)
        self.p_WS, self.p_WG = np.array(scenario.task.start), np.array(scenario.task.goal)
        self.R_WE = RollPitchYaw(scenario.robot.rpy_WE).ToRotationMatrix()
        self.q_start = start_positions(scenario)

    @property
    def query(self) -> QueryObject:
        return self.plant.get_geometry_query_input_port().Eval(self.context)

    def instance(self, geometry_id) -> str:
        frame = self.query.inspector().GetFrameId(geometry_id)
        body = self.plant.GetBodyFromFrameId(frame)
        return self.plant.GetModelInstanceName(body.model_instance())

    def obstacle_names(self) -> list[str]:
        count = self.plant.num_model_instances()
        names = [self.plant.GetModelInstanceName(ModelInstanceIndex(i)) for i in range(count)]
        return [name for name in names if name.startswith("obstacle_")]

    def contacts(self, q: np.ndarray) -> set[tuple[str, str]]:
        self.plant.SetPositions(self.context, q)
        pairs = self.query.ComputePointPairPenetration()
        return {tuple(sorted((self.instance(p.id_A), self.instance(p.id_B)))) for p in pairs}

    def obstacle_distance(self, p_WQ: np.ndarray) -> float:
        near = self.query.ComputeSignedDistanceToPoint(p_WQ)
        return min(d.distance for d in near if self.instance(d.id_G).startswith("obstacle_"))

    def inverse_kinematics(self, p_WE: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Newton steps to a tool position in the orientation of the task."""
        tool, world = self.plant.GetFrameByName("panda_hand_tcp"), self.plant.world_frame()
        q = q.copy()
        for _ in range(60):
            self.plant.SetPositions(self.context, q)
            X_WE = tool.CalcPoseInWorld(self.context)
            turn = (self.R_WE @ X_WE.rotation().inverse()).ToAngleAxis()
            error = np.r_[turn.angle() * turn.axis(), p_WE - X_WE.translation()]
            if np.abs(error).max() < 1e-9:
                return q
            J = self.plant.CalcJacobianSpatialVelocity(
                self.context, JacobianWrtVariable.kV, tool, np.zeros(3), world, world
            )[:, :7]
            q[:7] += np.linalg.lstsq(J, error, rcond=None)[0]
        raise AssertionError(f"no inverse kinematics solution at {p_WE}")


@pytest.fixture(scope="module", params=sorted(OBSTACLES))
def scene(request: pytest.FixtureRequest) -> Scene:
    return Scene(request.param)


@pytest.fixture(scope="module")
def straight_line(scene: Scene) -> np.ndarray:
    """Configurations (41, 9) along the straight line, the tool held as in the task."""
    q, path = scene.q_start, []
    for s in np.linspace(0.0, 1.0, 41):
        q = scene.inverse_kinematics(scene.p_WS + s * (scene.p_WG - scene.p_WS), q)
        path.append(q)
    return np.array(path)


@pytest.mark.parametrize("name", sorted(OBSTACLES))
def test_scene_holds_its_obstacles_table_robot_and_camera(name: str) -> None:
    scene = Scene(name)
    assert len(scene.obstacle_names()) == OBSTACLES[name]
    for instance in ("table", "panda", "camera_mount"):
        assert scene.plant.HasModelInstanceNamed(instance)
    assert scene.plant.num_positions() == 9  # Everything but the robot is welded.


def test_straight_line_hits_an_obstacle_and_its_ends_are_free(
    scene: Scene, straight_line: np.ndarray
) -> None:
    contacts = [scene.contacts(q) for q in straight_line]
    assert contacts[0] == contacts[-1] == set()
    hit = {pair for pairs in contacts for pair in pairs}
    assert any(pair[0].startswith("obstacle_") and pair[1] == "panda" for pair in hit)
    assert ("panda", "table") not in hit


def test_straight_line_is_within_the_joint_limits(scene: Scene, straight_line: np.ndarray) -> None:
    # The closed fingers are at theirs.
    assert (straight_line >= scene.plant.GetPositionLowerLimits()).all()
    assert (straight_line <= scene.plant.GetPositionUpperLimits()).all()


def test_there_is_a_way_over_the_obstacles(scene: Scene) -> None:
    q = scene.q_start
    # Straight above the ends is out of reach: up and inward, across, and down again.
    lift, inward = np.array([0.0, 0.0, 0.25]), (scene.p_WG - scene.p_WS) / 6.0
    above = [scene.p_WS + inward + lift, scene.p_WG - inward + lift]
    corners = [scene.p_WS, *above, scene.p_WG]
    for a, b in pairwise(corners):
        for s in np.linspace(0.0, 1.0, 17):
            q = scene.inverse_kinematics(a + s * (b - a), q)
            assert scene.contacts(q) == set()


def test_obstacles_leave_room_at_start_and_goal(scene: Scene) -> None:
    scene.plant.SetPositions(scene.context, scene.q_start)
    assert scene.obstacle_distance(scene.p_WS) > 0.25
    assert scene.obstacle_distance(scene.p_WG) > 0.25


def test_obstacles_stand_on_the_table_below_the_height_of_a_third_of_a_metre(scene: Scene) -> None:
    p = np.random.default_rng(0).uniform([0.2, -0.35, -0.04], [0.75, 0.35, 0.5], (800, 3))
    inside = p[[scene.obstacle_distance(p_WQ) < 0.0 for p_WQ in p]]
    assert len(inside) > 3
    assert (inside[:, 2] > -0.01).all()
    assert inside[:, 2].max() < 0.33
    assert (np.abs(inside[:, 1]) < 0.2).all()


def test_table_top_is_the_plane_z_zero(scene: Scene) -> None:
    for x, y in ((0.9, 0.7), (0.9, -0.7), (-0.2, 0.7)):
        near = scene.query.ComputeSignedDistanceToPoint([x, y, 0.01], 0.05)
        heights = [d.distance for d in near if scene.instance(d.id_G) == "table"]
        assert heights == pytest.approx([0.01])


def test_camera_sees_table_obstacle_and_robot_at_the_start(scene: Scene) -> None:
    scene.plant.SetPositions(scene.context, scene.q_start)
    X_WC = scene.plant.GetFrameByName("camera").CalcPoseInWorld(scene.context)
    info = CameraInfo(width=640, height=480, fov_y=np.deg2rad(45.0))
    assert np.rad2deg(info.fov_x()) == pytest.approx(58.0, abs=0.2)
    core = RenderCameraCore("vtk", info, ClippingRange(0.05, 10.0), RigidTransform())
    camera = DepthRenderCamera(core, DepthRange(0.8, 3.5))
    world = scene.scene_graph.world_frame_id()
    depth = np.asarray(scene.query.RenderDepthImage(camera, world, X_WC).data)[..., 0]

    v, u = np.nonzero(np.isfinite(depth) & (depth > 0.0))
    z = depth[v, u]
    rays = np.column_stack(
        [(u - info.center_x()) / info.focal_x(), (v - info.center_y()) / info.focal_y()]
    )
    p_CQ = np.column_stack([rays * z[:, None], z])
    p_WQ = X_WC.multiply(p_CQ.T).T
    assert (np.abs(p_WQ[:, 2]) < 0.004).mean() > 0.4  # Most of what it sees is the table's top.

    above = p_WQ[p_WQ[:, 2] > 0.02]
    above = above[:: max(1, len(above) // 500)]
    owners = []
    for point in above:
        near = scene.query.ComputeSignedDistanceToPoint(point, 0.03)
        owners.append(scene.instance(min(near, key=lambda d: d.distance).id_G) if near else "")
    seen = set(owners)
    assert {"panda", *scene.obstacle_names()} <= seen
    # What stands above the table belongs to a modelled collision shape: all can be told apart.
    assert owners.count("") < 0.01 * len(owners)


def test_optical_frame_looks_down_at_the_workspace(scene: Scene) -> None:
    X_WC = scene.plant.GetFrameByName("camera").CalcPoseInWorld(scene.context)
    p_CT = X_WC.inverse().multiply(np.array([0.45, 0.0, 0.2]))
    np.testing.assert_allclose(p_CT, [0.0, 0.0, 1.2], atol=2e-3)
    x_W, y_W, z_W = X_WC.rotation().matrix().T
    assert x_W[2] == pytest.approx(0.0, abs=1e-9)  # The image's rows are level.
    assert y_W[2] < 0.0
    assert z_W[2] == pytest.approx(-np.sqrt(0.5))


def test_camera_model_has_no_collision_geometry(scene: Scene) -> None:
    body = scene.plant.GetBodyByName("body", scene.plant.GetModelInstanceByName("camera_mount"))
    assert scene.plant.GetCollisionGeometriesForBody(body) == []
