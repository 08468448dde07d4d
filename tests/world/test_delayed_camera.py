"""DelayedCamera: time, state and depths of the output image, with and without delay."""

import copy
from functools import partial

import numpy as np
import pytest
from pydrake.common.schema import Transform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from drake_oa.scenario.faults import CameraDropout
from drake_oa.scenario.loading import load_scenario
from drake_oa.world.cameras import add_camera
from drake_oa.world.delayed_camera import BackgroundCamera, DelayedCamera
from drake_oa.world.depth_noise import add_depth_noise

PERIOD, DELAY = 0.1, 0.08
READY = np.array([-0.74, 0.19, 0.01, -1.9, 0.0, 2.09, 0.06, 0.005, 0.005])


SCENARIO = load_scenario("tabletop_box")
"""Scenario whose camera has small images."""
(CAMERA,) = SCENARIO.cameras
CAMERA.width, CAMERA.height = 64, 48


@pytest.fixture(scope="module")
def camera() -> BackgroundCamera:
    """Returns the scenario's camera without noise."""
    return BackgroundCamera(SCENARIO, CAMERA)


def camera_diagram(camera: BackgroundCamera, delay: float, *dropouts: CameraDropout) -> Diagram:
    """Builds a diagram of a delayed camera, with the first joint at 1 rad/s."""
    builder = DiagramBuilder()
    _, depth = CAMERA.MakeCameras()
    camera_system = DelayedCamera(
        camera,
        depth.core().intrinsics(),
        num_states=18,
        period=PERIOD,
        delay=delay,
        dropouts=dropouts,
    )
    builder.AddNamedSystem("camera_system", camera_system)
    ends = np.zeros((18, 2))
    ends[:9] = READY[:, None]
    ends[0, 1] += 1.0
    source = builder.AddSystem(TrajectorySource(PiecewisePolynomial.FirstOrderHold([0, 1], ends)))
    builder.Connect(source.get_output_port(), camera_system.get_input_port())
    return builder.Build()


def outputs(diagram: Diagram, root: Context) -> tuple[float, np.ndarray, np.ndarray]:
    """Returns capture time [s], plant state (18,) and depths (H, W) [m] of the output image."""
    camera_system = diagram.GetSubsystemByName("camera_system")
    context = camera_system.GetMyContextFromRoot(root)
    return (
        float(camera_system.GetOutputPort("image_time").Eval(context)[0]),
        np.array(camera_system.GetOutputPort("plant_state").Eval(context)),
        np.array(camera_system.GetOutputPort("depth_image").Eval(context).data[:, :, 0]),
    )


@pytest.mark.parametrize(
    ("time", "taken", "delay"),
    [
        (0.0, 0.0, DELAY),
        (0.17, 0.0, DELAY),
        (0.19, 0.1, DELAY),
        (0.27, 0.1, DELAY),
        (0.3, 0.2, DELAY),
        (0.17, 0.17, 0.0),
    ],
)
def test_image_is_output_after_the_delay_and_the_first_without_delay(
    camera: BackgroundCamera, time: float, taken: float, delay: float
) -> None:
    diagram = camera_diagram(camera, delay)
    simulator = Simulator(diagram)
    simulator.AdvanceTo(time)
    stamp, state, image = outputs(diagram, simulator.get_context())
    assert stamp == pytest.approx(taken)
    assert state[0] == pytest.approx(READY[0] + taken)
    assert np.isfinite(image).mean() > 0.5
    # A simulation that continues keeps the images, another one begins with its first.
    simulator.Initialize()
    assert outputs(diagram, simulator.get_context())[0] == pytest.approx(taken)
    simulator.get_mutable_context().SetTime(0.0)
    simulator.Initialize()
    assert outputs(diagram, simulator.get_context())[0] == 0.0


