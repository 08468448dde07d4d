"""A verified motion and the arm's posture along it: when other motions are looked for."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from drake_oa.action import SCALED_TO_REST
from drake_oa.arm_motion import ArmModel
from drake_oa.arm_regulation import ArmRegulator
from drake_oa.dmp import imitate, local_frame, minimum_jerk
from drake_oa.regressor import load_chain
from drake_oa.regulation import Regulation
from drake_oa.scenario import package_file
from drake_oa.values import EllipsoidSet, ObstacleClouds, PolicyState, TablePlane
from drake_oa.verification import SearchParameters
from drake_oa.verified_regulation import SEEK_AGAIN, Regulator
from drake_oa.whole_arm import ArmSight, WholeArm

START, GOAL = np.array([0.6, -0.3, 0.3]), np.array([0.4, 0.3, 0.3])
TABLE = TablePlane()
UNDER_WAY = PolicyState(p_WE=START, p_WS=START, p_WG=GOAL, R_WL=local_frame(START, GOAL), speed=0.2)
BALL = EllipsoidSet(
    stamp=0.0,
    p_WO=np.array([[0.5, 0.0, 0.28]]),
    R_WO=np.eye(3)[None],
    semi_axes=np.full((1, 3), 0.08),
    v_WO=np.zeros((1, 3)),
    ids=np.array([0]),
)


@pytest.fixture(scope="module")
def arm(posed_panda: Callable[[np.ndarray], ArmModel]) -> ArmModel:
    return posed_panda(START)


@pytest.fixture(scope="module")
def regulator(arm: ArmModel) -> ArmRegulator:
    dmp = imitate(*minimum_jerk(START, GOAL, duration=5.0))
    weights = load_chain(package_file("package://drake_oa/weights/regressor_chain.npz"))
    quick = SearchParameters(candidates=32, rounds=12, polish=0, steps=250)
    of_tool = Regulator(weights, dmp, 0.1, parameters=quick)
    return ArmRegulator(of_tool, WholeArm(arm), dmp)


def sight(arm: ArmModel, *clouds: np.ndarray) -> ArmSight:
    seen = ObstacleClouds(stamp=0.0, clouds_W=clouds, ids=np.arange(len(clouds)))
    return ArmSight(np.array(arm.posture), seen)


def test_where_the_arm_can_follow_no_other_is_sought(
    arm: ArmModel, regulator: ArmRegulator
) -> None:
    after = regulator.update(Regulation(), UNDER_WAY, GOAL, BALL, TABLE, sight(arm))
    assert after.way.plan.works
    assert not after.for_arm
    assert after.sought == -np.inf
    assert after.motion.q.shape == (len(after.motion), 7)


def test_where_it_cannot_others_are_sought_now_and_then(
    arm: ArmModel, regulator: ArmRegulator
) -> None:
    # Between the base and the elbow: no motion of the tool is of any help.
    block = np.random.default_rng(0).uniform(-0.15, 0.15, (2000, 3)) + [0.0, 0.0, 0.5]
    seen = sight(arm, block)
    first = regulator.update(Regulation(), UNDER_WAY, GOAL, BALL, TABLE, seen)
    assert not first.for_arm
    assert first.way.concern.startswith("no posture of the arm clears obstacle 0")
    assert first.sought == UNDER_WAY.stamp
    assert not first.anew
    for time, sought in ((0.5 * SEEK_AGAIN, 0.0), (1.1 * SEEK_AGAIN, 1.1 * SEEK_AGAIN)):
        later = replace(UNDER_WAY, stamp=time)
        assert regulator.update(first, later, GOAL, BALL, TABLE, seen).sought == sought


def test_points_that_are_not_finite_are_as_if_nothing_new_was_seen(
    arm: ArmModel, regulator: ArmRegulator
) -> None:
    seen = sight(arm, np.full((40, 3), [0.0, 0.6, 0.3]))
    first = regulator.update(Regulation(), UNDER_WAY, GOAL, BALL, TABLE, seen)
    lost = sight(arm, np.full((40, 3), np.nan))
    again = regulator.update(first, replace(UNDER_WAY, stamp=0.03), GOAL, BALL, TABLE, lost)
    assert again.way.seen is first.way.seen
    np.testing.assert_array_equal(again.motion.q, first.motion.q)


def test_it_goes_to_a_point_beside_rests_there_and_begins_anew(
    arm: ArmModel, regulator: ArmRegulator
) -> None:
    point = START + [0.0, 0.0, 0.15]
    first = regulator.update(Regulation(), UNDER_WAY, GOAL, BALL, TABLE, sight(arm))
    toward = replace(first, p_WV=point)
    on_its_way = replace(UNDER_WAY, p_WG=point, R_WL=local_frame(START, point))
    after = regulator.update(toward, on_its_way, GOAL, BALL, TABLE, sight(arm))
    np.testing.assert_allclose(after.motion.p_WE[-1], point, atol=1e-3)
    np.testing.assert_array_equal(after.coupling(BALL).p_WV, point)
    there = replace(on_its_way, p_WE=point - [0.0, 0.0, 0.005])
    held = regulator.update(after, there, GOAL, BALL, TABLE, sight(arm))
    assert held.note == "at the point beside the obstacle"
    np.testing.assert_array_equal(held.p_WV, point)
    anew = regulator.update(held, replace(there, speed=0.0), GOAL, BALL, TABLE, sight(arm))
    assert (anew.note, anew.anew, len(anew.p_WV)) == ("", True, 0)


def test_points_beside_are_tried_in_turn_where_it_is_kept_at_rest(
    arm: ArmModel, regulator: ArmRegulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[np.ndarray] = []

    def none_from(_: Regulator, *known: np.ndarray) -> list[Regulation]:
        asked.append(known[2])
        return []

    monkeypatch.setattr(Regulator, "others_from", none_from)
    cloud = np.full((40, 3), [0.0, 0.6, 0.3])
    rests = replace(UNDER_WAY, speed=0.0, note=SCALED_TO_REST)

    def later(before: Regulation, time: float, seen: float) -> Regulation:
        ball, policy = replace(BALL, stamp=seen), replace(rests, stamp=time)
        return regulator.update(before, policy, GOAL, ball, TABLE, sight(arm, cloud))

    first = later(Regulation(), 0.0, 0.0)
    assert first.way.plan.works
    assert later(first, 0.3, 0.3).sought == -np.inf
    # What was not seen for a while is no ground to go by.
    assert later(first, 1.0, 0.5).asides == 0
    assert not asked
    once = later(first, 1.0, 1.0)
    assert 3 <= once.asides < 52
    assert len(asked) == 3
    again = later(once, 2.0, 2.0)
    assert again.asides > once.asides
    assert len(np.unique(asked, axis=0)) == 6


def test_from_within_a_cloud_no_way_leads_aside(
    arm: ArmModel, regulator: ArmRegulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Regulator, "others_from", lambda *_: pytest.fail("no leg works"))
    block = np.random.default_rng(0).uniform(-0.15, 0.15, (2000, 3)) + [0.0, 0.0, 0.5]
    rests = replace(UNDER_WAY, speed=0.0)
    stuck = regulator.update(Regulation(), rests, GOAL, BALL, TABLE, sight(arm, block))
    assert (stuck.sought, stuck.asides, len(stuck.p_WV)) == (0.0, 0, 0)
