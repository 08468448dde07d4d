"""LiveCamera: images received by LCM, with their capture times and plant states."""

import logging
import uuid
from collections.abc import Callable

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.systems.sensors import CameraInfo
from pydrake.trajectories import PiecewisePolynomial

from drake_oa.common.config import ScenarioError
from drake_oa.scenario.loading import load_scenario
from drake_oa.world.depth_messages import CHANNEL, LcmFrames, lcm_bus, pack_depth
from drake_oa.world.live_camera import ExternalInputs, LiveCamera
from drake_oa.world.station import make_station, release_cameras

EPOCH, STEP = 1.7e9, 0.01
INFO = CameraInfo(8, 6, 10.0, 10.0, 3.5, 2.5)


class LiveCameraSetup:
    """Simulation of a live camera with a plant at 1 rad/s, and a wall clock at simulated time."""

    def __init__(
        self, to_simulated: Callable[[float], float] | None = None, **settings: float
    ) -> None:
        self.url = f"memq://{uuid.uuid4()}"
        self.clock_offset = 0.0
        builder = DiagramBuilder()
        self.camera = LiveCamera(
            LcmFrames(self.url, "eye"),
            INFO,
            RigidTransform([0.0, 0.0, 1.0]),
            num_states=2,
            external=ExternalInputs(to_simulated=to_simulated, clock=self.clock),
            **settings,
        )
        builder.AddNamedSystem("live_eye", self.camera)
        motion = PiecewisePolynomial.FirstOrderHold([0, 10], [[0, 10], [1, 1]])
        source = builder.AddSystem(TrajectorySource(motion))
        builder.Connect(source.get_output_port(), self.camera.get_input_port())
        self.bus = lcm_bus(self.url)
        self.simulator = Simulator(builder.Build())

    @property
    def context(self) -> Context:
        """Context of the camera."""
        return self.camera.GetMyContextFromRoot(self.simulator.get_context())

    def clock(self) -> float:
        """Returns the time of the wall clock [s]."""
        return EPOCH + self.simulator.get_context().get_time() + self.clock_offset

    def advance(self, end: float) -> None:
        """Advances the simulation to a time [s], including the events at that time."""
        self.simulator.AdvanceTo(end)
        self.simulator.AdvancePendingEvents()

    def send(self, taken: float, depth: float = 1.0, shape: tuple[int, int] = (6, 8)) -> None:
        """Publishes an image of one depth [m], captured at a time after the epoch [s]."""
        image = np.full(shape, depth, np.float32)
        message = pack_depth(image, camera="eye", utime=round((EPOCH + taken) * 1e6))
        self.bus.Publish(CHANNEL.format("eye"), message.encode())

    def output(self) -> tuple[float, float, float]:
        """Returns depth [m], capture time [s] and joint position [rad] of the output image."""
        image, time, state = (
            self.camera.GetOutputPort(name).Eval(self.context)
            for name in ("depth_image", "image_time", "plant_state")
        )
        return float(image.data[2, 3, 0]), float(time[0]), float(state[0])


def test_time_and_state_are_those_when_the_image_was_taken() -> None:
    setup = LiveCameraSetup()
    setup.advance(0.195)
    setup.send(0.153, 2.0)
    setup.advance(0.2)
    np.testing.assert_allclose(setup.output(), [2.0, 0.153, 0.153], atol=1e-6)
    # The newest image is output; an image older than the previous one is ignored.
    for taken, depth in ((0.17, 3.0), (0.19, 4.0), (0.18, 5.0)):
        setup.send(taken, depth)
        setup.advance(setup.simulator.get_context().get_time() + STEP)
    np.testing.assert_allclose(setup.output(), [4.0, 0.19, 0.19], atol=1e-6)


