"""The evasion layer alone, on scripted inputs."""

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator

from drake_oa.common.messages import Evasion, FloatArray, PolicyState
from drake_oa.common.thinking import Thinking
from drake_oa.geometry.solids import SolidScene, box, solids_of
from drake_oa.policy.dmp import imitate, minimum_jerk
from drake_oa.safety.config import EvasionParameters
from drake_oa.safety.guarded_arm import GuardedArm
from drake_oa.safety.obstacle_evasion import ObstacleEvasion
from tests.planning.arms import ArmAlone

PARAMETERS = EvasionParameters()
STEP, FRAME = 0.008, 1.0 / 30.0


class Bench:
    """A robot held at its home posture; what it sees can be changed."""

    def __init__(
        self, panda: ArmAlone, guarded: GuardedArm, thinking: Thinking | None = None
    ) -> None:
        q, self.p_WE = panda.q_full, panda.X_WE[9:]
        self.system = ObstacleEvasion(
            guarded,
            imitate(*minimum_jerk(np.zeros(3), [1.0, 0.0, 0.0], duration=5.0)),
            period=FRAME,
            step=STEP,
            thinking=thinking,
        )
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.give("robot_state", np.concatenate([q, np.zeros(len(q))]))
        self.give("policy_state", PolicyState(p_WE=self.p_WE))

    def give(self, port: str, value: object) -> None:
        is_vector = isinstance(value, np.ndarray)
        self.system.GetInputPort(port).FixValue(self.context, value if is_vector else Value(value))

    def see(self, offset: FloatArray, v_WO: FloatArray) -> None:
        """A cube at an offset from the tool point."""
        stamp = self.context.get_time()
        X_WO = RigidTransform(self.p_WE + offset).GetAsMatrix4()
        cube = replace(box([0.08] * 3), X_WO=X_WO, v_WO=v_WO, stamp=stamp, name=3)
        self.give("solids_W", SolidScene(stamp, solids_of([cube]), ("obstacle 3",)))

    def now(self) -> tuple[FloatArray, Evasion]:
        velocity = self.system.GetOutputPort("evasion").Eval(self.context)
        return np.array(velocity), self.system.GetOutputPort("evading").Eval(self.context)

    def run(self, duration: float) -> FloatArray:
        """(T, 3) velocities within each step until then."""
        found, begin = [], round(self.context.get_time() / STEP)
        for number in range(round(duration / STEP)):
            self.simulator.AdvanceTo((begin + number + 0.5) * STEP)
            found.append(self.now()[0])
        return np.array(found)


@pytest.fixture
def bench(panda: ArmAlone, guarded: GuardedArm) -> Callable[..., Bench]:
    return lambda thinking=None: Bench(panda, guarded, thinking)


COMING = (np.array([0.3, 0.0, 0.0]), np.array([-0.3, 0.0, 0.0]))


def test_it_does_nothing_while_nothing_moves(
    bench: Callable[..., Bench], caplog: pytest.LogCaptureFixture
) -> None:
    b = bench()
    b.see(np.array([0.1, 0.0, 0.0]), np.zeros(3))
    with caplog.at_level(logging.WARNING, "drake_oa"):
        assert not b.run(0.3).any()
    assert b.now()[1].action == ""
    assert caplog.messages == []


def test_it_evades_smoothly_and_comes_to_rest_again(
    bench: Callable[..., Bench], caplog: pytest.LogCaptureFixture
) -> None:
    b = bench()
    b.see(*COMING)
    with caplog.at_level(logging.WARNING, "drake_oa"):
        found = b.run(0.3)
        velocity, said = b.now()
        assert (said.action, said.obstacle) == ("evading", 3)
        assert 0.05 < np.linalg.norm(velocity) <= PARAMETERS.speed + 1e-9
        b.see(np.array([2.0, 0.0, 0.0]), np.array([-0.3, 0.0, 0.0]))
        found = np.concatenate([np.zeros((1, 3)), found, b.run(0.5)])
    assert not b.now()[0].any()
    change = np.linalg.norm(np.diff(found, axis=0), axis=1)
    assert change.max() <= PARAMETERS.acceleration * STEP + 1e-9
    assert [message.split(" s: ")[1] for message in caplog.messages] == [
        "evades obstacle 3",
        "nothing to evade",
    ]


def test_it_evades_when_it_has_thought(
    bench: Callable[..., Bench], caplog: pytest.LogCaptureFixture
) -> None:
    thinking = Thinking(decision=0.05)
    b, at_once = bench(thinking), bench()
    for one in (b, at_once):
        one.see(*COMING)
    with caplog.at_level(logging.WARNING, "drake_oa"):
        late = b.run(0.4)
    begun, cost = b.system.GetOutputPort("decision").Eval(b.context)
    # It looks at many ways, and makes one decision after the other.
    assert begun > 0.1
    assert thinking.decision < cost < 0.3
    first = int(late.any(axis=1).argmax())
    assert np.ceil(0.051 / STEP) <= first <= 0.3 / STEP
    soon = at_once.run(0.4)
    assert soon[:first].any()
    # What was decided from the same is the same.
    np.testing.assert_array_equal(late[first], soon[soon.any(axis=1).argmax()])
    assert caplog.messages[0].endswith("evades obstacle 3")
    assert float(caplog.messages[0][2:7]) == pytest.approx(first * STEP)


def test_what_was_seen_long_ago_or_is_not_finite_is_not_evaded(bench: Callable[..., Bench]) -> None:
    b = bench()
    b.see(*COMING)
    b.run(0.1)
    assert b.now()[1].action == "evading"
    b.run(0.6)
    assert b.now()[1].action == ""
    b.see(*COMING)
    b.run(0.1)
    assert b.now()[1].action == "evading"
    b.give("robot_state", np.full(18, np.nan))
    b.run(0.1)
    assert b.now()[1].action == ""


def test_all_run_time_data_is_in_the_context(bench: Callable[..., Bench]) -> None:
    b = bench()
    b.see(*COMING)
    b.run(0.1)
    clone = b.context.Clone()
    one = b.run(0.1)
    other = Simulator(b.system, clone)
    other.Initialize()
    other.AdvanceTo(b.context.get_time())
    again = b.system.GetOutputPort("evasion").Eval(other.get_context())
    np.testing.assert_array_equal(again, one[-1])


def test_bad_construction_is_refused(guarded: GuardedArm) -> None:
    dmp = imitate(*minimum_jerk(np.zeros(3), [1.0, 0.0, 0.0]))
    with pytest.raises(ValueError, match="period must be positive"):
        ObstacleEvasion(guarded, dmp, period=0.0)
