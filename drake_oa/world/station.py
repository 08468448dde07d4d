"""The world that the layers act in: plant, scene graph and camera.

`make_station` builds what a real cell has: the arm on its base, the table and the
obstacles, and a depth camera. `make_robot_plant` builds the robot alone, as the
controller and the self filter know it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph,
    MultibodyPlant,
)
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import DiagramBuilder

from drake_oa.common.schema_check import ScenarioError
from drake_oa.robot.grasped_object import part_carried
from drake_oa.scenario.obstacles import OBSTACLE_PREFIX, Obstacle
from drake_oa.scenario.scenario import Scenario
from drake_oa.world.camera_systems import add_cameras
from drake_oa.world.world_model import add_world, all_obstacles

if TYPE_CHECKING:
    from drake_oa.world.cameras import Camera


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


def make_station(builder: DiagramBuilder, scenario: Scenario, *, render: bool = True) -> Station:
    """Adds the simulated cell of a scenario to a builder.

    Args:
        builder: receives plant, scene graph and, if `render`, the cameras.
        scenario: with a robot.
        render: whether anything will ask for images.

    Raises:
        ScenarioError: naming the field of the scenario that does not fit.
    """

    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=scenario.plant_step)
    # Sampled ports would copy the diagram's whole state at each step (docs/design.md).
    plant.SetUseSampledOutputPorts(False)
    robot = add_world(plant, scenario)
    plant.Finalize()
    part_carried(plant, scene_graph, scenario.robot)
    cameras = add_cameras(builder, scenario, plant) if render else {}
    obstacles = tuple(
        instance
        for instance in map(ModelInstanceIndex, range(plant.num_model_instances()))
        if plant.GetModelInstanceName(instance).startswith(OBSTACLE_PREFIX)
    )
    _refuse_movable(plant, obstacles, all_obstacles(scenario))
    return Station(plant, scene_graph, robot, obstacles, cameras)


def _refuse_movable(
    plant: MultibodyPlant, obstacles: tuple[ModelInstanceIndex, ...], driven: list[Obstacle]
) -> None:
    """An obstacle that nothing drives would fall, or be pushed away, unlike a real one."""
    on_course = {f"{OBSTACLE_PREFIX}_{item.name}" for item in driven if item.driven}
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
