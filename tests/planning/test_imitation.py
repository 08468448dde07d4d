"""A path of the whole arm, as a demonstration that the primitives imitate."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import FloatArray
from drake_oa.planning.arm_world import (
    ArmWorld,
    exceeds,
    excess_along,
)
from drake_oa.planning.imitation import SPEED_SHARE, demonstration
from drake_oa.planning.joint_planner import plan_path
from drake_oa.policy.dmp import Demonstration, orientation_along, trajectory
from drake_oa.robot.arm import tool_poses
from tests.planning.arms import ArmAlone, box_at, random_things, wall_with_gap

PACE = 5.0


@pytest.fixture(scope="module")
def paths(panda_arm: ArmAlone) -> list[tuple[ArmWorld, FloatArray]]:
    """Worlds, and paths of corners in them."""
    mirror = np.array([-1.0, 1.0, -1.0, 1.0, -1.0, 1.0, 1.0])
    found = []
    for gap in (0.3, 0.5):
        world = panda_arm.among(wall_with_gap(gap), 0.03, 0.03)
        goal = (panda_arm.q * mirror)[None]
        found.append((world, plan_path(world, panda_arm.q, goal, most=60_000, seed=1)))
    random = np.random.default_rng(6)
    while len(found) < 6:
        world = panda_arm.among([thing.solid() for thing in random_things(random, 5)], 0.02, 0.02)
        goal = panda_arm.q + random.uniform(-0.8, 0.8, 7)
        goal = np.clip(goal, panda_arm.chain.lower, panda_arm.chain.upper)
        if exceeds(world, panda_arm.q) and exceeds(world, goal):
            path = plan_path(world, panda_arm.q, goal[None], most=20_000, seed=1)
            if len(path):
                found.append((world, path))
    return found


def spaced(corners: FloatArray) -> FloatArray:
    """(2001, n) along a polyline."""
    u = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1)))
    at = np.linspace(0.0, u[-1], 2001)
    return np.stack([np.interp(at, u, q) for q in corners.T], axis=1)


def shown_of(world: ArmWorld, corners: FloatArray) -> Demonstration:
    return demonstration(world, corners, pace=PACE)


def test_the_primitives_go_where_the_plan_goes(paths: list[tuple[ArmWorld, FloatArray]]) -> None:
    for world, corners in paths:
        shown = shown_of(world, corners)
        X_WE = tool_poses(world.chain, shown.q)
        way = trajectory(shown.position, X_WE[0, 9:], X_WE[-1, 9:], steps=800)
        p_WE = np.stack(
            [np.interp(shown.s, np.linspace(0.0, 1.0, 801), p) for p in way.p.T], axis=1
        )
        assert np.linalg.norm(p_WE - X_WE[:, 9:], axis=1).max() < 2e-3
        R_WE = X_WE[:, :9].reshape(-1, 3, 3)
        np.testing.assert_allclose(shown.R_WG, R_WE[-1], atol=1e-9)
        found = orientation_along(shown.orientation, R_WE[0], shown.R_WG, shown.s)
        off = Rotation.from_matrix(found @ R_WE.transpose(0, 2, 1)).magnitude()
        assert np.rad2deg(off.max()) < 1.0
        # From the plan's start to its end, from rest to rest.
        np.testing.assert_allclose(shown.q[[0, -1]], corners[[0, -1]], atol=1e-9)
        np.testing.assert_array_equal(shown.s[[0, -1]], [0.0, 1.0])
        steps = np.abs(np.diff(shown.q, axis=0)).max(axis=1)
        assert steps[[0, -1]].max() < 0.02 * steps.max()
        # Corners are rounded as far as the clearance allows; between samples a little is lost.
        least = min(excess_along(world, spaced(corners)), 0.0)
        assert excess_along(world, shown.q) >= least - 2e-3


def test_no_joint_is_faster_than_it_may(paths: list[tuple[ArmWorld, FloatArray]]) -> None:
    for world, corners in paths:
        shown = shown_of(world, corners)
        seconds = shown.position.duration
        rate = np.abs(np.diff(shown.q, axis=0)) / (seconds * np.diff(shown.s)[:, None])
        fastest = (rate / world.chain.speed).max()
        assert fastest <= SPEED_SHARE + 1e-9
        length = np.linalg.norm(np.diff(tool_poses(world.chain, shown.q)[:, 9:], axis=0), axis=1)
        # As slow as the pace asks, or as a joint makes it.
        is_fastest = fastest == pytest.approx(SPEED_SHARE)
        assert is_fastest or seconds == pytest.approx(PACE * length.sum())


def test_free_corners_are_rounded_and_tight_ones_stay(panda_arm: ArmAlone) -> None:
    corners = panda_arm.q + np.array(
        [[0.0] * 7, [0.5, -0.3, 0.0, 0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]]
    )

    def nearest(q: FloatArray) -> float:
        return float(np.abs(q - corners[1]).max(axis=1).min())

    free = shown_of(panda_arm.among(own=-1.0), corners)
    assert nearest(free.q) > 0.01
    # A box beside the corner, which the rounded way would come nearer to.
    p_WE = tool_poses(panda_arm.chain, np.stack([corners[1], free.q[len(free.q) // 2]]))[:, 9:]
    inward = (p_WE[1] - p_WE[0]) / np.linalg.norm(p_WE[1] - p_WE[0])
    beside = box_at([0.02, 0.02, 0.02], p_WE[0] + 0.06 * inward)
    world = panda_arm.among([beside], 0.0, -1.0, -1.0)
    kept = excess_along(world, spaced(corners))
    world = panda_arm.among([beside], kept, -1.0, -1.0)
    assert excess_along(world, free.q) < -1e-4
    tight = shown_of(world, corners)
    assert excess_along(world, tight.q) > 0.5 * excess_along(world, free.q)
    assert nearest(tight.q) < nearest(free.q)
