"""The configuration of perception: what the block `perception` of a scenario holds.

Every field has its unit and range; `drake_oa.common.config` holds a file's blocks, and
with `check_values` what Python code makes, against them.
"""

# No postponed annotations here: yaml_load_typed reads the fields' types.
import dataclasses as dc
import math

from pydrake.common.schema import Transform

from drake_oa.common.config import count, number

_FAR = 100.0
_MOST = 1_000_000


@dc.dataclass
class SegmentationConfig:
    """How a frame is segmented into table and obstacles."""

    # Depths outside [near, far] are ignored.
    near: float = number(0.3, "m", 0.0, _FAR, below="far")
    far: float = number(2.5, "m", 0.0, _FAR)
    # Whether there is a table; without one, as where the scenario's `table_height` is null, all
    # that is seen and is not the robot is an obstacle.
    table: bool = True
    # Height of the table in the world; null: that of the scenario, or unknown [m].
    table_height: float | None = dc.field(default=None, metadata={"unit": "m"})
    # Heights above the table that may be an obstacle (the lower limit at depth 0; what
    # noise may look like is added to it).
    min_height: float = number(0.004, "m", 0.0, _FAR, below="max_height")
    max_height: float = number(1.2, "m", 0.0, _FAR)
    # How far beyond the table's seen extent an obstacle may stand,
    table_margin: float = number(0.02, "m", 0.0, _FAR)
    # how far one that stands over it may jut out, and the least share of it that is over it.
    overhang: float = number(0.15, "m", 0.0, _FAR)
    over_table: float = number(0.15, "1", 0.0, 1.0)
    # Edge of a voxel, and the fewest points that make one.
    voxel: float = number(0.01, "m", 0.0, 1.0, open_low=True)
    min_occupancy: int = count(2, 1, _MOST)
    # Points nearer to each other than this belong together.
    cluster_tolerance: float = number(0.025, "m", 0.0, 1.0, open_low=True)
    # The fewest voxels that make an obstacle.
    min_cluster_voxels: int = count(12, 1, _MOST)
    # Points within this of the robot are the robot's.
    robot_margin: float = number(0.025, "m", 0.0, 1.0)
    # The plane is searched on every stride-th row and column.
    stride: int = count(4, 1, 1000)


@dc.dataclass
class CameraNoise:
    """The noise that a simulated depth camera has: that of a structured-light one.

    The deviation along the optical axis, of what the camera tells, at depth z and incidence
    theta (Nguyen et al., who measured up to 80 deg):

        sigma_z = axial_offset + axial_growth (z - axial_depth)^2
                  + axial_angle / sqrt(z) (theta / (pi/2 - theta))^2

    Sources of the figures: `drake_oa.world.depth_noise`.
    """

    # Deviation along the optical axis (Nguyen et al.).
    axial_offset: float = number(0.0012, "m", 0.0, 0.1)
    axial_growth: float = number(0.0019, "1/m", 0.0, 0.1)
    axial_depth: float = number(0.4, "m", 0.0, 10.0)
    axial_angle: float = number(0.0001, "m^1.5", 0.0, 0.01)
    # Deviation of an edge's place in the image (Nguyen et al.: 0.8 at normal incidence; its
    # growth with the angle, under 0.1 up to 65 deg, is left out). It acts at edges only, and at
    # most 2 pixels far: on a plane it is part of sigma_z.
    lateral: float = number(0.8, "pixel", 0.0, 2.0)
    # Pixels over which the axial noise is smooth, along rows and columns; 1 makes every pixel
    # independent. The scans' residuals from the table, less their mean over 21 x 21 pixels, are
    # correlated along a row by 0.72 at one pixel, 0.38 at four, 0.08 at eight; along a column by
    # 0.57 at one, 0.12 at three, -0.02 at four.
    correlation_u: int = count(5, 1, 64)
    correlation_v: int = count(3, 1, 64)
    # From camera to projector, which is on its right, and steps of disparity a pixel
    # (Khoshelham and Oude Elberink: 0.075, 8). A step is z^2 / (subpixels f baseline) of depth:
    # 2.9 mm at 1 m with f = 577 pixels.
    baseline: float = number(0.075, "m", 0.01, 1.0)
    subpixels: float = number(8.0, "1/pixel", 1.0, 1000.0)
    # Unit in which the driver hands out depths (OpenNI: millimetres).
    unit: float = number(0.001, "m", 1e-5, 0.1)
    # What is nearer or farther is missing (the nearest points of the scans; Khoshelham and Oude
    # Elberink); so is what the camera's own range leaves out.
    near: float = number(0.5, "m", 0.05, 20.0, below="far")
    far: float = number(5.0, "m", 0.05, 20.0)
    # Incidence at which pixels begin to be missing, and from which all are (Nguyen et al.
    # measured up to 80 deg).
    grazing_start: float = number(
        math.radians(70.0), "rad", 0.0, 0.5 * math.pi, below="grazing_end"
    )
    grazing_end: float = number(math.radians(80.0), "rad", 0.0, 0.5 * math.pi)
    # Difference between neighbours that is an edge, as a share of depth: a plane seen at 85 deg.
    edge_jump: float = number(0.02, "1", 0.001, 1.0)
    # Shares of the pixels beside an edge: missing, in patches, and between both surfaces
    # (judgements by the scans).
    edge_dropout: float = number(0.2, "1", 0.0, 1.0)
    flying: float = number(0.1, "1", 0.0, 1.0)
    # Whether what the projector does not light, left of edges, is missing.
    shadows: bool = True


