"""The camera's noise against the published formulas, on walls whose depth is known."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.common.value import Value
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem
from pydrake.systems.sensors import CameraInfo, ImageDepth32F

from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.perception.config import CameraNoise
from drake_oa.scenario.loading import load_scenario
from drake_oa.world.depth_noise import (
    DepthNoise,
    NoiseRoom,
    add_depth_noise,
)

K = np.array([577.0, 579.0, 319.5, 239.5])
SHAPE = (240, 320)
QUIET = CameraNoise(
    axial_offset=0.0, axial_growth=0.0, axial_angle=0.0, unit=1e-5, subpixels=1000.0
)


def axial_deviation(z, theta, p=CameraNoise()):  # noqa: B008
    """Published sigma_z [m] at depth z and incidence theta, see `CameraNoise`."""
    steep = theta / (0.5 * np.pi - theta)
    flat = p.axial_offset + p.axial_growth * (z - p.axial_depth) ** 2
    return flat + p.axial_angle / np.sqrt(z) * steep**2


def disparity_step(z, focal, p=CameraNoise()):  # noqa: B008
    """Difference of depth between two steps of disparity [m]."""
    return z**2 / (p.subpixels * focal * p.baseline)


def wall(z: float, tilt: float = 0.0, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    """A wall through depth z on the optical axis, turned about the camera's y axis [rad]."""
    x = (np.arange(shape[1]) - K[2]) / K[0]
    return np.tile(z / (1.0 - np.tan(tilt) * x), (shape[0], 1)).astype(np.float32)


def step(front: float, back: float, column: int = 160) -> np.ndarray:
    """A near surface right of a column, before a far one."""
    depth = wall(back)
    depth[:, column:] = front
    return depth


def incidence(tilt: float, columns: np.ndarray) -> np.ndarray:
    """Angle between rays and normal on such a wall [rad], in the middle row."""
    x = (columns - K[2]) / K[0]
    rays = np.stack([x, np.zeros_like(x), np.ones_like(x)]) / np.sqrt(1.0 + x * x)
    return np.arccos(np.abs(-np.sin(tilt) * rays[0] + np.cos(tilt) * rays[2]))


@pytest.mark.parametrize("z", [0.6, 1.0, 2.0, 3.0])
@pytest.mark.parametrize("degrees", [0.0, 30.0, 50.0, 60.0, 66.0])
def test_deviation_on_a_wall_is_the_published_one(z, degrees):
    tilt = np.deg2rad(degrees)
    # A narrow strip about the optical axis: depth and angle are nearly the same in it.
    true = wall(z, tilt, (480, 640))[:, 300:340]
    camera = K - [0.0, 0.0, 300.0, 0.0]
    error = np.stack([add_depth_noise(true, camera, seed=1, frame=k) - true for k in range(8)])[
        :, 180:300
    ]
    expected = axial_deviation(true[0], incidence(tilt, np.arange(300.0, 340.0)))
    assert np.isfinite(error).all()
    assert np.nanstd(error / expected) == pytest.approx(1.0, abs=0.08)
    # Where all pixels share one depth, rounding shifts them together.
    assert abs(np.nanmean(error / expected)) < 0.25


def test_the_formula_has_the_published_values():
    assert axial_deviation(0.4, 0.0) == pytest.approx(0.0012)
    assert axial_deviation(1.4, 0.0) == pytest.approx(0.0031)
    # theta / (pi / 2 - theta) is 1 at 45 degrees, 2 at 60.
    assert axial_deviation(1.0, np.pi / 3.0) == pytest.approx(0.0012 + 0.0019 * 0.36 + 0.0004)
    # Khoshelham and Oude Elberink: about 7 cm at 5 m.
    assert disparity_step(5.0, 577.0) == pytest.approx(0.0722, abs=1e-4)


@pytest.mark.parametrize("z", [1.0, 2.0, 4.0])
def test_depths_come_in_steps_of_disparity(z):
    only_steps = replace(QUIET, subpixels=8.0)
    ramp = np.linspace(z, 1.1 * z, SHAPE[1], dtype=np.float32)
    told = np.unique(add_depth_noise(np.tile(ramp, (SHAPE[0], 1)), K, only_steps)[:, 2:-2])
    told = told[np.isfinite(told)]
    expected = disparity_step(0.5 * (told[1:] + told[:-1]), K[0])
    np.testing.assert_allclose(np.diff(told), expected, atol=2.5e-5)


