"""The operational-space law on arrays: what holds whatever the arm."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drake_oa.control.operational_space import (
    ArmLimits,
    ArmState,
    DesiredMotion,
    JointTorque,
    braking_torque,
    no_torque,
    operational_space_torque,
)
from drake_oa.control.operational_space_kernels import damped_task_force, limit_torque
from drake_oa.robot.config import Gains

N = 7
SEEDS = st.integers(0, 2**31 - 1)
WIDE = ArmLimits(np.full(N, -3.0), np.full(N, 3.0), np.full(N, 1e9))


def arm(seed: int, *, rank: int = 6) -> ArmState:
    """A random arm whose Jacobian has the given rank."""
    random = np.random.default_rng(seed)
    root = random.normal(size=(N, N))
    U, s, Vt = np.linalg.svd(random.normal(size=(6, N)), full_matrices=False)
    s = np.clip(s, 0.5, None)
    s[rank:] = 0.0
    return ArmState(
        q=random.uniform(-2.0, 2.0, N),
        v=random.normal(size=N),
        p_WE=random.normal(size=3),
        R_WE=Rotation.random(random_state=random).as_matrix(),
        M=root @ root.T + np.eye(N),
        h=random.normal(size=N),
        J=U @ np.diag(s) @ Vt,
        Jdot_v=random.normal(size=6),
    )


def motion(seed: int) -> DesiredMotion:
    random = np.random.default_rng(seed + 1)
    R = Rotation.random(random_state=random).as_matrix()
    return DesiredMotion(*random.normal(size=(3, 3)), R)


def follow(state: ArmState, desired: DesiredMotion, **gains: float) -> JointTorque:
    return operational_space_torque(
        state, desired, np.zeros(N), WIDE, Gains(**({"max_effective_mass": 1e9} | gains))
    )


def acceleration(state: ArmState, torque: JointTorque) -> np.ndarray:
    """(6,) what the tool then does."""
    return state.J @ np.linalg.solve(state.M, torque.tau - state.h) + state.Jdot_v


@given(SEEDS)
@settings(max_examples=50, deadline=None)
def test_the_tool_accelerates_as_asked(seed: int) -> None:
    state, desired = arm(seed), motion(seed)
    torque = follow(state, desired)
    V = state.J @ state.v
    error_R = Rotation.from_matrix(desired.R_WE @ state.R_WE.T).as_rotvec()
    asked = np.concatenate(
        [
            400.0 * error_R - 40.0 * V[:3],
            desired.a_WE + 40.0 * (desired.v_WE - V[3:]) + 400.0 * (desired.p_WE - state.p_WE),
        ]
    )
    np.testing.assert_allclose(acceleration(state, torque), asked, rtol=1e-7, atol=1e-6)
    np.testing.assert_allclose(torque.position_error, desired.p_WE - state.p_WE)
    np.testing.assert_allclose(torque.orientation_error, error_R, atol=1e-9)
    assert not torque.saturated.any()
    assert not torque.stopping
    assert torque.singularity == 0.0


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_the_posture_does_not_move_the_tool(seed: int) -> None:
    state, desired = arm(seed), motion(seed)
    soft = acceleration(state, follow(state, desired, kp_posture=0.0, kd_posture=0.0, kp_limit=0.0))
    stiff = acceleration(state, follow(state, desired, kp_posture=900.0, kd_posture=60.0))
    np.testing.assert_allclose(stiff, soft, rtol=1e-6, atol=1e-5)


def test_the_posture_acts_in_the_null_space() -> None:
    state, desired = arm(3), motion(3)
    state = state._replace(v=np.zeros(N))
    off, on = (follow(state, desired, kp_posture=kp, kp_limit=0.0).tau for kp in (0.0, 100.0))
    drift = np.linalg.solve(state.M, on - off)
    # It pulls towards the posture (zero), as far as the tool allows, and not away from it.
    assert drift @ state.M @ state.q < 0.0


@given(SEEDS, st.integers(0, N - 1), st.sampled_from([-1.0, 1.0]))
@settings(max_examples=50, deadline=None)
def test_a_near_joint_limit_repels_in_the_null_space_only(
    seed: int, joint: int, side: float
) -> None:
    state, desired = arm(seed), motion(seed)
    state = state._replace(q=np.where(np.arange(N) == joint, 2.99 * side, 0.0))
    off, on = (
        follow(state, desired, kp_limit=kp, kp_posture=0.0, kd_posture=0.0) for kp in (0.0, 1e3)
    )
    drift = np.linalg.solve(state.M, on.tau - off.tau)
    assert side * drift[joint] <= 1e-9
    np.testing.assert_allclose(
        acceleration(state, on), acceleration(state, off), rtol=1e-6, atol=1e-5
    )


@given(SEEDS, st.integers(3, 5))
@settings(max_examples=30, deadline=None)
def test_a_singular_arm_is_bounded_and_reported(seed: int, rank: int) -> None:
    state, desired = arm(seed, rank=rank), motion(seed)
    torque = follow(state, desired, max_effective_mass=50.0)
    assert np.isfinite(torque.tau).all()
    assert np.abs(torque.tau).max() < 1e7
    assert torque.singularity == pytest.approx(1.0)


def test_damping_leaves_the_regular_directions_alone() -> None:
    inverse_inertia = np.diag([8.0, 8.0, 8.0, 1.0, 0.5, 1e-7])
    asked = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    force, share = damped_task_force(inverse_inertia, asked, 100.0, 0.25)
    done = inverse_inertia @ force
    np.testing.assert_allclose(done[:5], asked[:5], rtol=1e-12)
    assert abs(done[5]) < 1e-4 * asked[5]
    assert share > 0.99


@given(st.floats(1e-6, 1.0))
def test_damping_is_bounded_by_the_heaviest_mass(w: float) -> None:
    inverse_inertia = np.diag([8.0, 8.0, 8.0, 1.0, 1.0, w])
    force, share = damped_task_force(inverse_inertia, np.array([0, 0, 0, 0, 0, 1.0]), 100.0, 0.25)
    assert force[5] <= 100.0 * 4.0 / 3.0 + 1e-9
    assert (share > 0.0) == (w < 0.01)


@given(SEEDS)
@settings(max_examples=100, deadline=None)
def test_limited_torque_keeps_gravity_and_the_direction_of_the_drive(seed: int) -> None:
    random = np.random.default_rng(seed)
    effort = random.uniform(5.0, 20.0, N)
    bias, drive = random.uniform(-0.9, 0.9, N) * effort, 30.0 * random.normal(size=N)
    tau, saturated = limit_torque(bias, drive, effort)
    assert np.all(np.abs(tau) <= effort)
    np.testing.assert_array_equal(saturated, np.abs(bias + drive) > effort)
    factor = (tau - bias) @ drive / (drive @ drive)
    assert 0.0 <= factor <= 1.0
    np.testing.assert_allclose(tau, bias + factor * drive, atol=1e-9)
    if saturated.any():
        assert np.any(np.isclose(np.abs(tau), effort))


def test_a_bias_beyond_its_limit_is_clipped_and_may_be_unloaded() -> None:
    effort = np.array([10.0, 10.0])
    tau, saturated = limit_torque(np.array([12.0, 1.0]), np.array([-1.0, 2.0]), effort)
    np.testing.assert_allclose(tau, [10.0, 3.0])
    assert saturated.tolist() == [True, False]
    tau, _ = limit_torque(np.array([12.0, 1.0]), np.array([1.0, 2.0]), effort)
    np.testing.assert_allclose(tau, [10.0, 1.0])


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e308])
@pytest.mark.parametrize("field", ["p_WE", "v_WE", "a_WE"])
def test_a_desired_motion_that_is_not_finite_brakes_the_joints(field: str, bad: float) -> None:
    state = arm(1)
    desired = motion(1)._replace(**{field: np.array([0.0, bad, 0.0])})
    torque = follow(state, desired)
    assert np.isfinite(torque.tau).all()
    assert torque.stopping
    np.testing.assert_allclose(np.linalg.solve(state.M, torque.tau - state.h), -10.0 * state.v)
    assert np.isinf(torque.position_error).all()


def test_a_state_that_is_not_finite_gives_no_torque() -> None:
    state = arm(1)._replace(v=np.full(N, np.nan))
    for torque in (
        follow(state, motion(1)),
        braking_torque(state, WIDE, Gains()),
        no_torque(N),
    ):
        assert torque.stopping
        np.testing.assert_array_equal(torque.tau, np.zeros(N))


def test_limits_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="q_lower"):
        ArmLimits(np.ones(N), np.zeros(N), np.ones(N))
    with pytest.raises(ValueError, match="effort"):
        ArmLimits(np.zeros(N), np.ones(N), np.zeros(N))
