"""A verified motion and the arm's posture along it: when other motions are looked for."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from drake_oa.common.messages import (
    EllipsoidSet,
    HoldCause,
    ObstacleClouds,
    PolicyState,
    TablePlane,
)
from drake_oa.geometry.annulus import Annulus
from drake_oa.policy.dmp import imitate, local_frame, minimum_jerk
from drake_oa.posture.posture_planner import ArmSight, ArmWay, WholeArm
from drake_oa.posture.waypoint_tree import Aside
from drake_oa.regulation.config import SearchParameters
from drake_oa.regulation.regressor import load_chain
from drake_oa.regulation.regulated_arm import ArmRegulator
from drake_oa.regulation.regulation import Regulation
from drake_oa.regulation.regulator import Regulator
from drake_oa.robot.arm import ArmModel
from drake_oa.scenario.loading import package_file

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

EMPTY = EllipsoidSet(stamp=0.0)


@pytest.fixture(scope="module")
def arm(posed_panda: Callable[[np.ndarray], ArmModel]) -> ArmModel:
    return posed_panda(START)


@pytest.fixture(scope="module")
def regulator(arm: ArmModel) -> ArmRegulator:
    dmp = imitate(*minimum_jerk(START, GOAL, duration=5.0))
    weights = load_chain(package_file("package://drake_oa/weights/regressor_chain.safetensors"))
    quick = SearchParameters(candidates=32, rounds=12, polish=0, steps=250)
    of_tool = Regulator(weights, dmp, 0.1, parameters=quick, begins_anew=True)
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
    for time, sought in (
        (0.5 * SearchParameters().seek_period, 0.0),
        (1.1 * SearchParameters().seek_period, 1.1 * SearchParameters().seek_period),
    ):
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


def test_without_a_posture_it_keeps_the_one_of_before_or_stays(
    arm: ArmModel, regulator: ArmRegulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = sight(arm, np.full((40, 3), [0.0, 0.6, 0.3]))
    first = regulator.update(Regulation(), UNDER_WAY, GOAL, BALL, TABLE, seen)

    def no_way(*_: object, **__: object) -> ArmWay:
        return ArmWay(failed=True, seen=seen.obstacles)

    monkeypatch.setattr(WholeArm, "kept", lambda *_, **__: None)
    monkeypatch.setattr(WholeArm, "planned", no_way)
    after = regulator.update(first, replace(UNDER_WAY, stamp=0.1), GOAL, BALL, TABLE, seen)
    assert after.way.motion is first.way.motion
    # Displaced by 10 cm the old posture is that of somewhere else.
    off = replace(UNDER_WAY, p_WE=START + [0.0, 0.0, 0.1], stamp=0.1)
    after = regulator.update(first, off, GOAL, BALL, TABLE, seen)
    np.testing.assert_array_equal(after.motion.q, np.tile(seen.q, (len(after.motion), 1)))
    assert after.way.concern == "no posture of the arm reaches all of the path"


def held_on(policy: PolicyState) -> PolicyState:
    return replace(policy, speed=0.0, hold=HoldCause.SPEED_SCALE)


def test_it_goes_to_a_point_beside_rests_there_and_begins_anew(
    arm: ArmModel, regulator: ArmRegulator
) -> None:
    point = START + [0.0, 0.0, 0.15]
    first = regulator.update(Regulation(), UNDER_WAY, GOAL, BALL, TABLE, sight(arm))
    toward = replace(first, aside=Aside(p_WV=point, p_WG=GOAL))
    on_its_way = replace(UNDER_WAY, p_WG=point, R_WL=local_frame(START, point))
    after = regulator.update(toward, on_its_way, GOAL, BALL, TABLE, sight(arm))
    np.testing.assert_allclose(after.motion.p_WE[-1], point, atol=1e-3)
    np.testing.assert_array_equal(after.coupling(BALL).p_WV, point)
    # Nothing in view is no reason to forget it.
    alone = regulator.update(toward, on_its_way, GOAL, EMPTY, TABLE, sight(arm))
    np.testing.assert_array_equal(alone.coupling(EMPTY).p_WV, point)
    there = replace(on_its_way, p_WE=point - [0.0, 0.0, 0.005])
    held = regulator.update(after, there, GOAL, BALL, TABLE, sight(arm))
    assert held.note == "at the point beside the obstacle"
    np.testing.assert_array_equal(held.aside.p_WV, point)
    rests = replace(there, speed=0.0, note=held.note)
    anew = regulator.update(held, rests, GOAL, BALL, TABLE, sight(arm))
    assert (anew.note, anew.anew, len(anew.aside.p_WV)) == ("", True, 0)
    # By way of a further point it begins anew toward that.
    beyond = point + [0.0, 0.1, 0.0]
    two = replace(held, aside=Aside().by(np.array([point, beyond]), GOAL))
    anew = regulator.update(two, rests, GOAL, BALL, TABLE, sight(arm))
    assert anew.anew
    np.testing.assert_array_equal(anew.coupling(BALL).p_WV, beyond)
    assert not len(anew.aside.further)


@pytest.mark.parametrize(
    ("hold", "goal", "kept"),
    [
        (HoldCause.NONE, GOAL, True),
        (HoldCause.SPEED_SCALE, GOAL, True),
        (HoldCause.OBSTACLES, GOAL, False),
        (HoldCause.NONE, GOAL + [0.0, 0.05, 0.0], False),
    ],
)
def test_a_way_aside_that_is_of_no_use_is_given_up(
    arm: ArmModel, regulator: ArmRegulator, hold: HoldCause, goal: np.ndarray, kept: bool
) -> None:
    point = START + [0.0, 0.0, 0.15]
    first = regulator.update(Regulation(), UNDER_WAY, GOAL, BALL, TABLE, sight(arm))
    toward = replace(first, aside=Aside(p_WV=point, p_WG=GOAL), rests_since=0.0)
    rests = replace(UNDER_WAY, p_WG=point, speed=0.0, hold=hold, stamp=0.6)
    after = regulator.update(toward, rests, goal, BALL, TABLE, sight(arm))
    assert (len(after.aside.p_WV) > 0) == kept
    assert after.anew != kept


@pytest.fixture(scope="module")
def beside(arm: ArmModel) -> ArmSight:
    """The arm, and a little thing 35 mm beside its last link."""
    return sight(arm, np.full((40, 3), START + [0.0, -0.1, 0.2]))


def test_where_it_is_kept_beside_something_it_steps_aside(
    regulator: ArmRegulator, beside: ArmSight
) -> None:
    def later(before: Regulation, time: float, seen: float) -> Regulation:
        ball, policy = replace(BALL, stamp=seen), replace(held_on(UNDER_WAY), stamp=time)
        return regulator.update(before, policy, GOAL, ball, TABLE, beside)

    first = later(Regulation(), 0.0, 0.0)
    assert first.way.plan.works
    assert first.way.plan.distance[0] == pytest.approx(0.035, abs=0.002)
    assert later(first, 0.3, 0.3).sought == -np.inf
    # What was not seen for a while is no ground to go by.
    assert not len(later(first, 1.0, 0.5).aside.tree)
    found = later(first, 1.0, 1.0)
    assert found.anew
    np.testing.assert_array_equal(found.aside.p_WG, GOAL)
    assert 0.04 <= np.linalg.norm(found.aside.p_WV - START) <= 0.25
    assert later(first, 1.0, 1.0).aside.p_WV.tobytes() == found.aside.p_WV.tobytes()
    # Found in vain, the tree grows on.
    again = later(replace(found, aside=replace(found.aside, p_WV=np.zeros(0))), 2.1, 2.1)
    assert again.aside.tree.tried > found.aside.tree.tried
    np.testing.assert_array_equal(again.aside.tree.p_WV[0], START)


def test_points_that_lead_nowhere_are_tried_in_turn(
    regulator: ArmRegulator, beside: ArmSight, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[np.ndarray] = []

    def none_from(_: Regulator, *known: np.ndarray) -> list[Regulation]:
        asked.append(known[2])
        return []

    monkeypatch.setattr(Regulator, "others_from", none_from)
    after = regulator.update(Regulation(), held_on(UNDER_WAY), GOAL, BALL, TABLE, beside)
    for time in (1.0, 2.0):
        ball, policy = replace(BALL, stamp=time), replace(held_on(UNDER_WAY), stamp=time)
        after = regulator.update(after, policy, GOAL, ball, TABLE, beside)
    assert len(np.unique(asked, axis=0)) == 2


def test_held_with_nothing_near_it_stays(arm: ArmModel, regulator: ArmRegulator) -> None:
    seen = sight(arm, np.full((40, 3), [0.0, 0.6, 0.3]))
    rests = held_on(UNDER_WAY)
    first = regulator.update(Regulation(), rests, GOAL, BALL, TABLE, seen)
    later = replace(rests, stamp=1.0)
    after = regulator.update(first, later, GOAL, replace(BALL, stamp=1.0), TABLE, seen)
    assert after.sought == 1.0
    assert (len(after.aside.tree), len(after.aside.p_WV), after.anew) == (0, 0, False)


def test_a_point_has_to_be_over_the_table_and_in_the_workspace(regulator: ArmRegulator) -> None:
    of_tool = Regulator(
        load_chain(package_file("package://drake_oa/weights/regressor_chain.safetensors")),
        imitate(*minimum_jerk(START, GOAL, duration=5.0)),
        0.1,
        parameters=SearchParameters(),
        table_height=0.05,
        annulus=Annulus(np.array([[0.0, 1.0], [0.3, 0.3], [0.7, 0.7]])),
    )
    points = np.array([[0.5, 0.0, 0.1], [0.5, 0.0, 0.04], [0.2, 0.0, 0.1], [0.8, 0.0, 0.1]])
    np.testing.assert_array_equal(of_tool.inside(points, TABLE), [True, False, False, False])
    np.testing.assert_array_equal(of_tool.inside(points, None), [True, True, False, False])


def test_from_within_a_cloud_no_way_leads_aside(
    arm: ArmModel, regulator: ArmRegulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Regulator, "others_from", lambda *_: pytest.fail("no leg works"))
    block = np.random.default_rng(0).uniform(-0.15, 0.15, (2000, 3)) + [0.0, 0.0, 0.5]
    rests = replace(UNDER_WAY, speed=0.0)
    stuck = regulator.update(Regulation(), rests, GOAL, BALL, TABLE, sight(arm, block))
    assert (stuck.sought, len(stuck.aside.p_WV)) == (0.0, 0)
