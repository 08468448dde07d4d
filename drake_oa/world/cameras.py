"""Depth cameras of a scenario, and the separate scene graph in which their images are rendered.

The positions of the simulated plant set the geometry poses in this scene graph. If the scene graph
of the plant rendered the images, every step of the plant would also update the poses of the
rendered geometry.
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
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem, OutputPort
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
from drake_oa.robot.formats.meshes import convert_to_objs
from drake_oa.scenario.scenario import Scenario
from drake_oa.world.world_model import add_world

PIXEL_CENTER = 0.5
"""Image coordinate of the center of the first pixel in images of Drake's VTK renderer [pixel]."""


@dataclass(frozen=True)
class Camera:
    """Intrinsics and output ports of one depth camera of the station, simulated or outside the
    simulation.

    Attributes:
        intrinsics: intrinsics of the depth image.
        depth_image: output port with the depth image along the optical axis, an ImageDepth32F [m],
            with noise if the camera is simulated and the scenario sets noise.
        pose: output port with the pose X_WC of the camera (x right, y down, z forward) in the
            world, a RigidTransform.
        delay: time from the capture to the output of an image [s]; 0: no delay.
        image_time: output port (1,) with the capture time of the image [s].
        plant_state: output port (n,) with the state [q, v] of the plant at the capture time.
    """

    intrinsics: CameraInfo
    depth_image: OutputPort
    pose: OutputPort
    delay: float
    image_time: OutputPort
    plant_state: OutputPort


class TimedCamera(LeafSystem):
    """Base class of depth cameras that also output the capture time of each image, and the plant
    state at that time.

    .. pydrake_system::

      name: TimedCamera
      input_ports:
      - plant_state
      output_ports:
      - depth_image
      - camera_pose
      - image_time
      - plant_state

    - plant_state (input): (num_states,) present state [q, v] of the plant.
    - depth_image: ImageDepth32F with the depths (H, W) along the optical axis [m]; 0 is too near,
      inf is too far, NaN is missing.
    - camera_pose: RigidTransform X_WC of the camera (x right, y down, z forward) in the world at
      the capture time of the image.
    - image_time: (1,) capture time of the image [s].
    - plant_state (output): (num_states,) state [q, v] of the plant at the capture time of the
      image.
    """

    def __init__(self, intrinsics: CameraInfo, num_states: int, initial_state: object) -> None:
        """Declares the input port, the abstract state and the output ports of the camera.

        Args:
            intrinsics: intrinsics of the depth images.
            num_states: size n of the plant's state [q, v].
            initial_state: value of the abstract state before the first event, of a type that the
                derived class defines.
        """
        super().__init__()
        self._intrinsics = intrinsics
        size = (intrinsics.width(), intrinsics.height())
        self._state_port = self.DeclareVectorInputPort("plant_state", num_states)
        self._state_index = self.DeclareAbstractState(Value(initial_state))
        prerequisites = {
            self.time_ticket(),
            self.abstract_state_ticket(self._state_index),
            self._state_port.ticket(),
        }
        self.DeclareAbstractOutputPort(
            "depth_image", lambda: Value(ImageDepth32F(*size)), self._calc_image, prerequisites
        )
        self.DeclareAbstractOutputPort(
            "camera_pose",
            lambda: Value(RigidTransform()),
            lambda context, output: output.set_value(self.pose(context)),
            prerequisites,
        )
        self.DeclareVectorOutputPort(
            "image_time",
            1,
            lambda context, output: output.SetAtIndex(0, self.capture_state(context)[0]),
            prerequisites,
        )
        self.DeclareVectorOutputPort(
            "plant_state",
            num_states,
            lambda context, output: output.SetFromVector(self.capture_state(context)[1]),
            prerequisites,
        )

    def release(self) -> None:
        """Releases resources outside the diagram, such as a render engine; the camera acquires them
        again when it needs them.
        """
        raise NotImplementedError

    def image(self, context: Context) -> NDArray[np.float32] | float:
        """Returns the depth image (H, W) that the camera outputs at the time of a Context [m]; one
        number is the value of all pixels, such as NaN before the first image.
        """
        raise NotImplementedError

    def pose(self, context: Context) -> RigidTransform:
        """Returns the pose X_WC of the camera at the capture time of the image that it outputs at
        the time of a Context.
        """
        raise NotImplementedError

    def capture_state(self, context: Context) -> tuple[float, FloatArray]:
        """Returns the capture time [s] of the image that the camera outputs at the time of a
        Context, and the plant state (n,) at the capture time.
        """
        raise NotImplementedError

    def camera(self, delay: float = 0.0) -> Camera:
        """Returns the `Camera` of this system, which contains its intrinsics and output ports for
        the station.

        Args:
            delay: time from the capture to the output of an image [s].
        """
        names = ("depth_image", "camera_pose", "image_time", "plant_state")
        image, pose, time, state = map(self.GetOutputPort, names)
        return Camera(self._intrinsics, image, pose, delay, time, state)

    def _calc_image(self, context: Context, output: AbstractValue) -> None:
        """Sets the output port `depth_image` to the depth image that the camera outputs at the time
        of a Context.
        """
        image: Any = output.get_mutable_value()
        image.mutable_data[:, :, 0] = self.image(context)


