"""Obstacles from depth cameras, and the state that all perception sources share."""

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
    """Memory of a perception source, in its Context."""

    def __init__(self, system: LeafSystem) -> None:
        """Declares the state, and the output ports ``obstacles_W`` and ``cloud`` of it."""
        self._index = system.DeclareAbstractState(Value(TrackerState()))
        ticket = {system.abstract_state_ticket(self._index)}
        system.DeclareAbstractOutputPort(
            "obstacles_W", lambda: Value(ObstacleClouds()), self._calc_obstacles, ticket
        )
        # Not in the state, which is copied at every step of every system.
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
        """Memory in a Context."""
        memory: Any = context.get_abstract_state(int(self._index)).get_value()
        return memory

    def write(self, state: State, memory: TrackerState) -> None:
        """Stores the memory."""
        value: Any = state.get_mutable_abstract_state(int(self._index))
        value.set_value(memory)


def log_change(system: LeafSystem, before: str, now: str, time: float) -> None:
    """Reports once when the note of a source changes from ``before`` to ``now``."""
    if now == before:
        return
    name = system.get_name() or type(system).__name__
    if now:
        _logger.warning("%s at %.3f s: %s; what was seen last is kept", name, time, now)
    else:
        _logger.info("%s at %.3f s: sees again", name, time)


_NO_NEW_IMAGE = "no new image"
_AFTER = 1e-4
"""How long after an image has come it is looked at [s]."""
_SAME_TIME = 1e-6
"""Images whose stamps differ by less are of one instant [s]."""


@dataclass(frozen=True, eq=False)
class FreeSpace(Frozen):
    """Space before the surfaces in depth images of one instant, which is seen to be free.

    Attributes:
        views: images of the cameras, in order; None for one that shows nothing of that instant.
        stamp: time at which they were taken [s].
        near, far: range of the cameras' depths [m].
    """

    views: tuple[View | None, ...] = ()
    stamp: float = -np.inf
    near: float = 0.0
    far: float = np.inf

    def contains(self, p_WQ: FloatArray) -> BoolArray:
        """Checks for places (N, 3) [m] whether any camera saw them free.

        A pixel without depth shows nothing; one beyond the range shows its ray up to `far`.
        """
        free = np.zeros(len(p_WQ), dtype=bool)
        for view in self.views:
            if view is None:
                continue
            p_CQ = (p_WQ - view.X_WC[:3, 3]) @ view.X_WC[:3, :3]
            pixel, z = pixel_at(p_CQ, view.z.shape, view.K), p_CQ[:, 2]
            depth = np.minimum(view.z.ravel()[pixel], self.far)
            free |= (pixel >= 0) & (self.near <= z) & (z < depth)
        return free


class _Ports(NamedTuple):
    """Input ports of one camera; robot None: a system that knows no robot."""

    image: AbstractInput[Any]
    pose: AbstractInput[Any]
    robot: InputPort | None
    stamp: InputPort


