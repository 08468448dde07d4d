"""Tests of whole-arm roll-outs along random motions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drake_oa.planning.collision_model import FAR, LINKS, TOOL, ArmCollisionModel, group_distances
from drake_oa.planning.search import ToolPaths, roll_out_arm
from drake_oa.robot.arm import tool_poses
from tests.planning.arms import ArmAlone, random_boxes

SEEDS = st.integers(0, 2**32 - 1)
S = np.linspace(0.0, 1.0, 33)


def smooth_motions(arm: ArmAlone, random: np.random.Generator, count: int) -> ToolPaths:
    """Returns random smooth motions of the tool that start at its home pose."""
    ramp = S * S * (3.0 - 2.0 * S)
    bow = np.stack([ramp, np.sin(np.pi * S), np.sin(2.0 * np.pi * S)])
    p_WE = arm.X_WE[9:] + np.einsum("mt,nmk->ntk", bow, random.uniform(-0.15, 0.15, (count, 3, 3)))
    turns = Rotation.from_rotvec(ramp[:, None] * random.uniform(-0.5, 0.5, 3))
    R_WE = (turns.as_matrix() @ arm.X_WE[:9].reshape(3, 3)).reshape(-1, 9)
    posture = np.tile(arm.q, (count, len(S), 1))
    return ToolPaths(S, p_WE, np.tile(R_WE, (count, 1, 1)), posture, random.uniform(2.0, 6.0))


def free_model(arm: ArmAlone, objects: list) -> ArmCollisionModel:
    """Returns a collision model with required clearances 0: margins are distances."""
    return arm.model(objects, 0.0, 0.0, -5.0)


@settings(max_examples=12)
@given(seed=SEEDS)
def test_margins_errors_and_speeds_are_those_of_the_joint_motion(
    panda_arm: ArmAlone, seed: int
) -> None:
    random, arm = np.random.default_rng(seed), panda_arm
    world, paths = (free_model(arm, random_boxes(random, 4)), smooth_motions(arm, random, 3))
    result, tool = roll_out_arm(world, arm.q, paths), world.required.is_tool
    for i, q in enumerate(result.q):
        dt = paths.seconds / (len(S) - 1)
        d = group_distances(arm.chain, world.spheres, world.geometries, q, 0.0, FAR)
        d[world.spheres.group_joint < 0] = FAR
        np.testing.assert_allclose(result.clearance_margin[i, TOOL], d[tool].min(), atol=1e-9)
        np.testing.assert_allclose(result.clearance_margin[i, LINKS], d[~tool].min(), atol=1e-9)
        away = np.abs(tool_poses(arm.chain, q)[1:, 9:] - paths.p_WE[i, 1:])
        assert away.max() <= result.error[i] + 1e-9
        rate = np.abs(np.diff(q, axis=0)) / dt / arm.chain.speed
        assert result.max_joint_speed_ratio[i] == pytest.approx(rate.max(), rel=1e-9)


@settings(max_examples=8)
@given(seed=SEEDS)
def test_candidates_are_independent_and_aborted_below_a_margin(
    panda_arm: ArmAlone, seed: int
) -> None:
    random = np.random.default_rng(seed)
    world = free_model(panda_arm, random_boxes(random, 3))
    paths = smooth_motions(panda_arm, random, 9)
    p_WE = paths.p_WE.copy()
    p_WE[0, 20:] = np.nan
    paths = paths._replace(p_WE=p_WE)
    limit = np.where(random.random(9) < 0.5, 0.1, -np.inf)
    result, full = (
        roll_out_arm(world, panda_arm.q, paths, threshold) for threshold in (limit, -np.inf)
    )
    assert full.samples.tolist() == [20] + 8 * [len(S)]
    for i in range(9):
        single = ToolPaths(paths.s, *(of[i : i + 1] for of in paths[1:4]), paths.seconds)
        alone = roll_out_arm(world, panda_arm.q, single, limit[i])
        for one, other in zip(alone, result, strict=True):
            np.testing.assert_array_equal(one[0], other[i])
        count = result.samples[i]
        is_aborted = full.min_margin[i] < limit[i]
        assert (result.min_margin[i] < limit[i]) == is_aborted
        assert is_aborted or count == full.samples[i]
        np.testing.assert_array_equal(result.q[i, :count], full.q[i, :count])
        # After an abort the last configuration is repeated.
        assert (result.q[i, count:] == result.q[i, count - 1]).all()