@pytest.mark.parametrize(
    ("delay", "times"), [(0.0, [0.15, 0.2, 0.2, 0.2, 0.55]), (0.05, [0.1, 0.2, 0.2, 0.2, 0.5])]
)
def test_dropout_keeps_the_previous_image(
    camera: BackgroundCamera, delay: float, times: list[float]
) -> None:
    dropouts = CameraDropout(0.25, 0.15), CameraDropout(0.4, 0.05)
    diagram = camera_diagram(camera, delay, *dropouts)
    simulator = Simulator(diagram)
    for time, taken in zip((0.15, 0.25, 0.35, 0.44, 0.55), times, strict=True):
        simulator.AdvanceTo(time)
        stamp, state, _ = outputs(diagram, simulator.get_context())
        assert (stamp, state[0] - READY[0]) == (pytest.approx(taken), pytest.approx(taken))


def test_dropout_from_the_start_gives_no_depths(camera: BackgroundCamera) -> None:
    diagram = camera_diagram(camera, DELAY, CameraDropout(0.0, 0.25))
    simulator = Simulator(diagram)
    for time, is_out in ((0.2, True), (0.35, False)):
        simulator.AdvanceTo(time)
        stamp, _, image = outputs(diagram, simulator.get_context())
        assert (stamp == -np.inf) == is_out == np.isnan(image).all()


def test_rendered_image_equals_that_of_a_drake_sensor(camera: BackgroundCamera) -> None:
    builder = DiagramBuilder()
    sensor = add_camera(builder, SCENARIO, CAMERA)
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()
    state = np.concatenate([READY, np.zeros(9)])
    diagram.get_input_port().FixValue(root, state)
    image = sensor.depth_image_32F_output_port().Eval(sensor.GetMyContextFromRoot(root))
    X_WC = sensor.body_pose_in_world_output_port().Eval(sensor.GetMyContextFromRoot(root))
    rendered = camera.request(state, 0.0).result()
    np.testing.assert_array_equal(rendered.depth, image.data[:, :, 0])
    assert rendered.X_WC.IsExactlyEqualTo(X_WC)


def test_repeated_requests_give_the_same_image_also_after_a_release(
    camera: BackgroundCamera,
) -> None:
    states = [np.concatenate([READY + 0.05 * k, np.zeros(9)]) for k in range(6)]
    first = [camera.request(state, 0.0).result().depth for state in states]
    again = [camera.request(state, 0.0).result().depth for state in states[::-1]]
    for one, other in zip(first, again[::-1], strict=True):
        np.testing.assert_array_equal(one, other)
    assert not np.array_equal(first[0], first[-1])
    camera.release()
    np.testing.assert_array_equal(camera.request(states[0], 0.0).result().depth, first[0])


def test_image_of_a_camera_on_the_hand_keeps_its_pose() -> None:
    config = copy.copy(CAMERA)
    config.X_PB = Transform(base_frame="panda_hand")
    states = [np.concatenate([READY + change, np.zeros(9)]) for change in (0.0, 0.1)]
    camera = BackgroundCamera(SCENARIO, config)
    first, second = [camera.request(state, 0.0).result() for state in states]
    assert not first.X_WC.IsNearlyEqualTo(second.X_WC, 0.01)


def test_delay_must_be_shorter_than_the_period(camera: BackgroundCamera) -> None:
    with pytest.raises(ValueError, match="delay must be between 0 and the period"):
        camera_diagram(camera, PERIOD)


def test_noise_depends_on_the_capture_time(camera: BackgroundCamera) -> None:
    noise = partial(add_depth_noise, K=[60.0, 60.0, 31.5, 23.5], seed=3)
    state = np.concatenate([READY, np.zeros(9)])
    ideal = camera.request(state, 0.0).result().depth
    noisy = BackgroundCamera(SCENARIO, CAMERA, noise).request(state, 0.1).result().depth
    np.testing.assert_array_equal(noisy, noise(ideal, 0.1))
    assert not np.array_equal(noisy, noise(ideal, 0.2), equal_nan=True)
