"""The orientation's action layer alone, and beside the position's."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from pydrake.math import RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource

from drake_oa.common.messages import FloatArray
from drake_oa.policy.config import Policy
from drake_oa.policy.dmp import imitate, minimum_jerk
from drake_oa.policy.dmp_integrator import DmpIntegrator
from drake_oa.policy.orientation_dmp import (
    goal_vector,
    minimum_jerk_orientation,
    orientation_along,
    rotation_matrix,
)
from drake_oa.policy.orientation_integrator import OrientationIntegrator
from tests.builders import read

START = RollPitchYaw(np.pi, 0.0, 0.0).ToRotationMatrix().matrix()
GOAL = RollPitchYaw(np.pi - 0.4, 0.1, 0.7).ToRotationMatrix().matrix()
PRIMITIVE = minimum_jerk_orientation()
PERIOD = 0.008


def alone(**changes: object) -> OrientationIntegrator:
    return OrientationIntegrator(PRIMITIVE, START, GOAL, period=PERIOD, **changes)


def beside(*, speed: FloatArray | None = None) -> Diagram:
    """Position and orientation, the speed scaled by a table of seconds."""

    class Speed(LeafSystem):
        def __init__(self) -> None:
            super().__init__()
            self.DeclareVectorOutputPort("speed", 1, self._calc, {self.time_ticket()})

        def _calc(self, context: Context, output: BasicVector) -> None:
            assert speed is not None
            output[0] = speed[min(int(context.get_time()), len(speed) - 1)]

    builder = DiagramBuilder()
    path, t = minimum_jerk([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], duration=3.0)
    policy = builder.AddNamedSystem(
        "policy", DmpIntegrator(imitate(path, t), np.zeros(3), config=Policy(period=PERIOD))
    )
    goal = builder.AddSystem(ConstantVectorSource(np.array([1.0, 0.0, 0.0])))
    builder.Connect(goal.get_output_port(), policy.GetInputPort("goal"))
    if speed is not None:
        scale = builder.AddSystem(Speed())
        builder.Connect(scale.get_output_port(), policy.GetInputPort("speed_scale"))
    system = builder.AddNamedSystem("orientation", alone())
    builder.Connect(policy.GetOutputPort("policy_state"), system.GetInputPort("policy_state"))
    return builder.Build()


class Samples:
    """What the orientation does in a simulation, each 2 ms as a controller sees it."""

    def __init__(self, diagram: Diagram, until: float, step: float = 0.002) -> None:
        simulator = Simulator(diagram)
        simulator.Initialize()
        system, policy = (diagram.GetSubsystemByName(n) for n in ("orientation", "policy"))
        root = simulator.get_context()
        context, other = system.GetMyContextFromRoot(root), policy.GetMyContextFromRoot(root)
        names = (
            "desired_orientation",
            "desired_angular_velocity",
            "desired_angular_acceleration",
        )
        rows = []
        self.t = np.arange(round(until / step)) * step
        for t in self.t:
            simulator.AdvanceTo(t)
            state = policy.GetOutputPort("policy_state").Eval(other)
            rows.append([*(read(system, context, n) for n in names), [state.phase, state.speed]])
        self.q, self.w, self.alpha, policy_state = (np.array(c) for c in zip(*rows, strict=True))
        self.phase, self.speed = policy_state.T


@pytest.fixture(scope="module")
def free() -> Samples:
    return Samples(beside(), 4.0)


def test_it_arrives_with_the_position_and_goes_the_planned_way(free: Samples) -> None:
    planned = orientation_along(PRIMITIVE, START, GOAL, np.maximum(free.t - 2 * PERIOD, 0.0) / 3.0)
    for q, R in zip(free.q[::25], planned[::25], strict=True):
        assert np.linalg.norm(goal_vector(rotation_matrix(q), R)) < 1e-3
    assert np.linalg.norm(goal_vector(rotation_matrix(free.q[1500]), GOAL)) < 1e-3
    assert np.linalg.norm(free.w[1500]) < 2e-3


def assert_consistent(run: Samples) -> None:
    """The quaternion is smooth, and the rates are its derivatives."""
    assert (np.einsum("ti,ti->t", run.q[1:], run.q[:-1]) > 0.9).all()
    dt = run.t[1] - run.t[0]
    R = [rotation_matrix(q) for q in run.q]
    # Rotation from instant to instant in the world: R_1 R_0^T.
    between = np.array([goal_vector(a.T, b.T) for a, b in pairwise(R)])
    slope = -between / dt
    mean = 0.5 * (run.w[1:] + run.w[:-1])
    assert np.abs(slope - mean).max() < 2e-5 * max(1.0, np.abs(run.w).max())
    # Acceleration is linear but at the steps of the policy, which come after its samples.
    rise, mean = np.diff(run.w, axis=0) / dt, 0.5 * (run.alpha[1:] + run.alpha[:-1])
    inside = np.ones(len(rise), dtype=bool)
    inside[0::4] = False
    assert np.abs(rise - mean)[inside].max() < 2e-3 * max(1.0, np.abs(run.alpha).max())


def test_rates_are_the_derivatives(free: Samples) -> None:
    assert_consistent(free)


def test_a_hold_stops_the_orientation_and_then_it_goes_on() -> None:
    run = Samples(beside(speed=np.array([1.0, 0.0, 0.5, 1.0])), 6.0)
    held = run.speed == 0.0
    # All of it but the policy's last step before.
    assert held.sum() > 300
    at_rest = np.flatnonzero(held)[10:-5]
    assert np.abs(run.w[at_rest]).max() == 0.0
    assert np.ptp(run.q[at_rest], axis=0).max() == 0.0
    assert np.linalg.norm(goal_vector(rotation_matrix(run.q[-1]), GOAL)) < 1e-3
    assert_consistent(run)


def test_a_new_goal_is_reached_without_a_jump() -> None:
    simulator = Simulator(beside())
    system = simulator.get_system().GetSubsystemByName("orientation")
    context = system.GetMyMutableContextFromRoot(simulator.get_mutable_context())

    def desired() -> list[FloatArray]:
        return [read(system, context, f"desired_{n}") for n in ("orientation", "angular_velocity")]

    simulator.AdvanceTo(1.5)
    q, w = desired()
    other = RollPitchYaw(np.pi, -0.2, -0.5).ToRotationMatrix()
    # Of either sign, as a source may give it.
    system.GetInputPort("goal_orientation").FixValue(context, -other.ToQuaternion().wxyz())
    np.testing.assert_array_equal(desired()[0], q)
    for t in np.arange(1.5, 1.6, 0.002):
        simulator.AdvanceTo(t)
        before, (q, rate) = q, desired()
        assert np.linalg.norm(goal_vector(rotation_matrix(before), rotation_matrix(q))) < 0.005
        assert np.linalg.norm(rate - w) < 0.15
        w = rate
    simulator.AdvanceTo(6.0)
    assert np.linalg.norm(goal_vector(rotation_matrix(desired()[0]), other.matrix())) < 1e-3
