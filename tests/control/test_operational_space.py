"""The operational-space law on arrays: what holds whatever the arm."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_oa.control.operational_space import damped_task_force, operational_space_drive
from drake_oa.robot.config import Gains

N = 7
SEEDS = st.integers(0, 2**31 - 1)


class Arm(NamedTuple):
    """Random arguments of the law."""

    M: np.ndarray
    J: np.ndarray
    task: np.ndarray

    def drive(
        self,
        posture: np.ndarray | float = 0.0,
        repulsion: np.ndarray | float = 0.0,
        max_mass: float = 1e9,
    ) -> np.ndarray:
        gains, zeros = Gains(max_effective_mass=max_mass), np.zeros(N)
        return operational_space_drive(*self, zeros + posture, zeros + repulsion, gains)

    def acceleration(self, drive: np.ndarray) -> np.ndarray:
        """(6,) of the tool, less dJ/dt v."""
        return self.J @ np.linalg.solve(self.M, drive)


def arm(seed: int, *, rank: int = 6) -> Arm:
    """A random arm whose Jacobian has the given rank."""
    random = np.random.default_rng(seed)
    root = random.normal(size=(N, N))
    U, s, Vt = np.linalg.svd(random.normal(size=(6, N)), full_matrices=False)
    s = np.clip(s, 0.5, None)
    s[rank:] = 0.0
    return Arm(root @ root.T + np.eye(N), U @ np.diag(s) @ Vt, 100.0 * random.normal(size=6))


@given(SEEDS)
@settings(max_examples=50, deadline=None)
def test_the_tool_accelerates_as_asked_whatever_the_posture(seed: int) -> None:
    tested, random = arm(seed), np.random.default_rng(seed + 1)
    for posture, repulsion in np.vstack(
        [np.zeros((1, 2, N)), 100.0 * random.normal(size=(3, 2, N))]
    ):
        done = tested.acceleration(tested.drive(posture, repulsion))
        np.testing.assert_allclose(done, tested.task, rtol=1e-7, atol=1e-6)


def test_the_posture_acts_in_the_null_space() -> None:
    tested, q_error = arm(3), np.random.default_rng(3).normal(size=N)
    drift = np.linalg.solve(tested.M, tested.drive(100.0 * q_error) - tested.drive())
    # It pulls towards the posture, as far as the tool allows, and not away from it.
    assert drift @ tested.M @ q_error > 0.0


@given(SEEDS, st.integers(0, N - 1), st.sampled_from([-1.0, 1.0]))
@settings(max_examples=50, deadline=None)
def test_a_repulsion_never_moves_its_joint_towards_the_limit(
    seed: int, joint: int, side: float
) -> None:
    tested = arm(seed)
    repulsion = np.where(np.arange(N) == joint, -100.0 * side, 0.0)
    drift = np.linalg.solve(tested.M, tested.drive(repulsion=repulsion) - tested.drive())
    assert side * drift[joint] <= 1e-9


@given(SEEDS, st.integers(3, 5))
@settings(max_examples=30, deadline=None)
def test_a_singular_arm_is_bounded(seed: int, rank: int) -> None:
    drive = arm(seed, rank=rank).drive(max_mass=50.0)
    assert np.abs(drive).max() < 1e7


def test_damping_leaves_the_regular_directions_alone() -> None:
    inverse_inertia = np.diag([8.0, 8.0, 8.0, 1.0, 0.5, 1e-7])
    asked = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    done = inverse_inertia @ damped_task_force(inverse_inertia, asked, 100.0, 0.25)
    np.testing.assert_allclose(done[:5], asked[:5], rtol=1e-12)
    assert abs(done[5]) < 1e-4 * asked[5]


@given(st.floats(1e-6, 1.0))
def test_damping_is_bounded_by_the_heaviest_mass(w: float) -> None:
    inverse_inertia = np.diag([8.0, 8.0, 8.0, 1.0, 1.0, w])
    force = damped_task_force(inverse_inertia, np.array([0, 0, 0, 0, 0, 1.0]), 100.0, 0.25)
    assert force[5] <= 100.0 * 4.0 / 3.0 + 1e-9
    assert (force[5] < (1.0 - 1e-12) / w) == (w < 0.01)
