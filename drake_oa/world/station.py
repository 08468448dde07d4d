"""The world that the layers act in: plant, scene graph and cameras.

`make_station` builds what a real cell has: the arm on its base, the table and the
obstacles, and depth cameras. `make_robot_plant` builds the robot alone, as the
controller and the self filter know it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from pydrake.geometry import CollisionFilterDeclaration, SceneGraph
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph,
    MultibodyPlant,
)
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.sensors import CameraConfig, CameraInfo

from drake_oa.common.config import ScenarioError, field_errors
from drake_oa.geometry.pinhole import pinhole
from drake_oa.perception.config import DepthCamera, LcmCamera
from drake_oa.robot.grasped_object import part_carried
from drake_oa.scenario.faults import CameraDropout
from drake_oa.scenario.obstacles import OBSTACLE_PREFIX, Obstacle
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.sources import camera_configs, noise_seed
from drake_oa.world.cameras import (
    Camera,
    TimedCamera,
    depth_intrinsics,
)
from drake_oa.world.delayed_camera import BackgroundCamera, DelayedCamera, Noise
from drake_oa.world.depth_messages import LcmFrames
from drake_oa.world.depth_noise import add_depth_noise
from drake_oa.world.live_camera import LiveCamera, Outside, standing_pose
from drake_oa.world.obstacles import obstacle_instances
from drake_oa.world.world_model import add_world


def add_cameras(
    builder: DiagramBuilder,
    scenario: Scenario,
    plant: MultibodyPlant,
    outside: Outside | None = None,
) -> dict[str, Camera]:
    """Adds the cameras of a scenario, by name.

    Args:
        builder: receives late_<name> of simulated cameras. Where perception sees by cameras
            outside the simulation, live_<name> of these, and nothing that renders.
        scenario: with cameras.
        plant: the simulated one, in the builder, finalized.
        outside: what cameras outside the simulation go by; None: `Outside()`.

    Raises:
        ScenarioError: naming the camera that does not fit.
    """
    if isinstance(scenario.perception, LcmCamera):
        source, outside = scenario.perception, outside or Outside()
        return {
            config.name: _live_camera(builder, source, plant, config, outside)
            for config in camera_configs(scenario, source)
        }
    return {
        config.name: _simulated_camera(builder, scenario, plant, config)
        for config in scenario.cameras
    }


def _simulated_camera(
    builder: DiagramBuilder, scenario: Scenario, plant: MultibodyPlant, config: CameraConfig
) -> Camera:
    dropouts = [
        fault
        for fault in scenario.faults
        if isinstance(fault, CameraDropout) and fault.camera in ("", config.name)
    ]
    with field_errors(f"cameras: camera '{config.name}'", RuntimeError, ValueError):
        intrinsics = depth_intrinsics(config)
        noise = _noise(scenario, config, intrinsics)
    # Its errors name the fields themselves.
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


def _live_camera(
    builder: DiagramBuilder,
    source: LcmCamera,
    plant: MultibodyPlant,
    config: CameraConfig,
    outside: Outside,
) -> Camera:
    X_WC = standing_pose(plant, config)
    intrinsics = depth_intrinsics(config)
    system = LiveCamera(
        LcmFrames(source.lcm_url, config.name),
        intrinsics,
        X_WC,
        num_states=plant.num_multibody_states(),
        wait=source.wait,
        max_age=source.max_age,
        outside=outside,
    )
    builder.AddNamedSystem(f"live_{config.name}", system)
    state = outside.plant_state or plant.get_state_output_port()
    builder.Connect(state, system.GetInputPort("plant_state"))
    return system.camera()


def release_cameras(diagram: Diagram) -> None:
    """Releases the render engines and channels of a diagram's cameras."""
    for system in diagram.GetSystems():
        if isinstance(system, TimedCamera):
            system.release()


def _noise(scenario: Scenario, config: CameraConfig, intrinsics: CameraInfo) -> Noise | None:
    """Noise of a camera that perception looks through; None for another, or an ideal one."""
    source = scenario.perception
    if not isinstance(source, DepthCamera) or config.name not in source.names or not source.noise:
        return None
    seed = noise_seed(scenario, config.name)
    return partial(add_depth_noise, K=pinhole(intrinsics), seed=seed)


@dataclass(frozen=True)
class Station:
    """What `make_station` added to a builder.

    Attributes:
        plant: the finalized plant.
        scene_graph: its scene graph.
        robot: the robot's model instance.
        obstacles: the model instances of the obstacles.
        cameras: name -> the camera.
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
    outside: Outside | None = None,
) -> Station:
    """Adds the simulated cell of a scenario to a builder.

    Args:
        builder: receives plant, scene graph and, if `render`, the cameras.
        scenario: with a robot.
        render: whether anything will ask for images.
        outside: see `add_cameras`.

    Raises:
        ScenarioError: naming the field of the scenario that does not fit.
    """

    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=scenario.plant_step)
    # Sampled ports would copy the diagram's whole state at each step (docs/design.md).
    plant.SetUseSampledOutputPorts(False)
    robot = add_world(plant, scenario)
    plant.Finalize()
    part_carried(plant, scene_graph, scenario.robot)
    cameras = add_cameras(builder, scenario, plant, outside) if render else {}
    obstacles = obstacle_instances(plant)
    _refuse_movable(plant, obstacles, scenario.obstacles)
    # Obstacles touch the robot alone: a contact with anything else would push one off its course.
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


def _refuse_movable(
    plant: MultibodyPlant, obstacles: tuple[ModelInstanceIndex, ...], driven: list[Obstacle]
) -> None:
    """An obstacle that nothing drives would fall, or be pushed away, unlike a real one."""
    on_course = {f"{OBSTACLE_PREFIX}_{item.name}" for item in driven if item.is_driven}
    for instance in obstacles:
        name = plant.GetModelInstanceName(instance)
        if name in on_course:
            continue
        for index in plant.GetBodyIndices(instance):
            body = plant.get_body(index)
            if not plant.IsAnchored(body):
                raise ScenarioError(
                    f"directives: link '{body.name()}' of obstacle '{name}' can move; obstacles "
                    "must stand still: weld it to the world by an add_weld, or write it under "
                    "`obstacles` with waypoints"
                )
