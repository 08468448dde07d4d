"""Kinematics of the arm: tracking of poses and inverse kinematics."""

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
from tests.diagrams.six_arm import SIX_HOME, six_robot

SEEDS = st.integers(0, 2**32 - 1)
HOME = np.array(Robot().q_seed)


@pytest.fixture(scope="module")
def panda_chain(panda: RobotPlant) -> Chain:
    return make_chain(panda.plant, panda.tool_frame, home_positions(Robot()))


@pytest.fixture(scope="module")
def six_chain(tmp_path_factory: pytest.TempPathFactory) -> Chain:
    robot = make_robot_plant(six_robot(tmp_path_factory.mktemp("six")))
    return make_chain(robot.plant, robot.tool_frame, np.array(SIX_HOME))


def pose(chain: Chain, q: FloatArray) -> FloatArray:
    return tool_poses(chain, q[None])[0]


def shifted(X_WE: FloatArray, p: FloatArray, turn: FloatArray) -> FloatArray:
    """(12,) pose moved by p (3,) and turned by a rotation vector (3,)."""
    R = Rotation.from_rotvec(turn).as_matrix() @ X_WE[:9].reshape(3, 3)
    return np.append(R.ravel(), X_WE[9:] + p)


def tracked(
    chain: Chain, q: FloatArray, targets: FloatArray, guide: FloatArray, pull: float = 0.3
) -> tuple[FloatArray, FloatArray]:
    """Joints (T, n) and errors (T,) along poses (T, 12), led along postures (T, n) or one (n,)."""
    room, q = scratch(len(q)), np.array(q)
    led = np.array(np.broadcast_to(guide, (len(targets), len(q))))
    led = np.concatenate([led[:1], led])
    joints, errors = [], []
    for row, target in enumerate(targets):
        errors.append(follow(q, target, led, row + 1, pull, chain, room))
        joints.append(q.copy())
        np.testing.assert_array_equal(room.X[-1], pose(chain, q))
    return np.array(joints), np.array(errors)


@settings(max_examples=30)
@given(seed=SEEDS)
def test_a_path_is_followed(panda_chain: Chain, six_chain: Chain, seed: int) -> None:
    random = np.random.default_rng(seed)
    for chain, home in ((panda_chain, HOME), (six_chain, np.array(SIX_HOME))):
        p, turn = random.uniform(-0.01, 0.01, 3), random.uniform(-0.02, 0.02, 3)
        way = np.linspace(0.0, 1.0, 9)[1:, None]
        targets = np.array([shifted(pose(chain, home), u * p, u * turn) for u in way])
        joints, errors = tracked(chain, home, targets, home)
        assert errors.max() < 1e-4
        np.testing.assert_allclose(tool_poses(chain, joints), targets, atol=2e-4)
        margin = joint_margins(home, targets[None], 0.3, chain)[0]
        expected = np.minimum(joints - chain.lower, chain.upper - joints).min(axis=1)
        np.testing.assert_allclose(margin, expected, atol=1e-9)


def test_the_null_space_is_drawn_to_the_guide(panda_chain: Chain) -> None:
    """The tool stands; only the elbow of seven joints can swing then."""
    targets = np.tile(pose(panda_chain, HOME), (60, 1))
    guide = HOME + [0.5, 0.2, -0.5, 0.0, 0.0, 0.0, 0.0]
    way, errors = tracked(panda_chain, HOME, targets, guide)
    assert errors.max() < 2e-3
    assert np.linalg.norm(way[-1] - guide) < np.linalg.norm(HOME - guide) - 0.1
    led, errors = tracked(panda_chain, way[0], targets, way)
    assert errors.max() < 1e-4
    np.testing.assert_allclose(led, way, atol=2e-3)


@settings(max_examples=20)
@given(seed=SEEDS)
def test_joints_stay_within_their_limits_and_the_error_tells(
    panda_chain: Chain, six_chain: Chain, seed: int
) -> None:
    random = np.random.default_rng(seed)
    for chain in (panda_chain, six_chain):
        q, guide = random.uniform(chain.lower, chain.upper, (2, len(chain.lower)))
        # Far out of reach, along a straight way.
        out = random.normal(size=3)
        out *= 2.5 / np.linalg.norm(out)
        way = np.linspace(0.0, 1.0, 40)[:, None]
        targets = np.array([shifted(pose(chain, q), u * out, np.zeros(3)) for u in way])
        joints, errors = tracked(chain, q, targets, guide)
        assert np.isfinite(joints).all()
        assert (joints >= chain.lower).all()
        assert (joints <= chain.upper).all()
        assert errors[-1] > 0.1
        assert np.isneginf(joint_margins(q, targets[None], 0.3, chain)[0, -1])


@settings(max_examples=40)
@given(seed=SEEDS)
def test_poses_of_random_configurations_are_reached(
    panda_chain: Chain, six_chain: Chain, seed: int
) -> None:
    """Two joints of each second configuration are at their limits."""
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


def test_a_tool_pose_is_solved_near_the_seed(panda: RobotPlant, panda_chain: Chain) -> None:
    tool, seed = panda.tool_frame.name(), home_positions(Robot())
    down = RotationMatrix(RollPitchYaw(np.pi, 0.0, np.pi / 2.0))
    X_WE = RigidTransform(down, [0.45, -0.3, 0.3])
    q = solve_tool_pose(panda.plant, tool, X_WE, seed)
    np.testing.assert_array_equal(q[7:], seed[7:])
    (found,) = panda.tool_poses(q[None])
    assert found.IsNearlyEqualTo(X_WE, 4e-6)
    # No other configuration of the self-motion is nearer.
    samples = inverse_kinematics(panda_chain, pose(panda_chain, q[:7]), HOME, seeds=100)
    assert np.linalg.norm(samples - HOME, axis=1).min() > np.linalg.norm(q[:7] - HOME) - 1e-6
    with pytest.raises(ValueError, match=r"out of reach: tool_point cannot be at \[1\.2, "):
        solve_tool_pose(panda.plant, tool, RigidTransform(down, [1.2, 0.0, 0.3]), seed)
