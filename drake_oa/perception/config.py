"""Configuration of perception: the segmentation, and the blocks from which a scenario's field
`perception` selects its source of obstacles.
"""

from functools import partial
from typing import Annotated

from pydantic import AfterValidator, Field
from pydantic.dataclasses import dataclass
from pydrake.common.schema import Transform

from drake_oa.common.config import BLOCK, DrakeStruct, above, check_lcm_url

_FAR = 100.0
"""Largest valid value of the depths, heights and distances in a configuration of perception [m]."""
_MAX_COUNT = 1_000_000
"""Largest valid value of counts in a configuration of perception."""


@dataclass(config=BLOCK)
class SegmentationConfig:
    """Parameters of the segmentation, which divides a depth image or point cloud into the table and
    clusters of points, one per obstacle.
    """

    near: float = Field(default=0.3, ge=0.0, le=_FAR)
    """Minimum depth of the pixels that are used [m]. Raising it ignores points close to the
    camera."""
    far: Annotated[float, above("near")] = Field(default=2.5, le=_FAR)
    """Maximum depth of the pixels that are used [m]. Raising it adds distant points, whose noise is
    larger."""
    table: bool = True
    """Whether to search for a table. If false, every point that is not on the robot belongs to an
    obstacle. The same applies if `table_height` is null both here and in the scenario."""
    table_height: float | None = None
    """Expected height of the table in the world [m], near which it is searched for; null: the
    scenario's field `table_height`. Without a scenario, null searches at every height."""
    max_height: float = Field(default=1.2, gt=0.01, le=_FAR)
    """Maximum height of an obstacle's points above the table [m]. Raising it includes higher
    points, such as those on a ceiling."""
    table_margin: float = Field(default=0.02, ge=0.0, le=_FAR)
    """Distance beyond the visible edge of the table within which points still count as above the
    table [m]. Raising it includes obstacles beside the table."""
    voxel: float = Field(default=0.01, gt=0.0, le=1.0)
    """Edge length of the voxels (cubes) in which points are averaged [m]. Raising it makes
    segmentation faster and the shapes of obstacles coarser."""
    cluster_tolerance: float = Field(default=0.025, gt=0.0, le=1.0)
    """Maximum distance between neighboring points of one cluster [m]. Raising it merges obstacles
    that are close to each other."""
    min_cluster_voxels: int = Field(default=12, ge=1, le=_MAX_COUNT)
    """Minimum number of voxels in a cluster of points that counts as an obstacle [-]. Raising it
    rejects smaller obstacles."""
    robot_margin: float = Field(default=0.025, ge=0.0, le=1.0)
    """Distance from the robot's surface within which the self filter removes points as part of the
    robot [m]. Raising it removes more of the obstacles that are close to the robot."""


@dataclass(config=BLOCK)
class CameraNoise:
    """Block that adds the noise of a structured-light depth camera to simulated images, with
    parameter values from publications and from measured images.

    The noise model, its values and their sources are in `drake_oa.world.depth_noise`.
    """


@dataclass(config=BLOCK)
class CameraSource:
    """Perception by one or several depth cameras from the scenario's field `cameras`."""

    camera: str = "camera"
    """Name of the depth camera in the scenario's field `cameras`, if only one is used."""
    cameras: list[str] = Field(default_factory=list)
    """Names of several cameras with synchronized images, in place of `camera`. A point is visible
    if it is visible to any camera, and occluded if it is occluded from all."""
    noise: CameraNoise | None = None
    """Noise that is added to the images of simulated cameras: {} selects the noise model of
    structured-light cameras, null leaves the images exact."""
    segmentation: SegmentationConfig = Field(default_factory=SegmentationConfig)
    """Parameters of the segmentation, which divides the images into table and obstacles."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras in use: `cameras` if it is not empty, otherwise only `camera`."""
        return tuple(self.cameras) or (self.camera,)

    def signal(self, kind: str, name: str) -> str:
        """Returns the name of one camera's signal (a named value in the diagram, computed by one
        output port): `kind` itself, or `kind_name` if there are several cameras.

        Args:
            kind: quantity, such as depth_image.
            name: name of the camera.
        """
        return f"{kind}_{name}" if len(self.names) > 1 else kind


@dataclass(config=BLOCK)
class DepthCamera(CameraSource):
    """Perception by one or several simulated depth cameras from the scenario's field `cameras`."""


