"""Functions that add the layers perception, collision_scene and descriptor to a diagram."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.primitives import MatrixGain

from drake_oa.common.bags import BagWriter
from drake_oa.common.config import ScenarioError, field_errors
from drake_oa.common.signal_builder import SignalBuilder
from drake_oa.descriptor.descriptor import merged_parts
from drake_oa.descriptor.ellipsoid_descriptor import EllipsoidDescriptor, GivenEllipsoidSource
from drake_oa.diagrams.station import StationModel
from drake_oa.inference.config import Paper, Verified
from drake_oa.perception.config import (
    CameraSource,
    DepthCamera,
    GroundTruth,
    LcmCamera,
    RecordedBag,
    RecordedClouds,
    SegmentationConfig,
)
from drake_oa.perception.depth_perception import DepthPerception
from drake_oa.perception.ground_truth_perception import GroundTruthPerception
from drake_oa.perception.recorded_perception import RecordedPerception
from drake_oa.perception.visibility import ImageRange
from drake_oa.planning.ground_truth_scene import GroundTruthScene
from drake_oa.planning.perceived_scene import PerceivedScene
from drake_oa.robot.plant import tool_link_corners
from drake_oa.scenario.end_poses import robots_along_motion
from drake_oa.scenario.perception import GivenEllipsoids
from drake_oa.scenario.scenario import Scenario, allow_perception
from drake_oa.scenario.sources import (
    camera_configs,
    fixed_transform,
    given_ellipsoids,
    perception_period,
    table_plane,
)
from drake_oa.world.bag_images import ImageRecorder
from drake_oa.world.cameras import PIXEL_CENTER

AddSource = Callable[..., None]
"""Function (signals, block, scenario, station) that adds a source of obstacles to a diagram.

The first argument is the `SignalBuilder` that receives the systems. The block is the value of the
scenario's field `perception`. The station (plant and cameras) is None if the scenario has no robot.
"""

SOURCES: dict[type, AddSource] = {}
"""Functions that add sources of obstacles to a diagram, by the class of the block `perception`.

