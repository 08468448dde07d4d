"""The posture along a path: free arms stay, others go round, limits are kept."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.math import RotationMatrix

from drake_oa.common.messages import ObstacleClouds, TablePlane
from drake_oa.posture.arm_surroundings import ArmSurroundings
from drake_oa.posture.posture_plan import (
    PostureParameters,
    PosturePlan,
    _leaving,
    plan_posture,
    reviewed,
)
from drake_oa.robot import arm_kernels as kernels
from drake_oa.robot.arm import ArmModel

ROLL = 2
"""The upper arm's roll, whose value tells postures apart."""

START, GOAL = np.array([0.6, -0.3, 0.3]), np.array([0.4, 0.3, 0.3])
SECONDS = 5.0
BOARD = (np.array([0.1, 0.2, 0.7]), np.array([0.16, 0.22, 0.02]))


@pytest.fixture(scope="module")
def arm(posed_panda: Callable[[np.ndarray], ArmModel]) -> ArmModel:
    return posed_panda(START)


def box_cloud(center: np.ndarray, size: np.ndarray, apart: float = 0.01) -> np.ndarray:
    """Points of a grid on the faces of a box."""
    axes = [np.linspace(-0.5, 0.5, max(2, int(edge / apart) + 1)) * edge for edge in size]
    x, y, z = (a.ravel() for a in np.meshgrid(*axes))
    points = np.column_stack([x, y, z])
    return points[(np.abs(np.abs(points) - 0.5 * size) < 1e-9).any(axis=1)] + center


