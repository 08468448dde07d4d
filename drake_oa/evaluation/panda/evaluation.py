"""Methods on random scenes of the Panda: simulated and judged in parallel, stored one by one.

Methods:

  nominal       the planned motion, blind to obstacles
  paper            the paper's inference: a regressor chain at the obstacle's section by the
                   P-plane, sides by cost rings, without a supervisor. The chain is the one
                   trained for this action level, as the paper's own counts alpha in rad/s
  verified         the project's: motions of the whole arm that roll-outs among the true shapes
                   have checked, and a plan that the primitives imitate where none of them clears
  differential_ik  Drake's differential inverse kinematics with collision constraints, which
                   knows the obstacles exactly, on the same planned motion; its tool is asked
                   for the same clearance, as far as start and goal have it
  planner          a sampling-based planner that knows the obstacles and their courses exactly, to
                   tell which scenes have a solution at all: see `planner`. It is not simulated

Contacts are judged by SceneGraph at every logged instant (4 ms apart) until everything has
been at rest for a second: each link, the hand and the fingers against obstacles, table and each
other.

A run is a `success` (no contact, and the tool point ends within 5 mm of the goal), a
`contact` with the scene or with itself, or else `stopped`: it ended short of the goal without
a contact. The reason of a stop is what ended the run, with "#" for its numbers; a run that raised
an exception has that exception for a reason.

Runs of DRPBench's levels are judged by its rules as well, see `drp_outcome`.
"""

from __future__ import annotations

import copy
import logging
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from drake_oa.common.config import check_choice
from drake_oa.common.console import quiet
from drake_oa.evaluation.panda.claims import run_violations
from drake_oa.evaluation.panda.contacts import contact_events
from drake_oa.evaluation.panda.differential_ik import simulate_differential_ik
from drake_oa.evaluation.panda.drp_scenes import EPISODE
from drake_oa.evaluation.panda.planner import CLEARANCE, STATES, run_planner
from drake_oa.evaluation.panda.scenes import (
    DRP,
    KINDS,
    draw_panda_scene,
    seen_by,
)
from drake_oa.evaluation.panda.true_world import make_true_world
from drake_oa.evaluation.results import Task, resumed
from drake_oa.inference.config import Paper, Verified
from drake_oa.robot.plant import make_robot_plant
from drake_oa.runs.metrics import robot_metrics
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.report import layer_latencies, motion_report
from drake_oa.runs.simulation import AT_GOAL, MotionInterruptedError, simulate
from drake_oa.scenario.end_poses import end_rotations
from drake_oa.scenario.loading import parse_scenario, scenario_text
from drake_oa.scenario.obstacles import last_change
from drake_oa.scenario.scenario import Scenario, robot_of

PLANNER = "planner"
"""The method that plans, needs OMPL, and is not simulated."""
DIFFERENTIAL_IK = "differential_ik"
WITHOUT: dict[str, dict[str, Any]] = {
    "without_chain": {"chain": None},
    "without_search": {"generations": 0},
    "without_joint_path": {"configurations": 0, "last_configurations": 0},
}
"""Methods that are `verified` without one source of motions -> fields of its block."""
METHODS = ("nominal", "paper", "verified", DIFFERENTIAL_IK, PLANNER, *WITHOUT)
TRUTH_ONLY = frozenset({DIFFERENTIAL_IK, PLANNER})
"""Methods that know the obstacles exactly, whatever the perception."""

_UNKNOWN = (
    "tool_clearance_min",
    "robot_clearance_min",
    "clearance_shortfall",
    "sources",
    "orientation_error",
    "duration",
    "ended",
    "settled",
    "beyond_limits",
    "drp_outcome",
    "contact_events",
    "claim_violations",
)
"""Keys of a result that are None where nothing is known; the last two without moving obstacles."""

_NUMBER = re.compile(r"[-+]?\b\d+(?:\.\d+)?(?:e[-+]?\d+)?\b")

_logger = logging.getLogger("drake_oa")


@dataclass(frozen=True)
class Criteria:
    """Conditions of success of a run without a contact.

    Attributes:
        goal_error: largest distance from the goal [m].
        orientation_error: largest angle from the goal's orientation [rad].
        beyond_limits: how far a joint of the arm may have been beyond its limit [rad].
        planner_asked: whether the planner's robot keeps what the task asks of the tool; else
            `planner.CLEARANCE`.
        planner_states: that the planner may look at.
        by_drp: whether the rules of DRPBench judge a run as well.
    """

    goal_error: float = AT_GOAL
    orientation_error: float = math.inf
    beyond_limits: float = math.inf
    planner_asked: bool = False
    planner_states: int = STATES
    by_drp: bool = False

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


_CRITERIA = Criteria()


def with_method(scenario: Scenario, method: str) -> Scenario:
    """Returns the scenario as a method runs it."""
    scenario = copy.deepcopy(scenario)
    if method == "paper":
        scenario.inference = Paper()
        scenario.policy.fade = 0.0
    elif method == "verified" and not isinstance(scenario.inference, Verified):
        scenario.inference = Verified()
    elif method in WITHOUT:
        verified = with_method(scenario, "verified").inference
        scenario.inference = replace(verified, **WITHOUT[method])
    return scenario


