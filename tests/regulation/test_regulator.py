"""Regulation from one observation to the next: when a motion is looked at again."""

from dataclasses import replace

import numpy as np
import pytest

from drake_oa.common.messages import EllipsoidSet, PolicyState
from drake_oa.policy.dmp import Dmp, imitate, local_frame, minimum_jerk
from drake_oa.regulation.config import SearchParameters
from drake_oa.regulation.regressor import load_chain
from drake_oa.regulation.regulation import Hold, Regulation
from drake_oa.regulation.regulator import Regulator
from drake_oa.scenario.loading import package_file

START, GOAL = np.array([0.0, 0.0, 0.3]), np.array([1.0, 0.0, 0.3])
AT_START = PolicyState(p_WE=START, p_WS=START, p_WG=GOAL, R_WL=local_frame(START, GOAL), speed=0.2)
BALL = EllipsoidSet(
    stamp=0.0,
    p_WO=np.array([[0.5, 0.05, 0.3]]),
    R_WO=np.eye(3)[None],
    semi_axes=np.full((1, 3), 0.1),
    v_WO=np.zeros((1, 3)),
    ids=np.array([4]),
)
NOTE = "no motion that clears obstacle 4 found"


def regulator(*, begins_anew: bool = True) -> Regulator:
    dmp: Dmp = imitate(*minimum_jerk(START, GOAL, duration=5.0))
    weights = load_chain(package_file("package://drake_oa/weights/regressor_chain.safetensors"))
    quick = SearchParameters(candidates=32, rounds=12, polish=0, steps=250)
    return Regulator(weights, dmp, 0.1, parameters=quick, begins_anew=begins_anew)


@pytest.fixture(scope="module")
def held() -> tuple[Regulation, PolicyState]:
    """A motion that was verified, and is held for a reason; the policy rests on its way."""
    kept = regulator().update(Regulation(), AT_START, GOAL, BALL, None)
    assert not kept.held
    on_way = kept.motion.p_WE[len(kept.motion) // 4]
    rests = replace(AT_START, p_WE=on_way, phase=0.4, speed=0.0, stamp=2.0, note=NOTE)
    return replace(kept, hold=Hold.NO_MOTION, held_by=4), rests


def test_a_held_motion_begins_anew_where_one_from_there_will_do(
    held: tuple[Regulation, PolicyState],
) -> None:
    before, policy = held
    after = regulator().update(before, policy, GOAL, BALL, None)
    assert after.anew
    assert after.tried == policy.stamp
    # It goes on being held until the policy has begun anew.
    assert after.note == NOTE
    assert after.coupling(BALL).anew
    begun = replace(policy, p_WS=policy.p_WE, z_W=np.zeros(3), phase=1.0)
    again = regulator().update(after, begun, GOAL, BALL, None)
    assert not again.anew
    assert not again.held


@pytest.mark.parametrize("change", [{"speed": 0.1}, {"p_WE": START}, {"p_WE": GOAL}])
def test_a_motion_that_goes_or_is_at_an_end_does_not(
    held: tuple[Regulation, PolicyState], change: dict[str, object]
) -> None:
    before, policy = held
    policy = replace(policy, **change)  # type: ignore[arg-type]
    assert not regulator().update(before, policy, GOAL, BALL, None).anew


def test_it_is_not_looked_for_with_every_frame_nor_where_it_may_not(
    held: tuple[Regulation, PolicyState],
) -> None:
    before, policy = held
    tried = replace(before, tried=policy.stamp - 0.1)
    assert not regulator().update(tried, policy, GOAL, BALL, None).anew
    assert not regulator(begins_anew=False).update(before, policy, GOAL, BALL, None).anew


def test_a_motion_that_was_displaced_is_verified_again() -> None:
    one = regulator()
    kept = one.update(Regulation(), AT_START, GOAL, BALL, None)
    on_way = replace(AT_START, p_WE=kept.motion.p_WE[3], phase=0.6, stamp=1.0)
    assert one.update(kept, on_way, GOAL, BALL, None).motion is kept.motion
    aside = replace(on_way, p_WE=on_way.p_WE + [0.0, -0.06, 0.0])
    again = one.update(kept, aside, GOAL, BALL, None)
    np.testing.assert_allclose(again.motion.p_WE[0], aside.p_WE)


def test_other_motions_make_detours_of_several_sizes() -> None:
    one = regulator()
    kept = one.update(Regulation(), AT_START, GOAL, BALL, None)
    others = list(one.others(kept, AT_START))
    assert len(others) > 8
    for other in others:
        assert other.for_arm
        assert other.sought == AT_START.stamp
        np.testing.assert_allclose(other.motion.p_WE[-1], GOAL, atol=2e-3)
    assert max(other.remaining for other in others) > 1.3 * kept.remaining
    assert list(one.others_anew(kept, AT_START)) == []


def test_another_motion_is_kept_while_it_will_do() -> None:
    one = regulator()
    other = next(one.others(one.update(Regulation(), AT_START, GOAL, BALL, None), AT_START))
    later = replace(AT_START, stamp=0.1)
    noisy = replace(BALL, stamp=0.1, p_WO=BALL.p_WO + 1e-3)
    np.testing.assert_array_equal(one.update(other, later, GOAL, noisy, None).genes, other.genes)
    # It is no longer where the obstacle is in its way,
    on_it = replace(BALL, stamp=0.1, p_WO=other.motion.p_WE[len(other.motion) // 2][None])
    assert not one.update(other, later, GOAL, on_it, None).for_arm
    # nor, where something moves, for long.
    moving = replace(noisy, v_WO=np.array([[0.0, 0.02, 0.0]]))
    assert one.update(other, later, GOAL, moving, None).for_arm
    late = replace(AT_START, stamp=1.5)
    assert not one.update(other, late, GOAL, replace(moving, stamp=1.5), None).for_arm


def test_others_begin_anew_where_a_motion_rests(held: tuple[Regulation, PolicyState]) -> None:
    before, policy = held
    others = list(regulator().others_anew(before, policy))
    assert others
    for other in others:
        np.testing.assert_allclose(other.motion.p_WE[0], policy.p_WE)
    assert list(regulator(begins_anew=False).others_anew(before, policy)) == []