def test_capture_times_are_correct_while_the_simulation_falls_behind() -> None:
    setup = LiveCameraSetup()
    setup.advance(0.3)
    # The simulation paused for 50 ms, in which an image was received.
    setup.clock_offset = 0.05
    setup.send(0.29)
    setup.advance(0.31)
    assert setup.output()[1] == pytest.approx(0.29)
    # An image captured in the simulated future is stamped with the present time.
    setup.send(0.36)
    setup.advance(0.32)
    assert setup.output()[1] == pytest.approx(0.315)


def test_capture_time_follows_to_simulated() -> None:
    setup = LiveCameraSetup(to_simulated=lambda stamp: 0.5 * (stamp - EPOCH))
    setup.advance(0.195)
    setup.send(0.18)
    setup.advance(0.2)
    # The state is that at the capture time by the wall clock.
    np.testing.assert_allclose(setup.output()[1:], [0.09, 0.18], atol=1e-6)


@pytest.mark.parametrize(
    ("send_invalid", "reason"),
    [
        (lambda setup: setup.send(0.0), "are more than 0.2 s old"),
        (lambda setup: setup.send(0.3, shape=(6, 9)), "9 x 6 pixels, the scenario has 8 x 6"),
        (lambda setup: setup.bus.Publish(CHANNEL.format("eye"), b"noise"), "no lcmt_image_array"),
    ],
)
def test_invalid_images_are_rejected_and_logged_once(
    send_invalid: Callable[[LiveCameraSetup], None], reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    setup = LiveCameraSetup()
    setup.advance(0.2)
    setup.send(0.2, 2.0)
    for end in (0.25, 0.31, 0.32):
        setup.advance(end)
        if end > 0.3:
            send_invalid(setup)
    setup.advance(0.33)
    np.testing.assert_allclose(setup.output()[:2], [2.0, 0.2], atol=1e-6)
    setup.send(0.33, 3.0)
    setup.advance(0.34)
    assert setup.output()[0] == pytest.approx(3.0)
    words = [record.getMessage() for record in caplog.records]
    assert len(words) == 2
    assert reason in words[0]
    assert "recovered" in words[1]


def test_camera_waits_for_the_first_image_also_after_a_release() -> None:
    setup = LiveCameraSetup(wait=30.0)
    setup.send(-0.02, 2.0)
    setup.simulator.Initialize()
    np.testing.assert_allclose(setup.output()[:2], [2.0, -0.02], atol=1e-6)
    release_cameras(setup.simulator.get_system())
    setup.send(0.0, 3.0)
    setup.advance(0.05)
    assert setup.output()[0] == pytest.approx(2.0)
    setup = LiveCameraSetup(wait=0.01)
    with pytest.raises(ScenarioError, match=r"live_eye: no image received within 0\.01 s from LCM"):
        setup.simulator.Initialize()


# In scenarios -----------------------------------------------------------------------------


def test_live_camera_has_the_pose_of_the_simulated_one_and_replaces_rendering() -> None:
    def camera(*overrides: str) -> tuple[RigidTransform, set[str]]:
        """Returns the camera pose X_WC and the names of the station's systems."""
        scenario = load_scenario("tabletop_box", list(overrides))
        builder = DiagramBuilder()
        pose = make_station(builder, scenario).cameras["camera"].pose
        names = {system.get_name() for system in builder.GetSystems()}
        root = builder.Build().CreateDefaultContext()
        return pose.Eval(pose.get_system().GetMyContextFromRoot(root)), names

    simulated, rendering = camera()
    live, others = camera("perception=!LcmCamera {lcm_url: 'memq://'}")
    assert live.IsNearlyEqualTo(simulated, 1e-12)
    assert "delayed_camera" in rendering
    assert "delayed_camera" not in others


def test_live_camera_on_the_arm_is_rejected() -> None:
    scenario = load_scenario("tabletop_box", ["perception=!LcmCamera {lcm_url: 'memq://'}"])
    scenario.cameras[0].X_PB.base_frame = "panda::panda_hand"
    with pytest.raises(ScenarioError, match=r"X_PB\.base_frame: '.*' moves"):
        make_station(DiagramBuilder(), scenario)
