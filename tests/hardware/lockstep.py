"""A station and a player in one process, by a clock that only tests advance."""

from collections.abc import Callable
from itertools import count
from typing import Any

import numpy as np
from pydrake.lcm import DrakeLcm

from drake_oa.hardware.command_streamer import CommandStreamer
from drake_oa.hardware.panda_station import PandaStation
from drake_oa.hardware.robot_link import RobotLink
from drake_oa.scenario.loading import load_scenario
from drake_oa.world.depth_messages import lcm_bus

EPOCH, STEP = 1.7e9, 0.002
BLIND = ["cameras=[]", "perception=!GroundTruth {}"]
"""Fields of a scenario without cameras."""
_numbers = count()


class Clock:
    """A wall clock that a test advances."""

    def __init__(self) -> None:
        self.now = EPOCH

    def __call__(self) -> float:
        return self.now


class Deaf:
    """An LCM bus on which what is published may be lost."""

    def __init__(self, lcm: DrakeLcm) -> None:
        self._lcm, self.lost = lcm, False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._lcm, name)

    def Publish(self, channel: str, data: bytes) -> None:
        if not self.lost:
            self._lcm.Publish(channel, data)


def joints(arm: PandaStation) -> np.ndarray:
    """(7,) positions of the simulated arm [rad]."""
    return np.array(arm.status(EPOCH).joint_position)


class Lockstep:
    """The arm's side steps whenever the diagram's side waits.

    Attributes:
        alive: whether the station steps.
        statuses: `lost`, and with them images, or not.
        each: called before each step of the arm's side.
    """

    def __init__(
        self,
        scenario: str = "tabletop_box",
        *,
        images: bool = False,
        log: bool = False,
    ) -> None:
        # Each its own, which nobody of before speaks on.
        self.url = f"memq://{next(_numbers)}"
        self.lcm, self.clock = lcm_bus(self.url), Clock()
        self.statuses: Any = Deaf(self.lcm)
        self.scenario = load_scenario(scenario, [] if images else BLIND)
        self.station = PandaStation(
            self.scenario,
            self.statuses,
            clock=self.clock,
            waits=True,
            log=log,
        )
        self.link = RobotLink(self.url, wait=self.step, clock=self.clock)
        self.player = CommandStreamer(self.link.motion, self.lcm, self.link.rate)
        self.alive, self.ended = True, False
        self.each: Callable[[], object] = lambda: None

    def step(self) -> None:
        """One step of the plant's."""
        self.each()
        self.clock.now += STEP
        if self.alive:
            self.station.step()
        self.ended = self.ended or self.player.finished
        if not self.ended:
            self.player.step(self.clock.now)
