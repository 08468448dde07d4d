"""Obstacles from a recording."""

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
    """Plays back a folder of recorded depth images or clouds.

    .. pydrake_system::

      name: RecordedPerception
      output_ports:
      - obstacles_W
      - cloud

    Port `obstacles_W`: ObstacleClouds in the world frame [m], stamped with the
    simulation time at which the frame was due.

    Port `cloud`: PointCloud of every point above the table, in the world frame [m].

    The first frame is due at time 0, each other one as long after it as it was
    recorded; the newest frame due is looked up at initialization and then every
    `period`. A held frame keeps its stamp. When the recording has ended the scene is
    taken to stay as it was seen last, stamped again.

    The camera's pose is taken from the frame's file, else from `X_WC`; where
    neither knows it, the table defines the world: z along its normal, the origin
    where the optical axis meets it, x along the camera's x axis. Files are
    described in `drake_oa.perception.recordings`. Obstacles are followed as `DepthPerception` does;
    a cloud is taken to show everything, so that nothing is hidden in it.
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
        """Reads the folder, and declares ports, state and events.

        Args:
            folder: with .npz, .pcd, .ply or .png files.
            X_WC: pose of the camera for files that do not hold one; the identity
                for clouds already in the world frame; None when unknown.
            config: how frames are segmented; None for the defaults.
            robot: from `robot_geometries`: takes itself out of frames that
                know its `robot_state`; None: they show no robot.
            period: time between updates, and between files without stamp [s].

        Raises:
            FileNotFoundError: if the folder does not exist or is empty.
            ValueError: naming the file that cannot be used, or for a period that is
                not positive.
        """
        super().__init__()
        self._period = valid_period(period)
        self._frames = read_recording(folder, self._period)
        self._start = np.array([frame.stamp for frame in self._frames]) - self._frames[0].stamp
        self._X_WC: Any = None if X_WC is None else X_WC.GetAsMatrix4()
        self._config = config or SegmentationConfig()
        self._robot = robot
        self._state = PerceptionState(self)
        # Counts the frames due so far; -1 before the first.
        self._played = self.DeclareAbstractState(Value(-1))
        self.DeclareInitializationUnrestrictedUpdateEvent(self._update)
        self.DeclarePeriodicUnrestrictedUpdateEvent(self._period, self._period, self._update)

    @property
    def files_without_pose(self) -> tuple[Path, ...]:
        """The files that do not know where the camera was, in order of time."""
        return tuple(frame.path for frame in self._frames if frame.X_WC is None)

    def _update(self, context: Context, state: State) -> None:
        # Update times are sums of the period: allow for their rounding.
        due = int(np.searchsorted(self._start, context.get_time() + 1e-9, side="right")) - 1
        played: Any = state.get_mutable_abstract_state(int(self._played))
        previous = self._state.read(context)
        before = previous.obstacles
        if due == played.get_value():
            if due == len(self._frames) - 1 and not before.note:
                # Nothing is known of motion after the last frame.
                at_rest = np.zeros_like(before.v_WO)
                same = replace(before, stamp=context.get_time(), v_WO=at_rest)
                self._state.write(state, replace(previous, obstacles=same))
            return
        played.set_value(due)
        recorded = self._frames[due]
        robot = None
        if self._robot is not None and recorded.robot_state is not None:
            robot = self._robot.posed([recorded.robot_state])
        frame = segment_frame(recorded, self._X_WC, self._config, robot)
        if not frame.usable:
            frame = replace(frame, note=f"{recorded.path.name}: {frame.note}")
        memory = update_tracks(previous, frame, self._start[due], self._config, robot)
        log_change(self, before.note, memory.obstacles.note, context.get_time())
        if frame.usable:
            memory = replace(memory, cloud_W=frame.points_W)
        self._state.write(state, memory)


def segment_frame(
    frame: RecordedFrame,
    X_WC: FloatArray | None,
    config: SegmentationConfig,
    robot: CollisionGeometries | None = None,
) -> Segmentation:
    """Segments a recorded frame.

    Args:
        frame: a depth image with K, or points.
        X_WC: (4, 4) pose of the camera for a frame that does not hold one; None: unknown.
        config: parameters.
        robot: shapes of the robot at the time of the frame, or None.

    Raises:
        ValueError: as `segment_depth` and `segment_points` do.
    """
    pose = X_WC if frame.X_WC is None else frame.X_WC
    if frame.depth is not None and frame.K is not None:
        return segment_depth(frame.depth, frame.K, pose, config, robot)
    return segment_points(np.asarray(frame.points, dtype=float), pose, config, robot)
