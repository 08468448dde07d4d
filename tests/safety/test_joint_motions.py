"""Joint motions in time: limits, tracking of the tool, and predicted contacts."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_oa.geometry.solids import Solid, solids_of, sphere
from drake_oa.planning.arm_world import ArmWorld, Asked
from drake_oa.robot.arm import tool_poses
from drake_oa.safety.guarded_arm import GuardedArm
from drake_oa.safety.joint_motions import (
    advance,
    judge_motions,
    roll_out_legs,
    track,
)
from tests.planning.arms import ArmAlone

STEP = 0.008
joints = st.lists(st.floats(-2.0, 2.0), min_size=3, max_size=3).map(np.array)
rates = st.lists(st.floats(-0.9, 0.9), min_size=3, max_size=3).map(np.array)


@given(q=joints, v=rates, limit=st.floats(3.0, 10.0), moves=st.booleans())
@settings(max_examples=40, deadline=None)
def test_joints_converge_to_a_path_or_target_within_the_limits(
    q: np.ndarray, v: np.ndarray, limit: float, moves: bool
) -> None:
    q, v = q.copy(), v.copy()
    for k in range(1, 700):
        t = moves * k * STEP + np.arange(3)
        path = 0.3 * np.sin(t), 0.3 * moves * np.cos(t)
        before = v.copy()
        advance(q, v, *path, np.full(3, 2.0), limit, STEP)
        assert (np.abs(v - before) <= limit * STEP + 1e-9).all()
        assert (np.abs(v) <= 2.0 + 1e-9).all()
    np.testing.assert_allclose([q, v], path, atol=1e-3)


def test_the_tool_is_where_it_is_to_be_after_a_step(panda: ArmAlone, guarded: GuardedArm) -> None:
    chain, q = guarded.chain, np.array(panda.q)
    V_WE = np.array([0.1, -0.2, 0.15, 0.1, 0.3, -0.2])
    X_WE, posture = tool_poses(chain, q[None])[0], np.append(q, np.zeros(7))
    for _ in range(10):
        q, v = track(chain, q, X_WE, V_WE, posture, STEP, 20.0)
        before, X_WE = X_WE, tool_poses(chain, q[None])[0]
        np.testing.assert_allclose((X_WE - before)[9:] / STEP, V_WE[3:], atol=2e-2)
        ahead = tool_poses(chain, (q + 1e-5 * v)[None])[0]
        np.testing.assert_allclose((ahead - X_WE)[9:] / 1e-5, V_WE[3:], atol=1e-2)


def worlds(arm: GuardedArm, solid: Solid) -> tuple[ArmWorld, ArmWorld]:
    """The arm among one solid, as resting and as moving."""
    solids = solids_of([solid])
    groups = len(arm.spheres.group_joint)
    moves = bool(solids.ball[0, 4:7].any())
    nothing, touch = np.full((groups, 1), -np.inf), np.zeros((groups, 1))
    touch[arm.spheres.group_joint < 0] = -np.inf
    tool = np.zeros(groups, dtype=bool)
    return tuple(
        ArmWorld(arm.chain, arm.spheres, solids, Asked(table, of_self, tool), 0.0)
        for table, of_self in (
            (nothing if moves else touch, -1.0),
            (touch if moves else nothing, -np.inf),
        )
    )


@pytest.mark.parametrize("speed", [0.0, 0.5])
def test_a_contact_is_predicted_when_a_ball_arrives(
    panda: ArmAlone, guarded: GuardedArm, speed: float
) -> None:
    p_WE = tool_poses(guarded.chain, np.array(panda.q)[None])[0, 9:]
    ball = replace(
        sphere(0.05),
        X_WO=np.block([[np.eye(3), (p_WE + [0.4, 0.0, 0.0])[:, None]], [np.zeros(3), 1.0]]),
        v_WO=np.array([-speed, 0.0, 0.0]),
    )
    still = np.tile(np.array(panda.q), (1, 28, 1))
    found = judge_motions(*worlds(guarded, ball), still, 0.05, 0.12)
    if speed:
        assert 0.4 < found.first[0] < 0.8
        assert found.contact[0] > 0.0
        assert found.near_moving[0] > 0.0
    else:
        assert found.first[0] == np.inf
        assert found.contact[0] == found.near_resting[0] == 0.0


def test_maneuvers_are_rolled_out_as_they_are_executed() -> None:
    rng = np.random.default_rng(0)
    q, v = rng.normal(size=(2, 7)) * 0.4
    target, speed = rng.normal(size=(2, 7)), np.ones((2, 7))
    found = roll_out_legs(q.copy(), v.copy(), target, speed, 0.2, 5.0, STEP, 5, 10)
    for k in range(50):
        advance(q, v, target[int(k >= 25)], np.zeros(7), speed[0], 5.0, STEP)
        if k % 5 == 4:
            np.testing.assert_array_equal(found[k // 5], q)
