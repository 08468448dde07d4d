"""Roll-outs of the whole arm along random motions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drake_oa.planning.collision_model import (
    FAR,
    LINKS,
    TOOL,
    ArmCollisionModel,
    group_distances,
)
from drake_oa.planning.search import ToolPaths, roll_out_arm
from drake_oa.robot.arm import tool_poses
from tests.planning.arms import ArmAlone, random_solids

SEEDS = st.integers(0, 2**32 - 1)
S = np.linspace(0.0, 1.0, 33)


def swings(arm: ArmAlone, random: np.random.Generator, count: int) -> ToolPaths:
    """Smooth motions of the tool and of its orientation from where it is."""
    ramp = S * S * (3.0 - 2.0 * S)
    bow = np.stack([ramp, np.sin(np.pi * S), np.sin(2.0 * np.pi * S)])
    p_WE = arm.X_WE[9:] + np.einsum("mt,nmk->ntk", bow, random.uniform(-0.15, 0.15, (count, 3, 3)))
    turns = Rotation.from_rotvec(ramp[:, None] * random.uniform(-0.5, 0.5, 3))
    R_WE = (turns.as_matrix() @ arm.X_WE[:9].reshape(3, 3)).reshape(-1, 9)
    posture = np.tile(arm.q, (count, len(S), 1))
    return ToolPaths(S, p_WE, np.tile(R_WE, (count, 1, 1)), posture, random.uniform(2.0, 6.0))


def bare(arm: ArmAlone, objects: list) -> ArmCollisionModel:
    """In which nothing is asked, so that what is kept beyond it is the distance."""
    return arm.among(objects, 0.0, 0.0, -5.0)


@settings(max_examples=12)
@given(seed=SEEDS)
def test_clearances_errors_and_speeds_are_those_along_the_joints(
    panda_arm: ArmAlone, seed: int
) -> None:
    random, arm = np.random.default_rng(seed), panda_arm
    world, paths = bare(arm, random_solids(random, 4)), swings(arm, random, 3)
    found, tool = roll_out_arm(world, arm.q, paths), world.required.is_tool
    for i, q in enumerate(found.q):
        dt = paths.seconds / (len(S) - 1)
        d = group_distances(arm.chain, world.spheres, world.geometries, q, 0.0, FAR)
        d[world.spheres.group_joint < 0] = FAR
        np.testing.assert_allclose(found.clearance_margin[i, TOOL], d[tool].min(), atol=1e-9)
        np.testing.assert_allclose(found.clearance_margin[i, LINKS], d[~tool].min(), atol=1e-9)
        away = np.abs(tool_poses(arm.chain, q)[1:, 9:] - paths.p_WE[i, 1:])
        assert away.max() <= found.error[i] + 1e-9
        rate = np.abs(np.diff(q, axis=0)) / dt / arm.chain.speed
        assert found.max_joint_speed_ratio[i] == pytest.approx(rate.max(), rel=1e-9)


@settings(max_examples=8)
@given(seed=SEEDS)
def test_each_is_as_alone_and_followed_as_far_as_needed(panda_arm: ArmAlone, seed: int) -> None:
    random = np.random.default_rng(seed)
    world, paths = bare(panda_arm, random_solids(random, 3)), swings(panda_arm, random, 9)
    p_WE = paths.p_WE.copy()
    p_WE[0, 20:] = np.nan
    paths = paths._replace(p_WE=p_WE)
    enough = np.where(random.random(9) < 0.5, 0.1, -np.inf)
    found, whole = (roll_out_arm(world, panda_arm.q, paths, least) for least in (enough, -np.inf))
    assert whole.samples.tolist() == [20] + 8 * [len(S)]
    for i in range(9):
        alone = ToolPaths(paths.s, *(of[i : i + 1] for of in paths[1:4]), paths.seconds)
        again = roll_out_arm(world, panda_arm.q, alone, enough[i])
        for one, other in zip(again, found, strict=True):
            np.testing.assert_array_equal(one[0], other[i])
        count = found.samples[i]
        is_part = whole.min_margin[i] < enough[i]
        assert (found.min_margin[i] < enough[i]) == is_part
        assert is_part or count == whole.samples[i]
        np.testing.assert_array_equal(found.q[i, :count], whole.q[i, :count])
        # It stays where it was left.
        assert (found.q[i, count:] == found.q[i, count - 1]).all()
