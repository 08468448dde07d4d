"""The supervision layer on scripted inputs: one test for each thing that it watches."""

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator

from drake_oa.common.messages import Evasion, FloatArray, HoldCause, PolicyState, TablePlane
from drake_oa.geometry.solids import SURROUNDINGS, SolidScene, solids_of, sphere, table_solid
from drake_oa.safety.config import SupervisorParameters
from drake_oa.safety.guarded_arm import GuardedArm
from drake_oa.safety.supervision import Supervision
from drake_oa.safety.supervisor import Supervisor
from tests.planning.arms import ArmAlone

PERIOD, FRAME = 0.008, 1.0 / 15.0
V_WE = np.array([0.0, 0.4, 0.0])
FAR, REST = np.array([5.0, 0.0, 0.0]), np.zeros(3)


class Bench:
    """A supervisor on fixed inputs that can be changed on the way."""

    def __init__(self, panda: ArmAlone, guarded: GuardedArm, **changes: float) -> None:
        self.q = panda.q_full
        self.p_WE = panda.X_WE[9:]
        parameters = replace(SupervisorParameters(), **changes)
        self.system = Supervisor(guarded, 1.0, period=PERIOD, parameters=parameters)
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.give("robot_state", np.concatenate([self.q, np.zeros(len(self.q))]))
        self.move(V_WE)
        self.see(FAR)
        self.give("tracking_error", np.zeros(3))
        self.give("torque_saturation", np.zeros(1))

    def give(self, port: str, value: object) -> None:
        is_vector = isinstance(value, np.ndarray)
        self.system.GetInputPort(port).FixValue(self.context, value if is_vector else Value(value))

    def move(self, v_WE: FloatArray, **more: object) -> None:
        self.give("policy_state", PolicyState(p_WE=self.p_WE, z_W=v_WE, **more))

    def see(self, *places: FloatArray, v_WO: FloatArray = REST, table: float | None = None) -> None:
        """Balls of 1 mm at places."""
        stamp, solids = self.context.get_time(), []
        for row, place in enumerate(places):
            X_WO = RigidTransform(place).GetAsMatrix4()
            name = {"name": row, "label": f"obstacle {row}"}
            solids.append(replace(sphere(1e-3), X_WO=X_WO, v_WO=v_WO, stamp=stamp, **name))
        if table is not None:
            of_table = table_solid(TablePlane(offset=table))
            solids.append(replace(of_table, name=SURROUNDINGS, label="the table"))
        labels = tuple(solid.label for solid in solids)
        self.give("solids_W", SolidScene(stamp, solids_of(solids), labels))

    def run(self, duration: float, *, fresh: bool = True) -> Supervision:
        """Goes on; `fresh`: with a frame whenever one is due."""
        end = self.context.get_time() + duration
        while self.context.get_time() < end - 1e-9:
            self.simulator.AdvanceTo(min(end, self.context.get_time() + FRAME))
            if fresh:
                seen = self.system.GetInputPort("solids_W").Eval(self.context)
                time = self.context.get_time()
                seen.solids.ball[:, 7] = time
                self.give("solids_W", replace(seen, stamp=time))
        return self.now()

    def now(self) -> Supervision:
        found = self.system.GetOutputPort("supervision").Eval(self.context)
        (scale,) = self.system.GetOutputPort("speed_scale").Eval(self.context)
        assert scale == found.speed_scale
        return found


@pytest.fixture
def bench(panda: ArmAlone, guarded: GuardedArm) -> Callable[..., Bench]:
    return lambda **changes: Bench(panda, guarded, **changes)


def test_a_motion_in_the_open_runs(
    bench: Callable[..., Bench], caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, "drake_oa"):
        found = bench().run(0.5)
    assert (found.action, found.speed_scale, found.reason) == ("run", 1.0, "")
    assert caplog.messages == []


def test_an_old_frame_slows_holds_and_a_new_one_resumes(
    bench: Callable[..., Bench], caplog: pytest.LogCaptureFixture
) -> None:
    b = bench()
    with caplog.at_level(logging.WARNING, "drake_oa"):
        assert b.run(0.16, fresh=False).action == "run"
        slow = b.run(0.16, fresh=False)
        assert (slow.action, 0.1 < slow.speed_scale < 1.0) == ("slow", True)
        assert b.run(0.2, fresh=False).action == "hold"
        # However long it takes: it goes on by itself.
        assert b.run(5.0, fresh=False).action == "hold"
        b.see(FAR)
        assert b.run(0.1).action == "slow"
        found = b.run(2.0)
    assert (found.action, found.speed_scale, found.reason) == ("run", 1.0, "")
    said = [message.split("supervisor ")[1] for message in caplog.messages]
    assert said == [
        "slows: obstacles not seen since t = 0.00 s",
        "holds: obstacles not seen since t = 0.00 s",
        "slows: obstacles not seen since t = 0.00 s",
        "runs freely again",
    ]


