"""Simulated station of a scenario: functions that add its plant, scene graph and cameras to a
diagram.

`make_station` adds the arm on its base, the table, the obstacles, and the depth cameras. In
contrast, `make_robot_plant` of `drake_oa.robot` builds the robot alone, for the controller and for
the self filter, which removes the robot from depth images.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from pydrake.geometry import CollisionFilterDeclaration, SceneGraph
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.sensors import CameraConfig, CameraInfo

from drake_oa.common.config import ScenarioError, field_errors
from drake_oa.geometry.pinhole import pinhole
from drake_oa.perception.config import DepthCamera, LcmCamera, RecordedBag
from drake_oa.robot.grasped_object import exclude_grasp_contacts
from drake_oa.scenario.faults import CameraDropout
from drake_oa.scenario.obstacles import OBSTACLE_PREFIX, Obstacle
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.sources import camera_configs, noise_seed
from drake_oa.world.bag_images import BagCamera
from drake_oa.world.cameras import Camera, TimedCamera, depth_intrinsics
from drake_oa.world.delayed_camera import BackgroundCamera, DelayedCamera, Noise
from drake_oa.world.depth_messages import LcmFrames
from drake_oa.world.depth_noise import add_depth_noise
from drake_oa.world.live_camera import ExternalInputs, LiveCamera, fixed_pose
from drake_oa.world.obstacles import obstacle_instances
from drake_oa.world.world_model import add_world


def add_cameras(
    builder: DiagramBuilder,
    scenario: Scenario,
    plant: MultibodyPlant,
    external: ExternalInputs | None = None,
) -> dict[str, Camera]:
    """Adds the cameras of a scenario to a builder, and returns them by name.

    Args:
        builder: builder to which the systems are added. The system of a simulated camera is named
            delayed_<name>. With the perception block `!LcmCamera`, images are received by LCM, and
            the system is named live_<name>; with `!RecordedBag`, they are read from a bag, and the
            system is named bag_<name>.
        scenario: scenario with cameras.
        plant: finalized simulated plant, which is a system of the builder.
        external: measured plant state, and clocks, for cameras outside the simulation; None: the
            state of the simulated plant and the wall clock.

    Raises:
        ScenarioError: naming the camera whose configuration is invalid.
    """
    source, external = scenario.perception, external or ExternalInputs()
    if isinstance(source, LcmCamera | RecordedBag):
        return {
            config.name: _outside_camera(builder, source, plant, config, external)
            for config in camera_configs(scenario, source)
        }
    return {
        config.name: _simulated_camera(builder, scenario, plant, config)
        for config in scenario.cameras
    }


def _simulated_camera(
    builder: DiagramBuilder, scenario: Scenario, plant: MultibodyPlant, config: CameraConfig
) -> Camera:
    """Adds a simulated camera, with its noise and dropouts, to a builder, and returns its ports.

    Args:
        builder: builder to which the camera is added.
        scenario: scenario whose world is rendered, with image noise and faults (`CameraDropout`).
        plant: finalized simulated plant, which is a system of the builder.
        config: configuration of the camera.

    Raises:
        ScenarioError: naming the camera, if its configuration is invalid.
    """
    dropouts = [
        fault
        for fault in scenario.faults
        if isinstance(fault, CameraDropout) and fault.camera in ("", config.name)
    ]
    with field_errors(f"cameras: camera '{config.name}'", RuntimeError, ValueError):
        intrinsics = depth_intrinsics(config)
        noise = _noise(scenario, config, intrinsics)
    # Errors of BackgroundCamera already name the field.
    rendering = BackgroundCamera(scenario, config, noise)
    with field_errors(f"cameras: camera '{config.name}'", ValueError):
        system = DelayedCamera(
            rendering,
            intrinsics,
            num_states=plant.num_multibody_states(),
            period=1.0 / config.fps,
            delay=config.output_delay,
            dropouts=dropouts,
        )
    builder.AddNamedSystem(f"delayed_{config.name}", system)
    builder.Connect(plant.get_state_output_port(), system.GetInputPort("plant_state"))
    return system.camera(config.output_delay)


def _outside_camera(
    builder: DiagramBuilder,
    source: LcmCamera | RecordedBag,
    plant: MultibodyPlant,
    config: CameraConfig,
    external: ExternalInputs,
) -> Camera:
    """Adds a camera outside the simulation, whose images are received by LCM or read from a bag, to
    a builder, and returns its ports.

    Args:
        builder: builder to which the camera is added.
        source: perception block: `LcmCamera` with the URL of the LCM bus, the maximum time to wait
            for the first image and the maximum age of images, or `RecordedBag` with path and topics
            of the bag.
        plant: finalized plant, which contains the camera's base frame.
        config: configuration of the camera: name, intrinsics and pose.
        external: measured plant state and clocks.

    Raises:
        ScenarioError: if the pose of the camera in the scenario is not fixed, if the LCM bus cannot
            be opened, or if the bag cannot be read, lacks a topic or a pose of the camera, or has
            no joint of the robot.
    """
    system: TimedCamera
    if isinstance(source, RecordedBag):
        system, name, delay = BagCamera(source, config, plant), "bag", config.output_delay
    else:
        name, delay = "live", 0.0
        system = LiveCamera(
            LcmFrames(source.lcm_url, config.name),
            depth_intrinsics(config),
            fixed_pose(plant, config),
            num_states=plant.num_multibody_states(),
            wait=source.wait,
            max_age=source.max_age,
            external=external,
        )
    builder.AddNamedSystem(f"{name}_{config.name}", system)
    state = external.plant_state or plant.get_state_output_port()
    builder.Connect(state, system.GetInputPort("plant_state"))
    return system.camera(delay)


def release_cameras(diagram: Diagram) -> None:
    """Releases the render engines, LCM channels and open bags of all cameras in a diagram, at the
    end of a run.
    """
    for system in diagram.GetSystems():
        if isinstance(system, TimedCamera):
            system.release()


def _noise(scenario: Scenario, config: CameraConfig, intrinsics: CameraInfo) -> Noise | None:
    """Returns the function that adds noise to the images of a simulated camera.

    The function maps a true depth image (H, W) [m] and its capture time [s] to a measured one. The
    result is None if the scenario has no noise, or if perception does not use the camera.
    """
    source = scenario.perception
    if not isinstance(source, DepthCamera) or config.name not in source.names or not source.noise:
        return None
    seed = noise_seed(scenario, config.name)
    return partial(add_depth_noise, K=pinhole(intrinsics), seed=seed)


@dataclass(frozen=True)
class Station:
    """Plant, scene graph and cameras that `make_station` added to a builder.

    Attributes:
        plant: finalized plant.
        scene_graph: scene graph with the geometry of the plant.
        robot: model instance of the robot in the plant.
        obstacles: model instances of the obstacles in the plant.
        cameras: cameras by name; empty if no camera was added.
    """

    plant: MultibodyPlant
    scene_graph: SceneGraph
    robot: ModelInstanceIndex
    obstacles: tuple[ModelInstanceIndex, ...]
    cameras: dict[str, Camera]


def make_station(
    builder: DiagramBuilder,
    scenario: Scenario,
    *,
    render: bool = True,
    external: ExternalInputs | None = None,
) -> Station:
    """Adds the simulated station of a scenario to a builder.

    Args:
        builder: builder to which plant, scene graph and, if `render`, the cameras are added.
        scenario: scenario with a robot.
        render: whether the cameras of the scenario are added.
        external: measured plant state, and clocks, for cameras outside the simulation; None: the
            state of the simulated plant and the wall clock.

    Raises:
        ScenarioError: naming the invalid field of the scenario.
    """

    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=scenario.plant_step)
    # Sampled output ports would copy the state of the diagram at each step (docs/decisions/0026).
    plant.SetUseSampledOutputPorts(False)
    robot = add_world(plant, scenario)
    plant.Finalize()
    exclude_grasp_contacts(plant, scene_graph, scenario.robot)
    cameras = add_cameras(builder, scenario, plant, external) if render else {}
    obstacles = obstacle_instances(plant)
    _check_anchored(plant, obstacles, scenario.obstacles)
    # Obstacles collide with the robot only: other contacts would push them off their trajectories.
    still = [
        body
        for body in plant.GetBodiesWeldedTo(plant.world_body())
        if body.model_instance() != robot
    ]
    bodies = [plant.get_body(i) for item in obstacles for i in plant.GetBodyIndices(item)]
    scene_graph.collision_filter_manager().Apply(
        CollisionFilterDeclaration().ExcludeWithin(
            plant.CollectRegisteredGeometries([*still, *bodies])
        )
    )
    return Station(plant, scene_graph, robot, obstacles, cameras)


def _check_anchored(
    plant: MultibodyPlant, obstacles: tuple[ModelInstanceIndex, ...], configured: list[Obstacle]
) -> None:
    """Checks that each obstacle is fixed to the world, or is configured to move, appear or vanish;
    any other obstacle would fall.

    Args:
        plant: finalized plant with the obstacles.
        obstacles: model instances of the obstacles.
        configured: obstacles of the scenario's field `obstacles`; others are from `directives`.

    Raises:
        ScenarioError: naming a link that can move, and its obstacle.
    """
    moving = {f"{OBSTACLE_PREFIX}_{item.name}" for item in configured if item.is_driven}
    for instance in obstacles:
        name = plant.GetModelInstanceName(instance)
        if name in moving:
            continue
        for index in plant.GetBodyIndices(instance):
            body = plant.get_body(index)
            if not plant.IsAnchored(body):
                raise ScenarioError(
                    f"directives: link '{body.name()}' of obstacle '{name}' can move; obstacles "
                    "must be fixed: weld it to the world by an add_weld, or define it under "
                    "`obstacles` with waypoints"
                )
