"""Obstacles from a depth camera, and the state that all perception sources share."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.perception import PointCloud
from pydrake.systems.framework import AbstractStateIndex, Context, LeafSystem, State
from pydrake.systems.sensors import CameraInfo, ImageDepth32F

from drake_oa.common.config import check_values
from drake_oa.common.messages import Frozen, ObstacleClouds
from drake_oa.common.ports import read_value, valid_period
from drake_oa.geometry.collision_shapes import RobotModel
from drake_oa.geometry.pinhole import pinhole
from drake_oa.geometry.primitives import PosedShapes
from drake_oa.perception.config import SegmentationConfig, TrackingConfig
from drake_oa.perception.memory import ObstacleMemory
from drake_oa.perception.segmentation import segment_depth
from drake_oa.perception.tracking import fuse

_logger = logging.getLogger("drake_oa")


@dataclass(frozen=True, eq=False)
class _Points(Frozen):
    points_W: NDArray[np.floating] = field(default_factory=lambda: np.zeros((0, 3)))


@dataclass(frozen=True)
class PerceptionState:
    """Where a perception source keeps what it last saw, in its Context.

    Attributes:
        obstacles: index of the ObstacleClouds.
        points: index of the points to view.
        memory: index of the ObstacleMemory that the obstacles were taken from; an empty
            one where a source needs none.
    """

    obstacles: AbstractStateIndex
    points: AbstractStateIndex
    memory: AbstractStateIndex

    @staticmethod
    def declare(system: LeafSystem) -> PerceptionState:
        """Declares the state, and the output ports ``obstacles_W`` and ``cloud`` on it."""
        indices = PerceptionState(
            system.DeclareAbstractState(Value(ObstacleClouds())),
            system.DeclareAbstractState(Value(_Points())),
            system.DeclareAbstractState(Value(ObstacleMemory())),
        )
        system.DeclareStateOutputPort("obstacles_W", indices.obstacles)
        system.DeclareAbstractOutputPort(
            "cloud",
            lambda: Value(PointCloud(0)),
            indices.calc_cloud,
            prerequisites_of_calc={system.abstract_state_ticket(indices.points)},
        )
        return indices

    def calc_cloud(self, context: Context, output: AbstractValue) -> None:
        """The points as a PointCloud. It is made on demand: a Context that held it would
        copy it at every step of every system."""
        values: Any = context.get_abstract_state()
        points_W = values.get_value(int(self.points)).get_value().points_W
        cloud = PointCloud(len(points_W))
        cloud.mutable_xyzs()[:] = points_W.T
        output.set_value(cloud)

    def read(self, context: Context) -> ObstacleMemory:
        """What is remembered in a Context."""
        values: Any = context.get_abstract_state()
        memory: ObstacleMemory = values.get_value(int(self.memory)).get_value()
        return memory

    def write(
        self, state: State, memory: ObstacleMemory, points_W: NDArray[np.floating] | None
    ) -> None:
        """Stores the memory and, unless it is None, the cloud to view, (N, 3) [m]."""
        values: Any = state.get_mutable_abstract_state()
        values.get_mutable_value(int(self.obstacles)).set_value(memory.obstacles)
        values.get_mutable_value(int(self.memory)).set_value(memory)
        if points_W is not None:
            values.get_mutable_value(int(self.points)).set_value(_Points(points_W))


def log_change(system: LeafSystem, before: str, now: str, time: float) -> None:
    """Reports once when the note of a source changes from ``before`` to ``now``."""
    if now == before:
        return
    name = system.get_name() or type(system).__name__
    if now:
        _logger.warning("%s at %.3f s: %s; the last obstacles are kept", name, time, now)
    else:
        _logger.info("%s at %.3f s: sees again", name, time)


_NO_NEW_IMAGE = "no new image"
_AFTER = 1e-4
"""How long after an image has come it is looked at [s]."""


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

    The inputs are pulled at initialization and then every `period` (a simulated
    camera renders again each time it is asked), and the outputs are held between.
    Obstacles keep their names, and the points that an arm hides; an obstacle that does
    not move keeps its cloud, bit for bit, until it is seen to reach farther or less far
    (see `drake_oa.perception.tracking.fuse`, also for frames that repeat or go back in time). A
    frame that shows no table leaves the obstacles and their stamp as they were, and says why in
    `note`: a receiver tells from the stamp how old they are.
    """

    def __init__(
        self,
        camera: CameraInfo | Sequence[float],
        *,
        config: SegmentationConfig | None = None,
        tracking: TrackingConfig | None = None,
        robot: RobotModel | None = None,
        pixel_center: float = 0.0,
        period: float = 1.0 / 15.0,
        delay: float = 0.0,
    ) -> None:
        """Declares ports, state and events.

        Args:
            camera: the depth camera's intrinsics, or [fx, fy, cx, cy] [pixel].
            config: how frames are segmented; `table_height` there is the prior on
                the table. None for the defaults.
            tracking: how obstacles are followed, and with which noise; None for the
                defaults.
            robot: from `collect_collision_shapes`; None for no self filter.
            pixel_center: image coordinates of the middle of the first pixel
                [pixel]. 0 is the usual convention, and what CameraInfo documents;
                Drake 1.51's RenderEngineVtk renders as if it were 0.5, which
                turns the scene by half a pixel where it is not allowed for.
            period: time between frames [s].
            delay: how long after a period's beginning its image comes [s].

        Raises:
            ValueError: for a period that is not positive, a negative delay or invalid intrinsics.
        """
        super().__init__()
        if isinstance(camera, CameraInfo):
            self._size: tuple[int, int] | None = (camera.height(), camera.width())
            camera = pinhole(camera)
        else:
            self._size = None
        self._K = np.array(camera, dtype=float)
        if self._K.shape != (4,) or not np.isfinite(self._K).all() or (self._K[:2] <= 0.0).any():
            raise ValueError(f"camera must be [fx, fy, cx, cy] in pixels, not {camera}")
        if not abs(pixel_center) <= 1.0:
            raise ValueError(f"pixel_center must lie in [-1, 1] pixels, not {pixel_center}")
        self._K[2:] -= pixel_center
        if not 0.0 <= delay < np.inf:
            raise ValueError(f"delay must be finite and not negative [s], not {delay}")
        self._config = config or SegmentationConfig()
        self._tracking = tracking or TrackingConfig()
        for values in (self._config, self._tracking):
            check_values(values)
        self._robot = robot
        period = valid_period(period)
        self._image_port = self.DeclareAbstractInputPort("depth_image", Value(ImageDepth32F()))
        self._pose_port = self.DeclareAbstractInputPort("camera_pose", Value(RigidTransform()))
        self._robot_port = (
            None if robot is None else self.DeclareVectorInputPort("robot_state", robot.num_states)
        )
        self._stamp_port = self.DeclareVectorInputPort("image_stamp", 1)
        self._state = PerceptionState.declare(self)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._update)
        # The first frame is the initialization's.
        offset = period + delay + _AFTER if delay else period
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, offset, self._update)

    def _update(self, context: Context, state: State) -> None:
        time = context.get_time()
        previous = self._state.read(context)
        before = previous.obstacles
        stamp = time
        if self._stamp_port.HasValue(context):
            stamp = float(self._stamp_port.Eval(context)[0])
            if not stamp > before.stamp:
                log_change(self, before.note, _NO_NEW_IMAGE, time)
                same = replace(before, note=_NO_NEW_IMAGE)
                self._state.write(state, replace(previous, obstacles=same), None)
                return
        image: Any = read_value(self, self._image_port, context, ImageDepth32F)
        pose: Any = read_value(self, self._pose_port, context, RigidTransform)
        depth, X_WC = image.data[:, :, 0], pose.GetAsMatrix4()
        if self._size is not None and depth.shape != self._size:
            raise ValueError(
                f"{self.get_name()}: depth_image is {depth.shape[1]}x{depth.shape[0]}; the "
                f"camera's intrinsics are for {self._size[1]}x{self._size[0]} pixels"
            )
        robot = self._posed_robot(context)
        frame = segment_depth(depth, self._K, X_WC, self._config, robot)
        memory = fuse(previous, frame, depth, self._K, stamp, self._config, robot, self._tracking)
        log_change(self, before.note, memory.obstacles.note, time)
        self._state.write(state, memory, frame.points_W if frame.usable else None)

    def _posed_robot(self, context: Context) -> PosedShapes | None:
        if self._robot is None or self._robot_port is None:
            return None
        if not self._robot_port.HasValue(context):
            return None
        robot_state: Any = self._robot_port.Eval(context)
        return self._robot.posed(robot_state)
