"""The cameras of a scenario, each as its data asks for it: of the present, or late."""

from __future__ import annotations

from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraConfig, CameraInfo

from drake_oa.common.schema_check import ScenarioError
from drake_oa.geometry.pinhole import pinhole
from drake_oa.scenario.camera_noise import noise_parameters
from drake_oa.scenario.faults import camera_faults
from drake_oa.scenario.scenario import DepthCamera, Scenario
from drake_oa.world.background_camera import BackgroundCamera
from drake_oa.world.cameras import Camera, add_camera, add_camera_world
from drake_oa.world.depth_noise import FrameNoise
from drake_oa.world.late_camera import LateCamera


def add_cameras(
    builder: DiagramBuilder, scenario: Scenario, plant: MultibodyPlant
) -> dict[str, Camera]:
    """Adds the cameras of a scenario, by name.

    Args:
        builder: receives camera_world, camera_scene_graph and rgbd_sensor_<name>; late_<name>
            in their place for a camera with `output_delay`.
        scenario: with cameras. Its faults are of frames that come as they are taken: with
            any of the camera, no camera is late.
        plant: the simulated one, in the builder.

    Raises:
        ScenarioError: naming the camera that does not fit.
    """
    on_time = bool(camera_faults(scenario.faults))
    present = [c for c in scenario.cameras if on_time or c.output_delay == 0.0]
    cameras = {
        config.name: _late_camera(builder, scenario, plant, config)
        for config in scenario.cameras
        if config not in present
    }
    if not present:
        return cameras
    shown, scene_graph, poses = add_camera_world(builder, scenario)
    builder.Connect(plant.get_state_output_port(), poses.get_input_port())
    for config in present:
        sensor = add_camera(builder, shown, scene_graph, config)
        cameras[config.name] = Camera(
            sensor.default_depth_render_camera().core().intrinsics(),
            sensor.depth_image_32F_output_port(),
            sensor.body_pose_in_world_output_port(),
        )
    return cameras


def _late_camera(
    builder: DiagramBuilder, scenario: Scenario, plant: MultibodyPlant, config: CameraConfig
) -> Camera:
    try:
        _, depth = config.MakeCameras()
        intrinsics = depth.core().intrinsics()
        system = LateCamera(
            BackgroundCamera(scenario, config, _noise(scenario, config, intrinsics)),
            intrinsics,
            num_states=plant.num_multibody_states(),
            period=1.0 / config.fps,
            delay=config.output_delay,
        )
    except (RuntimeError, ValueError) as error:
        raise ScenarioError(f"cameras: camera '{config.name}': {error}") from None
    builder.AddNamedSystem(f"late_{config.name}", system)
    builder.Connect(plant.get_state_output_port(), system.GetInputPort("plant_state"))
    return Camera(
        intrinsics,
        system.GetOutputPort("depth_image"),
        system.GetOutputPort("camera_pose"),
        config.output_delay,
        system.GetOutputPort("image_time"),
        system.GetOutputPort("plant_state"),
    )


def _noise(scenario: Scenario, config: CameraConfig, intrinsics: CameraInfo) -> FrameNoise | None:
    """Of the camera that perception looks through; None for another, or an ideal one."""
    source = scenario.perception
    if not isinstance(source, DepthCamera) or source.camera != config.name:
        return None
    if source.noise is None:
        return None
    return FrameNoise(pinhole(intrinsics), noise_parameters(source.noise), seed=scenario.seed)
