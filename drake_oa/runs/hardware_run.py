"""Run of a scenario on hardware: its diagram commands a real arm and reads its cameras by LCM
messages.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache, partial
from operator import itemgetter

from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram

from drake_oa.common.console import quiet
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
    simulate,
)
from drake_oa.scenario.end_poses import start_positions
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario
from drake_oa.world.station import release_cameras

_WARMUP_DONE = 0.3
"""Duration of the warm-up, in simulated time, in which each layer is evaluated at least once before
the arm moves [s]."""
_IMAGE_DELAY = 0.05
"""Delay of real camera images, in wall time, that a hardware run tolerates [s].

The age of an observation above which the motion guard slows the arm is raised by this delay and by
`LEAD`, the time by which planned positions are ahead of the arm."""


@dataclass(frozen=True)
class HardwareSetup:
    """Diagram that has been warmed up and is ready to command a real arm, with the scenario of the
    run.

    Attributes:
        scenario: scenario of the run.
        known_scenario: copy of the scenario without its obstacles, which only the cameras perceive.
        diagram: diagram that exchanges messages with arm and cameras instead of simulating them.
    """

    scenario: Scenario
    known_scenario: Scenario
    diagram: Diagram


def prepare_hardware(
    scenario: Scenario, link: RobotLink, meshcat: Meshcat | None = None
) -> HardwareSetup:
    """Checks that a real arm is ready, builds the diagram that commands it, and runs a warm-up
    without commands.

    Args:
        scenario: scenario of the run.
        link: link to the arm. Its LCM bus (`url`) delivers the images, unless the scenario has a
            block `!LcmCamera` with another URL.
        meshcat: viewer, or None.

    Returns:
        Setup for `drive`.

    Raises:
        ScenarioError: if a field of the scenario is wrong; names the field.
        HardwareError: if the arm sends no status, is not at rest at the start, has a joint outside
            its position limits, or receives commands of another process; if the table in the images
            is not at the height that the scenario states.
    """
    max_delay = LEAD + link.rate * _IMAGE_DELAY
    known_scenario = hardware_scenario(scenario, link.url, max_delay)
    arm, limits = arm_of(known_scenario)
    _load_kernels()
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


@cache
def _load_kernels() -> None:
    """Loads or compiles the kernels (compiled functions) of all layers, because compiling one while
    the arm moves would delay decisions by seconds.

    The function simulates a shipped scenario in which an obstacle moves toward the arm. The motion
    is fast and its requested clearance cannot be reached, so that all compiled functions
    of the planner and the motion guard are called.
    """
    overrides = ["task.clearance=0.35", "task.duration=2.5", "perception.noise=null"]
    with quiet():  # Messages on this motion are not about the real arm.
        simulate(load_scenario("moving_obstacle", overrides), avoid_obstacles=True, duration=1.5)


def drive(
    setup: HardwareSetup,
    link: RobotLink,
    *,
    duration: float | None = None,
    on_step: OnStep = lambda monitor, root: None,
) -> MotionLog:
    """Moves a real arm to the goal while avoiding obstacles, until the motion has terminated, and
    closes the link.

    Args:
        setup: result of `prepare_hardware`.
        link: link to the arm of this setup.
        duration: simulated time at which the run ends in any case [s]; None: the time limit of the
            motion is 6 demonstrated durations after the last move of the goal.
        on_step: function that is called once per period of the policy, with the monitor of the
            motion and the root Context of the diagram.

    Returns:
        Log of the commanded motion.

    Raises:
        MotionInterruptedError: if an exception or a signal interrupted the run, or if the arm was
            stopped; contains the log until then.
    """
    # Real obstacles are unknown. From the trajectories of the scenario's obstacles, the monitor
    # knows until when the world may move.
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
    """Returns a copy of a log in which the events of the command streamer are added to the notes.

    The notes of a log explain why the motion is held. The command streamer is the process that
    sends positions to the arm. An event states that the arm stopped, holds its position, or resumed
    the motion. Each added note has the hold reason "speed_scale".

    Args:
        log: log of the commanded motion.
        link: link to the arm, which has collected the events.
    """
    events = [
        *zip(log.event_time.tolist(), log.event_hold, log.event, strict=True),
        *((t, HoldReason.SPEED_SCALE.value, note) for t, note in link.events),
    ]
    return replace(log, **columns_of(sorted(events, key=itemgetter(0)), EVENT))


def station_log(scenario: Scenario, station: PandaStation) -> MotionLog:
    """Creates the log of the simulated arm of a station (`drake-oa station`), which another process
    commands by messages.

    The log contains the true states of the arm. Its notes are the events of the command validator:
    the arm begins to follow commands or to hold, or a command is rejected. The attributes for
    observations and decisions are empty, because only the process that sent the commands has them.

    Args:
        scenario: scenario of the station.
        station: station that was created with `log=True`.
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
