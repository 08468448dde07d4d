"""Runs a scenario's diagram against an arm and cameras behind LCM messages."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from operator import itemgetter

from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram

from drake_oa.common.messages import HoldReason
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.hardware.command_streamer import LEAD
from drake_oa.hardware.hardware_station import add_hardware, arm_of, hardware_scenario
from drake_oa.hardware.panda_station import PandaStation
from drake_oa.hardware.robot_link import RobotLink
from drake_oa.runs.motion_log import MotionEnd, MotionLog
from drake_oa.runs.simulation import (
    EVENT,
    MotionInterruptedError,
    MotionMonitor,
    OnStep,
    columns_of,
    log_of,
    logged_signals,
    run_motion,
)
from drake_oa.scenario.end_poses import start_positions
from drake_oa.scenario.scenario import Scenario
from drake_oa.world.station import release_cameras

_WARMUP_DONE = 0.3
"""Simulated time in which every layer has had its turn [s]."""
_IMAGE_DELAY = 0.05
"""Additional delay of images by the wall clock for which the supervisor does not slow down [s]."""


@dataclass(frozen=True)
class Driven:
    """A diagram that is ready to drive an arm.

    Attributes:
        scenario: what it was asked to run.
        known: what it knows of that: obstacles are to be seen.
        diagram: with the arm's messages in place of the simulated world.
    """

    scenario: Scenario
    known: Scenario
    diagram: Diagram


def ready(scenario: Scenario, link: RobotLink, meshcat: Meshcat | None = None) -> Driven:
    """Looks whether the arm may be moved, builds what is to move it, and rehearses its beginning.

    Args:
        scenario: what to run.
        link: to the arm; the images come by the same bus.
        meshcat: viewer, or None.

    Raises:
        ScenarioError: naming the field that does not fit.
        HardwareError: if the arm is silent, not where the scenario begins, out of limits, moves
            or is commanded by somebody else, or the camera does not see the table where it is.
    """
    late = LEAD + link.rate * _IMAGE_DELAY
    known = hardware_scenario(scenario, link.url, late)
    arm, limits = arm_of(known)
    q = start_positions(known)
    q[arm] = link.ready_arm(q[arm], limits)
    station = partial(add_hardware, link=link, q_measured=q)
    diagram = build_avoidance(known, add_station=station, meshcat=meshcat)
    with link.warmup():
        simulator = Simulator(diagram)
        try:
            simulator.Initialize()
            simulator.AdvanceTo(_WARMUP_DONE)
        except BaseException:
            release_cameras(diagram)
            raise
    return Driven(scenario, known, diagram)


def drive(
    driven: Driven,
    link: RobotLink,
    *,
    duration: float | None = None,
    on_step: OnStep = lambda monitor, root: None,
) -> MotionLog:
    """Runs the avoiding motion on the arm; its end is `simulate`'s.

    Args:
        driven: of `ready`.
        link: likewise.
        duration: as for `simulate`.
        on_step: as for `simulate`.

    Returns:
        The log of what the arm was sent.

    Raises:
        MotionInterruptedError: as `simulate` does; also if the arm was stopped.
    """
    # The world rests when the scenario's own would, as far as it tells.
    monitor = MotionMonitor(driven.diagram, driven.scenario, duration, on_step)
    simulator = Simulator(driven.diagram)
    try:
        return _with_events(
            run_motion(driven.known, simulator, monitor, avoid_obstacles=True), link
        )
    except MotionInterruptedError as error:
        raise MotionInterruptedError(_with_events(error.log, link)) from error.__cause__
    finally:
        link.close()


def _with_events(log: MotionLog, link: RobotLink) -> MotionLog:
    """Returns the log with the events of the arm's player among those that held the motion."""
    told = [
        *zip(log.event_time.tolist(), log.event_hold, log.event, strict=True),
        *((t, HoldReason.SPEED_SCALE.value, note) for t, note in link.events),
    ]
    return replace(log, **columns_of(sorted(told, key=itemgetter(0)), EVENT))


def station_log(scenario: Scenario, station: PandaStation) -> MotionLog:
    """What the simulated arm did, by itself: the truth behind the messages.

    What is of who commanded it is not known here, and empty.

    Args:
        scenario: of the station.
        station: made with `log`.
    """
    t, signals = logged_signals(station.diagram, station.simulator.get_context())
    events = zip(station.event_times, station.validator.events, strict=False)
    return log_of(
        scenario,
        t,
        signals,
        q_world=signals["plant_state"][:, : station.num_positions],
        inference="",
        **columns_of([(at, "", event) for at, event in events], EVENT),
        stop_reason="station ended",
        ended=MotionEnd.TIME_LIMIT.value,
        wall_time=math.nan,
        avoid_obstacles=True,
    )
