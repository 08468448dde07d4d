"""Configuration of perception: the blocks of a scenario's field `perception`."""

import math
from functools import partial
from typing import Annotated

from pydantic import AfterValidator, Field
from pydantic.dataclasses import dataclass
from pydrake.common.schema import Transform

from drake_oa.common.config import BLOCK, DrakeStruct, above, check_lcm_url

_FAR = 100.0
_MAX_COUNT = 1_000_000


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
    min_height: float = Field(default=0.004, ge=0.0, le=_FAR)
    """Minimum height of an obstacle's points above the table at zero depth [m]; the noise of the
    depth is added. Raising it removes more false obstacles and more flat obstacles."""
    max_height: Annotated[float, above("min_height")] = Field(default=1.2, le=_FAR)
    """Maximum height of an obstacle's points above the table [m]. Raising it includes higher
    points, such as those on a ceiling."""
    table_margin: float = Field(default=0.02, ge=0.0, le=_FAR)
    """Distance beyond the visible edge of the table within which points count as above it [m].
    Raising it includes obstacles beside the table."""
    overhang: float = Field(default=0.15, ge=0.0, le=_FAR)
    """Maximum distance that an obstacle above the table may extend beyond its edge [m]. Raising it
    keeps longer overhanging parts."""
    over_table: float = Field(default=0.15, ge=0.0, le=1.0)
    """Minimum fraction of an overhanging cluster that is above the table [1]. Raising it rejects
    more clusters at the edge of the table."""
    voxel: float = Field(default=0.01, gt=0.0, le=1.0)
    """Edge length of a voxel [m]. Raising it makes frames quicker and shapes coarser."""
    min_occupancy: int = Field(default=2, ge=1, le=_MAX_COUNT)
    """Minimum number of points in an occupied voxel [1]. Raising it rejects more noise and more
    distant points."""
    cluster_tolerance: float = Field(default=0.025, gt=0.0, le=1.0)
    """Maximum distance between neighboring points of one cluster [m]. Raising it merges obstacles
    that are close to each other."""
    min_cluster_voxels: int = Field(default=12, ge=1, le=_MAX_COUNT)
    """Minimum number of voxels of a cluster [1]. Raising it rejects smaller obstacles."""
    robot_margin: float = Field(default=0.025, ge=0.0, le=1.0)
    """Distance from the robot's surface within which points are removed by the self filter [m].
    Raising it removes more of the obstacles that are close to the robot."""
    stride: int = Field(default=4, ge=1, le=1000)
    """Row and column stride of the pixels used to fit the table plane [1]. Raising it makes the
    fit quicker and less accurate."""


