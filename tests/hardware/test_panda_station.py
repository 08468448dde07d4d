"""PandaStation with Drake's Panda systems as command source, in one process."""

import numpy as np
from drake import lcmt_image_array, lcmt_panda_command, lcmt_panda_status
from pydrake.lcm import DrakeLcm
from pydrake.manipulation import PandaCommandSender, PandaControlMode, PandaStatusReceiver
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.lcm import LcmPublisherSystem, LcmSubscriberSystem

from drake_oa.hardware.command_streamer import COMMAND_CHANNEL, STATUS_CHANNEL
from drake_oa.hardware.panda_station import PandaStation
from drake_oa.scenario.loading import load_scenario
from drake_oa.world.depth_messages import CHANNEL, unpack_depth
from tests.hardware.lockstep import EPOCH, NO_CAMERAS, STEP, Clock, joints

BOX = load_scenario("tabletop_box", NO_CAMERAS)


class CommandSource:
    """Diagram of Drake's Panda systems; its Context starts at the wall-clock time."""

    def __init__(self, lcm: DrakeLcm, begin: float = EPOCH) -> None:
        self._lcm = lcm
        builder = DiagramBuilder()
        sender = builder.AddSystem(PandaCommandSender(7, PandaControlMode.kPosition))
        publisher = builder.AddSystem(
            LcmPublisherSystem.Make(
                COMMAND_CHANNEL, lcmt_panda_command, lcm, 0.005, use_cpp_serializer=True
            )
        )
        subscriber = builder.AddSystem(
            LcmSubscriberSystem.Make(
                STATUS_CHANNEL, lcmt_panda_status, lcm, use_cpp_serializer=True
            )
        )
        receiver = builder.AddSystem(PandaStatusReceiver())
        builder.Connect(sender.get_output_port(), publisher.get_input_port())
        builder.Connect(subscriber.get_output_port(), receiver.get_input_port())
        builder.ExportInput(sender.GetInputPort("position"), "position")
        builder.ExportOutput(receiver.GetOutputPort("position_measured"), "measured")
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        self.simulator.get_mutable_context().SetTime(begin)

    def command(self, q: np.ndarray, time: float) -> None:
        """Sends joint positions q (7,) [rad] until a wall-clock time [s]."""
        context = self.simulator.get_mutable_context()
        self.diagram.GetInputPort("position").FixValue(context, q)
        self.simulator.AdvanceTo(time)
        # An LcmInterfaceSystem crashes in newer releases of Drake if Python subscribes, too.
        while self._lcm.HandleSubscriptions(0):
            pass

    @property
    def measured(self) -> np.ndarray:
        """Measured joint positions (7,) [rad]."""
        return np.array(self.diagram.GetOutputPort("measured").Eval(self.simulator.get_context()))


def test_arm_follows_drakes_command_source_and_holds_during_its_outage() -> None:
    lcm, clock = DrakeLcm("memq://"), Clock()
    arm, source = PandaStation(BOX, lcm, clock=clock), CommandSource(lcm)
    start = joints(arm)
    goal = start + np.linspace(-0.2, 0.2, 7)
    for k in range(500):
        clock.now = EPOCH + k * STEP
        source.command(start + (goal - start) * k / 500, clock.now)
        arm.step()
    assert arm.validator.events == ["following"]
    np.testing.assert_allclose(joints(arm), goal, atol=2e-3)
    np.testing.assert_allclose(source.measured, joints(arm), atol=2e-3)
    for _ in range(60):
        clock.now += STEP
        arm.step()
    assert "no command for 0.1 s" in arm.validator.events[-1]
    for _ in range(20):
        clock.now += STEP
        source.command(goal, clock.now)
        arm.step()
    assert arm.validator.events[-1] == "following"


def test_images_are_stamped_with_their_capture_times() -> None:
    lcm, clock = DrakeLcm("memq://"), Clock()
    arm = PandaStation(load_scenario("tabletop_box"), lcm, clock=clock)
    received: list[bytes] = []
    lcm.Subscribe(CHANNEL.format("camera"), received.append)
    # The station waits for the second image, due at 0.063 s, from 0.093 s on. The third image is
    # due at 0.097 s.
    for k in range(48):
        clock.now = EPOCH + k * STEP
        arm.step()
        while lcm.HandleSubscriptions(0):
            pass
    assert len(received) == 2
    frames = [unpack_depth(lcmt_image_array.decode(data)) for data in received]
    assert frames[0][0].shape == (480, 640)
    assert 0.5 < np.nanmedian(frames[0][0]) < 3.0
    # The plant is a step ahead of the clock of this test.
    stamps = np.array([stamp for _, stamp in frames]) - EPOCH
    np.testing.assert_allclose(stamps, [-STEP, 1 / 30 - STEP], atol=1e-5)


def test_velocities_are_by_the_wall_clock_at_half_the_rate() -> None:
    lcm, clock = DrakeLcm("memq://"), Clock()
    arm = PandaStation(BOX, lcm, rate=0.5, clock=clock)
    source, start = CommandSource(lcm), joints(arm)
    for k in range(300):
        clock.now = EPOCH + k * STEP / 0.5
        source.command(start + 0.2 * (clock.now - EPOCH), clock.now)
        arm.step()
    status = arm.status(clock.now)
    np.testing.assert_allclose(status.joint_velocity, 0.2, atol=5e-3)
    np.testing.assert_allclose(status.joint_position, status.joint_position_desired, atol=2e-3)
    # At half the rate the limit is 1.1 of 2.2 rad/s, plus a fifth: faster commands are rejected.
    clock.now += 0.09
    source.command(np.array(status.joint_position_desired) + 0.15, clock.now)
    arm.step()
    assert "jumps by" in arm.validator.events[-1]