def depth_intrinsics(config: CameraConfig) -> CameraInfo:
    """Returns the intrinsics of the depth image that Drake's camera configuration describes."""
    return config.MakeCameras()[1].core().intrinsics()


def add_camera(builder: DiagramBuilder, scenario: Scenario, config: CameraConfig) -> RgbdSensor:
    """Adds a camera to a builder, with a separate scene graph in which the camera renders.

    The function exports the input port "state" of the builder's diagram: the state [q, v] of the
    scenario's plant that sets the poses of the rendered geometry. The camera has no delay and no
    color image, whatever its configuration.

    Args:
        builder: builder without another camera.
        scenario: scenario whose models are rendered.
        config: configuration of the camera.

    Returns:
        System that renders the depth image.

    Raises:
        ScenarioError: if Drake rejects the camera, for example because of an unknown base frame.
    """
    plant = MultibodyPlant(time_step=scenario.plant_step)
    scene_graph = builder.AddNamedSystem("camera_scene_graph", SceneGraph())
    source = plant.RegisterAsSourceForSceneGraph(scene_graph)
    add_world(plant, scenario)
    plant.Finalize()
    with field_errors("directives", OSError, ValueError):
        add_mesh_normals(scene_graph, source)
    poses = builder.AddNamedSystem(
        "camera_world", MultibodyPositionToGeometryPose(plant, input_multibody_state=True)
    )
    builder.Connect(poses.get_output_port(), scene_graph.get_source_pose_port(source))
    builder.ExportInput(poses.get_input_port(), "state")
    # Drake would render delayed images in another thread, in which its render engines fail.
    config = copy.copy(config)
    config.output_delay, config.rgb, config.depth = 0.0, False, True
    with field_errors(f"cameras: camera '{config.name}'", RuntimeError, ValueError):
        # With a null message queue Drake adds no publisher, which would render each image again.
        ApplyCameraConfig(
            config=config,
            builder=builder,
            plant=plant,
            scene_graph=scene_graph,
            lcm=DrakeLcm("memq://null"),
        )
    (sensor,) = (system for system in builder.GetSystems() if isinstance(system, RgbdSensor))
    return sensor


def add_mesh_normals(scene_graph: SceneGraph, source: SourceId) -> None:
    """Replaces visible meshes whose OBJ file has no normals by converted meshes that have normals.

    Drake's renderers reject a mesh without normals. A converted mesh has no material or texture: it
    has the single color that the robot's or object's model file states.

    Args:
        scene_graph: scene graph with all geometry, to which no renderer has been added yet.
        source: source ID under which the geometry is registered.

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
            (converted,) = convert_to_objs(file, hulls=False)
            mesh = Mesh(filename=str(converted), scale3=shape.scale3())
            scene_graph.ChangeShape(source, geometry, mesh)
