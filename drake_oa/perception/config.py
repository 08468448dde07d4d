"""The configuration of perception: what the block `perception` of a scenario holds.

Every field has its unit and range; `drake_oa.common.config` holds a file's blocks, and
with `check_values` what Python code makes, against them.
"""

# No postponed annotations here: yaml_load_typed reads the fields' types.
import dataclasses as dc
import math

from pydrake.common.schema import Transform

from drake_oa.common.config import count, number

_STEEPEST = math.radians(89.0)
_FAR = 100.0
_MOST = 1_000_000


@dc.dataclass
class PlaneSearch:
    """How the plane of the table is searched."""

    # Planes that are proposed, points that vote for them, and points that refine the best.
    hypotheses: int = count(400, 1, _MOST)
    scored_points: int = count(800, 3, _MOST)
    refined_points: int = count(4000, 3, _MOST)
    # Share of the points that the smallest plane holds.
    least_share: float = number(0.05, "1", 0.0, 1.0)
    # From an expected plane that holds so much of what lies at its height, within this share
    # of the tolerance, no other plane can be the one.
    expected_share: float = number(0.5, "1", 0.0, 1.0)
    expected_band: float = number(0.5, "1", 0.0, 1.0, open_low=True)
    # What is lower stands on a floor or table; what is higher, at most so high, and wide is a
    # table on a floor.
    object_height: float = number(0.45, "m", 0.0, _FAR, below="table_height")
    table_height: float = number(1.3, "m", 0.0, _FAR)
    # Area of the smallest table, and of the largest top of a box.
    least_table: float = number(0.1, "m^2", 0.0, _FAR)
    largest_top: float = number(0.4, "m^2", 0.0, _FAR)


@dc.dataclass
class SegmentationConfig:
    """How a frame is segmented into table and obstacles."""

    # Depths outside [near, far] are ignored.
    near: float = number(0.3, "m", 0.0, _FAR, below="far")
    far: float = number(2.5, "m", 0.0, _FAR)
    # Standard deviation of depth at 1 m; it grows with the square of the depth. So many of
    # them may look like a height.
    depth_noise: float = number(0.0015, "1/m", 0.0, 1.0)
    deviations: float = number(6.0, "1", 0.0, 100.0)
    # Structured-light cameras bend a plane, most at the border of the image and far away: in
    # the scans of docs/results/real_scans.md by up to 6 standard deviations within 1.1 m, and
    # by 3 cm at 1.7 m. A cluster needs a share of points higher than warp (z - start)^2.
    warp_start: float = number(1.1, "m", 0.0, _FAR)
    warp: float = number(0.15, "1/m", 0.0, _FAR)
    largest_warp: float = number(0.04, "m", 0.0, 1.0)
    higher_share: float = number(0.1, "1", 0.0, 1.0)
    # Largest tilt of the table against gravity when the camera's pose is known,
    plane_tilt: float = number(math.radians(5.0), "rad", 0.0, _STEEPEST, open_low=True)
    # and against the camera's up direction (-y) when it is not.
    plane_tilt_unknown_pose: float = number(
        math.radians(75.0), "rad", 0.0, _STEEPEST, open_low=True
    )
    # Where that shows little, against the direction towards the camera (-z).
    facing_tilt: float = number(math.radians(15.0), "rad", 0.0, _STEEPEST, open_low=True)
    # Distance from the plane at which a point (at depth 0) belongs to it.
    plane_tolerance: float = number(0.006, "m", 0.0, 1.0, open_low=True)
    plane: PlaneSearch = dc.field(default_factory=PlaneSearch)
    # Whether there is a table; without one, as where the scenario's `table_height` is null, all
    # that is seen and is not the robot is an obstacle.
    table: bool = True
    # Height of the table in the world; null: that of the scenario, or unknown [m].
    table_height: float | None = dc.field(default=None, metadata={"unit": "m"})
    # How far the table may be from that height.
    table_height_tolerance: float = number(0.05, "m", 0.0, _FAR, open_low=True)
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
    # Clusters up to this far apart belong together too where nothing shows through
    # the gap (the rim and the inside of a bowl).
    unseen_gap: float = number(0.06, "m", 0.0, 1.0)
    # The fewest voxels that make an obstacle.
    min_cluster_voxels: int = count(12, 1, _MOST)
    # Points within this of the robot are the robot's.
    robot_margin: float = number(0.025, "m", 0.0, 1.0)
    # The plane is searched on every stride-th row and column.
    stride: int = count(4, 1, 1000)


