"""FrankaArm with a simulated robot behind the vendor's protocol, in lockstep.

python -m tests.hardware.test_franka fr3_box 20      # runs with the seeds 0 to 19
"""

import gc
import os
import sys
from collections.abc import Callable
from multiprocessing import Pipe, get_context
from typing import Any

import numpy as np
import pytest

from drake_oa.app.main import main
from drake_oa.hardware import franka_arm, robot_link
from drake_oa.hardware.command_streamer import CommandStreamer
from drake_oa.hardware.hardware_station import arm_of
from drake_oa.hardware.robot_link import HardwareError, RobotLink
from drake_oa.runs.hardware_run import drive, prepare_hardware
from drake_oa.runs.simulation import MotionInterruptedError
from drake_oa.scenario.loading import load_scenario
from tests.hardware.lockstep import NO_CAMERAS, STEP, Clock
from tests.hardware.test_command_streamer import move

pylibfranka = pytest.importorskip("pylibfranka")
pytest.importorskip("franky_sim")
pytest.importorskip("ruckig")

IN_ONE_PROCESS = {"fr3_box": 0.0, "fr3_moving": 0.0}
"""Minimum clearances of `drake-oa run` [m]."""


class Simulation:
    """Client of a simulated robot in another process, which steps whenever the link waits.

    Attributes:
        before_step: function called before each step.
    """

    def __init__(self, name: str, *overrides: str) -> None:
        self.url = f"udpm://239.255.76.99:{7700 + os.getpid() % 200}?ttl=0&recv_buf_size=4000000"
        self.scenario, self.clock = load_scenario(name, overrides), Clock()
        self._pipe, end = Pipe()
        from tests.hardware.franka_simulator import serve

        words = end, name, list(overrides), self.url
        get_context("spawn").Process(target=serve, args=words, daemon=True).start()
        end.close()
        self.host, self._arm, self._streamer = self._pipe.recv(), None, None
        _, self.limits = arm_of(self.scenario)

    def ask(self, *words: Any) -> Any:
        """Sends a message to the simulator, and returns its answer."""
        self._pipe.send(words)
        return self._pipe.recv()

    def connect(self) -> RobotLink:
        """Ends the last connection, and returns the link of a new one."""
        self.ask("mode", "")
        self._arm = self._streamer = None
        gc.collect()
        self.link = RobotLink(self.url, wait=self.step, clock=self.clock, address=self.host)
        speeds, trajectory = self.limits.velocity_limit.tolist(), self.link.trajectory
        self.robot = self._arm = franka_arm.FrankaArm(self.host, speeds, trajectory)
        # As root, the library gives its thread a real-time priority.
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        self._streamer = CommandStreamer(trajectory, self._arm, 1.0)
        self.before_step: Callable[[], object] = lambda: None
        return self.link

    def step(self) -> None:
        self.before_step()
        self.clock.now += STEP
        self.q, self.v, self.is_finished = self.ask("run", self.clock.now)
        if round(self.clock.now / STEP) % 4 or self._streamer is None:
            return
        if not self._arm.is_commanded or self._streamer.is_finished:
            # Requests that start and end a motion wait for the robot.
            self.ask("mode", "")
        self._streamer.step(self.clock.now)
        if self._streamer.is_finished:
            self._arm.close()
            self._streamer = None

    def ask_after(self, delay: float, *words: Any) -> None:
        """Sends a message to the simulator once, after a delay [s]."""
        due = self.clock.now + delay
        self.before_step = lambda: due <= self.clock.now < due + STEP and self.ask(*words)


@pytest.fixture(scope="module")
def robot() -> Simulation:
    """Simulated robot without cameras; its arm stays where the last test has moved it."""
    simulation = Simulation("fr3_box", *NO_CAMERAS)
    simulation.connect()
    simulation.step()
    return simulation


def finish(robot: Simulation) -> None:
    """Ends the commands, and continues until the arm is at rest."""
    robot.link.close()
    for _ in range(150):
        robot.step()
    assert np.abs(robot.v).max() < 1e-3


