"""The scenes: what they contain, and that the camera sees it."""

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
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import LoadModelDirectives, Parser, ProcessModelDirectives
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraInfo

import drake_oa.models

MODELS = Path(next(iter(drake_oa.models.__path__)))
READY = np.array([-0.74, 0.19, 0.01, -1.9, 0.0, 2.09, 0.06, 0.005, 0.005])
OBSTACLES = {"tabletop_box": 1, "tabletop_irregular": 4, "tabletop_clutter": 6}


class Scene:
    """A scene with the robot and the camera, and its context."""

    def __init__(self, name: str) -> None:
        self.name = name
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


@pytest.fixture(scope="module", params=sorted(OBSTACLES))
def scene(request: pytest.FixtureRequest) -> Scene:
    return Scene(request.param)


def test_scene_holds_its_obstacles_table_robot_and_camera(scene: Scene) -> None:
    assert len(scene.obstacle_names()) == OBSTACLES[scene.name]
    for instance in ("table", "panda", "camera_mount"):
        assert scene.plant.HasModelInstanceNamed(instance)
    assert scene.plant.num_positions() == 9  # Everything but the robot is welded.


def test_camera_sees_table_obstacles_and_robot(scene: Scene) -> None:
    scene.plant.SetPositions(scene.context, READY)
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