class DepthPerception(LeafSystem):
    """Sees what stands on the table: one cluster of points for each obstacle.

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

    Of several cameras `names`, each has those four input ports, named `depth_image_NAME`,
    `camera_pose_NAME`, `robot_state_NAME` and `image_stamp_NAME`.

    Port `depth_image`: ImageDepth32F, depth along the optical axis [m]; 0 is too
    near, inf too far, NaN missing.

    Port `camera_pose`: RigidTransform X_WC of the depth camera (x right, y down,
    z forward) in the world.

    Port `robot_state` (optional): (num_states,) vector [q, v] of the robot [rad, m
    and per s], whose own points are removed; while it is not connected nothing is
    removed. A system made without `robot` does not have this port.

    Port `image_stamp` (optional): (1,) time at which the image was taken [s]; while it is
    not connected, the time at which it is pulled. An image that was not taken after the last
    good one is no new observation: nothing changes but the `note`.

    Port `obstacles_W`: ObstacleClouds in the world frame [m], with names and velocities.

    Port `cloud`: PointCloud of every point above the table, in the world frame [m],
    the robot's own included: for viewing.

    Port `free_space_W`: abstract `FreeSpace`, the images in which the obstacles were seen last.

    The inputs are pulled at initialization and then every `period` (a simulated
    camera renders again each time it is asked), and the outputs are held between.
    Obstacles keep their names, and the points that an arm hides; an obstacle that does
    not move keeps its cloud, bit for bit, until it is seen to reach farther or less far
    (see `drake_oa.perception.tracking.update_tracks`, also for frames that repeat or go back in time). A
    frame that shows no table leaves the obstacles and their stamp as they were, and says why in
    `note`: a receiver tells from the stamp how old they are.

    Images of one instant, or that are not farther apart than `sync_tolerance`, are one frame: of the
    newest one's time, and without the robot where it was at any of them. A camera that has no such
    image, or one that tells nothing, is left out of it and named in `note`; the others' sight
    counts, and the obstacles' stamp is that of the last image of the camera that has been missing
    for longest: obstacles may have entered where no camera looks.
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
        depth_range: tuple[float, float] = (0.0, np.inf),
    ) -> None:
        """Declares ports, state and events.

        Args:
            camera: the depth camera's intrinsics; of several cameras, name -> intrinsics.
            config: how frames are segmented; `table_height` there is the prior on
                the table. None for the defaults.
            robot: from `robot_geometries`; None for no self filter.
            pixel_center: image coordinates of the middle of the first pixel
                [pixel]. 0 is the usual convention, and what CameraInfo documents;
                Drake 1.51's RenderEngineVtk renders as if it were 0.5, which
                turns the scene by half a pixel where it is not allowed for.
            period: time between frames [s].
            delay: how long after a period's beginning its images come [s].
            sync_tolerance: images of several cameras whose stamps differ by no more are taken as of one
                instant, that of the newest [s].
            missing_image_timeout: how old a camera's last image may be before `note` says that there is no new
                one [s]: the images of a camera that goes by itself now and then miss a period.
            depth_range: minimum and maximum depth that all cameras measure [m].

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
        self._range = depth_range
        self._free_space = self.DeclareAbstractState(Value(FreeSpace()))
        self.DeclareStateOutputPort("free_space_W", self._free_space)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._update)
        # The first frame is the initialization's.
        offset = period + delay + _AFTER if delay else period
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, offset, self._update)

    def _declare_camera(self, suffix: str) -> _Ports:
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
        time, previous = context.get_time(), self._state.read(context)
        count = len(self._ports)
        last_image_stamps = (
            np.array(previous.last_image_stamps)
            if len(previous.last_image_stamps)
            else np.full(count, -np.inf)
        )
        stamps = np.array([self._stamp(port, context) for port in self._ports])
        newest = stamps.max()
        overdue = (self._missing_image_timeout == 0.0) | (
            time - stamps > self._missing_image_timeout
        )
        is_new = (stamps > last_image_stamps) & (
            stamps >= newest - max(_SAME_TIME, self._sync_tolerance)
        )
        if not (is_new & (stamps >= newest - _SAME_TIME)).any():
            note = _NO_NEW_IMAGE if overdue.all() else previous.obstacles.note
            self._write(
                context, state, replace(previous, last_image_stamps=last_image_stamps), note
            )
            return
        shown = np.flatnonzero(is_new).tolist()
        robot = self._posed_robot([self._ports[row] for row in shown], context)
        frame = segment_views([self._view(row, context) for row in shown], self._config, robot)
        unusable_views = {shown[number]: why for number, why in frame.unusable_views.items()}
        missing = {row: _NO_NEW_IMAGE for row in range(count) if row not in shown} | unusable_views
        memory = update_tracks(previous, frame, newest, self._config, robot, complete=not missing)
        seeing = [row for row in range(count) if row not in missing]
        last_image_stamps[seeing] = stamps[seeing]
        notes = [memory.obstacles.note]
        if frame.usable:
            notes = [
                f"{self._names[row]}: {why}"
                for row, why in sorted(missing.items())
                if row in unusable_views or overdue[row]
            ]
            seen = dict(zip(seeing, frame.views, strict=True))
            views = tuple(map(seen.get, range(count)))
            free_space = FreeSpace(views, newest, *self._range)
            state.get_mutable_abstract_state(self._free_space).set_value(free_space)
            obstacles = (
                as_of(memory.obstacles, last_image_stamps.min()) if missing else memory.obstacles
            )
            memory = replace(memory, obstacles=obstacles, cloud_W=frame.points_W)
        self._write(
            context, state, replace(memory, last_image_stamps=last_image_stamps), "; ".join(notes)
        )

    def _write(self, context: Context, state: State, memory: TrackerState, note: str) -> None:
        before = self._state.read(context).obstacles.note
        log_change(self, before, note, context.get_time())
        obstacles = replace(memory.obstacles, note=note)
        self._state.write(state, replace(memory, obstacles=obstacles))

    def _stamp(self, port: _Ports, context: Context) -> float:
        has_stamp = port.stamp.HasValue(context)
        return float(port.stamp.Eval(context)[0]) if has_stamp else context.get_time()

    def _view(self, row: int, context: Context) -> View:
        port, (K, size) = self._ports[row], self._cameras[row]
        image: Any = port.image.read(context)
        pose: Any = port.pose.read(context)
        depth = image.data[:, :, 0]
        if depth.shape != size:
            raise ValueError(
                f"{self.get_name()}: {port.image.port.get_name()} is "
                f"{depth.shape[1]}x{depth.shape[0]}; "
                f"the camera's intrinsics are for {size[1]}x{size[0]} pixels"
            )
        return View(depth, K, pose.GetAsMatrix4())

    def _posed_robot(self, ports: Sequence[_Ports], context: Context) -> CollisionGeometries | None:
        """The robot where it was when any of the images was taken."""
        if self._robot is None:
            return None
        known = (port.robot for port in ports if port.robot is not None)
        states = {tuple(port.Eval(context)) for port in known if port.HasValue(context)}
        return self._robot.posed([np.array(state) for state in sorted(states)])


def as_of(obstacles: ObstacleClouds, stamp: float) -> ObstacleClouds:
    """The obstacles with an older stamp [s]: those that move are where they then must have been.

    Who lets them go on from there has them where they are.
    """
    late = obstacles.stamp - stamp
    clouds = obstacles.clouds_W
    if math.isfinite(late) and late > 0.0:
        clouds = tuple(
            cloud - late * v_WO if v_WO.any() else cloud
            for cloud, v_WO in zip(clouds, obstacles.v_WO, strict=True)
        )
    return replace(obstacles, stamp=stamp, clouds_W=clouds)
