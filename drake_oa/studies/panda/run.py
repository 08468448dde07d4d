"""One method on one scene of the Panda, simulated and judged.

Methods:

  preplanned       the planned motion, blind to obstacles
  paper            the paper's regulation: a regressor chain at the obstacle's section by the
                   P-plane, sides by cost rings, without a supervisor. The chain is the one
                   trained for this action level, as the paper's own counts alpha in rad/s
  verified         the project's: motions of the whole arm that roll-outs among the true shapes
                   have checked, and a plan that the primitives imitate where none of them clears
  differential_ik  Drake's differential inverse kinematics with collision constraints, which
                   knows the obstacles exactly, on the same planned motion; its tool is asked
                   for the same clearance, as far as start and goal have it
  differential_ik_near
                   the same asked for 3 cm: most of its motions arrive with that
  planner          a sampling-based planner that knows the obstacles exactly, to tell which
                   scenes have a solution at all: see `planner`. It is not simulated, and runs
                   among obstacles at rest alone

Contacts are judged by SceneGraph at every logged instant (4 ms apart) until everything has
been at rest for a second: each link, the hand and the fingers against obstacles, table and each
other.

A run is a `success` (no contact, and the tool point ends within 5 mm of the goal), a
`contact` with the scene or with itself, or else `stopped`: it ended short of the goal without
a contact. The reason of a
stop is what ended the run, with "#" for its numbers; a run that raised an exception has that
exception for a reason.
"""

from __future__ import annotations

import copy
import logging
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drake_oa.regulation.config import Paper, Verified
from drake_oa.runs.decision_costs import layer_costs
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.report import feasible_clearance_of, judge_of, motion_report
from drake_oa.runs.simulation import AT_GOAL, MotionInterruptedError, simulate
from drake_oa.scenario.scenario import Scenario
from drake_oa.studies.panda.differential_ik import PeerParameters
from drake_oa.studies.panda.scenes import seen_by

PLANNER = "planner"
"""The method that plans, needs OMPL, and is not simulated."""
DIFFERENTIAL_IK = frozenset({"differential_ik", "differential_ik_near"})
DEFAULT_METHODS = ("preplanned", "paper", "verified", "differential_ik", "differential_ik_near")
METHODS = (*DEFAULT_METHODS, PLANNER)
TRUTH_ONLY = DIFFERENTIAL_IK | {PLANNER}
"""Methods that know the obstacles exactly, whatever the perception."""


_KEPT = (
    "contacts",
    "self_contacts",
    "tool_clearance_min",
    "robot_clearance_min",
    "asked_clearance",
    "feasible_clearance",
    "short_of_feasible",
    "believed_shortfall",
    "lowered",
    "goal_error",
    "orientation_error",
    "duration",
    "path_length",
    "torque_saturation",
    "stop_reason",
    "ended",
    "settled",
    "decision_cost",
    "evasion_cost",
    "events",
)
"""What of `motion_report` a result holds,"""
_JUDGED = ("beyond_limits", "moving_after")
"""and what besides."""
_MOVING = 0.02
"""Share of its pace at which a motion has begun."""


def default_methods(kind: str) -> tuple[str, ...]:
    """Returns the methods that run where none are named: the planner in elbow and clutter6 only."""
    return (*DEFAULT_METHODS, PLANNER) if kind in ("elbow", "clutter6") else DEFAULT_METHODS


_NUMBER = re.compile(r"[-+]?\b\d+(?:\.\d+)?(?:e[-+]?\d+)?\b")

_logger = logging.getLogger("drake_oa")