def run_and_evaluate(
    scenario: Scenario,
    method: str,
    perception: str,
    duration: float | None = None,
    criteria: Criteria = _CRITERIA,
) -> dict[str, Any]:
    """Runs a method on a scene.

    The result has `outcome` ("success", "contact" or "stopped"), `reason` (of what is no success:
    the stop reason with "#" for numbers), `failed` (whether it raised), and all of `motion_report`;
    besides `beyond_limits` [rad], `wall_time` [s] and `real_time_factor` of the simulation, and by
    the criteria `drp_outcome`; and where obstacles move `contact_events`, see there, and
    `claim_violations`: the number of logged instants, and of those that violate each claim of
    `claims`. Of `planner` see `run_planner`.

    Args:
        scenario: the scene.
        method: one of `METHODS`.
        perception: one of `scenes.PERCEPTIONS`.
        duration: time limit of the run [s]; None: that of `simulate`.
        criteria: conditions of success.
    """
    scenario = with_method(seen_by(scenario, perception), method)
    failed, log, found = False, None, _without_motion(scenario)
    try:
        if method == PLANNER:
            requested = scenario.task.clearance if criteria.planner_asked else CLEARANCE
            found |= run_planner(scenario, clearance=requested, states=criteria.planner_states)
        else:
            log = _simulate(scenario, method, duration)
    except MotionInterruptedError as error:
        if isinstance(error.__cause__, KeyboardInterrupt):
            raise KeyboardInterrupt from error
        log, failed = error.log, True
        _logger.info("the run was cut short", exc_info=True)
    except Exception as error:
        # A scene that cannot be run is a result like any other, and ends no other scene.
        _logger.info("the run could not start", exc_info=True)
        failed, found["stop_reason"] = True, f"{type(error).__name__}: {error}".rstrip(": ")
    if log is not None:
        found = _checked(scenario, log, criteria)
    outcome, reason = "success", criteria.lacks(found)
    if found["contacts"] or found["self_contacts"]:
        outcome, reason = "contact", found["stop_reason"]
    elif reason or failed:
        outcome, reason = "stopped", reason or found["stop_reason"]
    # Without its numbers equal reasons can be counted.
    reason = _NUMBER.sub("#", reason or "").strip()
    return {"outcome": outcome, "reason": reason, "failed": failed, **found}


def _simulate(scenario: Scenario, method: str, duration: float | None) -> MotionLog:
    if method == DIFFERENTIAL_IK:
        return simulate_differential_ik(scenario, duration)
    return simulate(scenario, avoid_obstacles=method != "nominal", duration=duration)


def _checked(scenario: Scenario, log: MotionLog, criteria: Criteria) -> dict[str, Any]:
    found = _without_motion(scenario) | motion_report(scenario, log)
    arm = len(robot_of(scenario).q_seed)
    q, lower, upper = log.q[:, :arm], log.position_lower[:arm], log.position_upper[:arm]
    found["beyond_limits"] = float(np.maximum(lower - q, q - upper).max(initial=0.0))
    if criteria.by_drp:
        found["drp_outcome"] = drp_outcome(scenario, log, found["contacts"])
    if len(log.t) and last_change(scenario.obstacles) > 0.0:
        world = make_true_world(scenario)
        violated = run_violations(scenario, log, world)
        counts = {claim: int(instants.sum()) for claim, instants in violated.items()}
        found["contact_events"] = contact_events(scenario, log, world)
        found["claim_violations"] = {"instants": len(log.t), **counts}
    return found | {
        # To a tenth of a millisecond: to be taken together over scenes.
        "decision_latencies": np.round(layer_latencies(log), 4).tolist(),
        "wall_time": log.wall_time,
        "real_time_factor": log.simulated_time / log.wall_time if log.wall_time > 0.0 else None,
    }


_DRP_ERROR, _DRP_TURN = 0.05, math.radians(15.0)
"""Maximum distance and angle of the tool from its goal by the rules of DRPBench [m, rad]."""


def drp_outcome(scenario: Scenario, log: MotionLog, contacts: Sequence[str]) -> str:
    """Judges a run by the rules of DRPBench: until the end of its episode, and there.

    Args:
        scenario: what was run.
        log: of the run; it may end before the episode does, at rest.
        contacts: those of the whole run, by true geometry.

    Returns:
        "contact" with an obstacle or the table, "success", or "stopped".
    """
    rows = log.t <= EPISODE
    q = log.q[rows]
    if contacts and robot_metrics(scenario, q, log.q_world[rows]).contacts:
        return "contact"
    (X_WE,) = make_robot_plant(robot_of(scenario)).tool_poses(q[-1:])
    error = math.dist(X_WE.translation(), scenario.task.goal)
    turn = X_WE.rotation().InvertAndCompose(end_rotations(scenario)[1]).ToAngleAxis().angle()
    return "success" if error <= _DRP_ERROR and turn <= _DRP_TURN else "stopped"