def path(count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Minimum jerk from start to goal."""
    s = np.linspace(0.0, 1.0, count)
    return s, START + (10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5)[:, None] * (GOAL - START)


def around(*clouds: np.ndarray, **changes: np.ndarray) -> ArmSurroundings:
    seen = ObstacleClouds(stamp=0.0, clouds_W=clouds, ids=np.arange(len(clouds)), **changes)
    return ArmSurroundings.of(seen, TablePlane())


def planned(arm: ArmModel, obstacles: ArmSurroundings, **changes: float) -> PosturePlan:
    return plan_posture(
        arm, obstacles, np.array(arm.posture), *path(), **{"seconds": SECONDS, **changes}
    )


def check_on_path(arm: ArmModel, plan: PosturePlan) -> None:
    for q, p_WE in zip(plan.q, path()[1], strict=True):
        X_WE = arm.poses(q)[-1]
        np.testing.assert_allclose(X_WE[:3, 3], p_WE, atol=1e-3)
        np.testing.assert_allclose(X_WE[:3, :3], arm.R_WE, atol=1e-3)


def away(arm: ArmModel, q: np.ndarray) -> float:
    return float((q - arm.posture) @ arm.mass @ (q - arm.posture))


def test_a_free_arm_goes_where_its_null_space_would_rest(arm: ArmModel) -> None:
    plan = planned(arm, around())
    assert plan.works
    check_on_path(arm, plan)
    # Turning the elbow either way from there costs more.
    q = plan.q[-1]
    target = arm.poses(q)[-1]
    for turn in (-0.3, 0.3):
        other = np.array(q)
        other[ROLL] += turn
        X_WB = np.empty((8, 4, 4))
        assert kernels.reach(
            other, target[:3, 3].copy(), target[:3, :3].copy(), ROLL, np.array(arm.X_PJ),
            X_WB, 8, 1e-6,
        )  # fmt: skip
        assert away(arm, q) < away(arm, other)


def test_the_elbow_goes_round_a_board(arm: ArmModel) -> None:
    board = around(box_cloud(*BOARD))
    free = planned(arm, around())
    hits = reviewed(free, arm, board, s=0.0, seconds=SECONDS)
    assert hits.distance.min() < 0.0
    assert hits.short > 0.0
    assert not hits.works
    plan = planned(arm, board)
    assert plan.works
    assert plan.distance.min() > 0.06
    check_on_path(arm, plan)
    assert (plan.q >= arm.lower + 0.1 - 1e-9).all()
    assert (plan.q <= arm.upper - 0.1 + 1e-9).all()
    rate = np.abs(np.diff(plan.q, axis=0)) / np.diff(plan.s)[:, None] / SECONDS
    assert (rate <= 0.82 * arm.speed).all()


def test_an_obstacle_that_will_have_left_is_not_gone_round(arm: ArmModel) -> None:
    leaves = around(box_cloud(*BOARD), v_WO=np.array([[0.0, 0.0, 0.5]]))
    plan = planned(arm, leaves)
    np.testing.assert_allclose(plan.q[-1], planned(arm, around()).q[-1], atol=0.05)


def test_what_cannot_be_cleared_is_told(arm: ArmModel) -> None:
    # The upper arm's own place.
    wall = box_cloud(np.array([0.0, 0.0, 0.5]), np.array([0.3, 0.3, 0.3]), apart=0.02)
    plan = planned(arm, around(wall))
    assert len(plan)
    assert not plan.works
    assert plan.short > 0.0
    assert plan.obstacle[plan.distance.argmin()] == 0


def test_a_path_out_of_reach_has_no_postures(arm: ArmModel) -> None:
    s, p_WE = path()
    plan = plan_posture(
        arm, around(), np.array(arm.posture), s, p_WE + 0.8 * s[:, None], seconds=SECONDS
    )
    assert not len(plan)
    assert not plan.works


def test_hurry_is_told(arm: ArmModel) -> None:
    plan = planned(arm, around(), seconds=0.3)
    assert plan.hurry > 1.0
    assert not plan.works


@settings(max_examples=5)
@given(yaw=st.floats(-0.6, 0.6))
def test_turning_everything_about_the_base_turns_the_first_joint(arm: ArmModel, yaw: float) -> None:
    R = RotationMatrix.MakeZRotation(yaw).matrix()
    turn = yaw * np.eye(7)[0]
    s, p_WE = path()
    cloud = box_cloud(*BOARD)
    # Voxels are those of the world: the same points, thinned already.
    seen = around(cloud).points.points
    one = plan_posture(arm, around(seen), np.array(arm.posture), s, p_WE, seconds=SECONDS)
    turned = replace(arm, posture=arm.posture + turn, R_WE=R @ arm.R_WE)
    turned = replace(turned, lower=arm.lower + turn, upper=arm.upper + turn)
    other = plan_posture(
        turned, around(seen @ R.T), arm.posture + turn, s, p_WE @ R.T, seconds=SECONDS
    )
    assert other.works
    # The voxels thin the turned points once more.
    np.testing.assert_allclose(other.q[-1] - turn, one.q[-1], atol=0.1)


def test_review_sees_what_came(arm: ArmModel) -> None:
    plan = planned(arm, around())
    rest = reviewed(plan, arm, around(box_cloud(*BOARD)), s=0.5, seconds=SECONDS)
    assert rest.s[0] >= 0.5
    assert len(rest) < len(plan)
    assert rest.distance.min() < plan.distance.min()
    assert not len(reviewed(PosturePlan(), arm, around(), s=0.0, seconds=1.0))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"q": np.zeros(6)}, "must be"),
        ({"q": np.full(7, np.nan)}, "finite"),
        ({"s": np.zeros(40)}, "increase"),
        ({"p_WE": np.zeros((40, 2))}, "must be"),
        ({"seconds": 0.0}, "seconds"),
        ({"seconds": np.inf}, "seconds"),
    ],
)
def test_bad_input_is_refused(arm: ArmModel, changes: dict, message: str) -> None:
    s, p_WE = path()
    given = {"q": np.array(arm.posture), "s": s, "p_WE": p_WE, "seconds": SECONDS, **changes}
    with pytest.raises(ValueError, match=message):
        plan_posture(arm, around(), **given)


@pytest.mark.parametrize(
    "changes",
    [
        {"link_clearance": 0.01},
        {"self_clearance": 0.0},
        {"limit_clearance": 0.05},
        {"speed_share": 0.0},
        {"near_weight": -1.0},
        {"motion_weight": np.nan},
    ],
)
def test_bad_parameters_are_refused(changes: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(changes))):
        PostureParameters(**changes)


def test_an_arm_of_six_joints_is_refused(arm: ArmModel) -> None:
    with pytest.raises(ValueError, match="7 joints"):
        planned(replace(arm, posture=np.zeros(6)), around())


def test_what_is_too_near_at_the_start_may_be_left_but_not_approached() -> None:
    stop = 0.035
    assert _leaving(np.array([0.02, 0.025, 0.03, 0.05, 0.01]), stop) == 3
    assert _leaving(np.array([0.05, 0.03, 0.02]), stop) == 1
    # By little each time, and yet nearer and nearer.
    assert _leaving(0.03 - 0.0015 * np.arange(15), stop) == 2
    assert _leaving(np.array([0.02]), stop) == 0
    assert _leaving(np.array([0.02, 0.03]), stop) == 1


def test_a_quick_plan_is_that_of_the_first_grid(arm: ArmModel) -> None:
    s = np.linspace(0.0, 1.0, 20)
    way = START + s[:, None] * [-0.1, 0.3, 0.0]
    free = ArmSurroundings.of(ObstacleClouds(stamp=0.0), TablePlane(), np.zeros(0))
    asked = (arm, free, np.array(arm.posture), s, way)
    quick = plan_posture(*asked, seconds=5.0, thorough=False)
    assert quick.works
    np.testing.assert_array_equal(quick.q, plan_posture(*asked, seconds=5.0).q)
    far = plan_posture(*asked[:4], way * [3.0, 1.0, 1.0], seconds=5.0, thorough=False)
    assert not len(far)