@dataclass(frozen=True)
class Criteria:
    """What a run is judged by, besides contacts.

    Attributes:
        goal_error: largest distance from the goal [m].
        orientation_error: largest angle from the goal's orientation [rad].
        beyond_limits: how far a joint of the arm may have been beyond its limit [rad].
        planner_asked: whether the planner's robot keeps what the task asks of the tool; else
            `planner.CLEARANCE`.
        planner_states: that the planner may look at; None: `planner.STATES`.
    """

    goal_error: float = AT_GOAL
    orientation_error: float = math.inf
    beyond_limits: float = math.inf
    planner_asked: bool = False
    planner_states: int | None = None

    def lacks(self, found: Mapping[str, Any]) -> str:
        """Why a run without a contact is no success; "" if it is one."""
        # NaN is no success.
        if not found["goal_error"] <= self.goal_error:
            return found["stop_reason"] or "short of the goal"
        if not (found["orientation_error"] or 0.0) <= self.orientation_error:
            return f"{math.degrees(found['orientation_error']):.1f} degrees from the goal"
        if not (found["beyond_limits"] or 0.0) <= self.beyond_limits:
            return f"a joint went {found['beyond_limits']:.4f} rad beyond its limit"
        # A plan is not simulated, and tells nothing of it.
        return "never at rest" if found["settled"] is False else ""


@dataclass(frozen=True)
class PandaRun:
    """A judged run and, where it ran at all, its log.

    Attributes:
        result: plain data, as `run_and_judge` describes it.
        log: None where nothing could be simulated.
    """

    result: dict[str, Any]
    log: MotionLog | None


def check_panda_method(name: str) -> None:
    """Raises ValueError for an unknown method."""
    if name not in METHODS:
        raise ValueError(f"unknown method {name!r}; panda has: {', '.join(METHODS)}")


def with_method(scenario: Scenario, method: str) -> Scenario:
    """The scenario as a method runs it."""
    check_panda_method(method)
    scenario = copy.deepcopy(scenario)
    if method == "paper":
        scenario.regulation = Paper()
        scenario.policy.fade = 0.0
        scenario.supervisor = None
    elif method == "verified" and not isinstance(scenario.regulation, Verified):
        scenario.regulation = Verified()
    return scenario


def run_and_judge(
    scenario: Scenario,
    method: str,
    perception: str,
    *,
    duration: float | None = None,
    criteria: Criteria | None = None,
) -> PandaRun:
    """Runs a method on a scene.

    The result has `outcome` ("success", "contact" or "stopped"), `reason` (of what is no success:
    the stop reason with "#" for numbers), `failed` (whether it raised), and of `motion_report`
    those of `_KEPT`; besides `moving_after`, `wall_time` [s] and `real_time_factor` of the
    simulation. Of `planner` see `run_planner`.

    Args:
        scenario: the scene.
        method: one of `METHODS`.
        perception: one of `scenes.PERCEPTIONS`.
        duration: time limit of the run [s]; None: that of `simulate`.
        criteria: what is a success; None: the defaults.
    """
    criteria = criteria or Criteria()
    scenario = with_method(seen_by(scenario, perception), method)
    if method == PLANNER:
        return PandaRun(_plan(scenario, criteria), None)
    feasible, judge, failed = None, None, False
    try:
        if method == "differential_ik":
            judge = judge_of(scenario)
            feasible = feasible_clearance_of(scenario, judge)
        log = _simulate(scenario, method, duration, feasible)
    except MotionInterruptedError as error:
        if isinstance(error.__cause__, KeyboardInterrupt):
            raise KeyboardInterrupt from error
        log, failed = error.log, True
        _logger.info("the run was cut short", exc_info=True)
    except Exception as error:
        # A scene that cannot be run is a result like any other, and ends no other scene.
        _logger.info("the run could not start", exc_info=True)
        return PandaRun(_not_run(scenario, _said(error)), None)
    report = motion_report(scenario, log, feasible, judge)
    return PandaRun(_judged(scenario, log, report, failed, criteria), log)


