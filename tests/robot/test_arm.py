"""Kinematics of the arm: tracking of tool poses, and inverse kinematics."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import FloatArray
from drake_oa.robot.arm import (
    Chain,
    chain_poses,
    follow,
    inverse_kinematics,
    joint_margins,
    make_chain,
    scratch,
    solve_tool_pose,
    tool_poses,
)
from drake_oa.robot.config import Robot
from drake_oa.robot.plant import RobotPlant, home_positions, make_robot_plant
from tests.diagrams.six_arm import SIX_HOME, six_scenario

SEEDS = st.integers(0, 2**32 - 1)
HOME = np.array(Robot().q_seed)


@pytest.fixture(scope="module")
def panda_chain(panda: RobotPlant) -> Chain:
    """Returns the chain of the Panda."""
    return make_chain(panda.plant, panda.tool_frame, home_positions(Robot()))


@pytest.fixture(scope="module")
def six_chain(tmp_path_factory: pytest.TempPathFactory) -> Chain:
    """Returns the chain of an arm of six joints."""
    robot = make_robot_plant(six_scenario(tmp_path_factory.mktemp("six")).robot)
    return make_chain(robot.plant, robot.tool_frame, np.array(SIX_HOME))


def pose(chain: Chain, q: FloatArray) -> FloatArray:
    """Returns the tool pose (12,) at a configuration q (n,) [rad]."""
    return tool_poses(chain, q[None])[0]


def shifted(X_WE: FloatArray, p: FloatArray, turn: FloatArray) -> FloatArray:
    """Returns a pose (12,) translated by p (3,) and rotated by a rotation vector (3,)."""
    R = Rotation.from_rotvec(turn).as_matrix() @ X_WE[:9].reshape(3, 3)
    return np.append(R.ravel(), X_WE[9:] + p)


def track(
    chain: Chain, q: FloatArray, targets: FloatArray, posture: FloatArray, pull: float = 0.3
) -> tuple[FloatArray, FloatArray]:
    """Tracks tool poses (T, 12) with nominal postures (T, n) or (n,) in the null space.

    Returns:
        (T, n) configurations [rad]; (T,) pose errors [m, rad].
    """
    work, q = scratch(len(q)), np.array(q)
    postures = np.array(np.broadcast_to(posture, (len(targets), len(q))))
    postures = np.concatenate([postures[:1], postures])
    joints, errors = [], []
    for row, target in enumerate(targets):
        errors.append(follow(q, target, postures, row + 1, pull, chain, work))
        joints.append(q.copy())
        np.testing.assert_array_equal(work.X[-1], pose(chain, q))
    return np.array(joints), np.array(errors)


@settings(max_examples=30)
@given(seed=SEEDS)
def test_arm_tracks_a_path(panda_chain: Chain, six_chain: Chain, seed: int) -> None:
    random = np.random.default_rng(seed)
    for chain, home in ((panda_chain, HOME), (six_chain, np.array(SIX_HOME))):
        p, turn = random.uniform(-0.01, 0.01, 3), random.uniform(-0.02, 0.02, 3)
        path = np.linspace(0.0, 1.0, 9)[1:, None]
        targets = np.array([shifted(pose(chain, home), u * p, u * turn) for u in path])
        joints, errors = track(chain, home, targets, home)
        assert errors.max() < 1e-4
        np.testing.assert_allclose(tool_poses(chain, joints), targets, atol=2e-4)
        margin = joint_margins(home, targets[None], 0.3, chain)[0]
        expected = np.minimum(joints - chain.lower, chain.upper - joints).min(axis=1)
        np.testing.assert_allclose(margin, expected, atol=1e-9)


def test_null_space_tracks_the_nominal_posture(panda_chain: Chain) -> None:
    """At a constant tool pose, only the elbow of an arm with seven joints can move."""
    targets = np.tile(pose(panda_chain, HOME), (60, 1))
    posture = HOME + [0.5, 0.2, -0.5, 0.0, 0.0, 0.0, 0.0]
    path, errors = track(panda_chain, HOME, targets, posture)
    assert errors.max() < 2e-3
    assert np.linalg.norm(path[-1] - posture) < np.linalg.norm(HOME - posture) - 0.1
    result, errors = track(panda_chain, path[0], targets, path)
    assert errors.max() < 1e-4
    np.testing.assert_allclose(result, path, atol=2e-3)


@settings(max_examples=20)
@given(seed=SEEDS)
def test_joints_remain_within_limits_on_an_unreachable_path(
    panda_chain: Chain, six_chain: Chain, seed: int
) -> None:
    random = np.random.default_rng(seed)
    for chain in (panda_chain, six_chain):
        q, posture = random.uniform(chain.lower, chain.upper, (2, len(chain.lower)))
        # A straight path to a position far out of reach.
        out = random.normal(size=3)
        out *= 2.5 / np.linalg.norm(out)
        path = np.linspace(0.0, 1.0, 40)[:, None]
        targets = np.array([shifted(pose(chain, q), u * out, np.zeros(3)) for u in path])
        joints, errors = track(chain, q, targets, posture)
        assert ((joints >= chain.lower) & (joints <= chain.upper)).all()
        assert errors[-1] > 0.1
        assert np.isneginf(joint_margins(q, targets[None], 0.3, chain)[0, -1])


@settings(max_examples=20)
@given(elbow=st.floats(0.02, 0.1), excess=st.floats(1.1e-3, 4e-3))
def test_arm_comes_to_rest_at_an_extended_elbow(
    six_chain: Chain, elbow: float, excess: float
) -> None:
    """Steps toward a pose beyond the extended arm do not alternate between mirrored elbows."""
    q, work = np.array(SIX_HOME), scratch(6)
    chain_poses(q * [1.0, 1.0, 0.0, 1.0, 1.0, 1.0], six_chain.X_PJ, work.X)
    out = work.X[4, 9:] - work.X[2, 9:]  # From the shoulder to the wrist.
    target = shifted(work.X[-1], excess * out / np.linalg.norm(out), np.zeros(3))
    q[2] = elbow
    joints, errors = track(six_chain, q, np.tile(target, (60, 1)), q)
    assert (joints[-20:] == joints[-1]).all()
    assert errors[-1] < 2.0 * excess


@settings(max_examples=40)
@given(seed=SEEDS)
def test_tracked_path_does_not_change_the_branch_of_the_inverse_kinematics(
    panda_chain: Chain, seed: int
) -> None:
    random = np.random.default_rng(seed)
    q, far = random.uniform(panda_chain.lower, panda_chain.upper, (2, 7))
    target = tool_poses(panda_chain, far[None])[0]
    joints, _ = track(panda_chain, q, np.tile(target, (60, 1)), q)
    assert np.abs(np.diff(joints, axis=0, prepend=q[None])).max() <= 1.0


@settings(max_examples=40)
@given(seed=SEEDS)
def test_poses_of_random_configurations_are_reached(
    panda_chain: Chain, six_chain: Chain, seed: int
) -> None:
    """Two joints of every second configuration are at their limits."""
    random = np.random.default_rng(seed)
    for chain, home in ((panda_chain, HOME), (six_chain, np.array(SIX_HOME))):
        q = random.uniform(chain.lower, chain.upper)
        if seed % 2:
            joints = random.integers(len(q), size=2)
            q[joints] = np.where(random.random(2) < 0.5, chain.lower[joints], chain.upper[joints])
        X_WE = pose(chain, q)
        found = inverse_kinematics(chain, X_WE, home)
        assert len(found)
        np.testing.assert_allclose(tool_poses(chain, found), [X_WE] * len(found), atol=4e-6)
        assert (found >= chain.lower).all()
        assert (found <= chain.upper).all()
        apart = np.abs(found[:, None] - found).max(axis=2)
        assert (apart[~np.eye(len(found), dtype=bool)] > 0.1).all()
        assert (np.diff(np.linalg.norm(found - home, axis=1)) >= 0.0).all()
        np.testing.assert_array_equal(found, inverse_kinematics(chain, X_WE, home))


def test_solution_of_a_tool_pose_is_the_nearest_to_the_seed(
    panda: RobotPlant, panda_chain: Chain
) -> None:
    tool, seed = panda.tool_frame.name(), home_positions(Robot())
    down = RotationMatrix(RollPitchYaw(np.pi, 0.0, np.pi / 2.0))
    X_WE = RigidTransform(down, [0.45, -0.3, 0.3])
    q = solve_tool_pose(panda.plant, tool, X_WE, seed)
    np.testing.assert_array_equal(q[7:], seed[7:])
    (found,) = panda.tool_poses(q[None])
    assert found.IsNearlyEqualTo(X_WE, 4e-6)
    # No sampled configuration of the self-motion is nearer.
    samples = inverse_kinematics(panda_chain, pose(panda_chain, q[:7]), HOME, seeds=100)
    assert np.linalg.norm(samples - HOME, axis=1).min() > np.linalg.norm(q[:7] - HOME) - 1e-6
    with pytest.raises(ValueError, match=r"out of reach: tool_point cannot be at \[1\.2, "):
        solve_tool_pose(panda.plant, tool, RigidTransform(down, [1.2, 0.0, 0.3]), seed)
