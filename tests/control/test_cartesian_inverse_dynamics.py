"""The control layer alone, and in a loop with a simulated Panda."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RollPitchYaw, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, LeafSystem, TriggerType
from pydrake.systems.primitives import LogVectorOutput, ZeroOrderHold

from drake_oa.control.cartesian_inverse_dynamics import (
    LARGEST_ACCELERATION,
    LARGEST_ERROR,
    CartesianInverseDynamics,
)
from drake_oa.geometry.rotation import rotation_vector
from drake_oa.robot.config import Gains

START, GOAL = np.array([0.45, -0.4, 0.3]), np.array([0.45, 0.4, 0.3])
TOOL = "panda_hand_tcp"
Q_ARM = np.array([-0.7401, 0.1857, 0.0143, -1.9017, -0.003, 2.0874, 0.0608])
Q_START = np.append(Q_ARM, [0.04, 0.04])
EFFORT = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
DOWN = RollPitchYaw(np.pi, 0.0, 0.0).ToRotationMatrix()
REST = np.zeros(3)

Motion = Callable[[float], tuple[np.ndarray, np.ndarray, np.ndarray]]


def panda(plant: MultibodyPlant, *, weld: bool = True) -> MultibodyPlant:
    parser = Parser(plant)
    models = Path(str(resources.files("drake_oa.models")))
    parser.package_map().AddPackageXml(str(models / "package.xml"))
    parser.AddModels(url="package://drake_oa/panda/panda_arm_hand.urdf")
    if weld:
        plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("panda_link0"))
    plant.Finalize()
    return plant


@pytest.fixture(scope="module")
def model() -> MultibodyPlant:
    return panda(MultibodyPlant(0.0))


@pytest.fixture(scope="module")
def controller(model: MultibodyPlant) -> CartesianInverseDynamics:
    return CartesianInverseDynamics(model, R_WE_desired=DOWN, q_posture=Q_ARM, tool_frame=TOOL)


def fixed(
    system: CartesianInverseDynamics,
    *,
    q: np.ndarray = Q_START,
    v: np.ndarray | None = None,
    p: np.ndarray = START,
    dp: np.ndarray = REST,
    ddp: np.ndarray = REST,
) -> Context:
    context = system.CreateDefaultContext()
    x = np.concatenate([q, np.zeros(9) if v is None else v])
    system.GetInputPort("robot_state").FixValue(context, x)
    system.GetInputPort("desired_position").FixValue(context, p)
    system.GetInputPort("desired_velocity").FixValue(context, dp)
    system.GetInputPort("desired_acceleration").FixValue(context, ddp)
    return context


def read(system: CartesianInverseDynamics, name: str, context: Context) -> np.ndarray:
    return np.array(system.GetOutputPort(name).Eval(context))


def test_five_lines_evaluate_it_alone(model: MultibodyPlant) -> None:
    system = CartesianInverseDynamics(model, R_WE_desired=DOWN, q_posture=Q_START, tool_frame=TOOL)
    context = fixed(system)
    assert read(system, "actuation", context).shape == (9,)
    assert read(system, "torque_saturation", context) == 0.0
    assert read(system, "stopping", context) == 0.0
    np.testing.assert_allclose(read(system, "tracking_error", context), 0.0, atol=1e-4)


def test_the_torque_gives_the_asked_tool_acceleration(
    model: MultibodyPlant, controller: CartesianInverseDynamics
) -> None:
    random = np.random.default_rng(0)
    v = np.append(0.3 * random.normal(size=7), [0.0, 0.0])
    asked = np.array([0.3, -0.2, 0.5])
    context = fixed(controller, v=v, ddp=asked)
    plant = model.CreateDefaultContext()
    model.SetPositionsAndVelocities(plant, np.concatenate([Q_START, v]))
    frame = model.GetFrameByName(TOOL)
    V = frame.CalcSpatialVelocityInWorld(plant)
    X = frame.CalcPoseInWorld(plant)
    model.get_actuation_input_port().FixValue(plant, read(controller, "actuation", context))
    model.get_applied_generalized_force_input_port().FixValue(plant, np.zeros(9))
    A = frame.CalcSpatialAccelerationInWorld(plant)
    wanted = asked - 40.0 * V.translational() + 400.0 * (START - X.translation())
    e = rotation_vector(np.ascontiguousarray((DOWN @ X.rotation().inverse()).matrix()))
    turning = 400.0 * e - 40.0 * V.rotational()
    # The law takes the fingers, of 15 g each, as fixed to the hand: hence one per cent.
    assert np.linalg.norm(A.translational() - wanted) < 0.01 * np.linalg.norm(wanted)
    assert np.linalg.norm(A.rotational() - turning) < 0.01 * np.linalg.norm(turning)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_desired_position_that_is_not_finite_brakes(
    model: MultibodyPlant, controller: CartesianInverseDynamics, bad: float
) -> None:
    context = fixed(controller, p=np.array([0.4, bad, 0.3]))
    plant = model.CreateDefaultContext()
    model.SetPositions(plant, Q_START)
    gravity = model.CalcGravityGeneralizedForces(plant)
    np.testing.assert_allclose(read(controller, "actuation", context)[:7], -gravity[:7], atol=1e-9)
    assert read(controller, "stopping", context) == 1.0
    assert read(controller, "torque_saturation", context) == 0.0
    assert np.isinf(read(controller, "tracking_error", context)).all()


@pytest.mark.parametrize("index", [0, 7, 9, 17])
def test_a_state_that_is_not_finite_gives_no_arm_torque(
    controller: CartesianInverseDynamics, index: int
) -> None:
    context = fixed(controller)
    x = np.append(Q_START, np.zeros(9))
    x[index] = np.nan
    controller.GetInputPort("robot_state").FixValue(context, x)
    tau = read(controller, "actuation", context)
    assert np.isfinite(tau).all()
    np.testing.assert_array_equal(tau[:7], 0.0)
    assert read(controller, "stopping", context) == 1.0


def test_wrong_arguments_say_what_is_valid(model: MultibodyPlant) -> None:
    def make(plant: MultibodyPlant = model, **changes: object) -> None:
        options = {"R_WE_desired": DOWN, "q_posture": Q_ARM, "tool_frame": TOOL}
        CartesianInverseDynamics(plant, **(options | changes))

    with pytest.raises(ValueError, match="no frame 'gripper'"):
        make(tool_frame="gripper")
    with pytest.raises(ValueError, match="must hold 7"):
        make(q_posture=np.zeros(5))
    with pytest.raises(ValueError, match="must hold 7"):
        make(q_posture=np.full(7, np.nan))
    with pytest.raises(ValueError, match="finger"):
        make(finger_opening=np.nan)
    with pytest.raises(ValueError, match=r"16000 must be below .* 16000"):
        Gains(ki_position=16000.0)
    with pytest.raises(ValueError, match="Finalize"):
        make(MultibodyPlant(0.0))
    with pytest.raises(ValueError, match="welded to the world"):
        make(panda(MultibodyPlant(0.0), weld=False))
    with pytest.raises(ValueError, match="joints that move 'panda_link0'"):
        make(tool_frame="panda_link0")


class _Source(LeafSystem):
    """Desired motion as functions of time."""

    def __init__(self, motion: Motion) -> None:
        super().__init__()

        def calc(order: int) -> Callable[[Context, BasicVector], None]:
            return lambda context, out: out.SetFromVector(motion(context.get_time())[order])

        for order, name in enumerate(("position", "velocity", "acceleration")):
            self.DeclareVectorOutputPort(
                f"desired_{name}", 3, calc(order), prerequisites_of_calc={self.time_ticket()}
            )


def minimum_jerk(*points: np.ndarray, duration: float) -> Motion:
    """From point to point, at rest in each, then held in the last."""

    def motion(t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        leg = min(int(t / duration), len(points) - 2)
        a, b = points[leg], points[leg + 1]
        s = min(t / duration - leg, 1.0)
        return (
            a + (b - a) * (10 * s**3 - 15 * s**4 + 6 * s**5),
            (b - a) * (30 * s**2 - 60 * s**3 + 30 * s**4) / duration,
            (b - a) * (60 * s - 180 * s**2 + 120 * s**3) / duration**2,
        )

    return motion


@dataclass
class Run:
    """What a simulation did, sampled each 10 ms."""

    tau: np.ndarray  # (9, T)
    saturated: np.ndarray  # (T,)
    distance: np.ndarray  # (T,) of the tool from the motion asked for [m]
    angle: np.ndarray  # (T,) of the tool from DOWN [rad]
    speed: np.ndarray  # (T,) fastest joint [rad/s]
    fingers: np.ndarray  # (2,) at the end


def simulate(
    model: MultibodyPlant,
    motion: Motion,
    duration: float,
    *,
    hold: float = 0.0,
    ki: float = 0.0,
    gravity: float = 9.81,
) -> Run:
    builder = DiagramBuilder()
    plant = builder.AddSystem(MultibodyPlant(0.001))
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -gravity])
    panda(plant)
    gains = Gains(ki_position=ki)
    law = CartesianInverseDynamics(
        model, R_WE_desired=DOWN, q_posture=Q_ARM, tool_frame=TOOL, gains=gains
    )
    system = builder.AddSystem(law)
    source = builder.AddSystem(_Source(motion))
    for name in ("desired_position", "desired_velocity", "desired_acceleration"):
        port = source.GetOutputPort(name)
        if hold > 0.0:
            held = builder.AddSystem(ZeroOrderHold(hold, 3))
            builder.Connect(port, held.get_input_port())
            port = held.get_output_port()
        builder.Connect(port, system.GetInputPort(name))
    builder.Connect(plant.get_state_output_port(), system.GetInputPort("robot_state"))
    builder.Connect(system.GetOutputPort("actuation"), plant.get_actuation_input_port())
    triggers = {TriggerType.kPeriodic}
    sinks = [
        LogVectorOutput(port, builder, publish_triggers=triggers, publish_period=0.01)
        for port in (
            plant.get_state_output_port(),
            system.GetOutputPort("actuation"),
            system.GetOutputPort("torque_saturation"),
        )
    ]
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    plant.SetPositions(plant.GetMyMutableContextFromRoot(context), Q_START)
    simulator.AdvanceTo(duration)
    logs = [sink.FindLog(context) for sink in sinks]
    x = logs[0].data()
    distance, angle = [], []
    probe = model.CreateDefaultContext()
    frame = model.GetFrameByName(TOOL)
    for t, state in zip(logs[0].sample_times(), x.T, strict=True):
        model.SetPositionsAndVelocities(probe, state)
        X_WE = frame.CalcPoseInWorld(probe)
        distance.append(np.linalg.norm(motion(t)[0] - X_WE.translation()))
        angle.append((DOWN @ X_WE.rotation().inverse()).ToAngleAxis().angle())
    return Run(
        tau=logs[1].data(),
        saturated=logs[2].data()[0],
        distance=np.array(distance),
        angle=np.array(angle),
        speed=np.abs(x[9:16]).max(axis=0),
        fingers=x[7:9, -1],
    )


def test_it_holds_a_position(model: MultibodyPlant) -> None:
    run = simulate(model, lambda t: (START, REST, REST), 0.8)
    assert run.distance[-1] < 1e-6
    assert run.angle[-1] < 1e-6
    assert run.saturated.sum() == 0
    np.testing.assert_allclose(run.fingers, 0.04, atol=1e-4)


@pytest.mark.parametrize(
    "via",
    [(), ([0.45, 0.0, 0.6],), ([0.25, 0.0, 0.3],), ([0.75, 0.0, 0.3],)],
    ids=["straight", "up", "inward", "outward"],
)
def test_it_tracks_the_table_top_task_and_its_detours(
    model: MultibodyPlant, via: tuple[list[float], ...]
) -> None:
    points = [START, *map(np.array, via), GOAL]
    run = simulate(model, minimum_jerk(*points, duration=2.4 / (len(points) - 1)), 2.4)
    assert run.distance.max() < 5e-4
    assert run.angle.max() < np.radians(0.1)
    assert run.saturated.sum() == 0


@pytest.mark.parametrize("hold", [0.002, 0.005])
def test_it_is_stable_with_held_inputs(model: MultibodyPlant, hold: float) -> None:
    run = simulate(model, minimum_jerk(START, GOAL, duration=1.2), 1.4, hold=hold)
    # A held position is late by half the hold on average; peak speed is 1.25 m/s.
    assert run.distance.max() < 1.25 * hold
    assert run.distance[-1] < 1e-4
    # A hold puts out zeros until its first update.
    assert run.saturated[1:].sum() == 0


def test_a_goal_out_of_reach_stays_bounded(model: MultibodyPlant) -> None:
    run = simulate(model, minimum_jerk(START, np.array([1.1, 0.2, 0.3]), duration=1.5), 2.5)
    assert np.isfinite(run.tau).all()
    assert np.all(np.abs(run.tau[:7]) <= EFFORT[:, None])
    assert run.distance[-1] == pytest.approx(0.22, abs=0.01)
    assert run.speed[-1] < 0.05


def test_a_violent_step_is_flagged_limited_and_still_arrives(model: MultibodyPlant) -> None:
    run = simulate(model, lambda t: (GOAL, REST, REST), 1.5)
    assert run.saturated.sum() > 0
    assert np.all(np.abs(run.tau[:7]) <= EFFORT[:, None])
    assert run.distance[-1] < 1e-3


def test_a_motion_that_turns_nan_stops_the_arm(model: MultibodyPlant) -> None:
    moving = minimum_jerk(START, GOAL, duration=2.0)
    lost = np.full(3, np.nan)
    run = simulate(model, lambda t: moving(t) if t < 0.6 else (lost, lost, lost), 1.6)
    assert np.isfinite(run.tau).all()
    assert run.speed[59] > 0.3
    assert run.speed[-1] < 1e-3


@pytest.mark.parametrize(("ki", "error"), [(0.0, 0.81 / 400.0), (1000.0, 0.0)])
def test_the_integral_removes_the_error_of_a_wrong_model(
    model: MultibodyPlant, ki: float, error: float
) -> None:
    run = simulate(model, lambda t: (START, REST, REST), 3.0, ki=ki, gravity=9.0)
    assert run.distance[-1] == pytest.approx(error, rel=0.1, abs=1e-6)


@pytest.mark.parametrize(
    ("error", "added"),
    [
        (0.9 * LARGEST_ERROR, LARGEST_ACCELERATION),
        (1.1 * LARGEST_ERROR, 0.0),
        (np.inf, 0.0),
        (np.nan, 0.0),
    ],
)
def test_a_tool_that_is_held_back_does_not_gather_force(
    controller: CartesianInverseDynamics, error: float, added: float
) -> None:
    at = START - read(controller, "tracking_error", fixed(controller))
    context = fixed(controller, p=at + [error, 0.0, 0.0])
    for _ in range(40):
        context.SetDiscreteState(controller.EvalUniquePeriodicDiscreteUpdate(context).value())
    correction = context.get_discrete_state_vector().value()
    np.testing.assert_allclose(correction, [0.0, 0.0, 0.0, added, 0.0, 0.0], atol=1e-9)


# The orientation and posture asked for by port.


def asked(controller: CartesianInverseDynamics, context: Context, **ports: np.ndarray) -> Context:
    for name, value in ports.items():
        controller.GetInputPort(name).FixValue(context, value)
    return context


@pytest.mark.parametrize("factor", [1.0, -1.0, -7.5, 1e-180])
def test_the_orientation_is_the_quaternions_of_any_sign_and_length(
    model: MultibodyPlant, controller: CartesianInverseDynamics, factor: float
) -> None:
    R = RollPitchYaw(2.9, 0.1, 0.3).ToRotationMatrix()
    reference = CartesianInverseDynamics(model, R_WE_desired=R, q_posture=Q_ARM, tool_frame=TOOL)
    context = asked(
        controller, fixed(controller), desired_orientation=factor * R.ToQuaternion().wxyz()
    )
    np.testing.assert_allclose(
        read(controller, "actuation", context),
        read(reference, "actuation", fixed(reference)),
        atol=1e-9,
    )


@pytest.mark.parametrize(
    ("name", "bad"),
    [
        ("desired_orientation", np.zeros(4)),
        ("desired_orientation", np.array([1.0, np.nan, 0.0, 0.0])),
        ("desired_orientation", np.array([np.inf, 0.0, 0.0, 0.0])),
        ("desired_angular_velocity", np.array([0.0, np.nan, 0.0])),
        ("desired_angular_acceleration", np.array([0.0, 0.0, np.inf])),
        ("desired_posture", np.append(np.zeros(13), np.nan)),
        ("desired_posture", np.append(np.inf, np.zeros(13))),
    ],
)
def test_what_is_asked_and_not_finite_brakes(
    controller: CartesianInverseDynamics, name: str, bad: np.ndarray
) -> None:
    context = asked(controller, fixed(controller), **{name: bad})
    assert read(controller, "stopping", context) == 1.0
    assert np.isfinite(read(controller, "actuation", context)).all()
    assert np.isinf(read(controller, "orientation_error", context)).all()


def test_angular_rates_are_fed_forward(
    model: MultibodyPlant, controller: CartesianInverseDynamics
) -> None:
    w_d, alpha_d = np.array([0.1, -0.3, 0.2]), np.array([1.0, 2.0, -1.5])
    context = asked(
        controller,
        fixed(controller),
        desired_angular_velocity=w_d,
        desired_angular_acceleration=alpha_d,
    )
    plant = model.CreateDefaultContext()
    model.SetPositions(plant, Q_START)
    frame = model.GetFrameByName(TOOL)
    model.get_actuation_input_port().FixValue(plant, read(controller, "actuation", context))
    model.get_applied_generalized_force_input_port().FixValue(plant, np.zeros(9))
    turning = frame.CalcSpatialAccelerationInWorld(plant).rotational()
    R = frame.CalcPoseInWorld(plant).rotation()
    e = rotation_vector(np.ascontiguousarray((DOWN @ R.inverse()).matrix()))
    wanted = 400.0 * e + 40.0 * w_d + alpha_d
    assert np.linalg.norm(turning - wanted) < 0.01 * np.linalg.norm(wanted)
    np.testing.assert_allclose(read(controller, "orientation_error", context), e, atol=1e-12)


@pytest.mark.parametrize("yaw", [0.3, -1.2, 2.0])
def test_a_cell_turned_about_the_vertical_gets_the_same_torques(
    controller: CartesianInverseDynamics, yaw: float
) -> None:
    tilted = RollPitchYaw(2.9, 0.1, 0.3).ToRotationMatrix()
    w, alpha = np.array([0.1, -0.3, 0.2]), np.array([1.0, 2.0, -1.5])
    torques = []
    for angle in (0.0, yaw):
        turn = RotationMatrix.MakeZRotation(angle)
        q = Q_START.copy()
        q[0] = angle
        context = asked(
            controller,
            fixed(controller, q=q, p=turn @ START),
            desired_orientation=(turn @ tilted).ToQuaternion().wxyz(),
            desired_angular_velocity=turn @ w,
            desired_angular_acceleration=turn @ alpha,
            desired_posture=np.append(np.append(angle, Q_ARM[1:]), np.zeros(7)),
        )
        torques.append(read(controller, "actuation", context))
    np.testing.assert_allclose(torques[1], torques[0], atol=1e-8)
