"""Tests of joint-space paths as demonstrations for the movement primitives."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_oa.planning.collision_model import min_clearance_margin
from drake_oa.planning.imitation import SPEED_FRACTION, demonstration
from drake_oa.planning.joint_planner import plan_path
from drake_oa.policy.dmp import orientation_along, trajectory
from drake_oa.robot.arm import tool_poses
from tests.planning.arms import ArmAlone, wall_with_gap

PACE = 5.0
MIRROR = np.array([-1.0, 1.0, -1.0, 1.0, -1.0, 1.0, 1.0])


@pytest.mark.parametrize("gap", [0.3, 0.5])
def test_the_primitives_reproduce_the_planned_path(panda_arm: ArmAlone, gap: float) -> None:
    world = panda_arm.model(wall_with_gap(gap), 0.03, 0.03)
    corners = plan_path(
        world, panda_arm.q, (panda_arm.q * MIRROR)[None], max_configurations=60_000, seed=1
    )
    demo = demonstration(world, corners, seconds_per_meter=PACE)
    X_WE = tool_poses(world.chain, demo.q)
    path = trajectory(demo.position, X_WE[0, 9:], X_WE[-1, 9:], steps=800)
    p_WE = np.stack([np.interp(demo.s, np.linspace(0.0, 1.0, 801), p) for p in path.p.T], axis=1)
    assert np.linalg.norm(p_WE - X_WE[:, 9:], axis=1).max() < 2e-3
    R_WE = X_WE[:, :9].reshape(-1, 3, 3)
    found = orientation_along(demo.orientation, R_WE[0], demo.R_WG, demo.s)
    angle = Rotation.from_matrix(found @ R_WE.transpose(0, 2, 1)).magnitude()
    assert np.rad2deg(angle.max()) < 1.0
    # The demonstration starts and ends at rest, at the ends of the plan.
    np.testing.assert_allclose(demo.q[[0, -1]], corners[[0, -1]], atol=1e-9)
    steps = np.abs(np.diff(demo.q, axis=0))
    assert steps[[0, -1]].max() < 0.02 * steps.max()
    # Corners are rounded as far as the clearance allows, up to the error between samples.
    assert min_clearance_margin(world, demo.q) >= -8e-3
    # Either the requested duration per meter or a joint speed determines the duration.
    seconds = demo.position.duration
    ratio = (steps / (seconds * np.diff(demo.s)[:, None]) / world.chain.speed).max()
    assert ratio <= SPEED_FRACTION + 1e-9
    length = np.linalg.norm(np.diff(X_WE[:, 9:], axis=0), axis=1).sum()
    assert ratio == pytest.approx(SPEED_FRACTION) or seconds == pytest.approx(PACE * length)


def test_corners_in_free_space_are_rounded(panda_arm: ArmAlone) -> None:
    corners = np.tile(panda_arm.q, (3, 1))
    corners[1, :2] += [0.5, -0.3]
    corners[2, 0] += 1.0
    demo = demonstration(panda_arm.model(self_clearance=-1.0), corners, seconds_per_meter=PACE)
    assert np.abs(demo.q - corners[1]).max(axis=1).min() > 0.01
