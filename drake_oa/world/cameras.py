"""A scenario's cameras, and the world that they see.

The world is a scene graph of its own that follows the positions of the simulated one: in the
plant's scene graph every step of the plant would pose the renderer's geometry too.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue, Value
from pydrake.geometry import Mesh, Role, SceneGraph, SourceId
from pydrake.lcm import DrakeLcm
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    LeafSystem,
    OutputPort,
)
from pydrake.systems.rendering import MultibodyPositionToGeometryPose
from pydrake.systems.sensors import (
    ApplyCameraConfig,
    CameraConfig,
    CameraInfo,
    ImageDepth32F,
    RgbdSensor,
)

from drake_oa.common.config import field_errors
from drake_oa.common.messages import FloatArray
from drake_oa.robot.formats.meshes import as_objs
from drake_oa.scenario.scenario import Scenario
from drake_oa.world.world_model import add_world


@dataclass(frozen=True)
class Camera:
    """A depth camera of the station.

    Attributes:
        intrinsics: of its image.
        depth_image: port of ImageDepth32F [m], with the camera's noise.
        pose: port of RigidTransform X_WC.
        delay: how long after it was taken an image comes [s]; 0: it shows the present.
        image_time: port (1,) of the time at which the image was taken [s].
        plant_state: port (n,) of the plant's state then.
    """

    intrinsics: CameraInfo
    depth_image: OutputPort
    pose: OutputPort
    delay: float
    image_time: OutputPort
    plant_state: OutputPort


class TimedCamera(LeafSystem):
    """Base class of cameras whose images come with their time and the plant's state then.

    .. pydrake_system::

      name: TimedCamera
      input_ports:
      - plant_state
      output_ports:
      - depth_image
      - camera_pose
      - image_time
      - plant_state

    - plant_state (input): (num_states,) state of the plant now.
    - depth_image: (H, W) depths [m].
    - camera_pose: X_WC of the image.
    - image_time: (1,) time of the image [s].
    - plant_state (output): (num_states,) state of the plant at that time.
    """

    def __init__(self, intrinsics: CameraInfo, num_states: int, kept: object) -> None:
        """Declares the ports.

        Args:
            intrinsics: of the images.
            num_states: size n of the plant's state.
            kept: abstract state of the camera at first.
        """
        super().__init__()
        self._intrinsics = intrinsics
        size = (intrinsics.width(), intrinsics.height())
        self._state_port = self.DeclareVectorInputPort("plant_state", num_states)
        self._kept = self.DeclareAbstractState(Value(kept))
        shown = {
            self.time_ticket(),
            self.abstract_state_ticket(self._kept),
            self._state_port.ticket(),
        }
        self.DeclareAbstractOutputPort(
            "depth_image", lambda: Value(ImageDepth32F(*size)), self._calc_image, shown
        )
        self.DeclareAbstractOutputPort(
            "camera_pose",
            lambda: Value(RigidTransform()),
            lambda context, output: output.set_value(self.pose(context)),
            shown,
        )
        self.DeclareVectorOutputPort(
            "image_time",
            1,
            lambda context, output: output.SetAtIndex(0, self.moment(context)[0]),
            shown,
        )
        self.DeclareVectorOutputPort(
            "plant_state",
            num_states,
            lambda context, output: output.SetFromVector(self.moment(context)[1]),
            shown,
        )

    def release(self) -> None:
        """Releases resources outside the diagram; the next image takes them again."""
        raise NotImplementedError

    def image(self, context: Context) -> NDArray[np.float32] | float:
        """(H, W) the depth image that is handed out now, or one depth for all of it [m]."""
        raise NotImplementedError

    def pose(self, context: Context) -> RigidTransform:
        """X_WC of that image."""
        raise NotImplementedError

    def moment(self, context: Context) -> tuple[float, FloatArray]:
        """Time of that image [s], and the plant's state (n,) then."""
        raise NotImplementedError

    def camera(self, delay: float = 0.0) -> Camera:
        """The camera's ports."""
        names = ("depth_image", "camera_pose", "image_time", "plant_state")
        image, pose, time, state = map(self.GetOutputPort, names)
        return Camera(self._intrinsics, image, pose, delay, time, state)

    def _calc_image(self, context: Context, output: AbstractValue) -> None:
        image: Any = output.get_mutable_value()
        image.mutable_data[:, :, 0] = self.image(context)


def depth_intrinsics(config: CameraConfig) -> CameraInfo:
    """Intrinsics of the depth image of one of Drake's configured cameras."""
    return config.MakeCameras()[1].core().intrinsics()


def add_camera(builder: DiagramBuilder, scenario: Scenario, config: CameraConfig) -> RgbdSensor:
    """Adds one of Drake's configured cameras in a scene graph of its own, without a plant.

    Exports the input of the scene graph: the state [q, v] of a scenario's plant.

    Raises:
        ScenarioError: if the camera does not fit the world.
    """
    shown = MultibodyPlant(time_step=scenario.plant_step)
    scene_graph = builder.AddNamedSystem("camera_scene_graph", SceneGraph())
    source = shown.RegisterAsSourceForSceneGraph(scene_graph)
    add_world(shown, scenario)
    shown.Finalize()
    with field_errors("directives", OSError, ValueError):
        give_normals(scene_graph, source)
    poses = builder.AddNamedSystem(
        "camera_world", MultibodyPositionToGeometryPose(shown, input_multibody_state=True)
    )
    builder.Connect(poses.get_output_port(), scene_graph.get_source_pose_port(source))
    builder.ExportInput(poses.get_input_port(), "state")
    # Drake would render late images in a thread of its own, in which its engines do not work.
    config = copy.copy(config)
    config.output_delay = 0.0
    with field_errors(f"cameras: camera '{config.name}'", RuntimeError, ValueError):
        # A null message queue: otherwise a publisher is added that renders each frame once more.
        ApplyCameraConfig(
            config=config,
            builder=builder,
            plant=shown,
            scene_graph=scene_graph,
            lcm=DrakeLcm("memq://null"),
        )
    (sensor,) = (system for system in builder.GetSystems() if isinstance(system, RgbdSensor))
    return sensor


def give_normals(scene_graph: SceneGraph, source: SourceId) -> None:
    """Gives visible meshes the normals of their faces, where an OBJ file has none.

    Cameras refuse a mesh without normals. Its material and texture are left out: the color is
    that of the model file.

    Args:
        scene_graph: with all geometry, without a renderer yet.
        source: owner of the geometry.

    Raises:
        ValueError: for a file that cannot be read as a mesh.
    """
    inspector = scene_graph.model_inspector()
    for geometry in inspector.GetAllGeometryIds(role=Role.kPerception):
        shape = inspector.GetShape(geometry)
        if not isinstance(shape, Mesh) or shape.extension() != ".obj":
            continue
        file = Path(shape.source().path())
        if "\nvn " not in file.read_text("utf-8"):
            (converted,) = as_objs(file, hulls=False)
            mesh = Mesh(filename=str(converted), scale3=shape.scale3())
            scene_graph.ChangeShape(source, geometry, mesh)
