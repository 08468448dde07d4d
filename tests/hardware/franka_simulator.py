"""Simulated Franka Research 3: the arm of a `PandaStation` behind the protocol of the vendor.

franky-sim speaks the protocol, and follows every command. The classes here add the generator of
asynchronous motions, and refuse what the controller refuses. Limits: "Control Interface
Specification and Robot Limits", section "Limits for Franka Research 3", of the vendor's
documentation. The vendor's generator is not published; Ruckig's is time-optimal within the same
limits.

    python -m tests.hardware.franka_simulator fr3_box 0.25      # scenario, rate
"""

import struct
import sys
import time
from contextlib import suppress
from typing import Any

import numpy as np
import ruckig
from franky_sim import franka_robot_protocol as protocol
from franky_sim import simulation_server
from franky_sim.base_simulator import BaseRobot, BaseSimulator, InnerRobotState
from franky_sim.franka_robot_server import FrankaRobotServer
from pydrake.lcm import DrakeLcm

from drake_oa.app.run import LCM_URL
from drake_oa.hardware import panda_station
from drake_oa.hardware.panda_station import PandaStation
from drake_oa.runs.hardware_run import station_log
from drake_oa.runs.report import motion_report
from drake_oa.scenario.loading import load_scenario
from tests.hardware.lockstep import EPOCH, STEP, LossyLcm

TICK, FREE_PERIOD = 1e-3, 0.01
TICKS = round(STEP / TICK)
Q_MAX = np.array([2.9007, 1.8361, 2.9007, -0.1169, 2.8763, 4.6216, 3.0508])
Q_MIN = np.array([-2.9007, -1.8361, -2.9007, -3.0770, -2.8763, 0.4398, -3.0508])
V_MAX = np.array([2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26])
A_MAX, J_MAX = 10.0, 5000.0
V_OFFSET = np.array([0.6599, 0.2517, 0.2000, 0.3533, 0.5757, 0.4878, 0.4628])
DECELERATION = np.array([6.0, 2.585, 3.5, 4.0, 17.0, 5.5, 17.0])
ERRORS = {
    "joint_reflex": 6,
    "joint_motion_generator_position_limits_violation": 12,
    "joint_motion_generator_velocity_limits_violation": 13,
    "joint_motion_generator_velocity_discontinuity": 14,
    "joint_motion_generator_acceleration_discontinuity": 15,
}
"""Positions of the errors' flags in a state message, by name of the error."""


def violations(target: np.ndarray, q: np.ndarray) -> list[str]:
    """Returns the errors for a target (7,), and the last four commands (4, 7), one per tick."""
    v, a, j = (np.diff(q, n, axis=0)[-1] / TICK**n for n in (1, 2, 3))
    room = np.maximum(0.0, [q[-1] - Q_MIN, Q_MAX - q[-1]])
    down, up = np.clip(np.sqrt(2.0 * DECELERATION * room) - V_OFFSET, 0.0, V_MAX)
    masks = (
        (target <= Q_MIN) | (target >= Q_MAX),
        (v < -down - 1e-3) | (v > up + 1e-3),
        np.abs(a) > A_MAX + 0.01,
        np.abs(j) > J_MAX + 1.0,
    )
    return [name for name, mask in zip(list(ERRORS)[1:], masks, strict=True) if mask.any()]


