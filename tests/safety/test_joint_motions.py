"""Tests of joint trajectories: limits of legs and paths, and tracking of the tool."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_oa.robot.arm import tool_poses
from drake_oa.safety.joint_motions import advance_leg, approach, track
from tests.planning.arms import ArmAlone

STEP = 0.008
joints = st.lists(st.floats(-2.0, 2.0), min_size=3, max_size=3).map(np.array)
rates = st.lists(st.floats(-0.9, 0.9), min_size=3, max_size=3).map(np.array)


@given(q=joints, v=rates, target=joints, speed=st.floats(1.0, 2.0), limit=st.floats(1.0, 10.0))
@settings(max_examples=40, deadline=None)
def test_a_leg_ends_at_rest_at_its_target_within_the_limits(
    q: np.ndarray, v: np.ndarray, target: np.ndarray, speed: float, limit: float
) -> None:
    q, v = q.copy(), v.copy()
    speeds, limits = np.full(3, speed), np.full(3, limit)
    for _ in range(1500):
        before = v.copy()
        advance_leg(q, v, target, speeds, limits, STEP)
        assert (np.abs(v) <= speed + 1e-9).all()
        assert (np.abs(v - before) <= limit * STEP + 1e-9).all()
    np.testing.assert_allclose(q, target, atol=1e-9)
    np.testing.assert_array_equal(v, 0.0)


@given(q=joints, v=rates, limit=st.floats(3.0, 10.0))
@settings(max_examples=20, deadline=None)
def test_joints_converge_to_a_moving_path_within_the_limits(
    q: np.ndarray, v: np.ndarray, limit: float
) -> None:
    x, speed = np.concatenate([q, v]), np.full(3, 2.0)
    for k in range(1, 700):
        t = k * STEP
        path = np.append(0.3 * np.sin(t + np.arange(3)), 0.3 * np.cos(t + np.arange(3)))
        after = approach(x, path, speed, limit, STEP)
        assert (np.abs(after[3:] - x[3:]) <= limit * STEP + 1e-9).all()
        assert (np.abs(after[3:]) <= 2.0 + 1e-9).all()
        x = after
    np.testing.assert_allclose(x, path, atol=1e-3)


def test_the_tool_tracks_a_desired_velocity(panda: ArmAlone) -> None:
    chain, q = panda.chain, np.array(panda.q)
    V_WE = np.array([0.1, -0.2, 0.15, 0.1, 0.3, -0.2])
    X_WE, posture = tool_poses(chain, q[None])[0], np.append(q, np.zeros(7))
    for _ in range(10):
        q, v = track(chain, q, X_WE, V_WE, posture, STEP, 20.0)
        before, X_WE = X_WE, tool_poses(chain, q[None])[0]
        np.testing.assert_allclose((X_WE - before)[9:] / STEP, V_WE[3:], atol=2e-2)
        ahead = tool_poses(chain, (q + 1e-5 * v)[None])[0]
        np.testing.assert_allclose((ahead - X_WE)[9:] / 1e-5, V_WE[3:], atol=1e-2)
