"""Roll-outs of the whole arm, against SceneGraph along random motions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drake_oa.planning.arm_world import (
    FAR,
    LINKS,
    TOOL,
    ArmWorld,
)
from drake_oa.planning.search import ToolPaths, roll_out_arm
from drake_oa.robot.arm import tool_poses
from tests.planning.arms import ArmAlone, Truth, random_things

SEEDS = st.integers(0, 2**32 - 1)
S = np.linspace(0.0, 1.0, 33)


def swings(arm: ArmAlone, random: np.random.Generator, count: int) -> ToolPaths:
    """Smooth motions of the tool and of its orientation from where it is, and of the posture."""
    X_WE, ramp = arm.X_WE, S * S * (3.0 - 2.0 * S)
    bows = np.sin(np.pi * np.outer([1.0, 2.0], S))
    way = random.uniform(-0.3, 0.3, (count, 3))
    sway = random.uniform(-0.08, 0.08, (count, 2, 3))
    p_WE = X_WE[9:] + ramp[:, None] * way[:, None] + np.einsum("mt,nmk->ntk", bows, sway)
    turns = Rotation.from_rotvec(ramp[:, None] * random.uniform(-0.5, 0.5, 3))
    R_WE = turns.as_matrix() @ X_WE[:9].reshape(3, 3)
    held = np.tile(X_WE[:9], (len(S), 1))
    drawn = arm.q + ramp[:, None] * random.uniform(-0.4, 0.4, len(arm.q))
    return ToolPaths(
        S,
        p_WE,
        np.stack([held, R_WE.reshape(-1, 9)])[random.integers(2, size=count)],
        np.stack([np.tile(arm.q, (len(S), 1)), drawn])[random.integers(2, size=count)],
        random.uniform(2.0, 6.0, count),
    )


def bare(arm: ArmAlone, things: list) -> ArmWorld:
    """In which nothing is asked, so that what is kept beyond it is the distance."""
    return arm.among([thing.solid() for thing in things], 0.0, 0.0, -5.0)


@settings(max_examples=12)
@given(seed=SEEDS)
def test_it_keeps_what_scene_graph_says(panda_arm: ArmAlone, six_arm: ArmAlone, seed: int) -> None:
    random = np.random.default_rng(seed)
    for arm in (panda_arm, six_arm):
        things = random_things(random, 4, moving=2)
        world, paths, truth = bare(arm, things), swings(arm, random, 3), Truth(arm, things)
        found = roll_out_arm(world, arm.q, paths)
        assert (found.samples == len(S)).all()
        overshoot = arm.overshoot
        for i in range(3):
            dt = paths.seconds[i] / (len(S) - 1)
            at_samples = np.array([truth.least(q, dt * row) for row, q in enumerate(found.q[i])])
            for which in (TOOL, LINKS):
                true, spheres = at_samples[:, which].min(), found.excess[i, which]
                # The spheres enclose the arm; and by no more than they stick out. Of shapes that
                # meet SceneGraph tells how to part them, the spheres how deep one of them is.
                assert spheres <= max(min(true, FAR), 0.0) + 1e-4
                if true > 0.0:
                    assert spheres >= min(true, FAR) - overshoot - 1e-4


@settings(max_examples=15)
@given(seed=SEEDS)
def test_the_joints_hold_the_tool_where_it_is_asked(
    panda_arm: ArmAlone, six_arm: ArmAlone, seed: int
) -> None:
    random = np.random.default_rng(seed)
    for arm in (panda_arm, six_arm):
        paths = swings(arm, random, 4)
        found = roll_out_arm(bare(arm, []), arm.q, paths)
        assert (found.q >= arm.chain.lower).all()
        assert (found.q <= arm.chain.upper).all()
        np.testing.assert_allclose(found.q[:, 0], np.tile(arm.q, (4, 1)), atol=1e-6)
        for i in range(4):
            X_WE = tool_poses(arm.chain, found.q[i])
            away = np.abs(X_WE[1:, 9:] - paths.p_WE[i, 1:]).max()
            R_WT = paths.R_WE[i].reshape(-1, 3, 3)
            R_WE = X_WE[:, :9].reshape(-1, 3, 3)
            turned = Rotation.from_matrix(R_WT @ R_WE.transpose(0, 2, 1)).as_rotvec()
            expected = max(away, np.abs(turned[1:]).max())
            assert found.error[i] == pytest.approx(expected, rel=0.02, abs=1e-9)
            dt = paths.seconds[i] * np.diff(S)[:, None]
            rate = np.abs(np.diff(found.q[i], axis=0)) / dt / arm.chain.speed
            assert found.hurry[i] == pytest.approx(rate.max(), rel=1e-9)


@settings(max_examples=8)
@given(seed=SEEDS)
def test_each_is_as_alone_and_followed_as_far_as_needed(panda_arm: ArmAlone, seed: int) -> None:
    random = np.random.default_rng(seed)
    world, paths = bare(panda_arm, random_things(random, 3, moving=1)), swings(panda_arm, random, 9)
    p_WE = paths.p_WE.copy()
    p_WE[0, 20:] = np.nan
    paths = paths._replace(p_WE=p_WE)
    enough = np.where(random.random(9) < 0.5, 0.1, -np.inf)
    found, whole = (roll_out_arm(world, panda_arm.q, paths, least) for least in (enough, -np.inf))
    assert whole.samples.tolist() == [20] + 8 * [len(S)]
    for i in range(9):
        alone = ToolPaths(paths.s, *(of[i : i + 1] for of in paths[1:]))
        again = roll_out_arm(world, panda_arm.q, alone, enough[i])
        for one, other in zip(again, found, strict=True):
            np.testing.assert_array_equal(one[0], other[i])
        count = found.samples[i]
        is_part = whole.least[i] < enough[i]
        assert (found.least[i] < enough[i]) == is_part
        assert is_part or count == whole.samples[i]
        np.testing.assert_array_equal(found.q[i, :count], whole.q[i, :count])
        # It stays where it was left.
        assert (found.q[i, count:] == found.q[i, count - 1]).all()