class Arm(BaseRobot):
    """Arm of a station, in place of the station's validator.

    Attributes:
        motion: "async": targets of a client; "direct": commands of each tick, from and to rest;
            "": brakes.
        errors: errors of the last command.
        events: all errors.
        is_free: whether robot time continues by itself.
    """

    motion, is_free = "", False

    def __init__(self, station: PandaStation, rate: float) -> None:
        super().__init__(has_gripper=False)
        self._station, self._rate = station, rate
        self.errors, self.events = list[str](), list[str]()
        self.update()
        self._commands = np.tile(self._state.q, (4, 1))
        station.validator = self
        self._generator, self._out = ruckig.Ruckig(7, TICK), ruckig.OutputParameter(7)
        self.input = ruckig.InputParameter(7)
        self.input.current_position = self._state.q
        self.input.synchronization = ruckig.Synchronization.No
        self.input.max_velocity = list(V_MAX)
        self.input.max_acceleration, self.input.max_jerk = [A_MAX] * 7, [J_MAX] * 7

    def update(self) -> None:
        """Reads the state of the station's arm."""
        status = self._station.status(EPOCH)
        state = status.joint_position, status.joint_velocity, status.joint_torque
        self._state = InnerRobotState(*map(tuple, state))

    def joint_position_control(self, target: Any, has_new_command: bool = True) -> None:
        """Generates, checks and executes the motion of one tick."""
        q = target if has_new_command else self._commands[-1]
        if self.motion != "direct":
            kinds = ruckig.ControlInterface.Velocity, ruckig.ControlInterface.Position
            self.input.control_interface = kinds[self.motion == "async"]
            self.input.target_position = list(target)
            self._generator.update(self.input, self._out)
            q = np.array(self._out.new_position)
        commands = np.vstack([self._commands[1:], q])
        self.errors = violations(target if self.motion else q, commands)
        self.events += self.errors
        if not self.errors:
            self._commands = commands
            self._out.pass_to_input(self.input) if self.motion != "direct" else None
        super().joint_position_control(self._commands[-1])

    def desired(self, now: float) -> tuple[np.ndarray, np.ndarray]:
        """Returns desired positions (7,) [rad], and velocities (7,) by the wall clock [rad/s]."""
        return self._commands[-1], self._rate * np.diff(self._commands, axis=0)[-1] / TICK

    is_holding = property(lambda self: self.is_free or not self.motion)

    def _get_state(self) -> InnerRobotState:
        return self._state

    def _torque_control(self, torques: np.ndarray) -> None:
        """Ignores the torques: the station's controller tracks `desired`."""

    set_hand_goal = _get_hand_width = _torque_control


class Move(protocol.MoveCommand):
    """Request of a motion, with the maximum speeds of an asynchronous motion."""

    @classmethod
    def from_bytes(cls, data: bytes, *words: Any) -> Any:
        command: Any = super().from_bytes(data, *words)
        command.is_async, *command.speeds = struct.unpack_from("<?7d", data, cls.STRUCT.size)
        return command

    def handle(self, server: Any) -> None:
        if server.robot_state.robot_mode != protocol.RobotMode.kIdle:
            self.reply(protocol.MoveStatus.kCommandNotPossibleRejected)
        elif (np.array(self.speeds) > V_MAX).any():
            self.reply(protocol.MoveStatus.kInvalidArgumentRejected)
        else:
            server.robot.motion = "async" if self.is_async else "direct"
            server.robot.input.max_velocity = self.speeds if self.is_async else list(V_MAX)
            super().handle(server)


class Recovery(protocol.AutomaticErrorRecoveryCommand):
    """Request of a recovery, which clears the errors."""

    def handle(self, server: Any) -> None:
        server.errors = []
        super().handle(server)


class Controller(FrankaRobotServer):
    """Server of one robot, with modes, errors, and the delays of commands.

    Attributes:
        mode: name of the mode that is reported; "": the present one.
        errors: active errors.
        delays: robot time from the last state that the client had read to its command [ms].
        times: robot time of each command [ms].
    """

    mode = ""

    def __init__(self, *words: Any) -> None:
        super().__init__(*words)
        self.errors, self.delays, self.times = list[str](), list[int](), list[int]()
        classes = self._FrankaServer__command_class_map
        classes[protocol.RobotCommand.kMove] = Move
        classes[protocol.RobotCommand.kAutomaticErrorRecovery] = Recovery

    def abort(self, errors: list[str]) -> None:
        """Stops the motion by a reflex."""
        motion, self.errors = self.current_motion_id, errors
        self.reset_current_motion_id()
        self.stop_motion()
        if motion:
            move, status = protocol.RobotCommand.kMove, protocol.MoveStatus.kReflexAborted
            protocol.BaseCommand.send_response(self._tcp_socket, move, motion, status)

    def stop_motion(self, send_preemption_signal: bool = True) -> None:
        self.robot.motion = ""
        super().stop_motion(send_preemption_signal)

    def _reset_state(self) -> None:
        self.robot.motion = ""
        super()._reset_state()

    def _handle_udp_command(self, data: bytes) -> None:
        seen = protocol.UDPCommand.from_bytes(data).message_id
        self.times.append(self._FrankaServer__message_id - 1)
        self.delays.append(self.times[-1] - seen)
        super()._handle_udp_command(data)

    def _post_process_commands(self) -> None:
        super()._post_process_commands()
        if self.robot.errors and self.robot.motion:
            self.abort(self.robot.errors)

    @property
    def robot_state(self) -> Any:
        state, mode = super().robot_state, "kReflex" if self.errors else self.mode
        flags = tuple(i in [ERRORS[name] for name in self.errors] for i in range(41))
        mode = protocol.RobotMode[mode] if mode else state.robot_mode
        return state.replace(robot_mode=mode, errors=flags, reflex_reason=flags)