@dc.dataclass
class FilterNoise:
    """What the filter of an obstacle's position takes as noise, and what as motion."""

    # Spectral density of the acceleration, each axis.
    acceleration: float = number(0.01, "m^2/s^3", 0.0, _FAR, open_low=True)
    # The same of one that moves: it may turn, stop or hurry.
    manoeuvre: float = number(0.05, "m^2/s^3", 0.0, _FAR, open_low=True)
    # Standard deviation of the measured place of one side of an obstacle, or of a point of it.
    side: float = number(0.0015, "m", 0.0, 1.0, open_low=True)
    # Standard deviation of the velocity of an obstacle that was not known before, and the
    # largest of one that has become open.
    initial_speed: float = number(0.4, "m/s", 0.0, _FAR, open_low=True)
    largest_speed: float = number(2.0, "m/s", 0.0, _FAR, open_low=True)
    # An obstacle moves when its speed is above `start_speed` and significant: v^T P^-1 v above
    # `start` (chi-square of 3 degrees of freedom; 21.1 is exceeded once in 10,000),
    start_speed: float = number(0.03, "m/s", 0.0, _FAR, open_low=True)
    start: float = number(21.1, "1", 0.0, 1e6, open_low=True)
    # at once where the statistic is above `certain`,
    certain: float = number(100.0, "1", 0.0, 1e6, open_low=True)
    # and rests again when it is below `floor` or the statistic below `stop`.
    floor: float = number(0.02, "m/s", 0.0, _FAR, open_low=True, below="start_speed")
    stop: float = number(7.8, "1", 0.0, 1e6, open_low=True, below="start")
    # So often in a row: frames to start, seconds to stop.
    start_frames: int = count(2, 1, 1000)
    stop_time: float = number(0.1, "s", 0.0, _FAR, open_low=True)
    # Where much is not where it was, a statistic above `stop` will do in `patience` times as
    # many frames.
    patience: int = count(3, 1, 1000)
    # A measurement farther off than this many standard deviations is an outlier; the
    # second in a row is a manoeuvre.
    outlier: float = number(5.0, "1", 0.0, 1e6, open_low=True)


