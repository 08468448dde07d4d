"""Run of a scenario's diagram with an arm and cameras that communicate by LCM messages."""

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
    logged_signals,
    make_log,
    run_motion,
)
from drake_oa.scenario.end_poses import start_positions
from drake_oa.scenario.scenario import Scenario
from drake_oa.world.station import release_cameras

_WARMUP_DONE = 0.3
"""Simulated time of the warm-up, in which every layer is evaluated at least once [s]."""
_IMAGE_DELAY = 0.05
"""Additional delay of images, in wall time, at which the motion guard does not slow down [s]."""


@dataclass(frozen=True)
class HardwareSetup:
    """Diagram that is ready to command an arm.

    Attributes:
        scenario: scenario of the run.
        known_scenario: the scenario without its obstacles, which the cameras perceive.
        diagram: diagram with the messages of the arm in place of the simulated world.
    """

    scenario: Scenario
    known_scenario: Scenario
    diagram: Diagram


def prepare_hardware(
    scenario: Scenario, link: RobotLink, meshcat: Meshcat | None = None
) -> HardwareSetup:
    """Checks that the arm is ready, builds its diagram, and simulates the beginning as a warm-up.

    Args:
        scenario: scenario of the run.
        link: link to the arm; images arrive on the same LCM bus.
        meshcat: viewer, or None.

    Raises:
        ScenarioError: naming the wrong field.
        HardwareError: if the arm sends no status, is not at the start, is beyond its limits, moves
            or has another command source, or if the table is not at its height in the images.
    """
    max_delay = LEAD + link.rate * _IMAGE_DELAY
    known_scenario = hardware_scenario(scenario, link.url, max_delay)
    arm, limits = arm_of(known_scenario)
    q = start_positions(known_scenario)
    q[arm] = link.ready_arm(q[arm], limits)
    station = partial(add_hardware, link=link, q_measured=q)
    diagram = build_avoidance(known_scenario, add_station=station, meshcat=meshcat)
    with link.warmup():
        simulator = Simulator(diagram)
        try:
            simulator.Initialize()
            simulator.AdvanceTo(_WARMUP_DONE)
        except BaseException:
            release_cameras(diagram)
            raise
    return HardwareSetup(scenario, known_scenario, diagram)


def drive(
    setup: HardwareSetup,
    link: RobotLink,
    *,
    duration: float | None = None,
    on_step: OnStep = lambda monitor, root: None,
) -> MotionLog:
    """Executes the avoiding motion on the arm; it terminates as in `simulate`.

    Args:
        setup: result of `prepare_hardware`.
        link: link to the arm of that setup.
        duration: time limit [s], see `simulate`.
        on_step: function that is called once a period, see `simulate`.

    Returns:
        The log of the commanded motion.

    Raises:
        MotionInterruptedError: as `simulate` does, and if the arm was stopped.
    """
    # Real obstacles are unknown, so the trajectories of the scenario's obstacles tell the monitor
    # until when the world moves.
    monitor = MotionMonitor(setup.diagram, setup.scenario, duration, on_step)
    simulator = Simulator(setup.diagram)
    try:
        return _with_events(
            run_motion(setup.known_scenario, simulator, monitor, avoid_obstacles=True), link
        )
    except MotionInterruptedError as error:
        raise MotionInterruptedError(_with_events(error.log, link)) from error.__cause__
    finally:
        link.close()


def _with_events(log: MotionLog, link: RobotLink) -> MotionLog:
    """Returns the log with the events of the command streamer added to the notes of the policy."""
    events = [
        *zip(log.event_time.tolist(), log.event_hold, log.event, strict=True),
        *((t, HoldReason.SPEED_SCALE.value, note) for t, note in link.events),
    ]
    return replace(log, **columns_of(sorted(events, key=itemgetter(0)), EVENT))


def station_log(scenario: Scenario, station: PandaStation) -> MotionLog:
    """Returns the log of the simulated arm of a station, from its true state.

    Data of the command source, such as observations and decisions, are unknown and empty.

    Args:
        scenario: scenario of the station.
        station: station that was created with `log`.
    """
    t, signals = logged_signals(station.diagram, station.simulator.get_context())
    events = zip(station.event_times, station.validator.events, strict=False)
    return make_log(
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