simulation_server.FrankaRobotServer = Controller


class FrankaSimulator(BaseSimulator):
    """Simulator whose robot, obstacles and cameras are those of a station of a scenario."""

    def __init__(self, name: str, overrides: list[str], url: str, **station: Any) -> None:
        super().__init__()
        self._scenario, self._ticks = load_scenario(name, overrides), 0
        self.lcm: Any = LossyLcm(DrakeLcm(url))
        self.station = PandaStation(self._scenario, self.lcm, waits=True, log=True, **station)
        self.arm = Arm(self.station, station.get("rate", 1.0))

    def _get_robots(self) -> list[BaseRobot]:
        return [self.arm]

    def _step(self) -> None:
        self._ticks += 1
        if self._ticks % TICKS == 0:
            self.station.step()
            self.arm.update()

    def report(self) -> dict[str, Any]:
        """Returns the report of the motion by true geometry, the errors, and the maximum delay of
        a command and pause between two commands [ms].
        """
        report = motion_report(self._scenario, station_log(self._scenario, self.station))
        delay, pause = max(self.arm.server.delays), int(np.diff(self.arm.server.times).max())
        return report | {"errors": self.arm.events, "delay": delay, "pause": pause}


def serve(pipe: Any, *words: Any) -> None:
    """Simulates a robot, as the messages of a pipe demand: a word with values.

    After "run" robot time stands still between messages. After other messages it continues by
    itself, for requests of pylibfranka that wait for answers, but obstacles do not start to move.
    The station waits for each image: a busy computer has no influence.
    """
    now, panda_station._MAX_LATENESS = EPOCH, 0.0
    simulator = FrankaSimulator(*words, clock=lambda: now)
    simulator.arm.is_free = True
    with simulator, simulation_server.SimulationServer(simulator) as server, suppress(EOFError):
        pipe.send(simulator.arm.hostname)
        while True:
            if simulator.arm.is_free and not pipe.poll(FREE_PERIOD):
                server.run_once(False)
                continue
            word, *values = pipe.recv()
            answer, simulator.arm.is_free = None, word != "run"
            if word == "run":
                (now,) = values
                for _ in range(TICKS):
                    server.run_once(False)
                state, station = simulator.arm.inner_state, simulator.station
                answer = np.array(state.q), np.array(state.dq), simulator.arm.events
                answer += station.is_finished, simulator.lcm.images
            elif word == "mode":
                (simulator.arm.server.mode,) = values
            else:
                owner = simulator if word == "report" else simulator.arm.server
                answer = getattr(owner, word)(*values)
            pipe.send(answer)


if __name__ == "__main__":
    wall = FrankaSimulator(sys.argv[1], [], LCM_URL, rate=float(sys.argv[2]), clock=time.time)
    with wall, simulation_server.SimulationServer(wall) as wall_server:
        print(f"robot at {wall.arm.hostname}", file=sys.stderr)
        while not wall.station.is_finished:
            wall_server.run_once(1.0 / float(sys.argv[2]))
    print(wall.report())
