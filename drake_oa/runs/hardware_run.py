"""Runs a scenario's diagram against an arm and cameras behind LCM messages."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram

from drake_oa.common.files import software_versions
from drake_oa.common.messages import HoldCause
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.diagrams.policy import make_dmp
from drake_oa.hardware.hardware_cell import add_hardware, arm_of, hardware_scenario
from drake_oa.hardware.panda_station import PandaStation
from drake_oa.hardware.robot_link import RobotLink
from drake_oa.robot.plant import make_robot_plant
from drake_oa.runs.motion_log import MotionEnd, MotionLog, pack_ellipsoids
from drake_oa.runs.simulation import (
    LONGEST_SCALING,
    MotionInterruptedError,
    MotionWatcher,
    run_motion,
)
from drake_oa.scenario.loading import scenario_text
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.scenario.task import last_move
from drake_oa.scenario.task_joints import start_positions
from drake_oa.world.station import release_cameras

_REHEARSED = 0.3
"""Simulated time in which every layer has had its turn [s]."""


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


def ready(
    scenario: Scenario, link: RobotLink, *, lcm_url: str, meshcat: Meshcat | None = None
) -> Driven:
    """Looks whether the arm may be moved, builds what is to move it, and rehearses its beginning.

    Args:
        scenario: what to run.
        link: to the arm.
        lcm_url: of the bus that the images come by.
        meshcat: viewer, or None.

    Raises:
        ScenarioError: naming the field that does not fit.
        HardwareError: if the arm is silent, not where the scenario begins, out of limits, moves
            or is commanded by somebody else, or the camera does not see the table where it is.
    """
    late = link.rules.lead + link.rate * link.rules.image_delay
    known = hardware_scenario(scenario, lcm_url, late)
    arm, limits = arm_of(known)
    q = start_positions(known)
    q[arm] = link.ready_arm(q[arm], limits)
    cell = partial(add_hardware, link=link, q_measured=q)
    diagram = build_avoidance(known, add_cell=cell, meshcat=meshcat)
    with link.rehearsal():
        simulator = Simulator(diagram)
        try:
            simulator.Initialize()
            simulator.AdvanceTo(_REHEARSED)
        except BaseException:
            release_cameras(diagram)
            raise
    return Driven(scenario, known, diagram)


def drive(
    driven: Driven,
    link: RobotLink,
    *,
    duration: float | None = None,
    on_progress: Callable[[float, float], None] | None = None,
    on_look: Callable[[MotionWatcher, Context], None] | None = None,
) -> MotionLog:
    """Runs the modulated motion on the arm; its end is `simulate`'s.

    Args:
        driven: of `ready`.
        link: likewise.
        duration: as for `simulate`.
        on_progress: as for `simulate`.
        on_look: as for `simulate`.

    Returns:
        The log of what the arm was sent.

    Raises:
        MotionInterruptedError: as `simulate` does; also if the arm was stopped.
    """
    known, end_time = driven.known, duration
    if end_time is None:
        end_time = make_dmp(known).duration * LONGEST_SCALING + last_move(known.task)
    # The world rests when the scenario's own would, as far as it tells.
    watcher = MotionWatcher(
        driven.diagram,
        driven.scenario,
        end_time,
        on_progress,
        latest_time=duration,
        on_look=on_look,
    )
    try:
        return _with_events(
            run_motion(known, Simulator(driven.diagram), watcher, modulated=True), link
        )
    except MotionInterruptedError as error:
        raise MotionInterruptedError(_with_events(error.log, link)) from error.__cause__
    finally:
        link.close()


def _with_events(log: MotionLog, link: RobotLink) -> MotionLog:
    """The log with what the arm's player said among what held the motion."""
    told = [
        *zip(log.event_time.tolist(), log.event_hold, log.event, strict=True),
        *((t, HoldCause.SPEED_SCALE.value, note) for t, note in link.events),
    ]
    told.sort(key=lambda one: one[0])
    return replace(
        log,
        event_time=np.array([t for t, _, _ in told]),
        event_hold=tuple(hold for _, hold, _ in told),
        event=tuple(note for _, _, note in told),
    )


def station_log(scenario: Scenario, station: PandaStation) -> MotionLog:
    """What the simulated arm did, by itself: the truth behind the messages.

    What is of who commanded it is not known here, and empty.

    Args:
        scenario: of the station.
        station: made with `log`.

    Raises:
        ValueError: if it kept no log.
    """
    states = station.states
    if not states:
        raise ValueError("the station keeps no log: make it with log=True")
    t, state = states["robot_state"]
    robot_plant = make_robot_plant(robot_of(scenario))
    q, v = np.hsplit(state, 2)
    p_WE = robot_plant.tool_path(q)
    events = station.guard.events
    nobody = np.zeros(len(t))
    still = np.zeros_like(p_WE)
    return MotionLog(
        t=t,
        q=q,
        v=v,
        torque=states["actuation"][1],
        saturated=nobody,
        p_WE=p_WE,
        desired_position=p_WE,
        desired_velocity=still,
        desired_acceleration=still,
        phase=nobody,
        speed_scale=np.ones(len(t)),
        tracking_error=np.full(len(t), math.nan),
        q_world=states["plant_state"][1][:, : station.num_positions],
        observation_time=np.zeros(0),
        **pack_ellipsoids([]),
        out_of_range=np.zeros(0, dtype=np.int64),
        regulation="",
        shortfall=nobody,
        event_time=np.array(station.event_times[: len(events)]),
        event_hold=("",) * len(events),
        event=tuple(events),
        supervision_time=np.zeros(0),
        supervision_action=(),
        supervision_reason=(),
        **vars(robot_plant.limits),
        stop_reason="station ended",
        ended=MotionEnd.TIME_LIMIT.value,
        wall_time=station.pace.wall,
        modulated=True,
        scenario=scenario_text(scenario),
        seed=scenario.seed,
        versions=software_versions(),
    )