def test_depths_are_whole_millimetres():
    told = add_depth_noise(wall(1.3, 0.4), K) * 1e3
    np.testing.assert_allclose(told, np.round(told), atol=1e-3)


def test_noise_is_smooth_over_a_few_pixels_and_fresh_in_each_frame():
    errors = np.stack([add_depth_noise(wall(1.0), K, frame=k) - 1.0 for k in range(6)])
    errors /= errors.std()

    def correlation(frames: int, rows: int, columns: int) -> float:
        a = errors[frames:, rows:, columns:]
        b = errors[: len(errors) - frames, : SHAPE[0] - rows, : SHAPE[1] - columns]
        return float((a * b).mean())

    assert 0.6 < correlation(0, 0, 1) < 0.9
    assert 0.4 < correlation(0, 1, 0) < 0.8
    assert abs(correlation(0, 0, 10)) < 0.05
    assert abs(correlation(0, 6, 0)) < 0.05
    assert abs(correlation(1, 0, 0)) < 0.05
    # Independent where asked, and nowhere more or less noisy for the lattice.
    white = CameraNoise(correlation_u=1, correlation_v=1)
    error = add_depth_noise(wall(1.0), K, white) - 1.0
    assert abs(np.corrcoef(error[:, 1:].ravel(), error[:, :-1].ravel())[0, 1]) < 0.05
    assert errors.std(axis=(0, 1)).min() > 0.75


def test_noise_depends_on_seed_frame_and_image_alone():
    image = step(1.0, 1.5)
    told = add_depth_noise(image, K, seed=3, frame=7)
    np.testing.assert_array_equal(add_depth_noise(image.copy(), K, seed=3, frame=7), told)
    for other in ({"seed": 4, "frame": 7}, {"seed": 3, "frame": 8}):
        assert np.mean(add_depth_noise(image, K, **other) != told) > 0.5


def test_holes_flying_pixels_and_shadow_are_at_edges_only():
    front, back, edge = 1.0, 1.4, 160
    frames = np.stack([add_depth_noise(step(front, back, edge), K, frame=k) for k in range(5)])
    shadow = int(K[0] * 0.075 * (1.0 / front - 1.0 / back))
    near = np.zeros(SHAPE[1], dtype=bool)
    near[edge - shadow - 5 : edge + 5] = True
    assert not np.isnan(frames[:, :, ~near]).any()
    # What the projector on the right does not light is all but gone.
    assert np.isnan(frames[:, :, edge - shadow + 3 : edge - 3]).mean() > 0.99
    # Away from the edge each pixel shows its own surface.
    assert np.abs(frames[:, :, : edge - shadow - 5] - back).max() < 0.03
    assert np.abs(frames[:, :, edge + 5 :] - front).max() < 0.02
    # Near it, one of both surfaces or something between, also on the wrong side.
    seen = frames[:, :, near]
    seen = seen[np.isfinite(seen)]
    assert seen.min() > front - 0.02
    assert seen.max() < back + 0.03
    assert np.mean((seen > front + 0.03) & (seen < back - 0.03)) > 0.005


def test_without_shadows_the_share_of_flying_pixels_is_the_given_one():
    p = CameraNoise(shadows=False, edge_dropout=0.0, lateral=0.0, flying=0.5)
    frames = np.stack([add_depth_noise(step(1.0, 2.0), K, p, frame=k) for k in range(10)])
    assert np.isfinite(frames).all()
    beside = frames[:, :, 159:161]
    assert np.mean((beside > 1.05) & (beside < 1.9)) == pytest.approx(0.5 * 0.85, abs=0.04)
    others = np.delete(frames, [159, 160], axis=2)
    assert not ((others > 1.05) & (others < 1.9)).any()


def test_the_share_of_missing_pixels_at_edges_is_the_given_one():
    p = CameraNoise(shadows=False, edge_dropout=0.3, lateral=0.0, flying=0.0)
    frames = np.stack([add_depth_noise(step(1.0, 2.0), K, p, frame=k) for k in range(20)])
    assert np.isnan(frames[:, :, 159:161]).mean() == pytest.approx(0.3, abs=0.04)
    assert np.isfinite(np.delete(frames, [159, 160], axis=2)).all()


def test_edges_move_by_the_lateral_deviation():
    p = replace(QUIET, shadows=False, edge_dropout=0.0, flying=0.0, lateral=0.8)
    told = np.stack([add_depth_noise(step(1.0, 2.0), K, p, frame=k) for k in range(20)])
    place = (told > 1.5).sum(axis=2)
    assert place.std() == pytest.approx(0.8, abs=0.2)
    assert abs(place.mean() - 160.0) < 0.1


