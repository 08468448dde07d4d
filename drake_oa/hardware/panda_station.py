"""Simulated Panda arm and depth cameras that send and receive the same LCM messages as the real
devices, to test hardware runs.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from drake import lcmt_panda_command, lcmt_panda_status
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator
from pydrake.systems.controllers import InverseDynamicsController
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput

from drake_oa.common.config import ScenarioError
from drake_oa.common.signal_builder import LOG_PERIOD
from drake_oa.diagrams.faults import make_obstacle_movers
from drake_oa.hardware.command_streamer import (
    ARM_JOINTS,
    COMMAND_CHANNEL,
    MICROSECOND,
    POSITION_MODE,
    STATUS_CHANNEL,
    CommandValidator,
)
from drake_oa.hardware.hardware_station import arm_of
from drake_oa.robot.plant import make_robot_plant
from drake_oa.scenario.end_poses import start_positions
from drake_oa.scenario.obstacles import last_change
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.scenario.sources import with_simulated_cameras
from drake_oa.world.cameras import Camera
from drake_oa.world.delayed_camera import DelayedCamera
from drake_oa.world.depth_messages import CHANNEL, pack_depth
from drake_oa.world.station import make_station, release_cameras

_STIFFNESS = 400.0
"""Proportional gain of the joint controller with which the simulated arm follows commands; the
controller is critically damped [1/s^2]."""
_MAX_LATENESS = 0.9
"""Maximum time by which the station sends an image late because it is not rendered yet, as a ratio
to the period of the camera [-]. After this time, the station waits for the rendering."""
_AT_REST, _REST_TIME = 0.01, 1.0
"""Maximum speed at which joints of the simulated robot count as at rest [rad/s, m/s], and time at
rest after which a run of the station ends [s]."""
_CATCH_UP = 0.02
"""Maximum delay of the simulation behind the wall clock that faster steps make up for [s]. The
part of a delay above this maximum remains."""

_logger = logging.getLogger("drake_oa")
"""Logger of the package drake_oa, used for warnings about invalid command messages."""


class _ImageSender:
    """Sender of the depth images of one simulated camera as LCM messages."""

    def __init__(self, name: str, camera: Camera, period: float) -> None:
        """Initializes the sender of a camera's images.

        Args:
            name: name of the camera in the messages and their channel.
            camera: output ports and delay of the simulated camera.
            period: time between two images [s].
        """
        self._name, self._camera, self._period = name, camera, period
        self._system = camera.depth_image.get_system()
        self._count, self._sent = 0, -math.inf

    def is_due(self, root: Context, now: float, is_paused: bool) -> bool:
        """Checks whether the station must send an image of the camera now.

        While the simulation is paused, the last image is sent again every period. Otherwise, an
        image that is not rendered yet is sent later, so that rendering does not delay the statuses
        of the arm. Once the image is late by more than `_MAX_LATENESS` of a period, the station
        waits for the rendering.

        Args:
            root: Context of the station's diagram.
            now: time of the wall clock [s].
            is_paused: whether the simulation is paused.
        """
        if is_paused:
            return now - self._sent >= self._period
        lateness = root.get_time() + 1e-9 - self._count * self._period - self._camera.delay
        waits = isinstance(self._system, DelayedCamera) and lateness <= _MAX_LATENESS * self._period
        context = self._system.GetMyContextFromRoot(root)
        return lateness >= 0.0 and (not waits or self._system.is_ready(context))

    def send(self, root: Context, lcm: DrakeLcm, now: float, rate: float, is_paused: bool) -> None:
        """Sends the latest image of the camera as an LCM message.

        Its time stamp is `now` minus the simulated age of the image over `rate`, the capture time
        by the wall clock. While the simulation is paused, each repetition has a later stamp.

        Args:
            root: Context of the station's diagram.
            lcm: LCM bus of the messages.
            now: time of the wall clock [s].
            rate: maximum ratio of simulated time to wall time [-].
            is_paused: whether the simulation is paused. The image then repeats an earlier one, and
                does not change the time at which the next new image is due.
        """
        camera, context = self._camera, self._system.GetMyContextFromRoot(root)
        image = camera.depth_image.Eval(context)
        age = root.get_time() - camera.image_time.Eval(context)[0]
        self._count += not is_paused
        self._sent = now
        message = pack_depth(
            image.data[:, :, 0], camera=self._name, utime=round((now - age / rate) / MICROSECOND)
        )
        lcm.Publish(CHANNEL.format(self._name), message.encode())


class PandaStation:
    """Simulated station of a scenario whose arm is commanded by LCM messages.

    The arm follows the positions that a `CommandValidator` accepts, by inverse dynamics with PD
    control. Other joints of the robot hold their start positions. A status message is sent after
    each step of the plant. Simulated time begins at 0. Stamps and velocities in messages refer to
    the wall clock: if simulated time runs at half the rate of wall time, the maximum speeds of the
    arm are half as high.

    Attributes:
        diagram: diagram of the simulated robot, obstacles and cameras.
        simulator: simulator of the diagram.
        validator: validator of the received commands.
        event_times: simulated time of each event in `validator.events` [s].
        num_positions: number of positions of the whole plant, obstacles included.
    """

    def __init__(
        self,
        scenario: Scenario,
        lcm: DrakeLcm,
        *,
        rate: float = 1.0,
        waits: bool = False,
        log: bool = False,
        clock: Callable[[], float] = time.time,
    ) -> None:
        """Builds the station, with the arm at the start of the scenario's motion.

        Args:
            scenario: scenario with a Panda and without faults.
            lcm: LCM bus of the messages.
            rate: maximum ratio of simulated time to wall time [-].
            waits: whether the simulation pauses until the first valid command, so that obstacles
                start with the motion. In this case, `run` ends once no valid commands are received,
                the robot is at rest, and no obstacle will move any more.
            log: whether states and torques are logged.
            clock: function that returns the time of the wall clock [s].

        Raises:
            ScenarioError: for a robot without seven joints, or naming another invalid field.
        """
        if scenario.faults:
            raise ScenarioError(
                "faults: not simulated by a station; remove them (--set 'faults=[]')"
            )
        self._arm, limits = arm_of(scenario)
        builder = DiagramBuilder()
        station = make_station(builder, with_simulated_cameras(scenario))
        self._q_start = start_positions(scenario)
        plant, self._robot = station.plant, station.robot
        plant.SetDefaultPositions(self._robot, self._q_start)
        kp = np.full(len(self._q_start), _STIFFNESS)
        controller = builder.AddNamedSystem(
            "joint_controller",
            InverseDynamicsController(
                make_robot_plant(robot_of(scenario)).plant,
                kp,
                0.0 * kp,
                2.0 * np.sqrt(kp),
                has_reference_acceleration=False,
            ),
        )
        state = plant.get_state_output_port(self._robot)
        builder.Connect(state, controller.get_input_port_estimated_state())
        for name, mover in make_obstacle_movers(scenario, station).items():
            instance = plant.GetModelInstanceByName(name)
            builder.AddNamedSystem(f"mover_{name}", mover)
            builder.Connect(
                plant.get_state_output_port(instance), mover.GetInputPort("obstacle_state")
            )
            builder.Connect(mover.get_output_port(), plant.get_actuation_input_port(instance))
        torque = controller.get_output_port_control()
        builder.Connect(torque, plant.get_actuation_input_port(self._robot))
        builder.ExportInput(controller.get_input_port_desired_state(), "desired_state")
        builder.ExportOutput(state, "robot_state")
        builder.ExportOutput(torque, "actuation")
        if log:
            ports = {
                "robot_state": state,
                "plant_state": plant.get_state_output_port(),
                "actuation": plant.get_net_actuation_output_port(self._robot),
            }
            for name, port in ports.items():
                LogVectorOutput(port, builder, LOG_PERIOD).set_name(f"log_{name}")
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        # Velocities in messages are by the wall clock, and so are their limits.
        limits = replace(limits, velocity_limit=rate * limits.velocity_limit)
        self.validator = CommandValidator(self._q_start[self._arm], limits)
        self._step, self._rate, self._clock, self._lcm = scenario.plant_step, rate, clock, lcm
        self._is_waiting = self._ends_itself = waits
        self.event_times: list[float] = []
        self.num_positions = plant.num_positions()
        self._world_end = last_change(scenario.obstacles)
        self._last_motion_time = 0.0
        periods = {config.name: 1.0 / config.fps for config in scenario.cameras}
        self._senders = [
            _ImageSender(name, camera, periods[name]) for name, camera in station.cameras.items()
        ]
        lcm.Subscribe(COMMAND_CHANNEL, self._receive)
        self._actuate()
        self.simulator.Initialize()
        for camera in station.cameras.values():
            # The first image takes longest, because it initializes the renderer.
            system = camera.depth_image.get_system()
            camera.depth_image.Eval(system.GetMyContextFromRoot(self.simulator.get_context()))

    def step(self) -> None:
        """Handles received commands, advances the simulated plant by one step, and sends the arm's
        status and the camera images that are due.
        """
        while self._lcm.HandleSubscriptions(0):
            pass
        self._actuate()
        context = self.simulator.get_context()
        is_paused = self._is_waiting and self.validator.is_holding
        if not is_paused:
            self._is_waiting = False
            self.simulator.AdvanceTo(context.get_time() + self._step)
        now, simulated = self._clock(), context.get_time()
        self.event_times += [simulated] * (len(self.validator.events) - len(self.event_times))
        self._lcm.Publish(STATUS_CHANNEL, self.status(now).encode())
        for sender in self._senders:
            if sender.is_due(context, now, is_paused):
                sender.send(context, self._lcm, now, self._rate, is_paused)

    @property
    def is_finished(self) -> bool:
        """Whether a station that was created with `waits=True` has ended its run.

        The run ends after the first command, once no valid commands are received, and the robot has
        been at rest and no obstacle has changed for 1 s. Always False for other stations, which run
        until they are stopped.
        """
        root = self.simulator.get_context()
        state = self.diagram.GetOutputPort("robot_state").Eval(root)
        if not self.validator.is_holding or np.abs(state[len(state) // 2 :]).max() > _AT_REST:
            self._last_motion_time = root.get_time()
        is_at_rest = root.get_time() > max(self._last_motion_time, self._world_end) + _REST_TIME
        return self._ends_itself and not self._is_waiting and is_at_rest

    def run(self, duration: float, each_step: Callable[[], None] = lambda: None) -> None:
        """Runs the station until a simulated time, or until `is_finished`, no faster than at its
        rate of simulated time to wall time.

        If a step lasts too long, later steps are faster until the simulation has caught up with the
        wall clock. They compensate delays of at most 20 ms, because after a longer delay the arm
        would move faster by the wall clock than commanded.

        Args:
            duration: simulated time at which the run ends at the latest [s]. If it is inf, the run
                of a station without `waits=True` ends when `each_step` raises an exception.
            each_step: function that is called after each step of the plant.
        """
        context = self.simulator.get_context()
        due = self._clock()
        try:
            while context.get_time() < duration - 0.5 * self._step and not self.is_finished:
                self.step()
                each_step()
                due = max(due + self._step / self._rate, self._clock() - _CATCH_UP)
                time.sleep(max(0.0, due - self._clock()))
        finally:
            release_cameras(self.diagram)

    def _receive(self, data: bytes) -> None:
        """Decodes a received LCM message as a command, and passes the command to the validator;
        logs and ignores a message that cannot be decoded.
        """
        # LCM handlers must not raise.
        try:
            self.validator.receive(lcmt_panda_command.decode(data), self._clock())
        except Exception as error:
            _logger.warning(
                "station: message on %s ignored: no lcmt_panda_command: %s", COMMAND_CHANNEL, error
            )

    def _actuate(self) -> None:
        """Sets the desired state of the simulated robot's joint controller from the last valid
        command; the controller tracks this state until the next step.
        """
        n = len(self._q_start)
        desired = np.concatenate([self._q_start, np.zeros(n)])
        q, v = self.validator.desired(self._clock())
        desired[self._arm] = q
        desired[n + np.array(self._arm)] = v / self._rate
        self.diagram.GetInputPort("desired_state").FixValue(
            self.simulator.get_mutable_context(), desired
        )

    def status(self, now: float) -> lcmt_panda_status:
        """Returns the status message of the simulated arm at a time of the wall clock [s]."""
        context = self.simulator.get_context()
        state = self.diagram.GetOutputPort("robot_state").Eval(context)
        tau = self.diagram.GetOutputPort("actuation").Eval(context)[self._arm]
        q, v = self.validator.desired(now)
        zero = [0.0] * ARM_JOINTS
        status = lcmt_panda_status()
        status.utime = round(now / MICROSECOND)
        status.num_joints = ARM_JOINTS
        status.joint_position, status.joint_position_desired = list(state[self._arm]), list(q)
        speed = self._rate * state[len(self._q_start) + np.array(self._arm)]
        status.joint_velocity, status.joint_velocity_desired = list(speed), list(v)
        status.joint_acceleration_desired = status.joint_torque_external = zero
        status.joint_torque = status.joint_torque_desired = list(tau)
        status.control_command_success_rate = 1.0
        status.robot_utime = round(context.get_time() / MICROSECOND)
        status.control_mode = POSITION_MODE
        return status
