"""FrankaArm with a simulated robot behind the vendor's protocol, in lockstep.

python -m tests.hardware.test_franka fr3_box 20      # runs with the seeds 0 to 19
"""

import gc
import os
import sys
from collections.abc import Callable, Iterator
from multiprocessing import Pipe, get_context
from pathlib import Path
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
from drake_oa.world.depth_messages import CHANNEL, lcm_bus
from tests.hardware.lockstep import NO_CAMERAS, PRINTED_METRICS, STEP, Clock, own_bus
from tests.hardware.test_command_streamer import move

pylibfranka = pytest.importorskip("pylibfranka")
pytest.importorskip("franky_sim")
pytest.importorskip("ruckig")

CLEARANCES = {"fr3_box": 0.160, "fr3_moving": 0.129}
"""Minimum clearances of scenarios in one process [m]."""


class Simulation:
    """Client of a simulated robot in another process, which steps whenever the link waits."""

    def __init__(self, name: str, *overrides: str) -> None:
        from tests.hardware.franka_simulator import serve

        self.url = own_bus()
        self.scenario, self.clock = load_scenario(name, overrides), Clock()
        self._bus, self._image_count = lcm_bus(self.url), 0
        self._bus.Subscribe(CHANNEL.format("camera"), self._count_image)
        self._pipe, end = Pipe()
        words = end, name, list(overrides), self.url
        self._process = get_context("spawn").Process(target=serve, args=words, daemon=True)
        self._process.start()
        end.close()
        self.host, self.arm = self._pipe.recv(), None
        _, self.limits = arm_of(self.scenario)

    def _count_image(self, data: bytes) -> None:
        self._image_count += 1

    def ask(self, *words: Any) -> Any:
        """Sends a message to the simulator, and returns its answer."""
        self._pipe.send(words)
        return self._pipe.recv()

    def ask_after(self, delay: float, *words: Any) -> None:
        """Sends a message to the simulator once, after a delay [s]."""
        due = self.clock.now + delay
        self._before_step = lambda: due <= self.clock.now < due + STEP and self.ask(*words)

    def connect(self) -> RobotLink:
        """Ends the last connection, and returns the link of a new one."""
        self.ask("mode", "")
        if self.arm is not None:
            # Records of the log hold exceptions, and with them the connection.
            self.arm.handler = self.arm._robot = None
        gc.collect()
        self.link = RobotLink(self.url, wait=self.step, clock=self.clock, address=self.host)
        speeds, trajectory = self.limits.velocity_limit.tolist(), self.link.trajectory
        self.arm = franka_arm.FrankaArm(self.host, speeds, trajectory)
        # As root, the library gives its thread a real-time priority.
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        self._streamer = CommandStreamer(trajectory, self.arm, 1.0)
        self._before_step: Callable[[], object] = lambda: None
        self.step()
        return self.link

    def step(self) -> None:
        self._before_step()
        self.clock.now += STEP
        state = self.ask("run", self.clock.now)
        self.q, self.v, self.errors, self.is_finished, sent_count = state
        while self._image_count < sent_count:
            assert self._bus.HandleSubscriptions(10_000), "an image was lost"
        if round(self.clock.now / STEP) % 4 or self._streamer is None:
            return
        if not self.arm.handler:
            # The request of a motion waits for the robot, as does its end.
            self.ask("mode", "")
        self._streamer.step(self.clock.now)
        if self._streamer.is_finished:
            self.ask("mode", "")
            self.arm.close()
            self._streamer = None

    def end(self) -> None:
        """Ends the simulator, whose images a later run would receive too."""
        self._pipe.close()
        self._process.join()

    def finish(self) -> None:
        """Ends the commands, and continues until the arm is at rest, without errors."""
        self.link.close()
        for _ in range(400):
            self.step()
        assert np.abs(self.v).max() < 1e-3
        assert self.errors == []


@pytest.fixture(scope="module")
def robot() -> Iterator[Simulation]:
    """Simulated robot without cameras; its arm stays where the last test has moved it."""
    simulation = Simulation("fr3_box", *NO_CAMERAS)
    yield simulation
    simulation.end()


def ready(robot: Simulation) -> np.ndarray:
    """Connects to the robot, and returns its positions (7,) [rad] after the checks of the start."""
    robot.connect()
    return robot.link.ready_arm(robot.q, robot.limits)


