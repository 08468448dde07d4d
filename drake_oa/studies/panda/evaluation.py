"""Methods on random scenes of the Panda: simulated and judged in parallel, stored one by one.

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
  planner          a sampling-based planner that knows the obstacles and their courses exactly, to
                   tell which scenes have a solution at all: see `planner`, and where obstacles
                   move `oracle`. It is not simulated

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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from drake_oa.common.console import quiet
from drake_oa.regulation.config import Paper, Verified
from drake_oa.robot.plant import make_robot_plant
from drake_oa.runs.metrics import robot_metrics
from drake_oa.runs.motion_log import MotionLog, save_logs
from drake_oa.runs.report import feasible_clearance_of, layer_costs, motion_report
from drake_oa.runs.simulation import AT_GOAL, MotionInterruptedError, simulate
from drake_oa.scenario.end_poses import end_rotations
from drake_oa.scenario.loading import parse_scenario, scenario_text
from drake_oa.scenario.obstacles import last_change
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.studies.panda.claims import run_violations
from drake_oa.studies.panda.contacts import contact_events
from drake_oa.studies.panda.differential_ik import ARM_DISTANCE, simulate_differential_ik
from drake_oa.studies.panda.drp_scenes import EPISODE
from drake_oa.studies.panda.oracle import run_oracle
from drake_oa.studies.panda.planner import CLEARANCE, STATES, run_planner
from drake_oa.studies.panda.scenes import (
    DRP,
    KINDS,
    check_choice,
    draw_panda_scene,
    seen_by,
)
from drake_oa.studies.panda.true_world import make_true_world
from drake_oa.studies.results import ResultFolder, Task, content_key, resumed

PLANNER = "planner"
"""The method that plans, needs OMPL, and is not simulated."""
DIFFERENTIAL_IK = "differential_ik"
DEFAULT_METHODS = ("preplanned", "paper", "verified", DIFFERENTIAL_IK)
WITHOUT: dict[str, dict[str, Any]] = {
    "without_chain": {"chain": None},
    "without_search": {"rounds": 0},
    "without_joint_path": {"configurations": 0, "last_configurations": 0},
}
"""Methods that are `verified` without one source of motions -> fields of its block."""
METHODS = (*DEFAULT_METHODS, PLANNER, *WITHOUT)
TRUTH_ONLY = frozenset({DIFFERENTIAL_IK, PLANNER})
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
    "sources",
    "goal_error",
    "orientation_error",
    "duration",
    "path_length",
    "torque_saturation",
    "stop_reason",
    "ended",
    "settled",
    "decision_cost",
    "guard_cost",
    "events",
    "beyond_limits",
    "drp_outcome",
    "contact_events",
    "claim_violations",
)
"""Keys of a result: values of `motion_report` and judgements, the last two of scenes with moving
obstacles."""


def default_methods(kind: str) -> tuple[str, ...]:
    """Returns the methods that run where none are named: the planner in all but tabletop."""
    return DEFAULT_METHODS if kind == "tabletop" else (*DEFAULT_METHODS, PLANNER)


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
    """The scenario as a method runs it."""
    scenario = copy.deepcopy(scenario)
    if method == "paper":
        scenario.regulation = Paper()
        scenario.policy.fade = 0.0
    elif method == "verified" and not isinstance(scenario.regulation, Verified):
        scenario.regulation = Verified()
    elif method in WITHOUT:
        verified = with_method(scenario, "verified").regulation
        scenario.regulation = replace(verified, **WITHOUT[method])
    return scenario


def run_and_judge(
    scenario: Scenario,
    method: str,
    perception: str,
    *,
    duration: float | None = None,
    criteria: Criteria = _CRITERIA,
    log_file: Path | None = None,
) -> dict[str, Any]:
    """Runs a method on a scene.

    The result has `outcome` ("success", "contact" or "stopped"), `reason` (of what is no success:
    the stop reason with "#" for numbers), `failed` (whether it raised), and of `motion_report`
    those of `_KEPT`; besides `wall_time` [s] and `real_time_factor` of the simulation, and by the
    criteria `drp_outcome`; and where obstacles move `contact_events`, see there, and
    `claim_violations`: the number of logged instants, and of those that violate each claim of
    `claims`. Of `planner` see `run_planner`.

    Args:
        scenario: the scene.
        method: one of `METHODS`.
        perception: one of `scenes.PERCEPTIONS`.
        duration: time limit of the run [s]; None: that of `simulate`.
        criteria: what is a success.
        log_file: where the log goes, if there is one.
    """
    scenario = with_method(seen_by(scenario, perception), method)
    failed = False
    try:
        if method == PLANNER:
            found = _without_motion(scenario, "") | _plan(scenario, criteria)
            return {**_outcome(found, criteria), "failed": False, **found}
        log = _simulate(scenario, method, duration)
    except MotionInterruptedError as error:
        if isinstance(error.__cause__, KeyboardInterrupt):
            raise KeyboardInterrupt from error
        log, failed = error.log, True
        _logger.info("the run was cut short", exc_info=True)
    except Exception as error:
        # A scene that cannot be run is a result like any other, and ends no other scene.
        _logger.info("the run could not start", exc_info=True)
        reason = f"{type(error).__name__}: {error}".rstrip(": ")
        result = {"outcome": "stopped", "reason": plain_reason(reason), "failed": True}
        return {**result, **_without_motion(scenario, reason)}
    if log_file is not None:
        save_logs(log_file, {"modulated" if log.modulated else "preplanned": log})
    return _judged(scenario, log, failed, criteria)


def _simulate(scenario: Scenario, method: str, duration: float | None) -> MotionLog:
    if method == DIFFERENTIAL_IK:
        # No arm starts where it would have to keep more than it has.
        tool, arm = feasible_clearance_of(scenario), min(ARM_DISTANCE, scenario.task.clearance)
        return simulate_differential_ik(scenario, duration=duration, tool=tool, arm=arm)
    return simulate(scenario, modulated=method != "preplanned", duration=duration)


def _plan(scenario: Scenario, criteria: Criteria) -> dict[str, Any]:
    if _moves(scenario):
        return run_oracle(scenario)
    clearance = scenario.task.clearance if criteria.planner_asked else CLEARANCE
    return run_planner(scenario, clearance=clearance, states=criteria.planner_states)


def _judged(scenario: Scenario, log: MotionLog, failed: bool, criteria: Criteria) -> dict[str, Any]:
    report = motion_report(scenario, log)
    found = {key: report.get(key) for key in _KEPT}
    found["beyond_limits"] = _beyond_limits(scenario, log)
    if criteria.by_drp:
        found["drp_outcome"] = drp_outcome(scenario, log, report["contacts"])
    if len(log.t) and _moves(scenario):
        world = make_true_world(scenario)
        violated = run_violations(scenario, log, world)
        counts = {claim: int(instants.sum()) for claim, instants in violated.items()}
        found["contact_events"] = contact_events(scenario, log, world)
        found["claim_violations"] = {"instants": len(log.t), **counts}
    outcome = _outcome(found, criteria)
    if failed and outcome["outcome"] == "success":
        outcome = {"outcome": "stopped", "reason": plain_reason(found["stop_reason"])}
    return {
        **outcome,
        "failed": failed,
        **found,
        # To a tenth of a millisecond: to be taken together over scenes.
        "decision_costs": np.round(layer_costs(log), 4).tolist(),
        "wall_time": log.wall_time,
        "real_time_factor": log.simulated_time / log.wall_time if log.wall_time > 0.0 else None,
    }


def _moves(scenario: Scenario) -> bool:
    """Checks whether an obstacle ever moves."""
    return last_change(scenario.obstacles) > 0.0


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


def _beyond_limits(scenario: Scenario, log: MotionLog) -> float:
    """Computes how far a joint of the arm went beyond its limit at most [rad]."""
    arm = len(robot_of(scenario).q_seed)
    q, lower, upper = log.q[:, :arm], log.position_lower[:arm], log.position_upper[:arm]
    return float(np.maximum(lower - q, q - upper).max(initial=0.0))


def _outcome(found: Mapping[str, Any], criteria: Criteria) -> dict[str, str]:
    """Returns `outcome` and `reason`."""
    if found["contacts"] or found["self_contacts"]:
        return {"outcome": "contact", "reason": plain_reason(found["stop_reason"])}
    lacks = criteria.lacks(found)
    return {"outcome": "stopped" if lacks else "success", "reason": plain_reason(lacks)}


def _without_motion(scenario: Scenario, reason: str) -> dict[str, Any]:
    """Returns the values of a result for a robot that stays at the start."""
    return {
        **dict.fromkeys(_KEPT),
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


def plain_reason(reason: str | None) -> str:
    """A reason with "#" for its numbers, so that equal reasons can be counted."""
    return _NUMBER.sub("#", reason or "").strip()


SCENE_SUFFIX = ".scenario.yaml"
"""Last part of the names of scenes' files."""


