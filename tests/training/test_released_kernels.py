"""The released code's kernel: its straight part, its certain contacts."""

import numpy as np
import pytest

from drake_oa.training import released_kernels as kernels
from drake_oa.training.planar_rollout import released_forcing, released_rollouts

STEPS, H = 1000, 0.003
DRIVE = released_forcing(STEPS, H)
CONSTANTS = (H, 25.0, 10.0, float(DRIVE[0]), float(DRIVE[1] - DRIVE[0]))


def straight_samples(b):
    """Positions and velocities after 0, 1, ... steps without coupling."""
    tau2 = (np.sqrt(1.0 + 4.0 * b * b) + 0.1) ** 2
    states = [(0.0, 0.0)]
    for push in DRIVE:
        x, v = states[-1]
        v += H * (tau2 * (25.0 * (1.0 - x) - 10.0 * v) + push)
        states.append((x + H * v, v))
    return np.array(states)


@pytest.mark.parametrize("b", [0.025, 0.1, 0.25, 1.0])
def test_straight_motion_is_that_of_the_steps(b):
    motion = kernels.straight_motion(b, CONSTANTS)
    got = [kernels.straight_state(motion, k, H) for k in range(STEPS + 1)]
    np.testing.assert_allclose(got, straight_samples(b), atol=1e-9)


def test_a_spring_that_is_not_overdamped_has_no_straight_form():
    motion = kernels.straight_motion(0.1, (H, 250.0, 10.0, *CONSTANTS[3:]))
    assert np.isnan(motion[4])
    assert kernels.entry(0.1, 0.1, 1.0, 1000.0, motion, STEPS, 10, H) == 0
    scene = ([[0.1, 0.1]], [[3000.0, 0.8, 200.0]])
    single, double = (
        released_rollouts(*scene, alpha_x=10.0, beta_x=25.0, precision=precision)
        for precision in ("single", "double")
    )
    assert single.contact[0] == double.contact[0]
    np.testing.assert_allclose(single.clearance, double.clearance, atol=1e-4)


def test_rows_start_before_the_term_acts_and_before_they_touch():
    rng = np.random.default_rng(0)
    late = touching = 0
    for _ in range(300):
        a, b = rng.uniform(0.025, 0.25, 2)
        alpha, kappa = rng.uniform(0.01, 30000.0), rng.uniform(0.0, 1000.0)
        motion = kernels.straight_motion(b, CONSTANTS)
        step = kernels.entry(a, b, alpha, kappa, motion, STEPS, 10, H)
        x = straight_samples(b)[:, 0]
        if step < 0:
            touching += 1
            # Whatever psi is: at pi the term does not fade with the angle.
            row = released_rollouts([[a, b]], [[alpha, 1e3, kappa]], precision="double")
            assert row.contact[0]
            continue
        assert step % 10 == 0
        late += step > 0
        if step > 0:
            assert x[step] < 0.5 - a
            assert alpha * np.exp(-kappa * (0.5 - x[step]) ** 2) < 1e-5
    assert late > 100
    assert touching > 50


@pytest.mark.parametrize("steps", [2, 97, 100, 1000])
@pytest.mark.parametrize("between", [False, True])
def test_any_number_of_steps_keeps_to_float64(steps, between):
    rng = np.random.default_rng(steps)
    dt = 3.0 / steps
    semi_axes = rng.uniform(0.025, 0.3, (300, 2))
    # A push that turns by more than a radian a step amplifies the last bit.
    parameters = rng.uniform((0.01, 0.1, 0.0), (1.0 / dt, 2.0, 100.0), (300, 3))
    single, double = (
        released_rollouts(
            semi_axes, parameters, steps=steps, dt=dt, between=between, precision=precision
        )
        for precision in ("single", "double")
    )
    np.testing.assert_array_equal(single.contact, double.contact)
    free = ~double.contact
    assert free.any()
    np.testing.assert_allclose(single.clearance[free], double.clearance[free], atol=1e-4)
    calm = free & (double.goal_error < 0.05)
    np.testing.assert_allclose(single.path_length[calm], double.path_length[calm], atol=1e-4)
    np.testing.assert_allclose(single.goal_error[calm], double.goal_error[calm], atol=1e-4)


def test_an_ellipse_smaller_than_a_step_is_not_taken_for_touched():
    scene = ([[1e-4, 1e-4]], [[0.0, 1.0, 100.0]])
    single, double = (released_rollouts(*scene, precision=p) for p in ("single", "double"))
    assert single.contact[0] == double.contact[0]
    np.testing.assert_allclose(single.clearance, double.clearance, atol=1e-5)