def test_franka_arm_follows_the_planned_positions(robot: Simulation) -> None:
    goal = move(robot, ready(robot), 2.0)
    robot.finish()
    np.testing.assert_allclose(robot.q, goal, atol=2e-3)
    assert robot.link.trajectory.max_tracking_error < 5e-3


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("abort", ["joint_reflex"]), "arm stopped: joint_reflex: contact, or a wrong load"),
        (("mode", "kUserStopped"), "arm is stopped by its user: release the stop"),
        (("reset_state",), "connection to 127.* lost: libfranka"),
    ],
)
def test_franka_fault_stops_the_arm_within_its_limits(
    robot: Simulation, words: tuple[Any, ...], reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    q = ready(robot)
    robot.ask_after(1.0, *words)
    with pytest.raises(HardwareError, match=reason):
        move(robot, q, 2.0)
    robot.finish()
    ready(robot)
    assert ("robot recovered from joint_reflex" in caplog.text) == ("abort" in words)


def test_franka_arm_in_another_mode_is_not_commanded(robot: Simulation) -> None:
    robot.connect()
    robot.ask("mode", "kGuiding")
    with pytest.raises(HardwareError, match="being guided by hand"):
        robot.link.ready_arm(robot.q, robot.limits)


def jump(robot: Simulation, step: float) -> None:
    """Commands a step of all joints [rad] in one cycle of a motion at 1 kHz."""
    ready(robot)
    robot.ask("mode", "")
    mode = pylibfranka.ControllerMode.JointImpedance
    control = robot.arm._robot.start_joint_position_control(mode)
    state, _ = control.readOnce()
    control.writeOnce(pylibfranka.JointPositions((np.array(state.q_d) + step).tolist()))
    for _ in range(100):
        control.readOnce()


def send_far_target(robot: Simulation) -> None:
    """Sends a target beyond the limits, and reads the following states."""
    ready(robot)
    robot.ask("mode", "")
    robot.link.trajectory.write_planned(0.0, robot.q + 3.0)
    robot.arm.send(0.0, robot.q)
    for _ in range(100):
        robot.arm.receive(0.0)


def test_franka_controller_refuses_what_exceeds_its_limits(robot: Simulation) -> None:
    with pytest.raises(pylibfranka.ControlException, match="generator_acceleration_discontin"):
        jump(robot, 8e-6)
    with pytest.raises(pylibfranka.ControlException, match="generator_velocity_discontinuity"):
        jump(robot, 0.01)
    with pytest.raises(franka_arm.ArmStoppedError, match="a target was beyond a joint's limits"):
        send_far_target(robot)


def test_franka_errors_have_names_of_the_library_and_rows_in_the_docs() -> None:
    page = (Path(__file__).parents[2] / "docs/troubleshooting.md").read_text()
    assert set(franka_arm.error_texts()) < set(dir(pylibfranka.Errors()))
    for name, text in franka_arm.error_texts().items():
        assert f"| `{name}` | {text} |" in page


def test_franka_second_client_and_wrong_host_are_refused(
    robot: Simulation, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    robot.connect()
    words = ["run", "fr3_box", "--no-log", "--hardware", "franka"]
    monkeypatch.setattr(robot_link, "STARTUP_TIMEOUT", 3.0)
    assert main([*words, "--host", robot.host]) == 1
    assert "does not answer: activate FCI, and end its other clients" in capsys.readouterr().err
    monkeypatch.setattr(robot_link, "STARTUP_TIMEOUT", 30.0)
    assert main([*words, "--host", "127.9.9.9"]) == 1
    assert "no connection to 127.9.9.9: libfranka: Connection to FCI" in capsys.readouterr().err
    assert main(words) == 2


def run(name: str, *overrides: str) -> dict[str, Any]:
    """Runs a scenario from depth; returns the report of the simulated robot."""
    robot = Simulation(name, *overrides)
    drive(prepare_hardware(robot.scenario, robot.connect()), robot.link)
    while not robot.is_finished:
        robot.step()
    report = robot.ask("report")
    robot.end()
    return report


@pytest.mark.slow
@pytest.mark.parametrize("name", CLEARANCES)
def test_franka_run_arrives_without_contacts(name: str) -> None:
    report = run(name)
    assert report["contacts"] == report["errors"] == []
    assert report["goal_error"] < 5e-3
    assert report["robot_clearance_min"] > CLEARANCES[name] - 3e-3
    assert report["delay"] <= 5


@pytest.mark.slow
def test_franka_run_that_is_stopped_has_a_log() -> None:
    robot = Simulation("fr3_box")
    setup = prepare_hardware(robot.scenario, robot.connect())
    robot.ask_after(0.5, "abort", ["joint_reflex"])
    with pytest.raises(MotionInterruptedError) as stopped:
        drive(setup, robot.link)
    robot.end()
    assert "joint_reflex" in stopped.value.log.stop_reason


if __name__ == "__main__":
    for seed in range(int(sys.argv[2])):
        report = run(sys.argv[1], f"seed={seed}")
        print(report["errors"], {key: report[key] for key in PRINTED_METRICS}, flush=True)
