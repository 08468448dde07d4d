"""Tests of `OrientationIntegrator` with `DmpIntegrator`: holds, new goals and restarts."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import CouplingParameters, EllipsoidSet, FloatArray
from drake_oa.policy.config import Policy
from drake_oa.policy.dmp import (
    Demonstration,
    imitate,
    imitate_orientation,
    minimum_jerk,
    minimum_jerk_orientation,
    minimum_jerk_profile,
    orientation_along,
)
from drake_oa.policy.dmp_integrator import DmpIntegrator
from drake_oa.policy.orientation_integrator import OrientationIntegrator
from tests.builders import fix, read

START, GOAL = np.array([0.3, -0.4, 0.3]), np.array([0.3, 0.4, 0.3])
R_WS = RollPitchYaw(np.pi, 0.0, 0.0).ToRotationMatrix().matrix()
R_WG = RollPitchYaw(np.pi - 0.4, 0.1, 0.7).ToRotationMatrix().matrix()
PRIMITIVE = minimum_jerk_orientation()
PERIOD, STEP = 0.008, 0.002


class Bench:
    """Simulation of both integrators, whose outputs are sampled every `STEP`."""

    def __init__(self, duration: float, **inputs: object) -> None:
        builder = DiagramBuilder()
        straight = imitate(*minimum_jerk(START, GOAL, duration=duration))
        self.policy = builder.AddSystem(
            DmpIntegrator(straight, START, config=Policy(period=PERIOD))
        )
        self.turning = builder.AddSystem(
            OrientationIntegrator(PRIMITIVE, R_WS, R_WG, period=PERIOD)
        )
        state = self.policy.GetOutputPort("policy_state")
        builder.Connect(state, self.turning.GetInputPort("policy_state"))
        self.simulator, self.steps = Simulator(builder.Build()), 0
        self.fix(goal=GOAL, **inputs)

    def fix(self, **inputs: object) -> None:
        root = self.simulator.get_mutable_context()
        for system in (self.policy, self.turning):
            fix(system, system.GetMyMutableContextFromRoot(root), **inputs)

    def advance(self, end: float) -> tuple[FloatArray, ...]:
        """Returns samples until a time [s].

        They are position, quaternion, angular velocity, angular acceleration, and speed ds/dt.
        """
        rows, root = [], self.simulator.get_context()
        while self.steps < round(end / STEP):
            self.simulator.AdvanceTo(self.steps * STEP)
            self.steps += 1
            policy, turning = (
                system.GetMyContextFromRoot(root) for system in (self.policy, self.turning)
            )
            names = ("orientation", "angular_velocity", "angular_acceleration")
            state = self.policy.GetOutputPort("policy_state").Eval(policy)
            outputs = [read(self.turning, turning, f"desired_{name}") for name in names]
            rows.append((read(self.policy, policy, "desired_position"), *outputs, state.speed))
        return tuple(np.array(column) for column in zip(*rows, strict=True))


def rotations(q: FloatArray) -> Rotation:
    return Rotation.from_quat(q, scalar_first=True)


def off(q: FloatArray, R: FloatArray) -> float:
    """Computes the angle between the last quaternion and an orientation [rad]."""
    return float((rotations(q[-1]).inv() * Rotation.from_matrix(R)).magnitude())


def assert_consistent(q: FloatArray, w: FloatArray, alpha: FloatArray) -> None:
    """Checks that quaternions are continuous, and that the rates are their derivatives."""
    assert (np.einsum("ti,ti->t", q[1:], q[:-1]) > 0.9).all()
    slope = (rotations(q[1:]) * rotations(q[:-1]).inv()).as_rotvec() / STEP
    assert np.abs(slope - 0.5 * (w[1:] + w[:-1])).max() < 2e-5 * max(1.0, np.abs(w).max())
    # Acceleration is linear between two steps of the policy, which follow every fourth sample.
    rise, mean = np.diff(w, axis=0) / STEP, 0.5 * (alpha[1:] + alpha[:-1])
    inside = np.arange(len(rise)) % 4 > 0
    assert np.abs(rise - mean)[inside].max() < 2e-3 * max(1.0, np.abs(alpha).max())


def test_the_orientation_follows_the_primitive_two_periods_late() -> None:
    _, q, w, alpha, _ = Bench(3.0).advance(4.0)
    s = np.maximum(STEP * np.arange(len(q)) - 2 * PERIOD, 0.0) / 3.0
    planned = Rotation.from_matrix(orientation_along(PRIMITIVE, R_WS, R_WG, s))
    assert (rotations(q).inv() * planned).magnitude().max() < 1e-3
    assert off(q, R_WG) < 1e-3
    assert_consistent(q, w, alpha)


def test_a_hold_stops_the_orientation_and_a_new_goal_is_reached_without_a_jump() -> None:
    run, parts = Bench(3.0), []
    other = RollPitchYaw(np.pi, -0.2, -0.5).ToRotationMatrix()
    for second, scale in enumerate((1.0, 0.0, 0.5, 1.0, 1.0, 1.0), 1):
        run.fix(speed_scale=np.array([scale]))
        parts.append(run.advance(second))
        if second == 3:
            # A source may output either sign.
            run.fix(goal_orientation=-other.ToQuaternion().wxyz())
    _, q, w, alpha, speed = (np.concatenate(column) for column in zip(*parts, strict=True))
    # Without the last step before the motion resumes.
    at_rest = np.flatnonzero(speed == 0.0)[10:-5]
    assert len(at_rest) > 285
    assert np.abs(w[at_rest]).max() == 0.0
    assert np.ptp(q[at_rest], axis=0).max() == 0.0
    assert off(q, other.matrix()) < 1e-3
    assert np.linalg.norm(np.diff(w, axis=0), axis=1).max() < 0.15
    assert_consistent(q[:1500], w[:1500], alpha[:1500])


@pytest.mark.parametrize("turned", [np.pi / 3.0, 7.0])
def test_restart_follows_the_new_demonstration(turned: float) -> None:
    """Demonstrates a half circle above the line, with a rotation of up to 400 degrees."""
    t = np.linspace(0.0, 2.0, 201)
    angle, center = np.pi * minimum_jerk_profile(t / 2.0), 0.5 * (START + GOAL)
    path = center + 0.4 * np.column_stack([0.0 * t, -np.cos(angle), np.sin(angle)])
    R = R_WS @ Rotation.from_rotvec(np.outer(turned * angle / np.pi, [0, 0, 1])).as_matrix()
    demo = Demonstration(imitate(path, t), imitate_orientation(R, t), R[0], R[-1], t / 2.0)
    inputs = {"ellipsoids_W": EllipsoidSet(stamp=np.inf), "demonstration": demo}
    restart = CouplingParameters(restart=True, verified=True)
    p, q, *_ = Bench(1.0, coupling_parameters=restart, **inputs).advance(3.5)
    np.testing.assert_allclose(np.linalg.norm(p - center, axis=1), 0.4, atol=5e-3)
    assert p[:, 2].max() > 0.69
    np.testing.assert_allclose(p[-1], GOAL, atol=1e-3)
    assert off(q, R[-1]) < 5e-3
    # Without a restart the demonstration has no effect.
    p, *_ = Bench(1.0, **inputs).advance(1.5)
    np.testing.assert_allclose(p[:, 2], START[2], atol=1e-6)
