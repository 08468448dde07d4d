"""The system between camera and perception."""

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem
from pydrake.systems.sensors import CameraInfo, ImageDepth32F

from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.scenario.camera_noise import DepthNoiseParameters
from drake_oa.scenario.loading import load_scenario
from drake_oa.world.depth_noise import add_depth_noise
from drake_oa.world.depth_noise_system import DepthNoise

CAMERA = CameraInfo(64, 48, 570.0, 580.0, 31.5, 23.5)
K = [570.0, 580.0, 31.5, 23.5]


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
    parameters = DepthNoiseParameters(lateral=0.3)
    system = DepthNoise(CAMERA, parameters=parameters, seed=5)
    context = fixed(system, image())
    context.SetTime(1.0 / 30.0)
    expected = add_depth_noise(image().data[:, :, 0], K, parameters, seed=5, frame=33333)
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
    system = DepthNoise(K)
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