@dc.dataclass
class CameraSource:
    """Obstacles as one depth camera of the scenario's `cameras` sees them, or several together."""

    camera: str = "camera"
    # Several in place of the one, which take their images at the same times: what any of them
    # sees is seen, and hidden is what is hidden from all.
    cameras: list[str] = dc.field(default_factory=list)
    # Whether what is seen is as old as the last image of that camera which has been missing for
    # longest, or, false, as the newest image of any.
    all_needed: bool = True
    # Noise of simulated cameras, {} for the published figures; null: ideal cameras.
    noise: CameraNoise | None = None
    segmentation: SegmentationConfig = dc.field(default_factory=SegmentationConfig)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the cameras that it sees by."""
        return tuple(self.cameras) or (self.camera,)

    def signal(self, of_one: str, name: str) -> str:
        """What a signal of one camera is called where there are several."""
        return f"{of_one}_{name}" if len(self.names) > 1 else of_one


@dc.dataclass
class DepthCamera(CameraSource):
    """Obstacles as one simulated depth camera of `cameras` sees them, or several together."""


@dc.dataclass
class LiveCameras(CameraSource):
    """What blocks of cameras outside the simulation have in common.

    Size, intrinsics and pose are those of the scenario's `cameras`; images have their own noise.
    """

    # How long the first image is waited for at the start.
    wait: float = number(5.0, "s", 0.0, 600.0)
    # An image whose stamp is older when it comes, or so far ahead of this machine's clock, is
    # passed over; that there is no new one is said when the last is older.
    max_age: float = number(0.2, "s", 0.0, 10.0, open_low=True)
    max_ahead: float = number(0.01, "s", 0.0, 10.0)
    # How often it is looked whether an image has come.
    poll: float = number(0.005, "s", 1e-4, 0.1)
    # Images of several cameras whose stamps differ by no more are taken as of one instant: of
    # cameras that nothing synchronizes a little more than the time between images.
    together: float = number(0.04, "s", 0.0, 1.0)
    # Image coordinates of the middle of the first pixel.
    pixel_center: float = number(0.0, "pixel", -1.0, 1.0)


@dc.dataclass
class LcmCamera(LiveCameras):
    """Depth cameras whose images come as Drake's `lcmt_image_array`.

    Channels are DRAKE_RGBD_CAMERA_IMAGES_<name of the camera>; stamps are of the wall clock.
    """

    # Where from. So large a buffer holds images of 640 x 480 that are not compressed.
    lcm_url: str = "udpm://239.255.76.99:7699?ttl=0&recv_buf_size=4000000"
    # Drake renders the first pixel's middle at 0.5, and so does `drake-oa station`; in a real
    # camera's images it is at 0.
    pixel_center: float = number(0.5, "pixel", -1.0, 1.0)


@dc.dataclass
class RealSense(LiveCameras):
    """Intel RealSense cameras at this machine; size and rate are those of the scenario's `cameras`.

    Needs `pip install 'drake_oa[realsense]'`.
    """

    # Serial number, as text, of each camera; one camera may go without: the only device.
    serials: dict[str, str] = dc.field(default_factory=dict)
    # Focal lengths and centre of the scenario's camera may differ from the device's by so much.
    tolerance: float = number(1.0, "pixel", 0.0, 100.0)


@dc.dataclass
class GroundTruth:
    """Obstacles as SceneGraph knows them."""

    period: float = number(1.0 / 15.0, "s", 1e-3, 10.0)


@dc.dataclass
class RecordedClouds:
    """Obstacles from a folder of recorded clouds or depth images."""

    # Folder with .npz, .pcd or .ply files; relative to the scenario file.
    folder: str = ""
    # Pose of the camera in the world, for files that hold none; {} is the identity,
    # for clouds already in the world frame.
    X_WC: Transform | None = None
    period: float = number(1.0 / 15.0, "s", 1e-3, 10.0)
    # Whether the recording starts again when it has ended.
    loop: bool = False
    segmentation: SegmentationConfig = dc.field(default_factory=SegmentationConfig)
