"""With which joints an arm holds its tool at a pose."""

import numpy as np
from scipy.spatial.transform import Rotation

from drake_oa.planning.arm_world import tool_poses
from drake_oa.planning.goal_postures import goal_postures, nearest_free_place
from tests.planning.arms import ArmAlone


def test_all_hold_the_pose_within_the_limits_and_differ(arm: ArmAlone) -> None:
    found = goal_postures(arm.chain, arm.X_WE, arm.q)
    assert len(found) >= 3
    X_WE = tool_poses(arm.chain, found)
    np.testing.assert_allclose(X_WE[:, 9:], np.tile(arm.X_WE[9:], (len(found), 1)), atol=1e-4)
    R = X_WE[:, :9].reshape(-1, 3, 3) @ arm.X_WE[:9].reshape(3, 3).T
    assert np.abs(Rotation.from_matrix(R).as_rotvec()).max() < 1e-4
    assert (found >= arm.chain.lower).all()
    assert (found <= arm.chain.upper).all()
    apart = np.abs(found[:, None] - found).max(axis=2)
    assert apart[~np.eye(len(found), dtype=bool)].min() > 0.1
    # What is begun with is the nearest.
    np.testing.assert_allclose(found[0], arm.q, atol=1e-4)
    assert (np.diff(np.linalg.norm(found - arm.q, axis=1)) >= 0.0).all()


def test_the_same_are_found_each_time_and_others_by_another_seed(arm: ArmAlone) -> None:
    found = [goal_postures(arm.chain, arm.X_WE, arm.q, seed=seed) for seed in (0, 0, 1)]
    np.testing.assert_array_equal(found[0], found[1])
    assert found[0].shape != found[2].shape or not np.array_equal(found[0], found[2])
    few = goal_postures(arm.chain, arm.X_WE, arm.q, seeds=0)
    assert len(few) == 1


def test_the_nearest_free_place_is_the_one_that_is_free_and_near(panda_arm: ArmAlone) -> None:
    chain, X_WE = panda_arm.chain, panda_arm.X_WE
    wall = X_WE[9] - 0.049

    def is_free(q: np.ndarray) -> bool:
        return bool(tool_poses(chain, q[None])[0, 9] < wall)

    found = nearest_free_place(chain, X_WE, panda_arm.q, is_free)
    assert found is not None
    np.testing.assert_allclose(found[1:], X_WE[10:], atol=1e-9)
    assert wall - 0.005 <= found[0] < wall
    assert nearest_free_place(chain, X_WE, panda_arm.q, lambda q: False) is None
