"""What arrives from a camera whose images say when they were taken."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import BodyIndex, SpatialInertia
from pydrake.systems.analysis import InitializeParams, Simulator
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, LeafSystem, State
from pydrake.systems.primitives import ConstantValueSource
from pydrake.systems.sensors import CameraInfo, ImageDepth32F

from drake_oa.scenario.faults import (
    CameraDropout,
    CameraFault,
    FrameBurst,
    ModelError,
    NanFrames,
    Push,
    TableMissing,
    TorqueSaturation,
)
from drake_oa.world.fault_systems import CameraFaults, ExternalPush, WeakActuators

PERIOD = 0.1
CAMERA = CameraInfo(8, 6, np.deg2rad(60.0))
DOWN = RigidTransform(RotationMatrix.MakeXRotation(np.pi), [0.0, 0.0, 10.0])


class TimeCamera(LeafSystem):
    """Every pixel's depth, and the robot's only position, is the time [s]; 10 at the left."""

    def __init__(self) -> None:
        super().__init__()
        self.DeclareAbstractOutputPort(
            "depth_image", lambda: Value(ImageDepth32F()), self._calc, {self.time_ticket()}
        )
        self.DeclareVectorOutputPort("robot_state", 2, self._calc_state, {self.time_ticket()})

    def _calc(self, context: Context, output: AbstractValue) -> None:
        image: Any = ImageDepth32F(CAMERA.width(), CAMERA.height())
        image.mutable_data[:] = context.get_time()
        image.mutable_data[:, 0] = 10.0
        output.set_value(image)

    def _calc_state(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector([context.get_time(), 0.0])


class Consumer(LeafSystem):
    """Pulls the three outputs as perception does, and keeps rows (stamp, depth, left, q)."""

    def __init__(self) -> None:
        super().__init__()
        self._image = self.DeclareAbstractInputPort("depth_image", Value(ImageDepth32F()))
        self._stamp = self.DeclareVectorInputPort("image_stamp", 1)
        self._robot = self.DeclareVectorInputPort("robot_state", 2)
        self.rows = self.DeclareAbstractState(Value(()))
        self.DeclareInitializationUnrestrictedUpdateEvent(self._pull)
        self.DeclarePeriodicUnrestrictedUpdateEvent(PERIOD, PERIOD, self._pull)

    def _pull(self, context: Context, state: State) -> None:
        depth = self._image.Eval(context).data[:, :, 0]
        row = (
            float(self._stamp.Eval(context)[0]),
            float(depth[3, 4]),
            float(depth[3, 0]),
            float(self._robot.Eval(context)[0]),
        )
        before = context.get_abstract_state(self.rows).get_value()
        state.get_mutable_abstract_state(self.rows).set_value((*before, row))


def make_simulator(faults: Sequence[CameraFault]) -> tuple[Simulator, Consumer]:
    builder = DiagramBuilder()
    camera = builder.AddSystem(TimeCamera())
    pose = builder.AddSystem(ConstantValueSource(Value(DOWN)))
    system = builder.AddSystem(CameraFaults(faults, CAMERA, num_states=2, period=PERIOD))
    consumer = builder.AddSystem(Consumer())
    builder.Connect(pose.get_output_port(), system.GetInputPort("camera_pose"))
    for name in ("depth_image", "robot_state"):
        builder.Connect(camera.GetOutputPort(name), system.GetInputPort(name))
    for name in ("depth_image", "image_stamp", "robot_state"):
        builder.Connect(system.GetOutputPort(name), consumer.GetInputPort(name))
    return Simulator(builder.Build()), consumer


def pulled(simulator: Simulator, consumer: Consumer) -> np.ndarray:
    context = consumer.GetMyContextFromRoot(simulator.get_context())
    return np.array(context.get_abstract_state(consumer.rows).get_value())


def run(*faults: CameraFault, end: float = 1.05) -> np.ndarray:
    simulator, consumer = make_simulator(faults)
    simulator.AdvanceTo(end)
    return pulled(simulator, consumer)


def test_a_sound_camera_is_passed_on() -> None:
    rows = run(CameraDropout(5.0, 1.0))
    t = np.arange(11) * PERIOD
    np.testing.assert_allclose(rows[:, [0, 1, 3]], np.column_stack([t, t, t]), atol=1e-6)


@pytest.mark.parametrize(
    ("fault", "frames"),
    [
        (CameraDropout(0.3, 0.4), [0, 1, 2, 2, 2, 2, 2, 7, 8, 9, 10]),
        (FrameBurst(0.3, 0.3), [0, 1, 2, 2, 2, 2, 3, 4, 5, 9, 10]),
    ],
)
def test_image_stamp_and_robot_state_belong_together(fault: CameraFault, frames: list[int]) -> None:
    rows = run(fault)
    expected = np.array(frames) * PERIOD
    np.testing.assert_allclose(rows[:, 0], expected)
    np.testing.assert_allclose(rows[:, 1], expected, atol=1e-6)
    np.testing.assert_allclose(rows[:, 3], expected)


def test_a_camera_that_is_dead_from_the_start_shows_nothing() -> None:
    rows = run(CameraDropout(0.0, 0.25))
    assert (rows[:3, 0] == -np.inf).all()
    assert np.isnan(rows[:3, 1]).all()
    np.testing.assert_allclose(rows[3:, 0], np.arange(3, 11) * PERIOD)


def test_a_frame_of_nan_is_new() -> None:
    rows = run(NanFrames(0.3, 0.2))
    np.testing.assert_allclose(rows[:, 0], np.arange(11) * PERIOD)
    assert np.flatnonzero(np.isnan(rows[:, 1])).tolist() == [3, 4]


def test_the_table_goes_and_what_stands_on_it_stays() -> None:
    rows = run(TableMissing(0.4, 2))
    assert np.flatnonzero(np.isnan(rows[:, 2])).tolist() == [4, 5]
    assert np.isfinite(rows[:, 1]).all()


def test_a_late_frame_shows_what_was_wrong_when_it_was_taken() -> None:
    rows = run(FrameBurst(0.3, 0.3), NanFrames(0.4, 0.1))
    late = rows[np.isclose(rows[:, 0], 0.4)]
    assert len(late) == 1
    assert np.isnan(late[0, 1])


def test_a_cloned_context_goes_on_with_the_same_frames() -> None:
    simulator, consumer = make_simulator([FrameBurst(0.3, 0.3)])
    simulator.AdvanceTo(0.55)
    other = Simulator(simulator.get_system(), simulator.get_context().Clone())
    simulator.AdvanceTo(1.05)
    other.Initialize(InitializeParams(suppress_initialization_events=True))
    other.AdvanceTo(1.05)
    np.testing.assert_array_equal(pulled(simulator, consumer), pulled(other, consumer))


PUSH = Push(start=1.0, duration=0.2, force=[1.0, -2.0, 3.0], torque=[0.1, 0.2, 0.3])


@pytest.mark.parametrize(
    ("time", "share"), [(0.0, 0.0), (0.99, 0.0), (1.0, 1.0), (1.19, 1.0), (1.2, 0.0), (9.0, 0.0)]
)
def test_it_acts_while_it_lasts(time: float, share: float) -> None:
    system = ExternalPush([(PUSH, BodyIndex(3))])
    context = system.CreateDefaultContext()
    context.SetTime(time)
    (applied,) = system.get_output_port().Eval(context)
    assert applied.body_index == BodyIndex(3)
    np.testing.assert_array_equal(applied.F_Bq_W.translational(), share * np.array(PUSH.force))
    np.testing.assert_array_equal(applied.F_Bq_W.rotational(), share * np.array(PUSH.torque))


def test_two_pushes_are_two_forces() -> None:
    system = ExternalPush([(PUSH, BodyIndex(3)), (Push(start=5.0), BodyIndex(4))])
    context = system.CreateDefaultContext()
    context.SetTime(5.1)
    forces = [item.F_Bq_W.translational()[1] for item in system.get_output_port().Eval(context)]
    assert forces == [0.0, 20.0]


def test_a_free_body_gets_its_momentum() -> None:
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, time_step=0.002)
    body = plant.AddRigidBody("body", SpatialInertia.SolidSphereWithMass(2.0, 0.1))
    plant.set_gravity_enabled(body.model_instance(), False)
    plant.Finalize()
    push = builder.AddSystem(ExternalPush([(PUSH, body.index())]))
    builder.Connect(push.get_output_port(), plant.get_applied_spatial_force_input_port())
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(1.5)
    context = plant.GetMyContextFromRoot(simulator.get_context())
    v = plant.EvalBodySpatialVelocityInWorld(context, body).translational()
    # Force times duration over mass.
    np.testing.assert_allclose(v, np.array(PUSH.force) * 0.2 / 2.0, rtol=0.02)


def test_there_is_a_push() -> None:
    with pytest.raises(ValueError, match="pushes is empty"):
        ExternalPush([])


LIMITS = np.array([87.0, 12.0, 20.0])
ASKED = np.array([50.0, -11.0, 3.0])


@pytest.mark.parametrize(
    ("time", "given"),
    [(0.9, ASKED), (1.0, [43.5, -6.0, 3.0]), (1.99, [43.5, -6.0, 3.0]), (2.0, ASKED)],
)
def test_torques_are_cut_off_while_the_fault_lasts(time: float, given: np.ndarray) -> None:
    system = WeakActuators([ModelError(), TorqueSaturation(1.0, 1.0, 0.5)], LIMITS)
    context = system.CreateDefaultContext()
    system.get_input_port().FixValue(context, ASKED)
    context.SetTime(time)
    np.testing.assert_array_equal(system.get_output_port().Eval(context), given)


def test_limits_must_be_positive() -> None:
    with pytest.raises(ValueError, match="effort_limits must be"):
        WeakActuators([], np.array([87.0, 0.0]))