class Drawing(NamedTuple):
    """Function that draws a scene, and its arguments.

    Attributes:
        name: of the scene's files.
        draw: makes a scenario's text.
        arguments: of `draw`, on which alone the scene depends.
    """

    name: str
    draw: Callable[..., str]
    arguments: tuple[Any, ...]


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
        drawings: number of a scene -> how it is made.
        criteria: what runs are judged by.

    Raises:
        ValueError: for no scenes or a negative seed.
    """

    name: str
    kind: str
    seed: int
    methods: tuple[str, ...]
    perception: str
    duration: float | None
    drawings: Mapping[int, Drawing]
    criteria: Criteria = _CRITERIA

    def __post_init__(self) -> None:
        if not self.drawings:
            raise ValueError("--scenes must be at least 1")
        if self.seed < 0:
            raise ValueError(f"--seed must be 0 or more, not {self.seed}")

    def perception_of(self, method: str) -> str:
        """What a method sees by."""
        return "truth" if method in TRUTH_ONLY else self.perception


def check_methods(methods: Sequence[str], known: Sequence[str]) -> tuple[str, ...]:
    """Returns each method once; raises ValueError for one that is not among the known ones."""
    for method in methods:
        check_choice("method", method, known)
    return tuple(dict.fromkeys(methods))


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
        ValueError: as `PandaSuite`, and for an unknown kind or method.
    """
    check_choice("kind of scenes", kind, KINDS)
    drawings = {
        scene: Drawing(f"{kind}-seed{seed}-scene{scene:04d}", draw_text, (seed, scene, kind))
        for scene in range(scenes)
    }
    chosen, criteria = check_methods(methods, METHODS), Criteria(by_drp=DRP in kind)
    return PandaSuite("panda", kind, seed, chosen, perception, duration, drawings, criteria)