def _simulate(
    scenario: Scenario, method: str, duration: float | None, feasible: float | None
) -> MotionLog:
    if method in DIFFERENTIAL_IK:
        from drake_oa.studies.panda.peer import simulate_differential_ik

        # No arm starts where it would have to keep more than it has.
        asked = PeerParameters()
        parameters = replace(asked, arm_distance=min(asked.arm_distance, scenario.task.clearance))
        if feasible is not None:
            parameters = replace(parameters, tool_distance=feasible)
        return simulate_differential_ik(scenario, duration=duration, parameters=parameters)
    return simulate(scenario, modulated=method != "preplanned", duration=duration)


def _plan(scenario: Scenario, criteria: Criteria) -> dict[str, Any]:
    from drake_oa.studies.panda.planner import CLEARANCE, run_planner

    clearance = scenario.task.clearance if criteria.planner_asked else CLEARANCE
    try:
        found = run_planner(scenario, clearance=clearance, states=criteria.planner_states)
    except Exception as error:
        _logger.info("the planner failed", exc_info=True)
        return _not_run(scenario, _said(error))
    found = dict.fromkeys((*_KEPT, *_JUDGED)) | found
    return {**_outcome(found, False, criteria), "failed": False, **found}


def _judged(
    scenario: Scenario,
    log: MotionLog,
    report: dict[str, Any],
    failed: bool,
    criteria: Criteria,
) -> dict[str, Any]:
    found = {key: report.get(key) for key in _KEPT}
    found |= {"beyond_limits": _beyond_limits(scenario, log), "moving_after": moving_after(log)}
    return {
        **_outcome(found, failed, criteria),
        "failed": failed,
        **found,
        # To a tenth of a millisecond: to be taken together over scenes.
        "decision_costs": np.round(layer_costs(log), 4).tolist(),
        "wall_time": log.wall_time,
        "real_time_factor": log.simulated_time / log.wall_time if log.wall_time > 0.0 else None,
    }


def moving_after(log: MotionLog) -> float | None:
    """When the motion first went at `_MOVING` of the pace that it reached [s]; None: never.

    The goal is known at 0, and what decisions cost has passed.
    """
    rate = np.diff(-np.log(log.phase[log.moving])) / np.diff(log.t[log.moving])
    goes = rate > _MOVING * rate.max(initial=0.0)
    return float(log.t[log.moving][goes.argmax()]) if goes.any() else None


def _beyond_limits(scenario: Scenario, log: MotionLog) -> float:
    """How far a joint of the arm went beyond its limit at most [rad]."""
    arm = len(scenario.robot.q_seed) if scenario.robot else 0
    q, lower, upper = log.q[:, :arm], log.position_lower[:arm], log.position_upper[:arm]
    return float(np.maximum(lower - q, q - upper).max(initial=0.0))


def _outcome(found: dict[str, Any], failed: bool, criteria: Criteria) -> dict[str, str]:
    """`outcome` and `reason`."""
    if found["contacts"] or found["self_contacts"]:
        return {"outcome": "contact", "reason": plain_reason(found["stop_reason"])}
    lacks = criteria.lacks(found) or (found["stop_reason"] if failed else "")
    return {"outcome": "stopped" if lacks else "success", "reason": plain_reason(lacks)}


def _said(error: Exception) -> str:
    return f"{type(error).__name__}: {error}".rstrip(": ")


def _not_run(scenario: Scenario, reason: str) -> dict[str, Any]:
    return {
        "outcome": "stopped",
        "reason": plain_reason(reason),
        "failed": True,
        **dict.fromkeys((*_KEPT, *_JUDGED)),
        "contacts": [],
        "self_contacts": [],
        "goal_error": math.dist(scenario.task.start, scenario.task.goal),
        "path_length": 0.0,
        "torque_saturation": 0.0,
        "stop_reason": reason,
        "events": [],
        "wall_time": 0.0,
        "real_time_factor": None,
    }


def plain_reason(reason: str) -> str:
    """A reason with "#" for its numbers, so that equal reasons can be counted."""
    return _NUMBER.sub("#", reason).strip()
