"""LiveCamera: images of LCM messages, and the times and states that belong to them."""

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
from drake_oa.world.live_camera import LiveCamera, Outside
from drake_oa.world.station import make_station, release_cameras

EPOCH, STEP = 1.7e9, 0.01
INFO = CameraInfo(8, 6, 10.0, 10.0, 3.5, 2.5)


class StationModel:
    """A live camera whose plant moves at 1 rad/s; a wall clock that goes with its time."""

    def __init__(
        self, to_simulated: Callable[[float], float] | None = None, **settings: float
    ) -> None:
        self.url = f"memq://{uuid.uuid4()}"
        self.late = 0.0
        builder = DiagramBuilder()
        self.camera = LiveCamera(
            LcmFrames(self.url, "eye"),
            INFO,
            RigidTransform([0.0, 0.0, 1.0]),
            num_states=2,
            outside=Outside(to_simulated=to_simulated, clock=self.clock),
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
        return self.camera.GetMyContextFromRoot(self.simulator.get_context())

    def clock(self) -> float:
        return EPOCH + self.simulator.get_context().get_time() + self.late

    def go(self, end: float) -> None:
        """Goes on, the events of that moment included."""
        self.simulator.AdvanceTo(end)
        self.simulator.AdvancePendingEvents()

    def send(self, taken: float, depth: float = 1.0, shape: tuple[int, int] = (6, 8)) -> None:
        """An image that was taken so long after the epoch."""
        image = np.full(shape, depth, np.float32)
        message = pack_depth(image, camera="eye", utime=round((EPOCH + taken) * 1e6))
        self.bus.Publish(CHANNEL.format("eye"), message.encode())

    def seen(self) -> tuple[float, float, float]:
        """Depth, time and joint of the image."""
        image, time, state = (
            self.camera.GetOutputPort(name).Eval(self.context)
            for name in ("depth_image", "image_time", "plant_state")
        )
        return float(image.data[2, 3, 0]), float(time[0]), float(state[0])


def test_time_and_state_are_those_when_the_image_was_taken() -> None:
    station_model = StationModel()
    station_model.simulator.Initialize()
    station_model.go(0.195)
    station_model.send(0.153, 2.0)
    station_model.go(0.2)
    np.testing.assert_allclose(station_model.seen(), [2.0, 0.153, 0.153], atol=1e-6)
    # Of several that have come the newest; one that is older than the last is none.
    for taken, depth in ((0.17, 3.0), (0.19, 4.0), (0.18, 5.0)):
        station_model.send(taken, depth)
        station_model.go(station_model.simulator.get_context().get_time() + STEP)
    np.testing.assert_allclose(station_model.seen(), [4.0, 0.19, 0.19], atol=1e-6)


def test_a_simulation_that_falls_behind_for_a_moment_keeps_the_times() -> None:
    station_model = StationModel()
    station_model.simulator.Initialize()
    station_model.go(0.3)
    # It stood still for 50 ms, in which an image came.
    station_model.late = 0.05
    station_model.send(0.29)
    station_model.go(0.31)
    assert station_model.seen()[1] == pytest.approx(0.29)
    # One that was taken in what is its future is of the present at most.
    station_model.send(0.36)
    station_model.go(0.32)
    assert station_model.seen()[1] == pytest.approx(0.315)


def test_simulated_time_is_what_the_arm_is_said_to_be_at() -> None:
    station_model = StationModel(to_simulated=lambda stamp: 0.5 * (stamp - EPOCH))
    station_model.simulator.Initialize()
    station_model.go(0.195)
    station_model.send(0.18)
    station_model.go(0.2)
    # The state is of the wall clock's time, as it was known then.
    np.testing.assert_allclose(station_model.seen()[1:], [0.09, 0.18], atol=1e-6)


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (lambda station_model: station_model.send(0.0), "are more than 0.2 s old"),
        (
            lambda station_model: station_model.send(0.3, shape=(6, 9)),
            "9 x 6 pixels, the scenario has 8 x 6",
        ),
        (
            lambda station_model: station_model.bus.Publish(CHANNEL.format("eye"), b"noise"),
            "no lcmt_image_array",
        ),
    ],
)
def test_what_does_not_fit_is_passed_over_and_said_once(
    spoil: Callable[[StationModel], None], why: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    station_model = StationModel()
    station_model.simulator.Initialize()
    station_model.go(0.2)
    station_model.send(0.2, 2.0)
    for end in (0.25, 0.31, 0.32):
        station_model.go(end)
        if end > 0.3:
            spoil(station_model)
    station_model.go(0.33)
    np.testing.assert_allclose(station_model.seen()[:2], [2.0, 0.2], atol=1e-6)
    station_model.send(0.33, 3.0)
    station_model.go(0.34)
    assert station_model.seen()[0] == pytest.approx(3.0)
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == 2
    assert why in said[0]
    assert "sees again" in said[1]


def test_the_first_image_is_waited_for_and_after_a_release_again() -> None:
    station_model = StationModel(wait=30.0)
    station_model.send(-0.02, 2.0)
    station_model.simulator.Initialize()
    np.testing.assert_allclose(station_model.seen()[:2], [2.0, -0.02], atol=1e-6)
    release_cameras(station_model.simulator.get_system())
    station_model.send(0.0, 3.0)
    station_model.go(0.05)
    assert station_model.seen()[0] == pytest.approx(2.0)
    station_model = StationModel(wait=0.01)
    with pytest.raises(ScenarioError, match=r"live_eye: no image came within 0\.01 s from LCM"):
        station_model.simulator.Initialize()


# In scenarios -----------------------------------------------------------------------------


def test_it_stands_where_the_simulated_camera_stands_and_nothing_renders() -> None:
    def camera(*overrides: str) -> tuple[RigidTransform, set[str]]:
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


def test_a_camera_on_the_arm_is_refused() -> None:
    scenario = load_scenario("tabletop_box", ["perception=!LcmCamera {lcm_url: 'memq://'}"])
    scenario.cameras[0].X_PB.base_frame = "panda::panda_hand"
    with pytest.raises(ScenarioError, match=r"X_PB\.base_frame: '.*' moves"):
        make_station(DiagramBuilder(), scenario)
