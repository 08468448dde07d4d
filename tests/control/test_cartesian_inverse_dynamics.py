"""Tests of `CartesianInverseDynamics`, alone and in closed loop with a simulated Panda."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from pydrake.math import RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.primitives import Demultiplexer, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from drake_oa.control.cartesian_inverse_dynamics import CartesianInverseDynamics
from drake_oa.control.joint_inverse_dynamics import JointInverseDynamics
from drake_oa.robot.config import Gains, Robot
from drake_oa.robot.plant import RobotPlant, add_robot
from tests.builders import fix, read

START, GOAL = np.array([0.45, -0.4, 0.3]), np.array([0.45, 0.4, 0.3])
Q_START = np.array([-0.7401, 0.1857, 0.0143, -1.9017, -0.003, 2.0874, 0.0608, 0.04, 0.04])
X_START = np.append(Q_START, np.zeros(9))
DOWN = RollPitchYaw(np.pi, 0.0, 0.0).ToRotationMatrix()
TILTED = RollPitchYaw(2.9, 0.1, 0.3).ToRotationMatrix()


def bare_plant(gravity: float = 9.81) -> MultibodyPlant:
    """Returns the plant of the robot without a scene graph."""
    plant = MultibodyPlant(0.001)
    add_robot(plant, Robot())
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -gravity])
    plant.Finalize()
    return plant


@pytest.fixture(scope="module")
def make(panda: RobotPlant) -> Callable[..., CartesianInverseDynamics]:
    def make(R_WE: RotationMatrix = DOWN, **options: object) -> CartesianInverseDynamics:
        more = {"q_posture": Q_START, "tool_frame": panda.tool_frame.name(), **options}
        return CartesianInverseDynamics(panda.plant, R_WE_desired=R_WE, **more)

    return make


def fixed(system: CartesianInverseDynamics, **ports: np.ndarray) -> Context:
    """Returns a context at rest at the start, except for the values of the given ports."""
    context = system.CreateDefaultContext()
    rest = {"robot_state": X_START, "desired_position": START}
    rest |= {f"desired_{name}": np.zeros(3) for name in ("velocity", "acceleration")}
    fix(system, context, **(rest | ports))
    return context


def test_the_torque_causes_the_commanded_acceleration(panda: RobotPlant, make: Callable) -> None:
    system, random = make(), np.random.default_rng(0)
    x = np.concatenate([Q_START, 0.3 * random.normal(size=7), np.zeros(2)])
    w_d, alpha_d, a_d = 0.1 * random.normal(size=(3, 3))
    context = fixed(
        system,
        robot_state=x,
        desired_acceleration=a_d,
        desired_angular_velocity=w_d,
        desired_angular_acceleration=alpha_d,
    )
    plant = bare_plant()
    frame, model = plant.GetFrameByName("panda_hand_tcp"), plant.CreateDefaultContext()
    plant.SetPositionsAndVelocities(model, x)
    V, X = frame.CalcSpatialVelocityInWorld(model), frame.CalcPoseInWorld(model)
    plant.get_actuation_input_port().FixValue(model, read(system, context, "actuation"))
    plant.get_applied_generalized_force_input_port().FixValue(model, np.zeros(9))
    A = frame.CalcSpatialAccelerationInWorld(model)
    turn = (DOWN @ X.rotation().inverse()).ToAngleAxis()
    e = turn.angle() * turn.axis()
    expected = a_d - 40.0 * V.translational() + 400.0 * (START - X.translation())
    expected_alpha = alpha_d + 40.0 * (w_d - V.rotational()) + 400.0 * e
    # The control law ignores that the fingers, of 15 g each, move: hence one per cent.
    assert np.linalg.norm(A.translational() - expected) < 0.01 * np.linalg.norm(expected)
    assert np.linalg.norm(A.rotational() - expected_alpha) < 0.01 * np.linalg.norm(expected_alpha)
    np.testing.assert_allclose(read(system, context, "orientation_error"), e, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "bad"),
    [
        ("desired_position", [0.4, np.inf, 0.3]),
        ("desired_orientation", np.zeros(4)),
        ("desired_orientation", [1.0, np.nan, 0.0, 0.0]),
        ("desired_angular_acceleration", [0.0, 0.0, np.inf]),
        ("desired_posture", np.append(np.zeros(13), np.nan)),
        ("robot_state", np.append(X_START[:-1], np.nan)),
    ],
)
def test_an_input_that_is_not_finite_brakes_the_arm(
    panda: RobotPlant, make: Callable, name: str, bad: np.ndarray, caplog: pytest.LogCaptureFixture
) -> None:
    system, model = make(), panda.plant.CreateDefaultContext()
    context = fixed(system, **{name: np.array(bad)})
    panda.plant.SetPositions(model, Q_START)
    gravity = panda.plant.CalcGravityGeneralizedForces(model)[:7]
    # Without a finite state the torque is 0.
    expected = 0.0 * gravity if name == "robot_state" else -gravity
    np.testing.assert_allclose(read(system, context, "actuation")[:7], expected, atol=1e-9)
    assert read(system, context, "stopping") == 1.0
    Simulator(system, context).AdvanceTo(0.03)
    assert len(caplog.messages) == 1
    assert name in caplog.text or not any(bad)
    for error in ("tracking_error", "orientation_error"):
        assert np.isinf(read(system, context, error)).all()


def test_errors_of_wrong_arguments_name_valid_values(make: Callable) -> None:
    with pytest.raises(ValueError, match=r"16000 must be below .* 16000"):
        Gains(ki_position=16000.0)
    with pytest.raises(ValueError, match="joints that move 'panda_link0'"):
        make(tool_frame="panda_link0")
    plant = MultibodyPlant(0.0)
    plant.AddRigidBody("free")
    plant.Finalize()
    with pytest.raises(ValueError, match="'free' moves without an actuator"):
        JointInverseDynamics(plant, tool_frame="free")


@pytest.mark.parametrize("factor", [1.0, -7.5, 1e-180])
def test_sign_and_length_of_the_desired_quaternion_have_no_effect(
    make: Callable, factor: float
) -> None:
    system, reference = make(), make(TILTED)
    context = fixed(system, desired_orientation=factor * TILTED.ToQuaternion().wxyz())
    expected = read(reference, fixed(reference), "actuation")
    np.testing.assert_allclose(read(system, context, "actuation"), expected, atol=1e-9)


@pytest.mark.parametrize(
    ("points", "ki", "gravity", "largest", "last"),
    [
        # A detour with discontinuous acceleration, and a step that saturates.
        ([START, [0.75, 0.0, 0.3], GOAL], 0.0, 9.81, 6e-3, 1e-4),
        ([GOAL, GOAL], 0.0, 9.81, 1.0, 1e-3),
        # The integral removes the error of a wrong model.
        ([START, START], 1000.0, 9.0, 0.81 / 390.0, 1e-5),
        # A goal out of reach.
        ([START, [1.1, 0.2, 0.3]], 0.0, 9.81, 0.24, 0.24),
    ],
)
def test_tracking_errors_of_a_simulated_arm_are_bounded(
    panda: RobotPlant,
    make: Callable,
    points: list,
    ki: float,
    gravity: float,
    largest: float,
    last: float,
) -> None:
    times, rest = np.linspace(0.0, 2.4, len(points)), np.zeros((3, len(points)))
    motion = PiecewisePolynomial.CubicHermite(times, np.transpose(points), rest)
    builder = DiagramBuilder()
    plant = builder.AddSystem(bare_plant(gravity))
    system = builder.AddSystem(make(gains=Gains(ki_position=ki)))
    source = builder.AddSystem(TrajectorySource(motion, 2, True))
    parts = builder.AddSystem(Demultiplexer(9, 3))
    builder.Connect(source.get_output_port(), parts.get_input_port())
    for order, name in enumerate(("position", "velocity", "acceleration")):
        builder.Connect(parts.get_output_port(order), system.GetInputPort(f"desired_{name}"))
    builder.Connect(plant.get_state_output_port(), system.GetInputPort("robot_state"))
    builder.Connect(system.GetOutputPort("actuation"), plant.get_actuation_input_port())
    simulator = Simulator(builder.Build())
    context = system.GetMyContextFromRoot(simulator.get_context())
    plant.SetPositions(plant.GetMyMutableContextFromRoot(simulator.get_mutable_context()), Q_START)
    errors, saturated = [], []
    for time in np.arange(0.0, 3.0, 0.05):
        simulator.AdvanceTo(time)
        errors.append(np.linalg.norm(read(system, context, "tracking_error")))
        saturated.append(read(system, context, "torque_saturation")[0])
        assert (np.abs(read(system, context, "actuation")) <= panda.limits.effort_limit).all()
    assert max(errors) < largest
    assert errors[-1] < last
    assert any(saturated) == (largest == 1.0)
    arm = plant.GetMyContextFromRoot(simulator.get_context())
    np.testing.assert_allclose(plant.GetPositions(arm)[7:], 0.04, atol=2e-4)
