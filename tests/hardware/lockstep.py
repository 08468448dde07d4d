"""Simulated station and command streamer in one process, with a clock advanced by tests."""

import os
from collections.abc import Callable
from itertools import count
from typing import Any

import numpy as np
from pydrake.lcm import DrakeLcm

from drake_oa.hardware.command_streamer import STATUS_CHANNEL, CommandStreamer, LcmArm
from drake_oa.hardware.panda_station import PandaStation
from drake_oa.hardware.robot_link import RobotLink
from drake_oa.scenario.loading import load_scenario
from drake_oa.world.depth_messages import lcm_bus

EPOCH, STEP = 1.7e9, 0.002
NO_CAMERAS = ["cameras=[]", "perception=!GroundTruth {}"]
"""Overrides for a scenario without cameras."""
PRINTED_METRICS = ("contacts", "robot_clearance_min", "goal_error", "delay", "pause")
"""Keys of the report of a run that are printed."""
_numbers = count()
"""Numbers of the LCM buses of this process."""


def own_bus() -> str:
    """Returns the URL of an LCM bus that no other test process uses."""
    return f"udpm://239.255.76.99:{7700 + os.getpid() % 10_000}?ttl=0&recv_buf_size=4000000"


class Clock:
    """Wall clock that a test advances."""

    def __init__(self) -> None:
        self.now = EPOCH

    def __call__(self) -> float:
        return self.now


class LossyLcm:
    """LCM bus that discards published messages while `is_lossy` is set, and counts images."""

    def __init__(self, lcm: DrakeLcm) -> None:
        self._lcm, self.is_lossy, self.images = lcm, False, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._lcm, name)

    def Publish(self, channel: str, data: bytes) -> None:
        self.images += channel != STATUS_CHANNEL
        if not self.is_lossy:
            self._lcm.Publish(channel, data)


def joints(arm: PandaStation) -> np.ndarray:
    """Returns the joint positions (7,) of the simulated arm [rad]."""
    return np.array(arm.status(EPOCH).joint_position)


class Lockstep:
    """Simulation in which station and streamer step whenever the link to the arm waits.

    Attributes:
        station_runs: whether the station steps.
        statuses: LCM bus of the station, which may discard its statuses and images.
        before_step: function called before each step of station and streamer.
    """

    def __init__(
        self,
        scenario: str = "tabletop_box",
        *overrides: str,
        images: bool = False,
        log: bool = False,
    ) -> None:
        # A new bus, without messages of earlier tests.
        self.url = f"memq://{next(_numbers)}"
        self.lcm, self.clock = lcm_bus(self.url), Clock()
        self.statuses: Any = LossyLcm(self.lcm)
        self.scenario = load_scenario(scenario, overrides if images else NO_CAMERAS)
        self.station = PandaStation(
            self.scenario, self.statuses, clock=self.clock, waits=True, log=log
        )
        self.link = RobotLink(self.url, wait=self.step, clock=self.clock)
        self.streamer = CommandStreamer(self.link.trajectory, LcmArm(self.lcm), self.link.rate)
        self.station_runs, self.ended = True, False
        self.before_step: Callable[[], object] = lambda: None

    def step(self) -> None:
        """Advances the clock by one step of the plant, and steps station and streamer."""
        self.before_step()
        self.clock.now += STEP
        if self.station_runs:
            self.station.step()
        self.ended = self.ended or self.streamer.is_finished
        if not self.ended:
            self.streamer.step(self.clock.now)