@dataclass
class PandaResults:
    """What is known so far.

    Attributes:
        suite: what is evaluated.
        scenarios: scene -> the scenario's text, as it was drawn.
        runs: method -> scene -> result, see `run_and_judge`.
        resumed: results that were on disk.
        interrupted: whether it was ended by an interrupt.
    """

    suite: PandaSuite
    scenarios: dict[int, str] = field(default_factory=dict)
    runs: dict[str, dict[int, dict[str, Any]]] = field(default_factory=dict)
    resumed: int = 0
    interrupted: bool = False

    def complete(self, method: str) -> bool:
        """Whether a method has run on all scenes."""
        return len(self.runs.get(method, {})) == len(self.suite.drawings)


def evaluate_panda(
    suite: PandaSuite,
    *,
    jobs: int = 1,
    scheduler: str | None = None,
    folder: ResultFolder | None = None,
    logs: Path | None = None,
    on_progress: Callable[[str, int], None] = lambda what, count: None,
) -> PandaResults:
    """Draws the scenes and runs each method on each.

    A result on disk whose key is that of the scene, the method and the present source is
    taken; all others are made, and written as soon as each is done. Where a log is requested
    and does not exist, the run is repeated.

    Args:
        suite: what to evaluate.
        jobs: processes at once.
        scheduler: address of a Dask scheduler to send the work to instead.
        folder: of the results; None: they are not stored.
        logs: folder of the log of each run (.npz), which the workers write; None: no logs.
        on_progress: called with what was done and how many of it.

    Returns:
        All results; after an interrupt those that were finished, with `interrupted`.

    Raises:
        ValueError: if the scheduler cannot be reached.
        RuntimeError: if a scene cannot be drawn.
    """
    results = PandaResults(suite, runs={method: {} for method in suite.methods})
    options: dict[str, Any] = {"jobs": jobs, "scheduler": scheduler}
    drawings = {
        scene: Task(name, content_key("scene", draw.__name__, repr(arguments)), (draw, arguments))
        for scene, (name, draw, arguments) in suite.drawings.items()
    }
    try:
        for scene, drawn, _ in resumed(_draw, drawings, folder, **options):
            results.scenarios[scene] = drawn["scenario"]
            on_progress("scenes drawn", 1)
        results.scenarios = dict(sorted(results.scenarios.items()))
        tasks = {
            (scene, method): _run_task(suite, scene, text, method, logs)
            for scene, text in results.scenarios.items()
            for method in suite.methods
        }
        for (scene, method), result, known in resumed(run_text, tasks, folder, **options):
            results.runs[method][scene] = result
            results.resumed += known
            on_progress(method, 1)
    except KeyboardInterrupt:
        results.interrupted = True
    results.runs = {method: dict(sorted(runs.items())) for method, runs in results.runs.items()}
    return results


def run_name(suite: PandaSuite, scene: int, method: str) -> str:
    """Returns the name of a run's files: those of the scene, the method and its perception."""
    return f"{suite.drawings[scene].name}-{method}-{suite.perception_of(method)}"


def _draw(draw: Callable[..., str], arguments: tuple[Any, ...]) -> dict[str, str]:
    return {"scenario": draw(*arguments)}


def _run_task(suite: PandaSuite, scene: int, text: str, method: str, logs: Path | None) -> Task:
    name = run_name(suite, scene, method)
    call = (text, method, suite.perception_of(method), suite.duration, suite.criteria)
    log = None if logs is None or method == PLANNER else logs / f"{name}.npz"
    return Task(name, content_key("run", repr(call)), (*call, log), log)


def draw_text(seed: int, scene: int, kind: str) -> str:
    """Draws a scene as a scenario's text."""
    return scenario_text(draw_panda_scene(seed, scene, kind=kind))


def run_text(
    text: str,
    method: str,
    perception: str,
    duration: float | None,
    criteria: Criteria,
    log: Path | None = None,
) -> dict[str, Any]:
    """Runs a scenario's text and returns the result; the log goes to a file, if one is given."""
    with quiet():
        return run_and_judge(
            parse_scenario(text),
            method,
            perception,
            duration=duration,
            criteria=criteria,
            log_file=log,
        )
