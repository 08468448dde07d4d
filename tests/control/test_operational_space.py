"""Tests of operational-space inverse dynamics on arrays, for random arms."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from drake_oa.control.operational_space import damped_task_force, operational_space_drive
from drake_oa.robot.config import Gains

N = 7
SEEDS = st.integers(0, 2**31 - 1)


def arm(seed: int, rank: int = 6) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draws mass matrix, Jacobian of the given rank, and task acceleration of an arm."""
    random = np.random.default_rng(seed)
    root = random.normal(size=(N, N))
    U, s, Vt = np.linalg.svd(random.normal(size=(6, N)), full_matrices=False)
    s = np.clip(s, 0.5, None) * (np.arange(6) < rank)
    return root @ root.T + np.eye(N), U @ np.diag(s) @ Vt, 100.0 * random.normal(size=6)


@given(SEEDS)
def test_the_task_is_exact_and_the_posture_acts_in_the_null_space(seed: int) -> None:
    M, J, task = arm(seed)
    posture, gains = np.random.default_rng(seed).normal(size=N), Gains(max_effective_mass=1e9)
    drive = operational_space_drive(M, J, task, posture, gains)
    np.testing.assert_allclose(J @ np.linalg.solve(M, drive), task, rtol=1e-7, atol=1e-6)
    drift = drive - operational_space_drive(M, J, task, np.zeros(N), gains)
    # The null-space torque accelerates toward the posture.
    assert drift @ posture > -1e-9


@given(SEEDS, st.integers(3, 5))
def test_a_singular_arm_is_bounded(seed: int, rank: int) -> None:
    gains = Gains(max_effective_mass=50.0)
    assert np.abs(operational_space_drive(*arm(seed, rank), np.zeros(N), gains)).max() < 1e7


@given(st.floats(1e-6, 1.0))
def test_damping_bounds_the_force_and_does_not_affect_other_directions(w: float) -> None:
    inverse_inertia = np.diag([8.0, 8.0, 8.0, 1.0, 0.5, w])
    force = damped_task_force(inverse_inertia, np.ones(6), 100.0, 0.25)
    np.testing.assert_allclose((inverse_inertia @ force)[:5], 1.0, rtol=1e-12)
    assert force[5] <= 100.0 * 4.0 / 3.0 + 1e-9
    assert (force[5] < (1.0 - 1e-12) / w) == (w < 0.01)