def test_no_observation_holds(bench: Callable[..., Bench]) -> None:
    b = bench()
    b.give("solids_W", SolidScene(note="no valid pixel"))
    assert b.run(0.1, fresh=False).reason == "no observation yet (no valid pixel)"


def test_without_solids_the_rest_is_watched(guarded: GuardedArm, panda: ArmAlone) -> None:
    system = Supervisor(guarded, 1.0)
    context = system.CreateDefaultContext()
    state = np.concatenate([panda.q_full, np.zeros(len(panda.q_full))])
    system.GetInputPort("robot_state").FixValue(context, state)
    policy = PolicyState(p_WE=panda.X_WE[9:], z_W=np.array([0.0, 5.0, 0.0]))
    system.GetInputPort("policy_state").FixValue(context, Value(policy))
    simulator = Simulator(system, context)
    simulator.AdvanceTo(0.1)
    assert "would be faster" in system.GetOutputPort("supervision").Eval(context).reason


def test_a_link_near_a_resting_obstacle_holds_then_stops(
    bench: Callable[..., Bench], caplog: pytest.LogCaptureFixture
) -> None:
    b = bench()
    # 0.103 m is half the hand's width along y.
    b.see(b.p_WE + np.array([0.0, 0.11 + 0.103, 0.08]))
    assert b.run(0.1).action == "slow"
    b.see(b.p_WE + np.array([0.0, 0.103 + 0.02, 0.08]))
    caplog.clear()
    with caplog.at_level(logging.WARNING, "drake_oa"):
        held = b.run(0.1)
        assert (held.action, held.speed_scale, held.obstacle) == ("hold", 0.0, 0)
        stop = b.run(3.5)
    assert stop.action == "stop"
    assert stop.reason == f"{held.link} within {stop.distance:.3f} m of obstacle 0"
    assert len(caplog.messages) == 2
    b.see(FAR)
    assert b.run(2.0).action == "run"


def test_it_goes_on_when_the_obstacle_has_gone_in_time(bench: Callable[..., Bench]) -> None:
    b = bench()
    b.see(b.p_WE + np.array([0.0, 0.12, 0.08]))
    assert b.run(2.0).action == "hold"
    b.see(FAR)
    assert b.run(2.0).action == "run"


def test_from_contact_it_may_leave_but_not_press(bench: Callable[..., Bench]) -> None:
    b = bench()
    b.see(b.p_WE + np.array([0.0, 0.1, 0.08]))
    assert b.run(0.1).action == "hold"
    b.move(-V_WE)
    left = b.run(0.5)
    assert (left.action, left.speed_scale) == ("slow", SupervisorParameters().leave_scale)
    other = bench()
    other.see(other.p_WE + np.array([0.0, 0.1, 0.08]))
    other.move(-V_WE)
    assert other.run(0.5).speed_scale == SupervisorParameters().leave_scale


def test_an_obstacle_that_comes_holds_and_never_stops(bench: Callable[..., Bench]) -> None:
    b = bench()
    place = b.p_WE + np.array([0.0, 0.103 + 0.08, 0.08])
    b.see(place, v_WO=np.array([0.0, -0.5, 0.0]))
    # It stands still with each frame, and is still said to come.
    assert b.run(4.0).action == "hold"


def test_while_the_policy_itself_holds_nothing_is_stopped(bench: Callable[..., Bench]) -> None:
    b = bench()
    b.see(b.p_WE + np.array([0.0, 0.12, 0.08]))
    b.move(V_WE, hold=HoldCause.OBSTACLES, note="goal inside obstacle 3")
    assert b.run(4.0).action == "hold"


def test_the_table_stops_a_descent(bench: Callable[..., Bench]) -> None:
    b = bench()
    b.see(table=b.p_WE[2] - 0.05)
    b.move(np.array([0.0, 0.0, -0.4]))
    assert b.run(0.1).reason.startswith("panda_leftfinger within")
    assert b.now().reason.endswith("of the table")
    assert b.now().speed_scale < 0.5
    b.move(np.array([0.0, 0.0, 0.1]))
    # The fingers leave freely; the shoulder, as near, goes along slowly.
    assert "finger" not in b.run(3.0).reason


def test_a_joint_near_its_limit_holds_toward_it_only(bench: Callable[..., Bench]) -> None:
    b = bench()
    q = b.q.copy()
    # The elbow, nearly folded: reaching outward opens it, drawing in folds it.
    q[3] = -3.06
    b.give("robot_state", np.concatenate([q, np.zeros(len(q))]))
    outward = np.array([0.3, 0.0, 0.0])
    actions = []
    for v_WE in (outward, -outward):
        b.move(v_WE)
        actions.append(b.run(2.0).action)
    assert sorted(actions) == ["hold", "run"]
    assert "panda_joint4" in b.now().reason or actions[0] == "hold"


