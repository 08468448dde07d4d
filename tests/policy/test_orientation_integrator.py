"""The orientation's action layer alone, and beside the position's."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from pydrake.math import RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import FloatArray
from drake_oa.policy.config import Policy
from drake_oa.policy.dmp import imitate, minimum_jerk, minimum_jerk_orientation, orientation_along
from drake_oa.policy.dmp_integrator import DmpIntegrator
from drake_oa.policy.orientation_integrator import OrientationIntegrator
from tests.builders import read

START = RollPitchYaw(np.pi, 0.0, 0.0).ToRotationMatrix().matrix()
GOAL = RollPitchYaw(np.pi - 0.4, 0.1, 0.7).ToRotationMatrix().matrix()
PRIMITIVE = minimum_jerk_orientation()
PERIOD, STEP = 0.008, 0.002


class Samples(NamedTuple):
    """Outputs every `STEP`, as a controller reads them, and the policy's speed."""

    orientation: Rotation
    q: FloatArray
    w: FloatArray
    alpha: FloatArray
    speed: FloatArray


def beside() -> Diagram:
    """The action levels of the position and of the orientation."""
    builder = DiagramBuilder()
    path, t = minimum_jerk([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], duration=3.0)
    policy = builder.AddNamedSystem(
        "policy", DmpIntegrator(imitate(path, t), np.zeros(3), config=Policy(period=PERIOD))
    )
    system = builder.AddNamedSystem(
        "orientation", OrientationIntegrator(PRIMITIVE, START, GOAL, period=PERIOD)
    )
    builder.Connect(policy.GetOutputPort("policy_state"), system.GetInputPort("policy_state"))
    return builder.Build()


def simulated(
    until: float, speeds: tuple[float, ...] = (1.0,), goals: dict[float, FloatArray] | None = None
) -> Samples:
    """Simulates with a speed scale a second, the last one to the end, and goals from instants."""
    diagram = beside()
    simulator = Simulator(diagram)
    systems = [diagram.GetSubsystemByName(name) for name in ("policy", "orientation")]
    policy, turning = systems
    contexts = [s.GetMyMutableContextFromRoot(simulator.get_mutable_context()) for s in systems]
    policy.GetInputPort("goal").FixValue(contexts[0], np.array([1.0, 0.0, 0.0]))
    rows = []
    for step in range(round(until / STEP)):
        time = step * STEP
        speed = speeds[min(int(time), len(speeds) - 1)]
        policy.GetInputPort("speed_scale").FixValue(contexts[0], np.array([speed]))
        for begin, goal in (goals or {}).items():
            if time >= begin:
                turning.GetInputPort("goal_orientation").FixValue(contexts[1], goal)
        simulator.AdvanceTo(time)
        state = policy.GetOutputPort("policy_state").Eval(contexts[0])
        names = ("orientation", "angular_velocity", "angular_acceleration")
        outputs = (read(turning, contexts[1], f"desired_{name}") for name in names)
        rows.append((*outputs, state.speed))
    q, w, alpha, speed = (np.array(column) for column in zip(*rows, strict=True))
    return Samples(Rotation.from_quat(q, scalar_first=True), q, w, alpha, speed)


@pytest.fixture(scope="module")
def free() -> Samples:
    return simulated(4.0)


def test_it_arrives_with_the_position_and_goes_the_planned_way(free: Samples) -> None:
    s = np.maximum(STEP * np.arange(len(free.q)) - 2 * PERIOD, 0.0) / 3.0
    planned = Rotation.from_matrix(orientation_along(PRIMITIVE, START, GOAL, s))
    assert (free.orientation.inv() * planned).magnitude().max() < 1e-3
    assert (free.orientation[1500].inv() * Rotation.from_matrix(GOAL)).magnitude() < 1e-3
    assert np.linalg.norm(free.w[1500]) < 2e-3


def assert_consistent(run: Samples) -> None:
    """The quaternion is smooth, and the rates are its derivatives."""
    assert (np.einsum("ti,ti->t", run.q[1:], run.q[:-1]) > 0.9).all()
    slope = (run.orientation[1:] * run.orientation[:-1].inv()).as_rotvec() / STEP
    mean = 0.5 * (run.w[1:] + run.w[:-1])
    assert np.abs(slope - mean).max() < 2e-5 * max(1.0, np.abs(run.w).max())
    # Acceleration is linear but at the steps of the policy, which come after its samples.
    rise, mean = np.diff(run.w, axis=0) / STEP, 0.5 * (run.alpha[1:] + run.alpha[:-1])
    inside = np.ones(len(rise), dtype=bool)
    inside[0::4] = False
    assert np.abs(rise - mean)[inside].max() < 2e-3 * max(1.0, np.abs(run.alpha).max())


def test_rates_are_the_derivatives(free: Samples) -> None:
    assert_consistent(free)


def test_a_hold_stops_the_orientation_and_then_it_goes_on() -> None:
    run = simulated(6.0, (1.0, 0.0, 0.5, 1.0))
    # All of it but the policy's last step before.
    at_rest = np.flatnonzero(run.speed == 0.0)[10:-5]
    assert len(at_rest) > 285
    assert np.abs(run.w[at_rest]).max() == 0.0
    assert np.ptp(run.q[at_rest], axis=0).max() == 0.0
    assert (run.orientation[-1].inv() * Rotation.from_matrix(GOAL)).magnitude() < 1e-3
    assert_consistent(run)


def test_a_new_goal_is_reached_without_a_jump() -> None:
    other = RollPitchYaw(np.pi, -0.2, -0.5).ToRotationMatrix()
    # Of either sign, as a source may give it.
    run = simulated(6.0, goals={1.5: -other.ToQuaternion().wxyz()})
    assert (run.orientation[1:].inv() * run.orientation[:-1]).magnitude().max() < 0.005
    assert np.linalg.norm(np.diff(run.w, axis=0), axis=1).max() < 0.15
    assert (run.orientation[-1].inv() * Rotation.from_matrix(other.matrix())).magnitude() < 1e-3