@dataclass(config=BLOCK)
class LcmCamera(CameraSource):
    """Perception by depth cameras whose images arrive as Drake's LCM messages `lcmt_image_array`.

    The channels are DRAKE_RGBD_CAMERA_IMAGES_<name of the camera>; stamps are wall-clock times.
    Size, intrinsics and pose are those of the scenario's field `cameras`.
    """

    wait: float = Field(default=5.0, ge=0.0, le=600.0)
    """Maximum time to wait for the first image [s]; without one, the run ends with an error.
    Raising it allows a slower start of the camera's driver."""
    max_age: float = Field(default=0.2, gt=0.0, le=10.0)
    """Maximum age of an image on arrival [s]; older images are rejected with a warning. Raising it
    accepts older images."""
    sync_tolerance: float = Field(default=0.04, ge=0.0, le=1.0)
    """Maximum difference between the stamps of several cameras' images that are processed as one
    observation [s]. Cameras without hardware synchronization require slightly more than the frame
    period. Raising it combines images that are further apart in time."""
    lcm_url: Annotated[str, AfterValidator(partial(check_lcm_url, field="LCM URL"))] = (
        "udpm://239.255.76.99:7699?ttl=0&recv_buf_size=4000000"
    )
    """LCM URL from which the images are received. The default buffer size suffices for uncompressed
    images of 640 x 480 pixels."""
    pixel_center: float = Field(default=0.5, ge=-1.0, le=1.0)
    """Image coordinate of the center of the first pixel [pixel]: 0.5 for images rendered by Drake,
    such as those that `drake-oa station` publishes; 0 for a real camera. The principal point is
    reduced by this value."""


@dataclass(config=BLOCK, kw_only=True)
class RecordedBag(CameraSource):
    """Depth camera whose images are in a bag of ROS 2 (rosbag2): an MCAP or sqlite3 file.

    Size, intrinsics and times of the images are those of the bag. Delay, range, and the frame rate
    that sets the period of perception are those of the camera in the scenario's field `cameras`.
    The pose of that camera in the world must be constant.
    """

    path: str = Field(min_length=1)
    """Folder of the bag, or its .mcap or .db3 file; relative to the scenario file."""
    depth_topic: str = "/camera/depth/image_rect_raw"
    """Topic of the depth images: sensor_msgs/Image, 16UC1 [mm] or 32FC1 [m]."""
    info_topic: str = "/camera/depth/camera_info"
    """Topic of the images' intrinsics: sensor_msgs/CameraInfo; distortion is ignored."""
    joint_topic: str | None = "/joint_states"
    """Topic of the robot's joint states (sensor_msgs/JointState), by which points on the robot are
    removed. If null, and for joints that the messages lack, the state of the simulated robot is
    used."""
    camera_pose: Annotated[Transform, DrakeStruct()] | None = None
    """Pose of the camera in the world (x right, y down, z forward); null: from the transforms on
    /tf and /tf_static, from the frame "world" to that of the images."""
    max_age: float = Field(default=0.2, ge=0.0)
    """Age of the last image above which a warning is logged [s]. Raising it tolerates longer gaps
    between images."""


@dataclass(config=BLOCK)
class GroundTruth:
    """Perception of the exact obstacles of the simulated world, whose poses are read from
    SceneGraph.
    """

    period: float = Field(default=1.0 / 15.0, ge=1e-3, le=10.0)
    """Time between two observations of the obstacles [s]. Raising it makes the reaction to moving
    obstacles slower."""


@dataclass(config=BLOCK)
class RecordedClouds:
    """Perception of obstacles in a folder of recorded point clouds or depth images."""

    folder: str = Field(min_length=1)
    """Folder with recorded frames as .npz, .pcd, .ply or .png files; relative to the scenario
    file."""
    X_WC: Annotated[Transform, DrakeStruct()] | None = None
    """Pose of the camera (x right, y down, z forward) in the world for files that contain none; {}
    is the identity, for point clouds in the world frame. It may be null if each file contains the
    pose."""
    period: float = Field(default=1.0 / 15.0, ge=1e-3, le=10.0)
    """Time between two observations, and between recorded files without a stamp [s]. Raising it
    makes the reaction to the recorded obstacles slower."""
    segmentation: SegmentationConfig = Field(default_factory=SegmentationConfig)
    """Parameters of the segmentation, which divides the recorded frames into table and
    obstacles."""
