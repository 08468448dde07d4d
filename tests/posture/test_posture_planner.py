"""When the posture is planned anew, and what is said where there is none."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from drake_oa.common.messages import ObstacleClouds, PlannedMotion, TablePlane
from drake_oa.posture.posture_planner import ArmSight, ArmWay, WholeArm
from drake_oa.robot.arm import ArmModel

START, GOAL = np.array([0.6, -0.3, 0.3]), np.array([0.4, 0.3, 0.3])
TABLE = TablePlane()
NOTHING = ObstacleClouds(stamp=0.0)


@pytest.fixture(scope="module")
def arm(posed_panda: Callable[[np.ndarray], ArmModel]) -> ArmModel:
    return posed_panda(START)


def motion(shift: float = 0.0) -> PlannedMotion:
    s = np.linspace(0.0, 1.0, 40)
    x = 10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5
    return PlannedMotion(s, START + x[:, None] * (GOAL - START) + [0.0, 0.0, shift])


def sight(arm: ArmModel, *clouds: np.ndarray) -> ArmSight:
    seen = ObstacleClouds(stamp=0.0, clouds_W=clouds, ids=np.arange(len(clouds)))
    return ArmSight(np.array(arm.posture), seen)


def board(z: float = 0.7) -> np.ndarray:
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0.02, 0.18, 0.01), np.arange(0.1, 0.3, 0.01)))
    return np.column_stack([x, y, np.full_like(x, z)])


def test_it_is_planned_anew_when_something_changes(arm: ArmModel) -> None:
    planner, first = WholeArm(arm), sight(arm, board())
    given = {"seconds": 5.0, "time": 0.0}
    way = planner.planned(motion(), first, TABLE, **given)
    assert way.plan.works
    assert way.concern == ""
    assert way.motion.q.shape == (40, 7)

    def stays(wanted: PlannedMotion, now: ArmSight) -> bool:
        return planner.kept(way, wanted, now, TABLE, s=0.0, **given) is not None

    noise = np.random.default_rng(0).normal(0.0, 0.001, board().shape)
    assert stays(way.motion, first)
    assert stays(motion(0.005), sight(arm, board() + noise))
    assert not stays(motion(0.02), first)
    assert not stays(way.motion, sight(arm, board(0.62)))
    assert not stays(way.motion, ArmSight(arm.posture + 0.5, first.obstacles))
    assert planner.kept(ArmWay(), motion(), first, TABLE, s=0.0, **given) is None
    # Another observation of the same clouds is nothing new; another table is.
    again = replace(first.obstacles, stamp=0.1)
    kept = planner.kept(way, way.motion, replace(first, obstacles=again), TABLE, s=0.0, **given)
    assert kept is way
    now = replace(first, obstacles=again)
    lower = TablePlane(offset=-0.1)
    assert planner.kept(way, way.motion, now, lower, s=0.0, **given).table is lower
    aside = replace(now, viewpoint_W=np.array([2.0, 0.0, 0.6]))
    assert planner.kept(way, way.motion, aside, TABLE, s=0.0, **given) is not way


def test_a_motion_that_is_too_fast_for_the_arm_is_made_slower(arm: ArmModel) -> None:
    way = WholeArm(arm).planned(motion(), sight(arm), TABLE, seconds=0.9, time=0.0)
    assert way.slower > 1.0


def test_what_cannot_be_done_is_said_and_not_tried_with_every_frame(arm: ArmModel) -> None:
    planner = WholeArm(arm)
    block = np.random.default_rng(0).uniform(-0.15, 0.15, (4000, 3)) + [0.0, 0.0, 0.5]
    way = planner.planned(motion(), sight(arm, block), TABLE, seconds=5.0, time=0.0)
    assert way.concern.startswith("no posture of the arm clears obstacle 0: short by")
    far = replace(motion(), p_WE=motion().p_WE * [1.0, 1.0, 4.0])
    lost = planner.planned(far, sight(arm), TABLE, seconds=5.0, time=0.0)
    assert lost.concern == "no posture of the arm reaches all of the path"
    for time, same in ((0.2, True), (1.0, False)):
        kept = planner.kept(lost, far, sight(arm), TABLE, s=0.0, seconds=5.0, time=time)
        assert (kept is lost) == same


def test_an_arm_of_six_joints_is_refused(arm: ArmModel) -> None:
    with pytest.raises(ValueError, match="7 joints"):
        WholeArm(replace(arm, posture=np.zeros(6)))