def test_out_of_range_and_grazing_pixels_are_missing():
    depth = wall(1.0)
    depth[:40], depth[40:80], depth[80:120], depth[120:160] = 6.0, np.inf, 0.0, np.nan
    told = add_depth_noise(depth, K)
    assert np.isnan(told[:157]).all()
    assert np.isfinite(told[165:]).all()
    # Such a wall is seen at more than 80 degrees everywhere.
    camera = K - [0.0, 0.0, 300.0, 0.0]
    steep = wall(1.0, np.deg2rad(82.0), (480, 640))[:, 300:340]
    assert np.isnan(add_depth_noise(steep, camera)).all()
    half = wall(1.0, np.deg2rad(75.0), (480, 640))[:, 300:340]
    assert 0.2 < np.isnan(add_depth_noise(half, camera)).mean() < 0.8


@settings(max_examples=30)
@given(
    st.integers(0, 2**63 - 1),
    st.integers(0, 2**63 - 1),
    st.lists(
        st.sampled_from([0.0, 0.3, 0.7, 1.0, 2.0, 6.0, np.inf, np.nan]), min_size=1, max_size=40
    ),
    st.integers(1, 9),
)
def test_any_image_gives_depths_in_range_or_nothing(seed, frame, depths, rows):
    image = np.tile(np.array(depths), (rows, 1))
    told = add_depth_noise(image, K, seed=seed, frame=frame)
    assert told.shape == image.shape
    assert told.dtype == np.float32
    seen = told[np.isfinite(told)]
    assert not np.isinf(told).any()
    assert (seen > 0.45).all()
    assert (seen < 5.6).all()


def test_out_is_filled_and_may_be_the_image_and_room_is_only_worked_in():
    image = step(1.0, 1.5)
    expected = add_depth_noise(image, K)
    # What an image before left in the room does not show.
    room = NoiseRoom(*image.shape)
    add_depth_noise(step(0.8, 2.0, 100), K, room=room)
    np.testing.assert_array_equal(add_depth_noise(image, K, room=room), expected)
    out = np.empty_like(image)
    assert add_depth_noise(image, K, out=out) is out
    np.testing.assert_array_equal(out, expected)
    add_depth_noise(image, K, out=image, room=room)
    np.testing.assert_array_equal(image, expected)


