"""Perception of obstacles from depth cameras, and the class `PerceptionState`, by which each
perception system keeps its tracked obstacles in the Context.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.perception import PointCloud
from pydrake.systems.framework import Context, InputPort, LeafSystem, State
from pydrake.systems.sensors import CameraInfo, ImageDepth32F

from drake_oa.common.messages import BoolArray, FloatArray, Frozen, ObstacleClouds
from drake_oa.common.ports import AbstractInput, valid_period
from drake_oa.geometry.collision_scene import CollisionGeometries, RobotGeometries
from drake_oa.geometry.pinhole import View, pinhole, pixel_at
from drake_oa.perception.config import SegmentationConfig
from drake_oa.perception.segmentation import segment_views
from drake_oa.perception.tracking import TrackerState, update_tracks

_logger = logging.getLogger("drake_oa")


class PerceptionState:
    """Abstract state and output ports of a perception system.

    The state is a `TrackerState`: the tracked obstacles with their remembered points, and the
    output. The output ports are computed from this state.
    """

    def __init__(self, system: LeafSystem) -> None:
        """Declares the abstract state and the output ports ``obstacles_W`` (ObstacleClouds) and
        ``cloud`` (PointCloud) of a perception system.
        """
        self._index = system.DeclareAbstractState(Value(TrackerState()))
        ticket = {system.abstract_state_ticket(self._index)}
        system.DeclareAbstractOutputPort(
            "obstacles_W", lambda: Value(ObstacleClouds()), self._calc_obstacles, ticket
        )
        # A PointCloud in the state would be copied whenever the Context is.
        system.DeclareAbstractOutputPort(
            "cloud", lambda: Value(PointCloud(0)), self._calc_cloud, ticket
        )

    def _calc_obstacles(self, context: Context, output: AbstractValue) -> None:
        output.set_value(self.read(context).obstacles)

    def _calc_cloud(self, context: Context, output: AbstractValue) -> None:
        points_W = self.read(context).cloud_W
        cloud = PointCloud(len(points_W))
        cloud.mutable_xyzs()[:] = points_W.T
        output.set_value(cloud)

    def read(self, context: Context) -> TrackerState:
        """Returns the tracker state that a Context of the perception system contains."""
        tracker: Any = context.get_abstract_state(int(self._index)).get_value()
        return tracker

    def write(self, state: State, tracker: TrackerState) -> None:
        """Stores a tracker state in the State of the perception system."""
        value: Any = state.get_mutable_abstract_state(int(self._index))
        value.set_value(tracker)


def log_change(system: LeafSystem, previous: str, note: str, time: float) -> None:
    """Logs the note of a perception system if it differs from the previous note.

    A note is the reason why an observation is degraded, and is logged as a warning. An empty note
    is logged as the recovery.

    Args:
        system: system whose name is logged.
        previous: note of the previous observation.
        note: note of the present observation.
        time: simulation time [s].
    """
    if note == previous:
        return
    name = system.get_name() or type(system).__name__
    if note:
        _logger.warning("%s at %.3f s: %s; earlier observations remain", name, time, note)
    else:
        _logger.info("%s at %.3f s: recovered", name, time)


_NO_NEW_IMAGE = "no new image"
"""Note (reason why an observation is degraded) of a frame in which a camera has no new image."""
_UPDATE_DELAY = 1e-4
"""Time from the arrival of a delayed image to the update of perception that processes it [s].
For a camera without delay it is zero."""
_SAME_TIME = 1e-6
"""Maximum difference between the stamps of images that count as taken at one instant [s]."""


@dataclass(frozen=True, eq=False)
class FreeSpace(Frozen):
    """Space observed to be free: between the cameras and the surfaces in images of one instant.

    Attributes:
        views: depth image of each camera, in the order of the cameras; None for a camera whose
            image of that instant is missing or was rejected by the segmentation.
        stamp: time of the images [s].
        ranges: minimum and maximum depth that each camera measures [m]; empty: not limited.
    """

    views: tuple[View | None, ...] = ()
    stamp: float = -np.inf
    ranges: tuple[tuple[float, float], ...] = ()

    def contains(self, p_WQ: FloatArray) -> BoolArray:
        """Checks for each of N points (N, 3) in the world [m] whether any camera observed it to be
        free.

        Points between the minimum depth and the measured surface are free. A pixel without depth
        observes no free space. A pixel with a depth beyond the range of its camera observes free
        space up to the maximum depth.
        """
        free = np.zeros(len(p_WQ), dtype=bool)
        ranges = self.ranges or ((0.0, np.inf),) * len(self.views)
        for view, (near, far) in zip(self.views, ranges, strict=True):
            if view is None:
                continue
            p_CQ = (p_WQ - view.X_WC[:3, 3]) @ view.X_WC[:3, :3]
            pixel, z = pixel_at(p_CQ, view.z.shape, view.K), p_CQ[:, 2]
            free |= (pixel >= 0) & (near <= z) & (z < np.minimum(view.z.ravel()[pixel], far))
        return free


class _Ports(NamedTuple):
    """Input ports of `DepthPerception` for one camera.

    Attributes:
        image: depth image.
        pose: pose of the camera in the world.
        robot: robot state at the time of the image, for the self filter; None without a self
            filter.
        stamp: time of the image [s].
    """

    image: AbstractInput[Any]
    pose: AbstractInput[Any]
    robot: InputPort | None
    stamp: InputPort


class DepthPerception(LeafSystem):
    """System that detects and tracks obstacles in depth images: one cloud and velocity for each.

    Note: if a frame lacks a usable image of one of several cameras, the stamp of `obstacles_W` is
    older than the frame: it is the oldest stamp among the last usable images of all cameras. Since
    that time, obstacles may have entered unobserved where no other camera has a view. An image is
    usable if at least 5 % of its pixels have depth (inf included). If a table is expected, one must
    also be found in this or another image of the same frame.

    .. pydrake_system::

      name: DepthPerception
      input_ports:
      - depth_image
      - camera_pose
      - robot_state (optional)
      - image_stamp (optional)
      output_ports:
      - obstacles_W
      - cloud
      - free_space_W

    With several cameras, each camera NAME has its own four input ports: `depth_image_NAME`,
    `camera_pose_NAME`, `robot_state_NAME` and `image_stamp_NAME`.

    Port `depth_image`: ImageDepth32F, depth along the optical axis [m]; 0: too near, inf: too far,
    NaN: missing.

    Port `camera_pose`: RigidTransform X_WC, the pose of the depth camera (x right, y down,
    z forward) in the world.

    Port `robot_state` (optional): (num_states,) vector [q, v] of the robot at the time of the image
    [rad, m and per s], for the self filter: points on the robot are removed. Not connected: no
    points are removed. A system constructed without `robot` does not have this port.

    Port `image_stamp` (optional): (1,) time of the image [s]. Not connected: the time at which the
    image is evaluated. An image that is not newer than the last usable image of its camera is no
    new observation: only the field `note` of `obstacles_W` changes.

    Port `obstacles_W`: ObstacleClouds in the world frame [m], with track IDs and velocities [m/s].
    Its field `note` is the reason why an observation is degraded.

    Port `cloud`: PointCloud of all points above the table (if no table is expected, of all points)
    in the world frame [m], including the robot's; for visualization.

    Port `free_space_W`: abstract `FreeSpace`, the space between the cameras and the surfaces in
    the usable images of the last frame with a usable image.

    The inputs are evaluated at initialization and then every `period`, since each evaluation makes
    a simulated camera render. The outputs are constant between these updates. An obstacle retains
    its track ID. Its cloud retains the points that the arm occludes. The cloud of an obstacle at
    rest remains bitwise equal until a larger or smaller extent is observed.
    `drake_oa.perception.tracking.update_tracks` describes the tracking. A frame without a usable
    image leaves the obstacles and their stamp unchanged and states the reason in `note`. A receiver
    computes the age of the obstacles from the stamp.

    Images whose stamps differ by at most `sync_tolerance` form one frame with the time of the
    newest image. The self filter removes the robot at the configurations of all these images. A
    camera without an image of that instant, or with one that is not usable, is left out of the
    frame and named in `note`; the other cameras still update the obstacles.
    """

    def __init__(
        self,
        camera: CameraInfo | Mapping[str, CameraInfo],
        *,
        config: SegmentationConfig | None = None,
        robot: RobotGeometries | None = None,
        pixel_center: float = 0.0,
        period: float = 1.0 / 15.0,
        delay: float = 0.0,
        sync_tolerance: float = 0.0,
        missing_image_timeout: float = 0.0,
        depth_ranges: Sequence[tuple[float, float]] = (),
    ) -> None:
        """Declares the ports, the state and the update events of depth perception.

        Args:
            camera: intrinsics of the depth camera; for several cameras a mapping from their names
                to their intrinsics.
            config: parameters of the segmentation; `table_height` is the prior on the table. None:
                defaults, with a table that is searched at every height.
            robot: collision geometry of the robot, from `collision_scene.robot_geometries`; points
                on it are removed. None: no points are removed.
            pixel_center: image coordinate of the center of the first pixel [pixel]. 0 is the
                convention of CameraInfo. RenderEngineVtk of Drake 1.51 renders with 0.5; without
                this correction the scene is rotated by half a pixel.
            period: time between frames [s].
            delay: time from the capture of images, at the start of a period, to their arrival [s].
            sync_tolerance: maximum difference of the stamps of images that form one frame [s].
            missing_image_timeout: age of the last image of a camera above which the field `note` of
                `obstacles_W` reports a missing image [s]; 0: every missing image is reported. An
                unsynchronized camera occasionally has no new image in a period.
            depth_ranges: minimum and maximum depth that each camera measures [m], for the output
                `free_space_W`; empty: no limits.

        Raises:
            ValueError: for a period that is not positive.
        """
        super().__init__()
        cameras = camera if isinstance(camera, Mapping) else {"": camera}
        self._names = tuple(cameras)
        center = np.array([0.0, 0.0, pixel_center, pixel_center])
        self._cameras = [
            (np.array(pinhole(one)) - center, (one.height(), one.width()))
            for one in cameras.values()
        ]
        self._config = config or SegmentationConfig()
        self._robot = robot
        self._sync_tolerance, self._missing_image_timeout = sync_tolerance, missing_image_timeout
        period = valid_period(period)
        several = len(cameras) > 1
        self._ports = [self._declare_camera(f"_{name}" if several else "") for name in cameras]
        self._state = PerceptionState(self)
        self._ranges = tuple(depth_ranges)
        self._free_space = self.DeclareAbstractState(Value(FreeSpace()))
        self.DeclareStateOutputPort("free_space_W", self._free_space)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._update)
        # The initialization event processes the first frame.
        offset = first_update(period, delay)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, offset, self._update)

    def _declare_camera(self, suffix: str) -> _Ports:
        """Declares the input ports of one camera, with a suffix appended to their names."""
        robot = self._robot
        return _Ports(
            AbstractInput(self, f"depth_image{suffix}", ImageDepth32F),
            AbstractInput(self, f"camera_pose{suffix}", RigidTransform),
            None
            if robot is None
            else self.DeclareVectorInputPort(f"robot_state{suffix}", robot.num_states),
            self.DeclareVectorInputPort(f"image_stamp{suffix}", 1),
        )

    def _update(self, context: Context, state: State) -> None:
        """Updates the tracked obstacles and the free space by the cameras' new images.

        Without a new image, only the note in the output changes (reason why the observation is
        degraded).
        """
        time, previous = context.get_time(), self._state.read(context)
        count = len(self._ports)
        last_image_stamps = np.full(count, -np.inf)
        last_image_stamps[: len(previous.last_image_stamps)] = previous.last_image_stamps
        stamps = np.array([self._stamp(port, context) for port in self._ports])
        overdue = (self._missing_image_timeout == 0.0) | (
            time - stamps > self._missing_image_timeout
        )
        is_new = select_synchronized(stamps, last_image_stamps, self._sync_tolerance)
        # A late image with the stamp of the last frame cannot be added to it.
        if not is_new.any() or stamps.max() <= previous.frame_stamp:
            note = _NO_NEW_IMAGE if overdue.all() else previous.obstacles.note
            self._write(context, state, previous, note)
            return
        newest, rows = stamps.max(), np.flatnonzero(is_new).tolist()
        robot = self._posed_robot([self._ports[row] for row in rows], context)
        frame = segment_views([self._view(row, context) for row in rows], self._config, robot)
        unusable_views = {rows[number]: why for number, why in frame.unusable_views.items()}
        missing = {row: _NO_NEW_IMAGE for row in range(count) if row not in rows} | unusable_views
        tracker = update_tracks(previous, frame, newest, self._config, robot, complete=not missing)
        usable = [row for row in range(count) if row not in missing]
        last_image_stamps[usable] = stamps[usable]
        notes = [tracker.obstacles.note]
        if frame.usable:
            notes = [
                f"{self._names[row]}: {why}"
                for row, why in sorted(missing.items())
                if row in unusable_views or overdue[row]
            ]
            view_of = dict(zip(usable, frame.views, strict=True))
            views = tuple(map(view_of.get, range(count)))
            free_space = FreeSpace(views, newest, self._ranges)
            state.get_mutable_abstract_state(self._free_space).set_value(free_space)
            obstacles = tracker.obstacles
            if missing:
                oldest = max(previous.obstacles.stamp, last_image_stamps.min())
                obstacles = backdate_obstacles(obstacles, oldest)
            tracker = replace(tracker, obstacles=obstacles, cloud_W=frame.points_W)
        self._write(
            context, state, replace(tracker, last_image_stamps=last_image_stamps), "; ".join(notes)
        )

    def _write(self, context: Context, state: State, tracker: TrackerState, note: str) -> None:
        """Stores a tracker state with a note (reason of a degraded observation), and logs the note
        if it has changed.
        """
        previous = self._state.read(context).obstacles.note
        log_change(self, previous, note, context.get_time())
        obstacles = replace(tracker.obstacles, note=note)
        self._state.write(state, replace(tracker, obstacles=obstacles))

    def _stamp(self, port: _Ports, context: Context) -> float:
        """Reads the stamp of a camera's image [s]; if its port is not connected, the time of the
        Context is returned.
        """
        has_stamp = port.stamp.HasValue(context)
        return float(port.stamp.Eval(context)[0]) if has_stamp else context.get_time()

    def _view(self, row: int, context: Context) -> View:
        """Reads the depth image and the pose of one camera from the input ports.

        Args:
            row: index of the camera.
            context: Context of the system.

        Raises:
            ValueError: if the image has another size than the intrinsics.
        """
        port, (K, size) = self._ports[row], self._cameras[row]
        image: Any = port.image.read(context)
        pose: Any = port.pose.read(context)
        # A copy: the image belongs to another system, and the state contains the view.
        depth = np.array(image.data[:, :, 0])
        if depth.shape != size:
            raise ValueError(
                f"{self.get_name()}: {port.image.port.get_name()} is "
                f"{depth.shape[1]}x{depth.shape[0]}; "
                f"the camera's intrinsics are for {size[1]}x{size[0]} pixels"
            )
        return View(depth, K, pose.GetAsMatrix4())

    def _posed_robot(self, ports: Sequence[_Ports], context: Context) -> CollisionGeometries | None:
        """Computes the collision geometry of the robot for the self filter, at the robot's states
        at the times of the images.

        Args:
            ports: input ports of the cameras in the frame.
            context: Context of the system.

        Returns:
            Collision geometry in the world: if the images were taken at different states of the
            robot, the robot's geometry once for each state. None without a self filter.
        """
        if self._robot is None:
            return None
        robot_ports = (port.robot for port in ports if port.robot is not None)
        states = {tuple(port.Eval(context)) for port in robot_ports if port.HasValue(context)}
        return self._robot.posed([np.array(state) for state in sorted(states)])


def first_update(period: float, delay: float) -> float:
    """Returns the time of the first periodic update of `DepthPerception` [s].

    Args:
        period: time between frames [s].
        delay: time from the capture of images, at the start of a period, to their arrival [s].
    """
    return period + delay + _UPDATE_DELAY if delay else period


def select_synchronized(stamps: FloatArray, last_stamps: FloatArray, tolerance: float) -> BoolArray:
    """Selects the cameras whose new images form one frame, together with the newest image.

    An image is new if its stamp is later than the camera's stamp in `last_stamps`.

    Args:
        stamps: (n,) stamps of the cameras' present images [s].
        last_stamps: (n,) for each camera the stamp of the last image that the segmentation did not
            reject [s]; -inf: none.
        tolerance: maximum difference of the stamps of one frame [s].

    Returns:
        (n,) whether each image is new and within the tolerance of the newest stamp; all False if no
        image with the newest stamp is new.
    """
    newest = stamps.max()
    is_new = (stamps > last_stamps) & (stamps >= newest - max(_SAME_TIME, tolerance))
    return np.asarray(is_new & (is_new & (stamps >= newest - _SAME_TIME)).any())


def backdate_obstacles(obstacles: ObstacleClouds, stamp: float) -> ObstacleClouds:
    """Returns the obstacles with an older stamp, and moves moving obstacles back to their positions
    at that time.

    A receiver that extrapolates the clouds with their velocities obtains the present positions.

    Args:
        obstacles: obstacles at their present positions.
        stamp: older stamp [s]; without effect on positions if it is not finite, or not older.
    """
    age = obstacles.stamp - stamp
    clouds = obstacles.clouds_W
    if math.isfinite(age) and age > 0.0:
        clouds = tuple(
            cloud - age * v_WO if v_WO.any() else cloud
            for cloud, v_WO in zip(clouds, obstacles.v_WO, strict=True)
        )
    return replace(obstacles, stamp=stamp, clouds_W=clouds)