`register_source` adds a function to this dictionary."""


def register_source(block: type, add: AddSource) -> None:
    """Registers a custom source of obstacles for the field `perception` of scenario files.

    Args:
        block: dataclass with a field `period`, the time between observations [s]. A scenario file
            selects it by `perception: !<name of the class> {<field>: <value>}`.
        add: function (signals, block, scenario, station) that adds the systems of the source to a
            `SignalBuilder`. Its arguments are this builder, the instance of `block`, the scenario,
            and the station (plant and cameras; None without a robot). The systems output
            obstacles_W (`ObstacleClouds`). Optional outputs are cloud (`PointCloud`) for the
            viewer, collision_scene_W (`CollisionScene`) in place of the scene estimated from
            obstacles_W, and free_space_W (`FreeSpace`), without which all space outside collision
            geometry counts as free.
    """
    allow_perception(block)
    SOURCES[block] = add


def add_perception(
    signals: SignalBuilder, scenario: Scenario, station: StationModel | None
) -> None:
    """Adds the source of obstacles that the scenario's field `perception` selects.

    The source outputs obstacles_W (point clouds of the obstacles). Only the source
    `!GivenEllipsoids` outputs ellipsoids_W instead.

    Raises:
        ScenarioError: if the scenario is invalid; names the field.
    """
    SOURCES[type(scenario.perception)](signals, scenario.perception, scenario, station)


def _add_given(
    signals: SignalBuilder,
    source: GivenEllipsoids,
    scenario: Scenario,
    station: StationModel | None,
) -> None:
    signals.add("perception", GivenEllipsoidSource(given_ellipsoids(source)))


def _add_ground_truth(
    signals: SignalBuilder, source: GroundTruth, scenario: Scenario, station: StationModel
) -> None:
    plant, inspector = station.plant, station.scene_graph.model_inspector()
    system = GroundTruthPerception(
        plant, inspector, station.obstacles, table=table_plane(scenario), period=source.period
    )
    signals.add("perception", system)
    if not isinstance(scenario.inference, Verified):
        return
    # The collision scene is all geometry but that of the robot.
    others = [
        body
        for instance in map(ModelInstanceIndex, range(plant.num_model_instances()))
        if instance != station.robot
        for body in plant.GetBodyIndices(instance)
        if plant.GetCollisionGeometriesForBody(plant.get_body(body))
    ]
    names = {
        body: name
        for name, instance in enumerate(station.obstacles)
        for body in plant.GetBodyIndices(instance)
    }
    collision_scene = GroundTruthScene(plant, inspector, others, names=names, period=source.period)
    signals.add("collision_scene", collision_scene)


def _add_recorded_clouds(
    signals: SignalBuilder, source: RecordedClouds, scenario: Scenario, station: StationModel
) -> None:
    X_WC = fixed_transform(source.X_WC, "perception.X_WC")
    with field_errors("perception.folder", OSError, ValueError):
        perception = RecordedPerception(
            source.folder,
            X_WC=X_WC,
            config=_segmentation(source, scenario),
            robot=station.robot_shapes,
            period=source.period,
        )
    if X_WC is None and perception.files_without_pose:
        # A camera pose estimated from the table leaves the position relative to the robot unknown.
        raise ScenarioError(
            f"perception.X_WC: must be set, because '{perception.files_without_pose[0]}' has no "
            "camera pose: 'X_WC: {translation: [x, y, z], rotation: !Rpy {deg: [r, p, y]}}', or "
            "'X_WC: {}' for a cloud in the world frame"
        )
    signals.add("perception", perception)


def _add_depth_camera(
    signals: SignalBuilder, source: CameraSource, scenario: Scenario, station: StationModel
) -> None:
    cameras = {name: station.cameras[name] for name in source.names}
    first = cameras[source.names[0]]
    live = source if isinstance(source, LcmCamera) else None
    plant = station.plant
    joints = [
        joint
        for joint in plant.GetJointIndices(station.robot)
        if plant.get_joint(joint).num_positions()
    ]
    inputs: dict[str, str | None] = {}
    for name in cameras:
        # The self filter uses the configuration at the stamp of the image.
        at_image = source.signal("robot_state_at_image", name)
        signals.add(
            source.signal("robot_at_image", name),
            MatrixGain(plant.MakeStateSelectorMatrix(joints)),
            inputs={"u0": source.signal("plant_state_at_image", name)},
            outputs={"y0": at_image},
        )
        inputs[source.signal("robot_state", name)] = at_image
    intrinsics = {name: camera.intrinsics for name, camera in cameras.items()}
    perception = DepthPerception(
        intrinsics if len(cameras) > 1 else first.intrinsics,
        config=_segmentation(source, scenario),
        robot=station.robot_shapes,
        pixel_center=live.pixel_center if live else PIXEL_CENTER,
        period=perception_period(scenario),
        delay=first.delay,
        sync_tolerance=live.sync_tolerance if live else 0.0,
        missing_image_timeout=getattr(source, "max_age", 0.0),
        depth_ranges=[(config.z_near, config.z_far) for config in camera_configs(scenario, source)],
    )
    signals.add("perception", perception, inputs=inputs)


SOURCES |= {
    DepthCamera: _add_depth_camera,
    LcmCamera: _add_depth_camera,
    RecordedBag: _add_depth_camera,
    GroundTruth: _add_ground_truth,
    RecordedClouds: _add_recorded_clouds,
    GivenEllipsoids: _add_given,
}


def add_collision_scene(
    signals: SignalBuilder, scenario: Scenario, station: StationModel | None
) -> None:
    """Adds the system collision_scene, which computes collision_scene_W from obstacles_W.

    collision_scene_W is the collision geometry of the obstacles, which only motions verified by
    roll-outs require. The system is added for `inference: !Verified`, unless the source of
    perception already outputs collision_scene_W.
    """
    if station is None or "collision_scene_W" in signals or "obstacles_W" not in signals:
        return
    if not isinstance(scenario.inference, Verified):
        return
    source, cameras = scenario.perception, {}
    if isinstance(source, CameraSource) and station.cameras:
        for config in camera_configs(scenario, source):
            seen = station.cameras[config.name].intrinsics
            cameras[source.signal("camera_pose", config.name)] = ImageRange(
                seen.focal_y(), seen.center_y(), seen.height(), config.z_near
            )
    collision_scene = PerceivedScene(
        period=perception_period(scenario), cameras=cameras, table=table_plane(scenario)
    )
    signals.add("collision_scene", collision_scene)


def _segmentation(source: CameraSource | RecordedClouds, scenario: Scenario) -> SegmentationConfig:
    """Returns the parameters by which a source of obstacles segments images or point clouds.

    The parameters are the field `segmentation` of the source's block. If `table_height` is null in
    this field, the scenario's `table_height` is used. If both heights are null, the search for a
    table plane is switched off.
    """
    if source.segmentation.table_height is not None:
        return source.segmentation
    if scenario.table_height is None:
        return replace(source.segmentation, table=False)
    return replace(source.segmentation, table_height=scenario.table_height)


def record_images(bag: BagWriter, scenario: Scenario, signals: SignalBuilder) -> None:
    """Adds the systems recorder_<camera>, which write the images of perception's cameras to a bag.

    Nothing is added if perception uses no camera, or replays the images of a bag.

    Args:
        bag: writer of the bag.
        scenario: configuration of the cameras.
        signals: builder of the diagram, to which the plant and the cameras have been added.
    """
    source = scenario.perception
    if not isinstance(source, DepthCamera | LcmCamera):
        return
    for config in camera_configs(scenario, source):
        recorder = ImageRecorder(bag, config, signals.builder.GetSubsystemByName("plant"))
        ports = ("depth_image", "camera_pose", "image_stamp", "plant_state_at_image")
        inputs = {port: source.signal(port, config.name) for port in ports}
        signals.add(f"recorder_{config.name}", recorder, inputs=inputs)


def add_descriptor(
    signals: SignalBuilder, scenario: Scenario, station: StationModel | None
) -> None:
    """Adds the system ellipsoid_descriptor, which computes ellipsoids_W from obstacles_W.

    An ellipsoid describes an obstacle, or a part of it, dilated by the tool, so that the tool
    counts as its tool point. The system is not added without a robot or without obstacles_W.
    """
    if station is None or "obstacles_W" not in signals:
        return
    goal = "goal" if scenario.task.goal_moves else None
    signals.add("ellipsoid_descriptor", make_ellipsoid_descriptor(scenario), inputs={"goal": goal})


def make_ellipsoid_descriptor(scenario: Scenario) -> EllipsoidDescriptor:
    """Creates the system that computes ellipsoids of obstacles dilated by the tool.

    Obstacles are dilated by the tool in all orientations that it has along the task's motion.
    """
    task = scenario.task
    held = list(map(tool_link_corners, robots_along_motion(scenario)))
    links = [np.concatenate(of_link) for of_link in zip(*held, strict=True)]
    inference = scenario.inference
    fitted = isinstance(inference, Paper) and inference.shape == "superquadric"
    return EllipsoidDescriptor(
        np.concatenate(links),
        method="least_squares" if fitted else "enclosing",
        # A moving goal is read from an input port.
        free_W=[task.start] if task.goal_moves else [task.start, task.goal],
        tool_parts=merged_parts(links),
    )