def test_franka_arm_follows_the_planned_positions(robot: Simulation) -> None:
    q = robot.connect().ready_arm(robot.q, robot.limits)
    goal = move(robot, q, 2.0)
    finish(robot)
    np.testing.assert_allclose(robot.q, goal, atol=2e-3)
    assert robot.link.trajectory.max_tracking_error < 5e-3
    events, delays, _ = robot.ask("report", False)
    assert events == []
    assert max(delays) <= 5


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("abort", ["joint_reflex"]), "arm stopped by joint_reflex: contact, or a wrong load"),
        (("mode", "kUserStopped"), "arm is stopped by its user: release the stop"),
        (("reset_state",), "connection to 127.* lost: libfranka"),
    ],
)
def test_franka_fault_stops_the_arm_within_its_limits(
    robot: Simulation, words: tuple[Any, ...], reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    q = robot.connect().ready_arm(robot.q, robot.limits)
    robot.ask_after(1.0, *words)
    with pytest.raises(HardwareError, match=reason):
        move(robot, q, 2.0)
    finish(robot)
    assert robot.ask("report", False)[0] == []
    # A new connection recovers from the reflex.
    robot.connect().ready_arm(robot.q, robot.limits)
    assert ("recovered from joint_reflex" in caplog.text) == ("abort" in words)


@pytest.mark.parametrize(("mode", "reason"), [("kGuiding", "guided by hand"), ("kOther", "FCI")])
def test_franka_arm_in_another_mode_is_not_commanded(
    robot: Simulation, mode: str, reason: str
) -> None:
    link = robot.connect()
    robot.ask("mode", mode)
    with pytest.raises(HardwareError, match=reason):
        link.ready_arm(robot.q, robot.limits)


def repeat(function: Callable[..., object], *words: object) -> None:
    """Calls a function for 100 states of the robot."""
    for _ in range(100):
        function(*words)


def test_franka_controller_refuses_what_exceeds_its_limits(robot: Simulation) -> None:
    robot.connect()
    client, handler = robot.robot._robot, pylibfranka.AsyncPositionControlHandler
    fast = handler.configure(client, handler.Configuration([3.0] * 7, 0.1))
    assert "invalid argument" in fast.error_message
    for step, reason in ((1e-4, "acceleration_discont"), (0.01, "velocity_discontinuity")):
        robot.connect()
        control = robot.robot._robot.start_joint_position_control(
            pylibfranka.ControllerMode.JointImpedance
        )
        state, _ = control.readOnce()
        control.writeOnce(pylibfranka.JointPositions((np.array(state.q_d) + step).tolist()))
        with pytest.raises(pylibfranka.ControlException, match=reason):
            repeat(control.readOnce)
    robot.connect()
    robot.link.trajectory.write_planned(0.0, robot.q + 3.0)
    robot.robot.send(0.0, robot.q)
    with pytest.raises(franka_arm.ArmStoppedError, match="beyond a joint's limits"):
        repeat(robot.robot.receive, 0.0)


def test_franka_errors_have_one_message_each() -> None:
    errors = pylibfranka.Errors()
    assert set(franka_arm.ERRORS) == {name for name in dir(errors) if name[0] != "_"}


def test_franka_second_client_and_wrong_host_are_refused(
    robot: Simulation, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    robot.connect()
    monkeypatch.setattr(robot_link, "STARTUP_TIMEOUT", 15.0)
    words = ["run", "fr3_box", "--no-log", "--hardware", "franka"]
    assert main([*words, "--host", robot.host]) == 1
    assert "does not answer: activate FCI, and end its other clients" in capsys.readouterr().err
    assert main([*words, "--host", "127.9.9.9"]) == 1
    assert "no connection to 127.9.9.9: libfranka: Connection to FCI" in capsys.readouterr().err
    assert main(words) == 2


def run(name: str, *overrides: str) -> dict[str, Any]:
    """Runs a scenario from depth; returns the report of the simulated robot."""
    robot = Simulation(name, *overrides)
    setup = prepare_hardware(robot.scenario, robot.connect())
    drive(setup, robot.link)
    while not robot.is_finished:
        robot.step()
    events, delays, report = robot.ask("report", True)
    return report | {"events": events, "delay": max(delays)}


@pytest.mark.parametrize("name", IN_ONE_PROCESS)
def test_franka_run_arrives_without_contacts(name: str) -> None:
    report = run(name)
    assert report["contacts"] == report["events"] == []
    assert report["goal_error"] < 5e-3
    assert abs(report["robot_clearance_min"] - IN_ONE_PROCESS[name]) < 3e-3


def test_franka_run_that_is_stopped_has_a_log() -> None:
    robot = Simulation("fr3_box")
    setup = prepare_hardware(robot.scenario, robot.connect())
    robot.ask_after(0.5, "abort", ["joint_reflex"])
    with pytest.raises(MotionInterruptedError) as stopped:
        drive(setup, robot.link)
    assert "joint_reflex" in stopped.value.log.stop_reason


if __name__ == "__main__":
    for seed in range(int(sys.argv[2])):
        print(run(sys.argv[1], f"seed={seed}"), flush=True)
