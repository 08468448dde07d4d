"""Images of an Intel RealSense, by its SDK's Python package."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from pydrake.systems.sensors import CameraInfo

from drake_oa.common.config import ScenarioError, field_errors
from drake_oa.world.live_camera import Frame

_MILLISECOND = 1e-3


class RealSenseFrames:
    """The depth stream of one device: a `drake_oa.world.live_camera.FrameSource`.

    A stamp is the device's where its clock is set against this machine's (`global_time_enabled`,
    which the SDK has on), or the driver's; else the image's arrival.

    Attributes:
        name: the device and its serial number.
    """

    def __init__(
        self,
        intrinsics: CameraInfo,
        fps: float,
        *,
        serial: str = "",
        tolerance: float = 1.0,
        device: Any = None,
        clock: Callable[[], float] = time.time,
    ) -> None:
        """Looks for the SDK, not yet for the device.

        Args:
            intrinsics: what the device's must be, within the tolerance.
            fps: images in a second.
            serial: number of the device; empty: the only one.
            tolerance: of focal lengths and centre [pixel].
            device: a `pyrealsense2.device` to be used in place of looking for one.
            clock: the wall clock [s].

        Raises:
            ScenarioError: if the SDK is not installed.
        """
        try:
            import pyrealsense2
        except ImportError as error:
            raise ScenarioError(
                f"perception: !RealSense needs pyrealsense2 ({error}): "
                "pip install 'drake_oa[realsense]'"
            ) from None
        self._rs: Any = pyrealsense2
        self._intrinsics, self._fps, self._serial = intrinsics, fps, serial
        self._tolerance, self._given, self._clock = tolerance, device, clock
        self.name = f"RealSense {serial}".strip()
        self._sensor: Any = None
        self._scale = 0.0
        # Of one frame: a newer one takes its place.
        self._queue = self._rs.frame_queue(1)

    def open(self) -> None:
        """Starts the depth stream; started already, it does nothing.

        Raises:
            ScenarioError: if there is no such device, or its images are others than the scenario's.
        """
        if self._sensor is not None:
            return
        with field_errors(f"perception: {self.name}", RuntimeError):
            device = self._given or self._found()
            sensor = device.first_depth_sensor()
            profile = self._profile(sensor)
            self._check(profile.get_intrinsics())
            self._scale = sensor.get_depth_scale()
            sensor.open(profile)
            sensor.start(self._queue)
        self._sensor = sensor

    def latest(self) -> Frame | None:
        """The newest image that has come since it was asked last; None: none has."""
        found = self._queue.poll_for_frame()
        if not found:
            return None
        values = np.asanyarray(found.get_data())
        depth = values.astype(np.float32)
        depth *= self._scale
        depth[values == 0] = np.nan
        return Frame(depth, self._stamp(found))

    def close(self) -> None:
        """Stops the stream."""
        if self._sensor is None:
            return
        sensor, self._sensor = self._sensor, None
        sensor.stop()
        sensor.close()
        self._queue.poll_for_frame()

    def _found(self) -> Any:
        key = self._rs.camera_info.serial_number
        devices = {each.get_info(key): each for each in self._rs.context().query_devices()}
        known = ", ".join(devices) or "none"
        if self._serial and self._serial not in devices:
            raise ScenarioError(
                f"perception.serials: no RealSense '{self._serial}' is connected; there is {known}"
            )
        if not self._serial and len(devices) != 1:
            raise ScenarioError(
                f"perception: one RealSense must be connected; there is {known}"
                + (": name them in perception.serials" if devices else "")
            )
        return devices[self._serial] if self._serial else next(iter(devices.values()))

    def _profile(self, sensor: Any) -> Any:
        """The stream of the scenario's size and rate."""
        rs, info = self._rs, self._intrinsics
        wanted = (info.width(), info.height(), round(self._fps))
        offered = {}
        for each in sensor.get_stream_profiles():
            if each.stream_type() == rs.stream.depth and each.format() == rs.format.z16:
                video = each.as_video_stream_profile()
                offered[(video.width(), video.height(), each.fps())] = video
        if wanted not in offered:
            modes = ", ".join(f"{w} x {h} at {fps}" for w, h, fps in sorted(offered)) or "none"
            raise ScenarioError(
                f"cameras: {self.name} has no depth stream of width {wanted[0]}, height "
                f"{wanted[1]} and fps {wanted[2]}; it has {modes}"
            )
        return offered[wanted]

    def _check(self, own: Any) -> None:
        """Holds the device's intrinsics against the scenario's.

        Both count pixels from the middle of the first one.
        """
        info = self._intrinsics
        theirs = np.array([own.fx, own.fy, own.ppx, own.ppy])
        ours = np.array([info.focal_x(), info.focal_y(), info.center_x(), info.center_y()])
        if any(own.coeffs):
            raise ScenarioError(f"cameras: {self.name}: its depth images are not rectified")
        if np.abs(theirs - ours).max() > self._tolerance:
            fx, fy, cx, cy = ours
            raise ScenarioError(
                f"cameras: {self.name} has 'focal: !FocalLength {{x: {own.fx:.3f}, "
                f"y: {own.fy:.3f}}}', 'center_x: {own.ppx:.3f}' and 'center_y: {own.ppy:.3f}'; "
                f"the scenario has {fx:.3f}, {fy:.3f}, {cx:.3f} and {cy:.3f} [pixel]: write the "
                "device's, or raise perception.tolerance"
            )

    def _stamp(self, found: Any) -> float:
        """When it was taken, by the wall clock [s]."""
        rs = self._rs
        if found.get_frame_timestamp_domain() != rs.timestamp_domain.hardware_clock:
            return float(found.get_timestamp()) * _MILLISECOND
        arrival = rs.frame_metadata_value.time_of_arrival
        if found.supports_frame_metadata(arrival):
            return float(found.get_frame_metadata(arrival)) * _MILLISECOND
        return self._clock()
