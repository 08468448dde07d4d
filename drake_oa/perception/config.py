"""Configuration of perception: the blocks of a scenario's field `perception`."""

from functools import partial
from typing import Annotated

from pydantic import AfterValidator, Field
from pydantic.dataclasses import dataclass
from pydrake.common.schema import Transform

from drake_oa.common.config import BLOCK, DrakeStruct, above, check_lcm_url

_FAR = 100.0
"""Largest valid value of distances in a configuration [m]."""
_MAX_COUNT = 1_000_000
"""Largest valid value of counts in a configuration."""


@dataclass(config=BLOCK)
class SegmentationConfig:
    """Segmentation of a depth image or point cloud into table and obstacles."""

    near: float = Field(default=0.3, ge=0.0, le=_FAR)
    """Minimum depth [m]. Raising it ignores points close to the camera."""
    far: Annotated[float, above("near")] = Field(default=2.5, le=_FAR)
    """Maximum depth [m]. Raising it adds distant points, whose noise is larger."""
    table: bool = True
    """Whether to search for a table. If false, or if the scenario's `table_height` is null,
    every point that is not on the robot belongs to an obstacle."""
    table_height: float | None = None
    """Height of the table in the world [m]; null: the scenario's `table_height`. Raising it
    expects the table higher."""
    max_height: float = Field(default=1.2, gt=0.01, le=_FAR)
    """Maximum height of an obstacle's points above the table [m]. Raising it includes higher
    points, such as those on a ceiling."""
    table_margin: float = Field(default=0.02, ge=0.0, le=_FAR)
    """Distance beyond the visible edge of the table within which points count as above it [m].
    Raising it includes obstacles beside the table."""
    voxel: float = Field(default=0.01, gt=0.0, le=1.0)
    """Edge length of a voxel [m]. Raising it makes frames quicker and shapes coarser."""
    cluster_tolerance: float = Field(default=0.025, gt=0.0, le=1.0)
    """Maximum distance between neighboring points of one cluster [m]. Raising it merges obstacles
    that are close to each other."""
    min_cluster_voxels: int = Field(default=12, ge=1, le=_MAX_COUNT)
    """Minimum number of voxels of a cluster [1]. Raising it rejects smaller obstacles."""
    robot_margin: float = Field(default=0.025, ge=0.0, le=1.0)
    """Distance from the robot's surface within which points are removed by the self filter [m].
    Raising it removes more of the obstacles that are close to the robot."""


@dataclass(config=BLOCK)
class CameraNoise:
    """Noise of a simulated structured-light depth camera, with the published values.

    Model and values: `drake_oa.world.depth_noise`.
    """


@dataclass(config=BLOCK)
class CameraSource:
    """One or several depth cameras from the scenario's field `cameras`."""

    camera: str = "camera"
    """Name of the camera."""
    cameras: list[str] = Field(default_factory=list)
    """Names of several cameras with synchronized images, in place of `camera`. A point is visible
    if it is visible to any camera, and occluded if it is occluded from all."""
    noise: CameraNoise | None = None
    """Noise of the simulated cameras: {} or null, no noise."""
    segmentation: SegmentationConfig = Field(default_factory=SegmentationConfig)
    """Segmentation of the images into table and obstacles."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras in use."""
        return tuple(self.cameras) or (self.camera,)

    def signal(self, kind: str, name: str) -> str:
        """Returns the name of a camera's signal: `kind`, or `kind_name` with several cameras."""
        return f"{kind}_{name}" if len(self.names) > 1 else kind


@dataclass(config=BLOCK)
class DepthCamera(CameraSource):
    """One or several simulated depth cameras from the scenario's field `cameras`."""


@dataclass(config=BLOCK)
class LcmCamera(CameraSource):
    """Depth cameras whose images arrive as Drake's `lcmt_image_array` messages.

    The channels are DRAKE_RGBD_CAMERA_IMAGES_<name of the camera>; stamps are wall-clock times.
    Size, intrinsics and pose are those of the scenario's field `cameras`.
    """

    wait: float = Field(default=5.0, ge=0.0, le=600.0)
    """Maximum time to wait for the first image [s]. Raising it allows a slower start of the
    driver."""
    max_age: float = Field(default=0.2, gt=0.0, le=10.0)
    """Maximum age of an image on arrival [s]; older images are skipped, and a warning is logged
    when the last image is older. Raising it accepts older images."""
    sync_tolerance: float = Field(default=0.04, ge=0.0, le=1.0)
    """Maximum difference between the stamps of several cameras' images that are processed as one
    observation [s]; without hardware synchronization slightly more than the frame period. Raising
    it combines images that are further apart in time."""
    lcm_url: Annotated[str, AfterValidator(partial(check_lcm_url, field="LCM URL"))] = (
        "udpm://239.255.76.99:7699?ttl=0&recv_buf_size=4000000"
    )
    """LCM URL of the images. The default buffer size suffices for uncompressed images of 640 x
    480 pixels."""
    pixel_center: float = Field(default=0.5, ge=-1.0, le=1.0)
    """Image coordinate of the center of the first pixel [pixel]: 0.5 for images rendered by Drake
    (`drake-oa station`), 0 for a real camera. Raising it moves the principal point."""


@dataclass(config=BLOCK)
class GroundTruth:
    """Perception of exact obstacles, read from SceneGraph."""

    period: float = Field(default=1.0 / 15.0, ge=1e-3, le=10.0)
    """Time between two observations [s]. Raising it makes the reaction slower."""


@dataclass(config=BLOCK)
class RecordedClouds:
    """Perception of obstacles in a folder of recorded point clouds or depth images."""

    folder: str = Field(min_length=1)
    """Folder with .npz, .pcd or .ply files; relative to the scenario file."""
    X_WC: Annotated[Transform, DrakeStruct()] | None = None
    """Pose of the camera in the world for files without one; {} is the identity, for point clouds
    in the world frame."""
    period: float = Field(default=1.0 / 15.0, ge=1e-3, le=10.0)
    """Time between two recorded frames [s]. Raising it replays the recording more slowly."""
    segmentation: SegmentationConfig = Field(default_factory=SegmentationConfig)
    """Segmentation of the frames into table and obstacles."""