@dataclass(config=BLOCK)
class CameraNoise:
    """Noise model of a simulated structured-light depth camera.

    Standard deviation of the depth z at angle of incidence theta (C. V. Nguyen et al., 3DIMPVT
    2012, measured up to 80 deg):

        sigma_z = axial_offset + axial_growth (z - axial_depth)^2
                  + axial_angle / sqrt(z) (theta / (pi/2 - theta))^2

    Sources of the values: `drake_oa.world.depth_noise`.
    """

    axial_offset: float = Field(default=0.0012, ge=0.0, le=0.1)
    """Standard deviation of the depth at `axial_depth` and normal incidence (Nguyen et al.) [m].
    Raising it adds depth noise everywhere."""
    axial_growth: float = Field(default=0.0019, ge=0.0, le=0.1)
    """Quadratic growth of the standard deviation with the depth [1/m]. Raising it adds noise to
    distant points."""
    axial_depth: float = Field(default=0.4, ge=0.0, le=10.0)
    """Depth of minimum noise [m]. Raising it moves the most accurate range away from the camera."""
    axial_angle: float = Field(default=0.0001, ge=0.0, le=0.01)
    """Growth of the standard deviation with the angle of incidence [m^1.5]. Raising it adds noise
    to inclined surfaces."""
    lateral: float = Field(default=0.8, ge=0.0, le=2.0)
    """Standard deviation of the position of a depth edge in the image [pixel] (Nguyen et al.: 0.8
    at normal incidence; its growth with the angle, below 0.1 up to 65 deg, is neglected). It acts
    on edges only, up to 2 pixels; on a plane it is part of sigma_z. Raising it frays outlines."""
    correlation_u: int = Field(default=5, ge=1, le=64)
    """Correlation length of the depth noise along image rows [pixel]; 1 makes pixels independent.
    Raising it makes the noise smoother. The residuals of the real scans, after subtraction of their
    mean over 21 x 21 pixels, are correlated along a row by 0.72 at one pixel, 0.38 at four and 0.08
    at eight."""
    correlation_v: int = Field(default=3, ge=1, le=64)
    """Correlation length of the depth noise along image columns [pixel]. Raising it makes the noise
    smoother. The real scans have 0.57 at one pixel, 0.12 at three and -0.02 at four."""
    baseline: float = Field(default=0.075, ge=0.01, le=1.0)
    """Distance from the camera to the projector on its right [m] (Khoshelham and Oude Elberink:
    0.075). Raising it makes depth steps finer and shadows wider."""
    subpixels: float = Field(default=8.0, ge=1.0, le=1000.0)
    """Disparity steps of one pixel [1/pixel] (Khoshelham and Oude Elberink: 8). A step is
    z^2 / (subpixels f baseline) of depth, 2.9 mm at 1 m with f = 577 pixels. Raising it makes depth
    steps finer."""
    unit: float = Field(default=0.001, ge=1e-5, le=0.1)
    """Resolution of the depth values of the driver [m] (OpenNI: one millimeter). Raising it rounds
    depths more coarsely."""
    near: float = Field(default=0.5, ge=0.05, le=20.0)
    """Depth below which pixels are missing [m], beside the range of the camera itself. Raising it
    removes closer points. The value is that of the closest points of the real scans."""
    far: Annotated[float, above("near")] = Field(default=5.0, ge=0.05, le=20.0)
    """Depth above which pixels are missing [m] (Khoshelham and Oude Elberink). Raising it keeps
    more distant points."""
    grazing_start: float = Field(default=math.radians(70.0), ge=0.0, le=0.5 * math.pi)
    """Angle of incidence above which some pixels are missing [rad]. Raising it keeps more pixels of
    inclined surfaces."""
    grazing_end: Annotated[float, above("grazing_start")] = Field(
        default=math.radians(80.0), ge=0.0, le=0.5 * math.pi
    )
    """Angle of incidence above which all pixels are missing [rad] (Nguyen et al. measured up to
    80 deg). Raising it keeps more pixels of inclined surfaces."""
    edge_jump: float = Field(default=0.02, ge=0.001, le=1.0)
    """Relative difference in depth of neighboring pixels at an edge [1]; that of a plane at 85 deg.
    Raising it finds fewer edges."""
    edge_dropout: float = Field(default=0.2, ge=0.0, le=1.0)
    """Fraction of the pixels at an edge that are missing, in patches [1]; estimated from the real
    scans. Raising it removes more of an outline."""
    flying: float = Field(default=0.1, ge=0.0, le=1.0)
    """Fraction of the pixels at an edge whose depth is between both surfaces [1]; estimated from
    the real scans. Raising it adds flying pixels."""
    shadows: bool = True
    """Whether pixels that the projector does not illuminate, left of edges, are missing."""


@dataclass(config=BLOCK)
class CameraSource:
    """One or several depth cameras from the scenario's field `cameras`."""

    camera: str = "camera"
    """Name of the camera."""
    cameras: list[str] = Field(default_factory=list)
    """Names of several cameras with synchronized images, in place of `camera`. A point that any
    camera sees is visible; occluded space is occluded from all."""
    noise: CameraNoise | None = None
    """Noise of the simulated cameras, {} for the published values; null: no noise."""
    segmentation: SegmentationConfig = Field(default_factory=SegmentationConfig)
    """Segmentation of the images into table and obstacles."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras in use."""
        return tuple(self.cameras) or (self.camera,)

    def signal(self, of_one: str, name: str) -> str:
        """Returns the name of one camera's signal, which ends in the camera's name if there are
        several cameras."""
        return f"{of_one}_{name}" if len(self.names) > 1 else of_one


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
    together: float = Field(default=0.04, ge=0.0, le=1.0)
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
    """Exact obstacles, read from SceneGraph."""

    period: float = Field(default=1.0 / 15.0, ge=1e-3, le=10.0)
    """Time between two observations [s]. Raising it makes the reaction slower."""


@dataclass(config=BLOCK)
class RecordedClouds:
    """Obstacles from a folder of recorded point clouds or depth images."""

    folder: str = Field(min_length=1)
    """Folder with .npz, .pcd or .ply files; relative to the scenario file."""
    X_WC: Annotated[Transform, DrakeStruct()] | None = None
    """Pose of the camera in the world for files without one; {} is the identity, for point clouds
    in the world frame."""
    period: float = Field(default=1.0 / 15.0, ge=1e-3, le=10.0)
    """Time between two recorded frames [s]. Raising it replays the recording more slowly."""
    loop: bool = False
    """Whether the recording starts again at its end."""
    segmentation: SegmentationConfig = Field(default_factory=SegmentationConfig)
    """Segmentation of the frames into table and obstacles."""