def _without_motion(scenario: Scenario) -> dict[str, Any]:
    """Returns the values of a result for a robot that stays at the start."""
    return {
        **dict.fromkeys(_UNKNOWN),
        "contacts": [],
        "self_contacts": [],
        "goal_error": math.dist(scenario.task.start, scenario.task.goal),
        "stop_reason": "",
        "wall_time": 0.0,
        "real_time_factor": None,
    }


@dataclass(frozen=True)
class PandaSuite:
    """Methods and the scenes that they run on.

    Attributes:
        name: of the evaluation.
        kind: of the scenes.
        seed: of the scenes.
        methods: some of `METHODS`.
        perception: one of `scenes.PERCEPTIONS`.
        duration: time limit of a run [s]; None: that of `simulate`.
        stem: beginning of the names of the scenes' files.
        drawings: number of a scene -> call that makes its scenario's text, which depends on the
            positional arguments alone.
        criteria: conditions of success.

    Raises:
        ValueError: for an unknown method.
    """

    name: str
    kind: str
    seed: int
    methods: tuple[str, ...]
    perception: str
    duration: float | None
    stem: str
    drawings: Mapping[int, partial[str]]
    criteria: Criteria = _CRITERIA

    def __post_init__(self) -> None:
        check_choice("method", METHODS, *self.methods)

    def perception_of(self, method: str) -> str:
        """Returns the perception of a method."""
        return "truth" if method in TRUTH_ONLY else self.perception

    def scene_name(self, scene: int) -> str:
        """Returns the name of a scene's files."""
        return f"{self.stem}-scene{scene:04d}"

    def run_name(self, scene: int, method: str) -> str:
        """Returns the name of a run's files."""
        return f"{self.scene_name(scene)}-{method}-{self.perception_of(method)}"


def panda_suite(
    kind: str,
    scenes: int,
    seed: int,
    methods: Sequence[str],
    perception: str = "depth",
    duration: float | None = None,
) -> PandaSuite:
    """Makes a suite of random scenes, of which scene i depends on kind and seed alone.

    Args:
        kind: one of `KINDS`.
        scenes: number of scenes.
        seed: of the scenes.
        methods: some of `METHODS`.
        perception: one of `scenes.PERCEPTIONS`.
        duration: time limit of a run [s]; None: that of `simulate`.

    Raises:
        ValueError: for an unknown kind or method.
    """
    check_choice("kind of scenes", KINDS, kind)
    return PandaSuite(
        "panda",
        kind,
        seed,
        tuple(methods),
        perception,
        duration,
        f"{kind}-seed{seed}",
        {scene: partial(draw_text, seed, scene, kind) for scene in range(scenes)},
        Criteria(by_drp=DRP in kind),
    )


class PandaResults(NamedTuple):
    """Results of a suite.

    Attributes:
        suite: what is evaluated.
        scenarios: scene -> the scenario's text, as it was drawn.
        runs: method -> scene -> result, see `run_and_evaluate`.
        resumed: number of results that were on disk.
    """

    suite: PandaSuite
    scenarios: dict[int, str]
    runs: dict[str, dict[int, dict[str, Any]]]
    resumed: int = 0


def evaluate_panda(
    suite: PandaSuite, *, workers: int | str = 1, folder: Path | None = None
) -> PandaResults:
    """Draws the scenes and runs each method on each.

    A result on disk whose key is that of the scene, the method and the present source is
    taken; all others are made, and written as soon as each is done.

    Args:
        suite: what to evaluate.
        workers: see `carry_out`.
        folder: of the results; None: they are not stored.

    Raises:
        ValueError: if the scheduler cannot be reached.
        RuntimeError: if a scene cannot be drawn.
    """
    drawings = {n: Task(suite.scene_name(n), draw) for n, draw in suite.drawings.items()}
    scenarios, _ = resumed(drawings, folder, workers)
    limits = suite.duration, suite.criteria
    tasks = {
        (method, scene): Task(
            suite.run_name(scene, method),
            partial(run_text, text, method, suite.perception_of(method), *limits),
        )
        for scene, text in scenarios.items()
        for method in suite.methods
    }
    found, known = resumed(tasks, folder, workers)
    runs: dict[str, dict[int, dict[str, Any]]] = {method: {} for method in suite.methods}
    for (method, scene), result in found.items():
        runs[method][scene] = result
    return PandaResults(suite, scenarios, runs, known)


def draw_text(seed: int, scene: int, kind: str) -> str:
    """Draws a scene as a scenario's text."""
    return scenario_text(draw_panda_scene(seed, scene, kind=kind))


def run_text(text: str, *arguments: Any) -> dict[str, Any]:
    """Runs a scenario's text with further arguments of `run_and_evaluate`; returns the result."""
    with quiet():
        return run_and_evaluate(parse_scenario(text), *arguments)
