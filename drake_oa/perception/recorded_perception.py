"""Perception of obstacles in recorded depth images or point clouds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, LeafSystem, State

from drake_oa.common.messages import FloatArray
from drake_oa.common.ports import valid_period
from drake_oa.geometry.collision_scene import CollisionGeometries, RobotGeometries
from drake_oa.perception.config import SegmentationConfig
from drake_oa.perception.depth_perception import PerceptionState, log_change
from drake_oa.perception.recordings import RecordedFrame, read_recording
from drake_oa.perception.segmentation import Segmentation, segment_depth, segment_points
from drake_oa.perception.tracking import update_tracks


class RecordedPerception(LeafSystem):
    """System that detects and tracks obstacles in a folder of recorded depth images or clouds.

    .. pydrake_system::

      name: RecordedPerception
      output_ports:
      - obstacles_W
      - cloud

    Port `obstacles_W`: ObstacleClouds in the world frame [m], with track IDs and velocities [m/s].
    The stamp is the simulation time at which the frame became due.

    Port `cloud`: PointCloud of all points above the table (if no table is expected, of all points),
    in the world frame [m].

    The first frame is due at time 0, the others with the time differences of the recording. At
    initialization and then every `period`, the newest due frame is processed, unless it was
    processed before. The stamp of the output is constant until the next frame. After the last frame
    the scene is assumed to remain as observed: each update sets the stamp of the output to the
    present time, and all velocities to zero.

    The pose of the camera is read from the frame's file, else `X_WC` is used. Without both, the
    table defines the world: z along its normal, x along the camera's x axis, and the origin at the
    intersection of table and optical axis. `drake_oa.perception.recordings` describes the files.
    Obstacles are tracked over the frames, with constant track IDs, also while they are occluded. A
    point cloud is assumed to contain every surface, without occlusion.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        X_WC: RigidTransform | None = None,
        config: SegmentationConfig | None = None,
        robot: RobotGeometries | None = None,
        period: float = 1.0 / 15.0,
    ) -> None:
        """Reads the recorded files of a folder, and declares ports, state and events.

        Args:
            folder: folder with .npz, .pcd, .ply or .png files.
            X_WC: pose of the camera (x right, y down, z forward) in the world for files without a
                pose; the identity for clouds in the world frame. None: unknown; then the table
                defines the world.
            config: parameters of the segmentation; None: defaults.
            robot: collision geometry of the robot, from `collision_scene.robot_geometries`; points
                on it are removed from frames with a `robot_state`. None: no points are removed.
            period: time between updates, and between files without stamp [s].

        Raises:
            FileNotFoundError: if the folder does not exist or is empty.
            ValueError: for a file that cannot be used, which the message names, or for a period
                that is not positive.
        """
        super().__init__()
        self._period = valid_period(period)
        self._frames = read_recording(folder, self._period)
        self._start = np.array([frame.stamp for frame in self._frames]) - self._frames[0].stamp
        self._X_WC: Any = None if X_WC is None else X_WC.GetAsMatrix4()
        self._config = config or SegmentationConfig()
        self._robot = robot
        count = robot.num_states if robot else 0
        for frame in self._frames:
            if count and frame.robot_state is not None and len(frame.robot_state) != count:
                raise ValueError(f"'robot_state' in '{frame.path}' must have {count} numbers")
        self._state = PerceptionState(self)
        # Index of the last processed frame; -1 before the first one.
        self._last_frame = self.DeclareAbstractState(Value(-1))
        self.DeclareInitializationUnrestrictedUpdateEvent(self._update)
        self.DeclarePeriodicUnrestrictedUpdateEvent(self._period, self._period, self._update)

    @property
    def files_without_pose(self) -> tuple[Path, ...]:
        """Paths of the recorded files that contain no pose of the camera, sorted by stamp."""
        return tuple(frame.path for frame in self._frames if frame.X_WC is None)

    def _update(self, context: Context, state: State) -> None:
        """Processes the newest recorded frame that is due; after the last frame, only updates the
        stamp and sets all velocities to zero.
        """
        # Update times are sums of the period, with rounding errors.
        due = int(np.searchsorted(self._start, context.get_time() + 1e-9, side="right")) - 1
        last_frame: Any = state.get_mutable_abstract_state(int(self._last_frame))
        previous = self._state.read(context)
        before = previous.obstacles
        if due == last_frame.get_value():
            if due == len(self._frames) - 1 and not before.note:
                # Motion after the last frame is unknown; the obstacles are assumed to rest.
                at_rest = np.zeros_like(before.v_WO)
                same = replace(before, stamp=context.get_time(), v_WO=at_rest)
                self._state.write(state, replace(previous, obstacles=same))
            return
        last_frame.set_value(due)
        recorded = self._frames[due]
        robot = None
        if self._robot is not None and recorded.robot_state is not None:
            robot = self._robot.posed([recorded.robot_state])
        frame = segment_frame(recorded, self._X_WC, self._config, robot)
        if not frame.usable:
            frame = replace(frame, note=f"{recorded.path.name}: {frame.note}")
        tracker = update_tracks(previous, frame, self._start[due], self._config, robot)
        log_change(self, before.note, tracker.obstacles.note, context.get_time())
        if frame.usable:
            tracker = replace(tracker, cloud_W=frame.points_W)
        self._state.write(state, tracker)


def segment_frame(
    frame: RecordedFrame,
    X_WC: FloatArray | None,
    config: SegmentationConfig,
    robot: CollisionGeometries | None = None,
) -> Segmentation:
    """Segments a recorded frame into the table and one cluster of points per obstacle.

    Args:
        frame: recorded frame with a depth image and intrinsics K, or with points.
        X_WC: (4, 4) pose of the camera in the world for a frame without a pose; None: unknown; then
            the table defines the world.
        config: parameters of the segmentation.
        robot: collision geometry of the robot at the time of the frame, whose points are removed;
            None: no points are removed.

    Raises:
        ValueError: if `config.table` is False and no pose of the camera is known.
    """
    pose = X_WC if frame.X_WC is None else frame.X_WC
    if frame.depth is not None and frame.K is not None:
        return segment_depth(frame.depth, frame.K, pose, config, robot)
    return segment_points(np.asarray(frame.points, dtype=float), pose, config, robot)
