"""The orientation's action layer alone, and beside the position's."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource

from drake_oa.common.messages import FloatArray, PolicyState
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

START = RollPitchYaw(np.pi, 0.0, 0.0).ToRotationMatrix().matrix()
GOAL = RollPitchYaw(np.pi - 0.4, 0.1, 0.7).ToRotationMatrix().matrix()
PRIMITIVE = minimum_jerk_orientation()
PERIOD = 0.008


def alone(**changes: object) -> OrientationIntegrator:
    return OrientationIntegrator(PRIMITIVE, START, GOAL, period=PERIOD, **changes)


def read(system: LeafSystem, name: str, context: Context) -> FloatArray:
    return np.array(system.GetOutputPort(name).Eval(context))


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
            rows.append([*(read(system, n, context) for n in names), [state.phase, state.speed]])
        self.q, self.w, self.alpha, policy_state = (np.array(c) for c in zip(*rows, strict=True))
        self.phase, self.speed = policy_state.T


def test_five_lines_evaluate_it_alone() -> None:
    system = alone()
    context = system.CreateDefaultContext()
    system.GetInputPort("policy_state").FixValue(context, Value(PolicyState()))
    R = rotation_matrix(read(system, "desired_orientation", context))
    np.testing.assert_allclose(R, START, atol=1e-12)
    assert not read(system, "desired_angular_velocity", context).any()
    assert not read(system, "desired_angular_acceleration", context).any()


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


class MovingPolicy(LeafSystem):
    """A policy that goes on at a steady rate of normalised time."""

    def __init__(self, speed: float) -> None:
        super().__init__()

        def calc(context: Context, output: AbstractValue) -> None:
            phase = float(PRIMITIVE.dmp.phase(speed * context.get_time()))
            output.set_value(PolicyState(phase=phase, speed=speed, stamp=context.get_time()))

        self.DeclareAbstractOutputPort(
            "policy_state", lambda: Value(PolicyState()), calc, {self.time_ticket()}
        )


class Run:
    """The system with a policy of 4 s."""

    def __init__(self, *, goal: FloatArray | None = None) -> None:
        builder = DiagramBuilder()
        policy = builder.AddSystem(MovingPolicy(0.25))
        self.system = builder.AddSystem(alone())
        self.system.set_name("orientation")
        builder.Connect(policy.get_output_port(), self.system.GetInputPort("policy_state"))
        self.simulator = Simulator(builder.Build())
        self.context = self.system.GetMyMutableContextFromRoot(self.simulator.get_mutable_context())
        if goal is not None:
            self.fix("goal_orientation", goal)

    def fix(self, name: str, value: FloatArray) -> None:
        self.system.GetInputPort(name).FixValue(self.context, value)

    def read(self, name: str) -> FloatArray:
        return read(self.system, name, self.context)

    def orientation(self) -> FloatArray:
        return rotation_matrix(self.read("desired_orientation"))


def test_a_new_goal_is_reached_without_a_jump() -> None:
    run = Run()
    run.simulator.AdvanceTo(2.0)
    q, w = run.read("desired_orientation"), run.read("desired_angular_velocity")
    other = RollPitchYaw(np.pi, -0.2, -0.5).ToRotationMatrix()
    # Of either sign, as a source may give it.
    run.fix("goal_orientation", -other.ToQuaternion().wxyz())
    np.testing.assert_array_equal(run.read("desired_orientation"), q)
    before = rotation_matrix(q)
    for t in np.arange(2.0, 2.1, 0.002):
        run.simulator.AdvanceTo(t)
        after, rate = run.orientation(), run.read("desired_angular_velocity")
        assert np.linalg.norm(goal_vector(before, after)) < 0.005
        assert np.linalg.norm(rate - w) < 0.1
        before, w = after, rate
    run.simulator.AdvanceTo(6.0)
    assert np.linalg.norm(goal_vector(run.orientation(), other.matrix())) < 1e-3


@pytest.mark.parametrize("bad", [np.zeros(4), np.array([1.0, np.nan, 0.0, 0.0])])
def test_a_goal_that_is_no_rotation_is_refused_by_name(bad: FloatArray) -> None:
    with pytest.raises(ValueError, match="orientation: goal_orientation: a quaternion must be"):
        Run(goal=bad).simulator.AdvanceTo(0.1)


def test_a_cloned_context_goes_on_in_the_same_way() -> None:
    diagram = beside()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(1.0)
    other = Simulator(diagram, simulator.get_context().Clone())
    system = diagram.GetSubsystemByName("orientation")
    for t in (1.1, 1.7, 2.5):
        simulator.AdvanceTo(t)
        other.AdvanceTo(t)
        one, two = (system.GetMyContextFromRoot(s.get_context()) for s in (simulator, other))
        np.testing.assert_allclose(
            read(system, "desired_orientation", one),
            read(system, "desired_orientation", two),
            atol=1e-9,
        )


def test_another_value_on_the_policy_port_is_refused() -> None:
    system = alone()
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.GetInputPort("policy_state").FixValue(context, Value([1.0]))
    with pytest.raises(TypeError, match="must be a PolicyState"):
        simulator.AdvanceTo(0.1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"period": 0.0}, "period"),
        ({"start": np.zeros((3, 3))}, "start must be a rotation matrix"),
        ({"goal": np.eye(4)}, "goal must be a rotation matrix"),
        ({"goal": START @ np.diag([-1.0, -1.0, 1.0])}, "half a turn apart"),
    ],
)
def test_wrong_arguments_say_what_is_valid(changes: dict[str, object], message: str) -> None:
    arguments: dict[str, object] = {"start": START, "goal": GOAL, "period": PERIOD} | changes
    with pytest.raises(ValueError, match=message):
        OrientationIntegrator(PRIMITIVE, **arguments)
