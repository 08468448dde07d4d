"""Postures along the null space: equally far apart, on the tool's pose, all round."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_oa.common.messages import ObstacleClouds, TablePlane
from drake_oa.posture import trace_kernels as kernels
from drake_oa.posture.arm_surroundings import ArmSurroundings
from drake_oa.posture.posture_plan import plan_posture
from drake_oa.robot.arm import ArmModel

START, GOAL = np.array([0.6, -0.3, 0.3]), np.array([0.4, 0.3, 0.3])
STEP = 0.1
BOARD_START, BOARD_GOAL = (0.5457, 0.5081, 0.1336), (0.3672, -0.2255, 0.1825)
BOARD_CENTER, BOARD_YAW = (0.2763, 0.0419, 0.6836), 2.0555
BOARD_SIZE = (0.1144, 0.1280, 0.0208)
BOARD_Q = (0.4943, 0.8765, 0.3643, -1.2963, -0.3258, 2.1150, 0.1213)
"""A motion under a board in the elbow's way, and the arm at its start."""


@pytest.fixture(scope="module")
def arm(posed_panda: Callable[[np.ndarray], ArmModel]) -> ArmModel:
    return posed_panda(START)


def traced(
    arm: ArmModel, p_WE: np.ndarray, q: np.ndarray, most: int = 60, margin: float = 0.1
) -> tuple[np.ndarray, np.ndarray]:
    """The postures of a layer, and the directions of the null space there."""
    nodes, along = np.zeros((256, 7)), np.zeros((256, 7))
    roll = np.eye(7)[2]
    X_WB, R_WE = np.empty((8, 4, 4)), np.array(arm.R_WE)
    count = kernels.trace(
        np.array(q), roll, p_WE, R_WE, STEP, most, arm.arrays, margin, X_WB, nodes, along, 0
    )
    seed, direction = nodes[count // 3].copy(), along[count // 3].copy()
    again = kernels.trace(
        seed, direction, p_WE, R_WE, STEP, most, arm.arrays, margin, X_WB, nodes, along, count
    )
    assert again == count, "a posture of the curve begins no other curve"
    return nodes[:count], along[:count]


@settings(max_examples=10)
@given(
    # The layer before is a few centimetres away.
    shift=st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.floats(-0.05, 0.05)),
)
def test_postures_along_the_null_space(arm: ArmModel, shift: tuple[float, ...]) -> None:
    p_WE = START + shift
    nodes, along = traced(arm, p_WE, arm.posture)
    assert len(nodes) > 20
    for q, direction in zip(nodes, along, strict=True):
        X_WE = arm.poses(q)[-1]
        np.testing.assert_allclose(X_WE[:3, 3], p_WE, atol=3e-4)
        np.testing.assert_allclose(X_WE[:3, :3], arm.R_WE, atol=3e-4)
        moved = arm.poses(q + 1e-4 * direction)[-1]
        np.testing.assert_allclose(moved, X_WE, atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(direction), 1.0)
    assert (nodes >= arm.lower + 0.1).all()
    assert (nodes <= arm.upper - 0.1).all()
    apart = np.linalg.norm(nodes[:, None] - nodes, axis=2) + 9.0 * np.eye(len(nodes))
    assert apart.min() > 0.6 * STEP
    assert apart.min(axis=1).max() < 1.1 * STEP


def test_a_few_to_each_side(arm: ArmModel) -> None:
    nodes, _ = traced(arm, START, arm.posture, most=4)
    assert len(nodes) == 9
    np.testing.assert_allclose(nodes[0], arm.posture, atol=1e-3)


def test_nothing_out_of_reach_or_outside_the_limits(arm: ArmModel) -> None:
    assert not len(traced(arm, START + [1.0, 0.0, 0.0], arm.posture)[0])
    assert not len(traced(arm, START, arm.posture, margin=2.0)[0])


def test_the_elbow_swings_far_round_a_board(arm: ArmModel) -> None:
    """The null space comes apart on the way; no grid of the roll's values leads along it."""
    start, goal = np.array(BOARD_START), np.array(BOARD_GOAL)
    s = np.linspace(0.0, 1.0, 38)
    share = 10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5
    path = start + share[:, None] * (goal - start)
    axes = [np.linspace(-0.5, 0.5, 12) * edge for edge in BOARD_SIZE]
    x, y, z = (a.ravel() for a in np.meshgrid(*axes))
    c, w = np.cos(BOARD_YAW), np.sin(BOARD_YAW)
    cloud = np.column_stack([c * x - w * y, w * x + c * y, z]) + BOARD_CENTER
    around = ArmSurroundings.of(
        ObstacleClouds(stamp=0.0, clouds_W=(cloud,), ids=np.arange(1)), TablePlane()
    )
    posed = replace(arm, posture=np.array(BOARD_Q))
    plan = plan_posture(posed, around, np.array(BOARD_Q), s, path, seconds=5.0)
    assert plan.works
    assert np.ptp(plan.q[:, 2]) > 1.5
    for q, p_WE in zip(plan.q, path, strict=True):
        np.testing.assert_allclose(arm.poses(q)[-1][:3, 3], p_WE, atol=1e-3)
