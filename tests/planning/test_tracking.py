"""The joints along a path of the tool."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import FloatArray
from drake_oa.planning.tracking import follow, pose_error, reach, scratch
from tests.planning.arms import ArmAlone

PULL = 0.3
SEEDS = st.integers(0, 2**32 - 1)


def shifted(X_WE: FloatArray, p: FloatArray, turn: FloatArray) -> FloatArray:
    """(12,) pose moved by p (3,) and turned by a rotation vector (3,)."""
    R = Rotation.from_rotvec(turn).as_matrix() @ X_WE[:9].reshape(3, 3)
    return np.append(R.ravel(), X_WE[9:] + p)


def went(
    arm: ArmAlone, q: FloatArray, targets: FloatArray, guide: FloatArray, pull: float = PULL
) -> tuple[FloatArray, FloatArray]:
    """Joints (T, n) and errors (T,) along poses (T, 12), led along postures (T, n) or one (n,)."""
    room, q = scratch(len(q)), np.array(q)
    led = np.array(np.broadcast_to(guide, (len(targets), len(q))))
    led = np.concatenate([led[:1], led])
    joints, errors = [], []
    for row, target in enumerate(targets):
        errors.append(follow(q, target, led, row + 1, pull, arm.chain, room))
        joints.append(q.copy())
        np.testing.assert_array_equal(room.X, arm.poses(q))
    return np.array(joints), np.array(errors)


@settings(max_examples=30)
@given(seed=SEEDS)
def test_the_error_is_the_largest_of_way_and_turn(panda_arm: ArmAlone, seed: int) -> None:
    random = np.random.default_rng(seed)
    q, e = panda_arm.random_q(random), np.empty(6)
    X = panda_arm.poses(q)
    p = random.normal(size=3) * 10 ** random.uniform(-6, 0)
    turn = random.normal(size=3)
    turn *= 10 ** random.uniform(-6, 0.49) / np.linalg.norm(turn)
    largest = pose_error(X, shifted(X[-1], p, turn), e)
    np.testing.assert_allclose(e[3:], p, atol=1e-12)
    np.testing.assert_allclose(e[:3], turn, rtol=1e-3, atol=1e-9)
    assert largest == pytest.approx(np.abs(e).max())


@pytest.mark.parametrize(
    "axis", [[1, 0, 0], [0, 1, 0], [0, 0, -1], [0.6, 0, 0.8], [-0.48, 0.6, 0.64]]
)
def test_half_a_turn_is_an_error(panda_arm: ArmAlone, axis: list[float]) -> None:
    """It has no skew part."""
    X, e, turn = panda_arm.poses(panda_arm.q), np.empty(6), np.pi * np.array(axis)
    pose_error(X, shifted(X[-1], np.zeros(3), turn), e)
    np.testing.assert_allclose(np.abs(e[:3] @ turn), np.pi**2, rtol=1e-6)
    assert np.linalg.norm(e[:3]) == pytest.approx(np.pi, abs=1e-6)
    q = panda_arm.q.copy()
    target = panda_arm.X_WE
    q[6] -= np.pi * np.sign(q[6])
    assert reach(q, target, panda_arm.chain, scratch(7), 60, 1e-5)
    np.testing.assert_allclose(panda_arm.poses(q)[-1], target, atol=1e-4)


@settings(max_examples=30)
@given(seed=SEEDS)
def test_the_next_pose_is_reached(panda_arm: ArmAlone, six_arm: ArmAlone, seed: int) -> None:
    random = np.random.default_rng(seed)
    for arm in (panda_arm, six_arm):
        p, turn = random.uniform(-0.01, 0.01, 3), random.uniform(-0.02, 0.02, 3)
        way = np.linspace(0.0, 1.0, 9)[1:, None]
        targets = np.array([shifted(arm.X_WE, u * p, u * turn) for u in way])
        joints, errors = went(arm, arm.q, targets, arm.q)
        assert errors.max() < 1e-4
        for q, target, error in zip(joints, targets, errors, strict=True):
            e = np.empty(6)
            assert error == pose_error(arm.poses(q), target, e) < 1e-4


def test_the_null_space_is_drawn_to_the_guide(panda_arm: ArmAlone) -> None:
    """The tool stands; only seven joints can move then."""
    swivelled = panda_arm.q.copy()
    # A posture with the same pose of the tool: where the guide drew it, it stays.
    targets = np.tile(panda_arm.X_WE, (60, 1))
    guide = swivelled + [0.5, 0.2, -0.5, 0.0, 0.0, 0.0, 0.0]
    joints, errors = went(panda_arm, panda_arm.q, targets, guide)
    assert errors.max() < 2e-3
    away = np.linalg.norm(joints - guide, axis=1)
    assert away[-1] < np.linalg.norm(panda_arm.q - guide) - 0.1
    assert np.abs(joints[-1] - joints[-2]).max() < 1e-3
    # From there another guide brings it back.
    back, errors = went(panda_arm, joints[-1], targets, panda_arm.q)
    assert errors.max() < 2e-3
    np.testing.assert_allclose(back[-1], panda_arm.q, atol=0.01)
    # Without a pull, nothing moves.
    still, _ = went(panda_arm, panda_arm.q, targets, guide, 0.0)
    np.testing.assert_allclose(still[-1], panda_arm.q, atol=1e-9)


def test_the_null_space_is_led_along_postures(panda_arm: ArmAlone) -> None:
    """The tool stands while the elbow swings: led along its way it does not lag."""
    targets = np.tile(panda_arm.X_WE, (40, 1))
    way, _ = went(panda_arm, panda_arm.q, targets, panda_arm.q + [0.5, 0.2, -0.5, 0, 0, 0, 0])
    assert np.abs(way[-1] - way[0]).max() > 0.2
    led, errors = went(panda_arm, way[0], targets, way)
    assert errors.max() < 1e-4
    np.testing.assert_allclose(led, way, atol=2e-3)


@settings(max_examples=20)
@given(seed=SEEDS)
def test_joints_stay_within_their_limits_and_the_error_tells(
    panda_arm: ArmAlone, six_arm: ArmAlone, seed: int
) -> None:
    random = np.random.default_rng(seed)
    for arm in (panda_arm, six_arm):
        q = arm.random_q(random)
        # Far out of reach, along a straight way.
        out = random.normal(size=3)
        out *= 2.5 / np.linalg.norm(out)
        way = np.linspace(0.0, 1.0, 40)[:, None]
        X_WE = arm.poses(q)[-1]
        targets = np.array([shifted(X_WE, u * out, np.zeros(3)) for u in way])
        joints, errors = went(arm, q, targets, arm.random_q(random))
        assert np.isfinite(joints).all()
        assert (joints >= arm.chain.lower).all()
        assert (joints <= arm.chain.upper).all()
        assert errors[-1] > 0.1