@dc.dataclass
class TrackingConfig:
    """How obstacles are followed from frame to frame."""

    filter: FilterNoise = dc.field(default_factory=FilterNoise)
    # Depth difference that tells "before" and "behind" from "at".
    depth_margin: float = number(0.03, "m", 0.0, 1.0, open_low=True)
    # A point of a frame this near to a remembered one speaks for its obstacle,
    match_radius: float = number(0.02, "m", 0.0, 1.0, open_low=True)
    # this near it supports the point, and this near it is the same point.
    support_radius: float = number(0.012, "m", 0.0, 1.0, open_low=True)
    same_radius: float = number(0.008, "m", 0.0, 1.0, open_low=True)
    # A cluster is an obstacle's with which it has this share of points in common, of the
    # smaller of the two, and at least so many points;
    common_points: int = count(4, 1, _MOST)
    common_share: float = number(0.25, "1", 0.0, 1.0, open_low=True)
    # one without a common point belongs to the obstacle whose predicted centroid is nearest,
    # and nearer than this.
    gate: float = number(0.1, "m", 0.0, _FAR, open_low=True)
    # A new cluster of so many times the fewest voxels is believed at once.
    solid: float = number(2.0, "1", 0.0, 1000.0, open_low=True)
    # A remembered point is the mean of at most so many frames.
    mean_frames: int = count(20, 1, _MOST)
    # Share of an obstacle's area that lies beyond its side, of a side that must end at free
    # space, and of an obstacle that must be seen, for it to be measured by them.
    side_tail: float = number(0.02, "1", 0.0, 0.5, open_low=True)
    open_share: float = number(0.7, "1", 0.0, 1.0, open_low=True)
    least_area: float = number(0.15, "1", 0.0, 1.0, open_low=True)
    # What this many times as much is seen of as before comes into view, and may widen: its sides
    # have so many times the deviation.
    coming: float = number(1.1, "1", 1.0, 100.0)
    coming_factor: float = number(6.0, "1", 1.0, 100.0)
    # Points of two frames that are farther apart, beside what was expected of the obstacle's
    # motion, are not the same.
    registered: float = number(0.02, "m", 0.0, 1.0, open_low=True)
    # A side is not seen when so much of what is remembered beyond it is hidden; points no
    # farther beyond belong to it.
    hidden_share: float = number(0.3, "1", 0.0, 1.0, open_low=True)
    side_slack: float = number(0.004, "m", 0.0, 1.0, open_low=True)
    # Standard deviation of a side in pixels, and how much wider it is of what is almost all
    # hidden; share of a frame in the remembered distance between two sides.
    side_grain: float = number(0.7, "pixel", 0.0, 100.0, open_low=True)
    hidden_factor: float = number(3.0, "1", 0.0, 100.0, open_low=True)
    side_learning: float = number(0.05, "1", 0.0, 1.0, open_low=True)
    # An obstacle at rest that is found farther off than this was moved; a share of a frame goes
    # into its place else. What moves must be farther than `moved` from its place at rest.
    jump: float = number(0.01, "m", 0.0, 1.0, open_low=True)
    settling: float = number(0.1, "1", 0.0, 1.0, open_low=True)
    moved: float = number(0.004, "m", 0.0, 1.0, open_low=True)
    # An obstacle moves only when this share of its points is not found at its old place, of
    # what should be seen, which is at least `least_seen` of all; so much of a doubt is left a
    # frame later.
    doubt: float = number(0.04, "1", 0.0, 1.0, open_low=True)
    least_seen: float = number(0.2, "1", 0.0, 1.0, open_low=True)
    fading: float = number(0.9, "1", 0.0, 1.0, open_low=True)
    # With this share a slow motion is believed that is little beyond noise.
    strong_doubt: float = number(0.15, "1", 0.0, 1.0, open_low=True)
    # A correction of a position by more is looked at again.
    correction: float = number(0.003, "m", 0.0, 1.0, open_low=True)
    # It is where it was measured only if so much of what is seen of it where it was expected is
    # seen there too.
    found_again: float = number(0.9, "1", 0.0, 1.0)
    # A moving obstacle that is not seen goes on for this long, and is then taken to rest;
    coast_time: float = number(0.5, "s", 0.0, 1e6, open_low=True)
    # after this long it is mentioned in the note.
    mentioned_after: float = number(0.3, "s", 0.0, 1e6, open_low=True)
    # An obstacle that does not move has no velocity along an axis that it was not measured
    # along for this long.
    blind_time: float = number(0.2, "s", 0.0, 1e6, open_low=True)
    # After a gap longer than this between frames no velocity is believed.
    longest_gap: float = number(1.0, "s", 0.0, 1e6, open_low=True)
    # Parts of an obstacle that are apart for so many frames are two.
    split_frames: int = count(3, 1, _MOST)
    # Obstacles at rest that are one cluster for this long are one.
    merge_time: float = number(0.5, "s", 0.0, 1e6, open_low=True)
    # The cloud of an obstacle is handed on again when it reaches this much farther
    # or less far in any direction, or when this share of its points is new or gone.
    grown: float = number(0.0025, "m", 0.0, 1.0, open_low=True)
    shrunk: float = number(0.005, "m", 0.0, 1.0, open_low=True)
    changed_share: float = number(0.1, "1", 0.0, 1.0, open_low=True)
    # The table is handed on again when it moved by more than this within its reach, 1 m.
    table_shift: float = number(0.003, "m", 0.0, 1.0, open_low=True)


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
    tracking: TrackingConfig = dc.field(default_factory=TrackingConfig)

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
    tracking: TrackingConfig = dc.field(default_factory=TrackingConfig)