def test_every_number_has_a_range_and_its_default_lies_within():
    for item in fields(CameraNoise):
        if item.name != "shadows":
            assert item.metadata["low"] <= item.default <= item.metadata["high"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"axial_offset": -0.1}, r"CameraNoise.axial_offset: -0.1 is outside \[0, 0.1\] \[m\]"),
        ({"lateral": float("nan")}, "lateral: must be a finite number"),
        ({"correlation_u": 0}, "correlation_u"),
        ({"correlation_v": 2.5}, "correlation_v: expected a whole number"),
        ({"near": 3.0, "far": 2.0}, "near must be less than far, not 3.0 and 2.0"),
        (
            {"grazing_start": 1.4, "grazing_end": 1.3},
            "start must be less than grazing_end",
        ),
    ],
)
def test_bad_parameters_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        DepthNoise(CAMERA, parameters=CameraNoise(**changes))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"depth": np.ones(3)}, "depth must be an image"),
        ({"K": [1.0, 2.0, 3.0]}, "K must be"),
        ({"K": [0.0, 2.0, 3.0, 4.0]}, "K must be"),
        ({"seed": -1}, "seed must lie in"),
        ({"frame": 2**63}, "frame must lie in"),
        ({"out": np.ones((2, 3), dtype=np.float64)}, "out must be"),
        ({"room": NoiseRoom(3, 2)}, r"room is for images \(3, 2\), not \(2, 3\)"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        add_depth_noise(**({"depth": np.ones((2, 3)), "K": K} | arguments))


CAMERA = CameraInfo(64, 48, 570.0, 580.0, 31.5, 23.5)
SMALL_K = [570.0, 580.0, 31.5, 23.5]


def image(depth: float = 1.2, width: int = 64, height: int = 48) -> ImageDepth32F:
    made = ImageDepth32F(width, height)
    made.mutable_data[:] = depth
    made.mutable_data[10:20, 20:30] = 0.8
    return made


def measured(system: DepthNoise, context: Context) -> np.ndarray:
    return system.GetOutputPort("depth_image").Eval(context).data[:, :, 0].copy()


def fixed(system: DepthNoise, value: ImageDepth32F) -> Context:
    context = system.CreateDefaultContext()
    system.GetInputPort("depth_image").FixValue(context, Value(value))
    return context


def test_gives_what_the_function_gives_at_the_time_in_microseconds():
    parameters = CameraNoise(lateral=0.3)
    system = DepthNoise(CAMERA, parameters=parameters, seed=5)
    context = fixed(system, image())
    context.SetTime(1.0 / 30.0)
    expected = add_depth_noise(image().data[:, :, 0], SMALL_K, parameters, seed=5, frame=33333)
    np.testing.assert_array_equal(measured(system, context), expected)


def test_a_frame_is_the_same_again_and_another_one_is_not():
    system = DepthNoise(CAMERA, seed=1)
    context = fixed(system, image())
    first = measured(system, context)
    context.SetTime(0.1)
    second = measured(system, context)
    assert np.mean(first != second) > 0.3
    context.SetTime(0.0)
    np.testing.assert_array_equal(measured(system, context), first)
    clone = context.Clone()
    np.testing.assert_array_equal(measured(system, clone), first)
    clone.SetTime(0.1)
    np.testing.assert_array_equal(measured(system, clone), second)
    other = DepthNoise(CAMERA, seed=2)
    assert np.mean(measured(other, fixed(other, image())) != first) > 0.3


def test_intrinsics_alone_take_any_size():
    system = DepthNoise(SMALL_K)
    assert measured(system, fixed(system, image())).shape == (48, 64)
    assert measured(system, fixed(system, image(width=32, height=40))).shape == (40, 32)


def test_the_input_is_left_as_it_was():
    system = DepthNoise(CAMERA)
    context = fixed(system, image())
    measured(system, context)
    np.testing.assert_array_equal(
        system.GetInputPort("depth_image").Eval(context).data, image().data
    )


def test_pulls_its_input_once_an_instant_and_not_unasked():
    pulls = []

    class Camera(LeafSystem):
        def __init__(self) -> None:
            super().__init__()
            self.DeclareAbstractOutputPort(
                "depth_image", lambda: Value(ImageDepth32F(64, 48)), self._render
            )

        def _render(self, context, output):
            pulls.append(context.get_time())
            output.set_value(image())

    builder = DiagramBuilder()
    camera, noise = builder.AddSystem(Camera()), builder.AddSystem(DepthNoise(CAMERA))
    builder.Connect(camera.get_output_port(), noise.get_input_port())
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    assert pulls == []
    for time in (0.0, 0.1):
        context.SetTime(time)
        for _ in range(3):
            measured(noise, noise.GetMyContextFromRoot(context))
    assert pulls == [0.0, 0.1]


def test_bad_arguments_and_inputs_are_named():
    with pytest.raises(ValueError, match="K must be"):
        DepthNoise([1.0, 2.0])
    with pytest.raises(ValueError, match="seed must lie in"):
        DepthNoise(CAMERA, seed=-1)
    system = DepthNoise(CAMERA)
    with pytest.raises(RuntimeError, match="depth_image"):
        measured(system, system.CreateDefaultContext())


@pytest.mark.parametrize("seed", [0, 1])
def test_perception_sees_the_noisy_image_of_the_scenario_s_seed(seed):
    scenario = load_scenario("tabletop_box", [f"seed={seed}"])
    # Late images come with their noise: tests/world/test_late_camera.py.
    scenario.cameras[0].output_delay = 0.0
    diagram = build_avoidance(scenario)
    context = diagram.CreateDefaultContext()
    perception = diagram.GetSubsystemByName("perception")
    noise = diagram.GetSubsystemByName("depth_noise")
    seen = perception.GetInputPort("depth_image").Eval(perception.GetMyContextFromRoot(context))
    true = noise.GetInputPort("depth_image").Eval(noise.GetMyContextFromRoot(context)).data
    _, camera = scenario.cameras[0].MakeCameras()
    info = camera.core().intrinsics()
    K = [info.focal_x(), info.focal_y(), info.center_x(), info.center_y()]
    expected = add_depth_noise(true[:, :, 0], K, seed=seed, frame=0)
    np.testing.assert_array_equal(seen.data[:, :, 0], expected)


def test_an_ideal_camera_has_no_noise():
    diagram = build_avoidance(load_scenario("tabletop_box", ["perception.noise=null"]))
    assert not diagram.HasSubsystemNamed("depth_noise")
