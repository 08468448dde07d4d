"""Inverse kinematics of the Panda."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from drake_oa.robot.inverse_kinematics import solve_tool_pose
from drake_oa.robot.plant import RobotPlant

DOWN = RollPitchYaw(np.pi, 0.0, 0.0).ToRotationMatrix()
Q_START = np.array([-0.7401, 0.1857, 0.0143, -1.9017, -0.003, 2.0874, 0.0608, 0.02, 0.03])
TOOL = "panda_hand_tcp"


@pytest.fixture(scope="module")
def plant(panda: RobotPlant) -> MultibodyPlant:
    return panda.plant


def solve(
    plant: MultibodyPlant,
    p: list[float] | np.ndarray,
    R: RotationMatrix = DOWN,
    thorough: bool = True,
) -> np.ndarray:
    return solve_tool_pose(plant, TOOL, RigidTransform(R, p), Q_START, thorough=thorough)


def pose(plant: MultibodyPlant, q: np.ndarray) -> RigidTransform:
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    return plant.GetFrameByName(TOOL).CalcPoseInWorld(context)


def test_the_solution_stays_near_the_seed_and_is_repeatable(plant: MultibodyPlant) -> None:
    q = solve(plant, [0.45, -0.4, 0.3])
    np.testing.assert_allclose(q, Q_START, atol=1e-2)
    np.testing.assert_array_equal(q, solve(plant, [0.45, -0.4, 0.3]))


def test_what_is_within_reach_is_found(plant: MultibodyPlant) -> None:
    """Poses of random configurations; every second one has two joints at their limits."""
    random = np.random.default_rng(8)
    lower, upper = plant.GetPositionLowerLimits()[:7], plant.GetPositionUpperLimits()[:7]
    for number in range(40):
        q = Q_START.copy()
        q[:7] = random.uniform(lower, upper)
        if number % 2 == 0:
            joints = random.integers(7, size=2)
            q[joints] = np.where(random.random(2) < 0.5, lower[joints], upper[joints])
        X = pose(plant, q)
        found = solve_tool_pose(plant, TOOL, X, Q_START)
        assert pose(plant, found).IsNearlyEqualTo(X, 2e-6), number
        np.testing.assert_allclose(found[7:], Q_START[7:], atol=1e-3)
        assert (found >= plant.GetPositionLowerLimits()).all()
        assert (found <= plant.GetPositionUpperLimits()).all()


def test_a_pose_out_of_reach_is_refused_with_what_is_possible(plant: MultibodyPlant) -> None:
    with pytest.raises(ValueError, match=r"out of reach: panda_hand_tcp .*1\.2.*0\.404 m"):
        solve(plant, [1.2, 0.0, 0.3])
    with pytest.raises(ValueError, match="out of reach"):
        solve(plant, [0.05, 0.0, 0.2], thorough=False)
    solve(plant, [0.5, 0.0, 0.2])


def test_any_robot_is_told_how_near_it_comes() -> None:
    other = MultibodyPlant(0.0)
    arm = """<robot name="other"><link name="base"/><link name="tip"/>
        <joint name="lift" type="prismatic"><parent link="base"/><child link="tip"/>
        <axis xyz="0 0 1"/><limit lower="0" upper="0.5" effort="1"/></joint></robot>"""
    Parser(other).AddModelsFromString(arm, "urdf")
    other.WeldFrames(other.world_frame(), other.GetFrameByName("base"))
    other.Finalize()
    with pytest.raises(ValueError, match=r"as near as 1\.500 m, to \[0\.0, 0\.0, 0\.5\]$"):
        solve_tool_pose(other, "tip", RigidTransform([0.0, 0.0, 2.0]), np.zeros(1))
