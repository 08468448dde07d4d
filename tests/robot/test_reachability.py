"""What an arm reaches, by inverse kinematics over a grid."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from drake_oa.common.messages import FloatArray
from drake_oa.common.numba_tools import kernel_arrays
from drake_oa.diagrams.motion import robot_reachability
from drake_oa.robot import reachability as kernels
from drake_oa.robot.arm import ArmModel
from drake_oa.robot.arm_kernels import poses
from drake_oa.robot.config import Robot
from drake_oa.robot.inverse_kinematics import solve_pose, solve_tool_pose
from drake_oa.robot.plant import RobotPlant, home_positions, make_robot_plant
from drake_oa.robot.reachability import Reachability, reachability
from tests.builders import arm_of

ROBOT = Robot()


@cache
def panda() -> RobotPlant:
    return make_robot_plant(ROBOT)


@cache
def arm() -> ArmModel:
    return arm_of(panda(), RollPitchYaw(ROBOT.rpy_WE).ToRotationMatrix())


def mapped() -> Reachability:
    return reachability(arm())


def in_reach_of_drake(p_WE: FloatArray) -> bool:
    try:
        solve_tool_pose(
            panda().plant,
            panda().tool_frame.name(),
            RigidTransform(RotationMatrix(arm().R_WE), p_WE),
            home_positions(ROBOT),
        )
    except ValueError:
        return False
    return True


@pytest.mark.parametrize("direction", [(1.0, 0.2, 0.1), (0.3, -1.0, 0.4), (0.2, 0.5, 1.0)])
def test_its_edge_is_where_drakes_inverse_kinematics_ends(direction: tuple[float, ...]) -> None:
    ray = np.array(direction) / np.linalg.norm(direction)
    along = np.linspace(0.4, 1.3, 901)[:, None] * ray
    margin = mapped().reach_margin(along)
    edge = along[np.flatnonzero(margin > 0.0)[-1]]
    assert in_reach_of_drake(edge - 0.02 * ray)
    assert not in_reach_of_drake(edge + 0.02 * ray)


def test_the_joint_margin_costs_reach() -> None:
    rng = np.random.default_rng(4)
    p = rng.uniform(-0.9, 0.9, (2000, 3))
    found = mapped()
    assert (found.joint_margin(p) <= found.reach_margin(p) + 0.01).all()
    assert ((found.joint_margin(p) < 0.0) & (found.reach_margin(p) > 0.0)).any()


def test_another_orientation_of_the_tool_is_mapped_too() -> None:
    ahead = replace(ROBOT, rpy_WE=[0.0, np.pi / 2.0, 0.0])
    found = robot_reachability(ahead)
    assert found is not None
    assert found.reach_margin(np.array([0.6, 0.0, 0.5])) > 0.05
    # The hand, now ahead of the flange, adds to the reach.
    p_WE = np.array([0.8, 0.0, 0.6])
    assert found.reach_margin(p_WE) > 0.02
    assert mapped().reach_margin(p_WE) < -0.02


def test_the_same_arm_is_mapped_once() -> None:
    assert reachability(arm()) is reachability(replace(arm(), posture=arm().posture.copy()))


def test_a_way_round_the_back_of_the_base_is_not_followed() -> None:
    start, goal = [0.45, -0.45, 0.3], [0.45, 0.45, 0.3]
    found = mapped()
    ahead = np.array([start, [0.45, 0.0, 0.5], goal])
    behind = np.array([start, [-0.45, 0.0, 0.3], goal])
    assert (found.reach_margin(behind) > 0.0).all()
    assert found.followed(ahead) == 3
    assert found.followed(behind) < 3


def test_poses_near_by_are_solved_within_the_limits() -> None:
    rng = np.random.default_rng(0)
    model, plant = arm(), panda().plant
    X_PJ, lower, upper = kernel_arrays(model.X_PJ, model.lower, model.upper)
    X_WB, context = np.empty((8, 4, 4)), plant.CreateDefaultContext()
    fingers = home_positions(ROBOT)[7:]
    solved = 0
    for _ in range(300):
        asked = model.lower + rng.uniform(0.15, 0.85, 7) * (model.upper - model.lower)
        q = np.clip(asked + rng.uniform(-0.05, 0.05, 7), model.lower, model.upper)
        poses(asked, X_PJ, X_WB)
        p, R = X_WB[7, :3, 3].copy(), X_WB[7, :3, :3].copy()
        if not solve_pose(q, p, R, lower, upper, X_PJ, X_WB):
            continue
        solved += 1
        assert (q >= model.lower).all()
        assert (q <= model.upper).all()
        plant.SetPositions(context, np.concatenate([q, fingers]))
        X_WE = panda().tool_frame.CalcPoseInWorld(context)
        np.testing.assert_allclose(X_WE.translation(), p, atol=1e-3)
        np.testing.assert_allclose(X_WE.rotation().matrix(), R, atol=5e-3)
    # The pull to the middle of the ranges leaves a few short of the pose: 52 of 10,000.
    assert solved >= 295


@given(at=st.tuples(*[st.floats(-1.0, 3.0)] * 3), slope=st.tuples(*[st.floats(-2.0, 2.0)] * 3))
def test_between_grid_points_it_is_linear_and_falls_beyond(
    at: tuple[float, ...], slope: tuple[float, ...]
) -> None:
    origin, spacing = np.array([-0.5, 0.0, 0.5]), 0.25
    nodes = origin + spacing * np.moveaxis(np.indices((7, 8, 9)), 0, -1)
    grid = np.ascontiguousarray(nodes @ np.array(slope))
    p = np.array([at])
    out = np.empty(1)
    kernels.interpolate(p, origin, spacing, grid, out)
    kept = np.clip(p, origin, origin + spacing * np.array([6, 7, 8]))
    expected = kept @ np.array(slope) - np.linalg.norm(p - kept)
    np.testing.assert_allclose(out, expected, atol=1e-9)