def test_the_tracking_error_slows_and_holds(bench: Callable[..., Bench]) -> None:
    b = bench()
    b.give("tracking_error", np.array([0.0, 0.03, 0.0]))
    assert b.run(0.1).action == "slow"
    b.give("tracking_error", np.array([0.06, 0.0, 0.0]))
    assert b.run(0.1).reason == "tracking error 0.060 m"
    assert b.now().action == "hold"
    b.give("tracking_error", np.zeros(3))
    assert b.run(2.0).action == "run"


def test_torque_saturation_slows(bench: Callable[..., Bench]) -> None:
    b = bench()
    b.give("torque_saturation", np.ones(1))
    assert b.run(0.09).action == "run"
    slow = b.run(0.2)
    assert (slow.action, slow.reason) == ("slow", "a joint torque is at its limit")
    b.give("torque_saturation", np.zeros(1))
    assert b.run(2.0).action == "run"


@pytest.mark.parametrize("port", ["robot_state", "tracking_error", "policy_state"])
def test_what_is_not_finite_stops(bench: Callable[..., Bench], port: str) -> None:
    b = bench()
    if port == "policy_state":
        b.move(np.full(3, np.nan))
    else:
        b.give(port, np.full(b.system.GetInputPort(port).size(), np.nan))
    stop = b.run(0.1)
    assert stop.action == "stop"
    assert stop.reason == f"the {port.replace('_', ' ')} is not finite"


def test_a_clone_replays_bit_for_bit(bench: Callable[..., Bench]) -> None:
    b = bench()
    b.see(b.p_WE + np.array([0.0, 0.103 + 0.1, 0.08]))
    b.run(0.05, fresh=False)
    other = Simulator(b.system, b.context.Clone())
    found = []
    for simulator in (b.simulator, other):
        simulator.AdvanceTo(0.7)
        state = b.system.GetOutputPort("supervision").Eval(simulator.get_context())
        found.append((state.action, state.speed_scale, state.reason, state.since, state.distance))
    assert found[0] == found[1]
    assert found[0][0] == "hold"


def test_a_wrong_type_on_a_port_is_refused_by_its_name(bench: Callable[..., Bench]) -> None:
    b = bench()
    b.give("solids_W", PolicyState())
    with pytest.raises(TypeError, match="'solids_W' holds a PolicyState"):
        b.run(0.1, fresh=False)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"duration": 0.0}, "duration must be finite and positive"),
        ({"period": np.nan}, "period must be positive"),
    ],
)
def test_bad_construction_is_refused(
    guarded: GuardedArm, change: dict[str, float], said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        Supervisor(guarded, **({"duration": 1.0} | change))


def near(bench: Bench) -> None:
    """A point that moves, close ahead of the tool."""
    bench.see(bench.p_WE + np.array([0.0, 0.05, -0.02]), v_WO=np.array([0.0, 0.1, 0.0]))


def test_who_is_told_to_go_on_is_not_slowed_by_what_moves(bench: Callable[..., Bench]) -> None:
    b = bench()
    near(b)
    assert b.run(0.1).action in ("hold", "slow")
    b = bench()
    b.give("evading", Evasion("going on", obstacle=0))
    near(b)
    assert b.run(0.1).action == "run"
    # What rests still counts.
    b.see(b.p_WE + np.array([0.0, 0.05, -0.02]))
    assert b.run(0.1).action in ("hold", "slow")


def test_it_waits_while_it_is_told_to_and_goes_on_by_itself(bench: Callable[..., Bench]) -> None:
    b = bench()
    b.give("evading", Evasion("evading", np.array([0.1, 0.0, 0.0]), 0, 0.05))
    found = b.run(4.0)
    assert (found.action, found.reason) == ("hold", "evades obstacle 0")
    b.give("evading", Evasion())
    assert b.run(2.0).action == "run"


def test_what_cannot_be_evaded_is_told_and_holds_for_no_longer_than_it_is_there(
    bench: Callable[..., Bench], caplog: pytest.LogCaptureFixture
) -> None:
    b = bench()
    b.give("evading", Evasion("caught", np.array([0.1, 0.0, 0.0]), 5, -0.05, contact=1.0))
    assert b.run(0.1).action == "hold"
    b.give("evading", Evasion("caught", np.array([0.1, 0.0, 0.0]), 5, -0.05, contact=0.2))
    with caplog.at_level(logging.WARNING, "drake_oa"):
        found = b.run(0.1)
    assert (found.action, found.speed_scale) == ("hold", 0.0)
    assert found.reason == "obstacle 5 cannot be evaded by this arm"
    assert any("holds: obstacle 5 cannot be evaded" in message for message in caplog.messages)
    # A false alarm, or what has passed.
    b.give("evading", Evasion())
    assert b.run(2.0).action == "run"
