"""RealSenseFrames, by the SDK's device without hardware."""

import sys
import time
from typing import Any

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraInfo

from drake_oa.common.config import ScenarioError
from drake_oa.scenario.loading import load_scenario
from drake_oa.world.live_camera import Frame, FrameSource
from drake_oa.world.realsense import RealSenseFrames
from drake_oa.world.station import make_station

WIDTH, HEIGHT = 64, 48
INFO = CameraInfo(WIDTH, HEIGHT, 60.0, 60.0, 31.5, 23.5)
NOW = 1.7e9


class Device:
    """A depth camera of 64 x 48 pixels at 30 images in a second; its unit is 0.25 mm."""

    def __init__(self, coefficients: float = 0.0) -> None:
        self.rs: Any = pytest.importorskip("pyrealsense2", reason="!RealSense needs it")
        rs = self.rs
        self.device = rs.software_device()
        self._sensor = self.device.add_sensor("Stereo Module")
        own = rs.intrinsics()
        own.width, own.height = WIDTH, HEIGHT
        own.fx, own.fy, own.ppx, own.ppy = 60.4, 60.2, 31.0, 24.0
        own.model, own.coeffs = rs.distortion.brown_conrady, [coefficients] * 5
        stream = rs.video_stream()
        stream.type, stream.fmt, stream.uid, stream.index = rs.stream.depth, rs.format.z16, 1, 0
        stream.width, stream.height, stream.fps, stream.bpp = WIDTH, HEIGHT, 30, 2
        stream.intrinsics = own
        self._profile = self._sensor.add_video_stream(stream).as_video_stream_profile()
        self._sensor.add_read_only_option(rs.option.depth_units, 2.5e-4)
        self._number = 0

    def send(self, values: np.ndarray, stamp: float, domain: str = "global_time") -> None:
        frame = self.rs.software_video_frame()
        self._number += 1
        frame.pixels, frame.stride, frame.bpp = values.astype(np.uint16), 2 * WIDTH, 2
        frame.timestamp, frame.frame_number = 1e3 * stamp, self._number
        frame.domain = getattr(self.rs.timestamp_domain, domain)
        frame.profile, frame.depth_units = self._profile, 2.5e-4
        self._sensor.on_video_frame(frame)

    def frames(self, info: CameraInfo = INFO, fps: float = 30.0, **settings: Any) -> FrameSource:
        return RealSenseFrames(info, fps, device=self.device, clock=lambda: NOW, **settings)


def waited_for(source: FrameSource) -> Frame:
    """The SDK hands images on in a thread of its own."""
    end = time.monotonic() + 10.0
    while (frame := source.latest()) is None:
        assert time.monotonic() < end
        time.sleep(0.001)
    return frame


def test_images_come_in_metres_with_the_devices_stamp() -> None:
    device = Device()
    source = device.frames()
    source.open()
    values = np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)
    device.send(values, 1.7e9 + 0.125)
    depth, stamp = waited_for(source)
    assert stamp == pytest.approx(1.7e9 + 0.125, abs=1e-5)
    assert depth.dtype == np.float32
    assert np.isnan(depth[0, 0])
    np.testing.assert_allclose(depth.ravel()[1:], 2.5e-4 * values.ravel()[1:], rtol=1e-6)
    assert source.latest() is None
    source.close()


def test_of_a_clock_of_its_own_the_arrival_counts() -> None:
    device = Device()
    source = device.frames()
    source.open()
    device.send(np.ones((HEIGHT, WIDTH)), 12.0, "hardware_clock")
    assert waited_for(source).stamp == NOW
    device.send(np.ones((HEIGHT, WIDTH)), 1.6e9, "system_time")
    assert waited_for(source).stamp == pytest.approx(1.6e9)
    source.close()


def test_it_is_opened_again() -> None:
    device = Device()
    source = device.frames()
    for value in (4, 8):
        source.open()
        source.open()
        device.send(np.full((HEIGHT, WIDTH), value), NOW)
        np.testing.assert_allclose(waited_for(source).depth, 2.5e-4 * value)
        source.close()
        source.close()


@pytest.mark.parametrize(
    ("made", "why"),
    [
        (
            lambda: Device().frames(CameraInfo(WIDTH, HEIGHT, 58.0, 60.0, 31.5, 23.5)),
            r"focal: !FocalLength \{x: 60\.400, y: 60\.200\}', 'center_x: 31\.000'",
        ),
        (lambda: Device().frames(tolerance=0.3), r"the scenario has 60\.000, 60\.000, 31\.500"),
        (lambda: Device().frames(fps=15.0), "fps 15; it has 64 x 48 at 30"),
        (lambda: Device(coefficients=0.1).frames(), "not rectified"),
    ],
)
def test_another_device_than_the_scenarios_is_refused(made: Any, why: str) -> None:
    with pytest.raises(ScenarioError, match=why):
        made().open()


def test_without_the_package_it_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(ScenarioError, match=r"pip install 'drake_oa\[realsense\]'"):
        RealSenseFrames(INFO, 30.0)


def test_a_scenario_is_built_without_the_device_and_asks_for_it_at_the_start() -> None:
    rs = pytest.importorskip("pyrealsense2", reason="!RealSense needs it")
    if len(rs.context().query_devices()):
        pytest.skip("there is a device")
    builder = DiagramBuilder()
    scenario = load_scenario("tabletop_box", ["perception=!RealSense {}"])
    make_station(builder, scenario)
    with pytest.raises(ScenarioError, match="one RealSense must be connected; there is none"):
        Simulator(builder.Build()).Initialize()
