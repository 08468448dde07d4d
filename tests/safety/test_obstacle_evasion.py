"""The evasion layer alone, on scripted inputs."""

import logging
from functools import cache

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator

from drake_oa.common.messages import Evasion, FloatArray, ObstacleClouds, PolicyState
from drake_oa.common.thinking import Thinking
from drake_oa.geometry.collision_shapes import RobotModel, collect_collision_shapes
from drake_oa.policy.dmp import imitate, minimum_jerk
from drake_oa.robot.config import Robot
from drake_oa.robot.plant import RobotPlant, home_positions, make_robot_plant
from drake_oa.safety.config import EvasionParameters
from drake_oa.safety.obstacle_evasion import ObstacleEvasion

PARAMETERS = EvasionParameters()
STEP, FRAME = 0.008, 1.0 / 30.0
CUBE = 0.04 * np.array(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3)).reshape(3, -1).T


@cache
def robot() -> tuple[RobotPlant, RobotModel]:
    made = make_robot_plant(Robot())
    shapes = collect_collision_shapes(made.plant, made.scene_graph.model_inspector(), made.instance)
    return made, shapes


class Bench:
    """A robot held at its home posture; what it sees can be changed."""

    def __init__(self, thinking: Thinking | None = None) -> None:
        made, shapes = robot()
        q = home_positions(made, Robot())
        context = made.plant.CreateDefaultContext()
        made.plant.SetPositions(context, q)
        self.p_WE = made.tool_frame.CalcPoseInWorld(context).translation()
        self.system = ObstacleEvasion(
            shapes,
            made.tool_frame.name(),
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
        cloud = self.p_WE + offset + CUBE
        stamp = self.context.get_time()
        seen = ObstacleClouds(stamp, (cloud,), np.array([3]), v_WO=np.array([v_WO]))
        self.give("obstacles_W", seen)

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


COMING = (np.array([0.3, 0.0, 0.0]), np.array([-0.3, 0.0, 0.0]))


def test_it_does_nothing_while_nothing_moves(caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench()
    bench.see(np.array([0.1, 0.0, 0.0]), np.zeros(3))
    with caplog.at_level(logging.WARNING, "drake_oa"):
        assert not bench.run(0.3).any()
    assert bench.now()[1].action == ""
    assert caplog.messages == []


def test_it_evades_smoothly_and_comes_to_rest_again(caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench()
    bench.see(*COMING)
    with caplog.at_level(logging.WARNING, "drake_oa"):
        found = bench.run(0.3)
        velocity, said = bench.now()
        assert (said.action, said.obstacle) == ("evading", 3)
        assert 0.05 < np.linalg.norm(velocity) <= PARAMETERS.speed + 1e-9
        bench.see(np.array([2.0, 0.0, 0.0]), np.array([-0.3, 0.0, 0.0]))
        found = np.concatenate([np.zeros((1, 3)), found, bench.run(0.5)])
    assert not bench.now()[0].any()
    change = np.linalg.norm(np.diff(found, axis=0), axis=1)
    assert change.max() <= PARAMETERS.acceleration * STEP + 1e-9
    assert [message.split(" s: ")[1] for message in caplog.messages] == [
        "evades obstacle 3",
        "nothing to evade",
    ]


def test_it_evades_when_it_has_thought(caplog: pytest.LogCaptureFixture) -> None:
    thinking = Thinking(decision=0.05)
    bench, at_once = Bench(thinking), Bench()
    for one in (bench, at_once):
        one.see(*COMING)
    with caplog.at_level(logging.WARNING, "drake_oa"):
        late = bench.run(0.4)
    begun, cost = bench.system.GetOutputPort("decision").Eval(bench.context)
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


def test_what_was_seen_long_ago_or_is_not_finite_is_not_evaded() -> None:
    bench = Bench()
    bench.see(*COMING)
    bench.run(0.1)
    assert bench.now()[1].action == "evading"
    bench.run(0.6)
    assert bench.now()[1].action == ""
    bench.see(np.full(3, np.nan), np.array([-0.3, 0.0, 0.0]))
    bench.run(0.1)
    assert bench.now()[1].action == ""
    bench.see(*COMING)
    bench.run(0.1)
    assert bench.now()[1].action == "evading"


def test_all_run_time_data_is_in_the_context() -> None:
    bench = Bench()
    bench.see(*COMING)
    bench.run(0.1)
    clone = bench.context.Clone()
    one = bench.run(0.1)
    other = Simulator(bench.system, clone)
    other.Initialize()
    other.AdvanceTo(bench.context.get_time())
    again = bench.system.GetOutputPort("evasion").Eval(other.get_context())
    np.testing.assert_array_equal(again, one[-1])


def test_bad_construction_is_refused() -> None:
    made, shapes = robot()
    dmp = imitate(*minimum_jerk(np.zeros(3), [1.0, 0.0, 0.0]))
    with pytest.raises(ValueError, match="no frame 'nowhere'"):
        ObstacleEvasion(shapes, "nowhere", dmp)
    with pytest.raises(ValueError, match="period must be positive"):
        ObstacleEvasion(shapes, made.tool_frame.name(), dmp, period=0.0)
