"""Helpers that tests of several folders share."""

from collections.abc import Callable, Sequence
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.common.value import Value
from pydrake.geometry import SceneGraph, Shape
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import RevoluteJoint, RigidBody, SpatialInertia
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, LeafSystem, System
from pydrake.systems.sensors import ImageDepth32F

from drake_oa.app.main import main
from drake_oa.common.messages import EllipsoidSet, FloatArray
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario


def balls(
    *centers: Sequence[float],
    radius: ArrayLike = 0.1,
    stamp: float = 0.0,
    ids: Sequence[int] | None = None,
    v_WO: ArrayLike = 0.0,
    **more: object,
) -> EllipsoidSet:
    """Returns balls at the centers [m]; three radii give ellipsoids along the world's axes."""
    count = len(centers)
    return EllipsoidSet(
        stamp=stamp,
        p_WO=np.array(centers, dtype=float).reshape(count, 3),
        R_WO=np.tile(np.eye(3), (count, 1, 1)),
        semi_axes=np.full((count, 3), radius),
        v_WO=np.full((count, 3), v_WO, dtype=float),
        ids=np.arange(count) if ids is None else np.array(ids),
        **more,  # type: ignore[arg-type]
    )


def ball_scene(
    p_WO: ArrayLike, *overrides: str, radius: float = 0.1, waypoints: Sequence[list[float]] = ()
) -> Scenario:
    """Returns `tabletop_box` with ground-truth perception and an additional ball [m]."""
    ball = f"name: ball, shapes: [!Sphere {{radius: {radius}}}]"
    ball += f", translation: {np.array(p_WO, float).tolist()}, waypoints: {list(waypoints)}"
    truth = "cameras=[]", "perception=!GroundTruth {}", f"obstacles=[{{{ball}}}]"
    return load_scenario("tabletop_box", [*truth, *overrides])


def cubes_on_table(*centers: tuple[float, float], size: float = 0.1) -> FloatArray:
    """Returns points in the world [m]: a table, and the top and two sides of cubes on it."""
    grid = np.arange(-0.4, 0.4, 0.008)
    x, y = (axis.ravel() for axis in np.meshgrid(grid, grid))
    free = np.ones(len(x), dtype=bool)
    parts = []
    side = np.arange(0.0, size, 0.004)
    a, b = (axis.ravel() for axis in np.meshgrid(side, side))
    for cx, cy in centers:
        low = np.array([cx, cy, 0.0]) - [size / 2, size / 2, 0.0]
        free &= (np.abs(x - cx) > size / 2) | (np.abs(y - cy) > size / 2)
        end = np.full(len(a), size)
        parts += [low + np.stack(face, axis=1) for face in ((a, b, end), (end, a, b), (a, end, b))]
    table = np.stack([x[free], y[free], np.zeros(free.sum())], axis=1)
    return np.concatenate([table, *parts])


def write_cloud(path: Path, points: FloatArray, **options: bool) -> None:
    """Writes a point cloud to a .pcd or .ply file."""
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    open3d.io.write_point_cloud(str(path), cloud, **options)


def depth_image(depth: np.ndarray) -> ImageDepth32F:
    """Returns a Drake image of a depth array (H, W) [m]."""
    image: Any = ImageDepth32F(depth.shape[1], depth.shape[0])
    image.mutable_data[:, :, 0] = depth
    return image


def read(system: System, context: Context, port: str) -> FloatArray:
    """Returns the value of a vector output port of a system."""
    return np.array(system.GetOutputPort(port).Eval(context))


def fix(system: System, context: Context, **inputs: object) -> None:
    """Fixes the input ports of a system that have these names to values."""
    for name, value in inputs.items():
        if system.HasInputPort(name):
            is_vector = isinstance(value, list | np.ndarray)
            system.GetInputPort(name).FixValue(context, value if is_vector else Value(value))


class TimeFunctionSource(LeafSystem):
    """System whose abstract output is a function of time [s]."""

    def __init__(self, value: Callable[[float], Any], name: str = "value") -> None:
        super().__init__()
        self.DeclareAbstractOutputPort(
            name, lambda: Value(value(0.0)), lambda c, output: output.set_value(value(c.get_time()))
        )


def hinged_shapes(
    shapes: Sequence[Shape], X_BG: RigidTransform
) -> tuple[Diagram, MultibodyPlant, SceneGraph, RigidBody]:
    """Builds a plant with collision geometries on one body, which a joint rotates about z."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    instance = plant.AddModelInstance("arm")
    inertia = SpatialInertia.SolidSphereWithMass(1.0, 0.1)
    body = plant.AddRigidBody("link", instance, inertia)
    plant.AddJoint(RevoluteJoint("hinge", plant.world_frame(), body.body_frame(), [0.0, 0.0, 1.0]))
    for number, shape in enumerate(shapes):
        plant.RegisterCollisionGeometry(body, X_BG, shape, f"g{number}", CoulombFriction())
    plant.Finalize()
    return builder.Build(), plant, scene_graph, body


def load_module(path: Path) -> Any:
    """Imports the module of a file outside the package."""
    spec = spec_from_file_location(path.stem, path)
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def command(*arguments: object) -> int:
    """Runs `drake-oa` with arguments, and returns its exit status."""
    try:
        return main([str(argument) for argument in arguments])
    except SystemExit as ended:
        return int(ended.code or 0)
