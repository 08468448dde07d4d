"""Evaluation of methods on random scenes of the Panda, in parallel and with stored results.

Methods:

  nominal          the nominal motion, which ignores obstacles
  paper            the method of Pairet et al., RA-L 2019, without motion guard (the system that
                   slows, brakes or evades during the motion). A regressor chain of three networks
                   computes coupling parameters from the obstacle's section with the P-plane (plane
                   of motion and obstacle). Cost rings (costs of the directions of passing) select
                   the side. The chain is `paper_chain_running`, trained for this system's movement
                   primitive; the strength alpha of the coupling term that it computes has the unit
                   1/T, with the demonstrated duration T
  verified         this project's method: whole-arm motions, verified by simulation among the
                   obstacles' collision geometry; if none is collision-free, a planned path that
                   the movement primitives imitate
  differential_ik  Drake's differential inverse kinematics with collision constraints along the
                   nominal motion; it knows the obstacles exactly. Its tool keeps the achievable
                   clearance: the requested one, or that at start or goal if less
  planner          a sampling-based planner that knows the obstacles and their trajectories
                   exactly and shows which scenes have a solution, see `planner`; not simulated
  without_...      ablations of `verified`, each without one source of candidate motions:
                   without_chain (regressor chain), without_search (search among roll-outs),
                   without_joint_path (paths of a joint-space planner)

SceneGraph checks contacts of links, hand and fingers with obstacles, table and each other at every
logged instant (4 ms apart), until everything has been at rest for a second.

Outcome of a run:

  success   no contact, the tool point ends within 5 mm of the goal, and everything comes to rest
  contact   a contact with the scene or of the robot with itself
  stopped   any other end; the reason in words is why the motion terminated, the condition of
            success that failed, or the exception that the run raised, with "#" for numbers

Runs in scenes of the benchmark DRPBench are also evaluated by its rules (`drp_outcome`): no contact
for 16.7 s, and the tool then within 5 cm and 15 degrees of the goal.
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
from drake_oa.common.console import is_interrupt, quiet
from drake_oa.evaluation.panda.claims import run_violations
from drake_oa.evaluation.panda.contacts import contact_events
from drake_oa.evaluation.panda.differential_ik import simulate_differential_ik
from drake_oa.evaluation.panda.drp_scenes import EPISODE
from drake_oa.evaluation.panda.planner import CLEARANCE, STATES, run_planner
from drake_oa.evaluation.panda.scenes import DRP, KINDS, draw_panda_scene, with_perception
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
"""Name of the baseline method that plans a joint path by OMPL or by a search among moving
obstacles; its plans are not simulated."""
DIFFERENTIAL_IK = "differential_ik"
"""Name of the baseline method that runs Drake's differential inverse kinematics with collision
constraints."""
ABLATIONS: dict[str, dict[str, Any]] = {
    "without_chain": {"chain": None},
    "without_search": {"generations": 0},
    "without_joint_path": {"configurations": 0, "last_configurations": 0},
}
"""Name of a variant of the method `verified` without one source of candidate motions (regressor
chain, search among roll-outs, or joint-space planner) -> changed fields of the scenario's block
`inference`."""
METHODS = ("nominal", "paper", "verified", DIFFERENTIAL_IK, PLANNER, *ABLATIONS)
"""Names of all methods that can be evaluated on a scene of the Panda, variants of `verified`
included."""
TRUTH_ONLY = frozenset({DIFFERENTIAL_IK, PLANNER})
"""Names of the methods that always know the obstacles exactly, even if cameras perceive a scene for
other methods."""

_UNKNOWN_KEYS = (
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
"""Keys that have the value None in the result of a run that did not start. Of these keys, the
method `planner` computes at most "tool_clearance_min", "robot_clearance_min", "duration" and
"ended"; the others remain None. "contact_events" and "claim_violations" are also None in scenes
where no obstacle moves or appears."""

_NUMBER = re.compile(r"[-+]?\b\d+(?:\.\d+)?(?:e[-+]?\d+)?\b")
"""Regular expression of numbers in the reason for which a motion stopped; they are replaced by "#"
to count equal reasons."""

_logger = logging.getLogger("drake_oa")


@dataclass(frozen=True)
class Criteria:
    """Conditions of success for a run without a contact, and settings of the planner and of
    DRPBench's rules.

    Attributes:
        goal_error: maximum distance of the tool from the goal [m].
        orientation_error: maximum angle of the tool from the goal's orientation [rad].
        beyond_limits: maximum excess of a joint over its position limit during the run [rad].
        keeps_request: whether the minimum clearance of the method `planner` is the requested
            clearance; else it is 2.5 cm (`planner.CLEARANCE`).
        planner_states: maximum number of states that the planner checks among resting obstacles.
        has_drp_rules: whether runs are also evaluated by the rules of the benchmark DRPBench, see
            `drp_outcome`.
    """

    goal_error: float = AT_GOAL
    orientation_error: float = math.inf
    beyond_limits: float = math.inf
    keeps_request: bool = False
    planner_states: int = STATES
    has_drp_rules: bool = False

    def failure_reason(self, result: Mapping[str, Any]) -> str:
        """Returns the reason why a run without a contact is not a success; "" if it is one.

        Args:
            result: result of the run, see `run_and_evaluate`.
        """
        # Written such that NaN is not a success.
        if not result["goal_error"] <= self.goal_error:
            return result["stop_reason"] or "ended away from the goal"
        if not (result["orientation_error"] or 0.0) <= self.orientation_error:
            return f"{math.degrees(result['orientation_error']):.1f} degrees from the goal"
        if not (result["beyond_limits"] or 0.0) <= self.beyond_limits:
            return f"a joint exceeded its limit by {result['beyond_limits']:.4f} rad"
        # `settled` is None for a plan, since plans are not simulated.
        return "did not come to rest" if result["settled"] is False else ""


_CRITERIA = Criteria()
"""Default conditions of success, which apply to runs in random scenes."""


def with_method(scenario: Scenario, method: str) -> Scenario:
    """Returns a copy of a scenario with the inference and policy settings of a method.

    Only the methods `paper`, `verified` and the ablations of `verified`, which lack one source of
    candidate motions, change settings.

    Args:
        scenario: scenario of a scene.
        method: name of the method, from `METHODS`.
    """
    scenario = copy.deepcopy(scenario)
    if method == "paper":
        scenario.inference = Paper()
        scenario.policy.fade = 0.0
    elif method == "verified" and not isinstance(scenario.inference, Verified):
        scenario.inference = Verified()
    elif method in ABLATIONS:
        verified = with_method(scenario, "verified").inference
        scenario.inference = replace(verified, **ABLATIONS[method])
    return scenario


def run_and_evaluate(
    scenario: Scenario,
    method: str,
    perception: str,
    duration: float | None = None,
    criteria: Criteria = _CRITERIA,
) -> dict[str, Any]:
    """Runs a method on a scene and evaluates contacts, clearances, goal error and outcome on ground
    truth.

    Args:
        scenario: scenario of the scene; "depth2" and "truth" replace its perception.
        method: one of `METHODS`.
        perception: source of the obstacles: "depth" (camera of the scene), "depth2" (two cameras
            beside the robot) or "truth" (exact obstacles).
        duration: time limit of the run [s]; None: six times the demonstrated duration after the
            last move of the goal, as in `simulate`.
        criteria: conditions of success.

    Returns:
        A dictionary with the keys of `motion_report` (for the method `planner`: of `run_planner`)
        and the following ones. If no motion was simulated, unknown values are None or missing.

        - outcome: "success", "contact" or "stopped" (any other end).
        - reason: the reason in words why the run is not a success, with "#" for numbers.
        - failed: whether the run raised an exception.
        - beyond_limits: maximum excess of a joint over its position limit [rad].
        - decision_latencies: simulated compute latency of each selection of a motion [s].
        - wall_time, real_time_factor: wall time of the simulation [s], and simulated time over it.
        - drp_outcome: outcome by the rules of the benchmark DRPBench; None if
          `criteria.has_drp_rules` is false.
        - contact_events: contacts, with closing speed, energy and avoidability, see
          `contacts.contact_events`; None if no obstacle moves or appears.
        - claim_violations: three numbers: "instants", the number of logged instants; "A" and "B",
          how many of them violate claim A (the arm rests or recedes before a moving obstacle can
          reach it) and claim B (the arm is slow toward unobserved space) of passive motion safety.
          None if no obstacle moves or appears, or without observations.
    """
    scenario = with_method(with_perception(scenario, perception), method)
    has_failed, log, result = False, None, _without_motion(scenario)
    try:
        if method == PLANNER:
            clearance = scenario.task.clearance if criteria.keeps_request else CLEARANCE
            result |= run_planner(scenario, clearance=clearance, states=criteria.planner_states)
        else:
            log = _simulate(scenario, method, duration)
    except MotionInterruptedError as error:
        if is_interrupt(error):
            raise KeyboardInterrupt from error
        log, has_failed = error.log, True
        _logger.info("the run was interrupted by an exception", exc_info=True)
    except Exception as error:
        # A scene that cannot be run is stored as a result, so that the other scenes are run.
        _logger.info("the run did not start", exc_info=True)
        has_failed, result["stop_reason"] = True, f"{type(error).__name__}: {error}".rstrip(": ")
    if log is not None:
        result = _evaluate_run(scenario, log, criteria)
    outcome, reason = "success", criteria.failure_reason(result)
    if result["contacts"] or result["self_contacts"]:
        outcome, reason = "contact", result["stop_reason"]
    elif reason or has_failed:
        outcome, reason = "stopped", reason or result["stop_reason"]
    # Replace numbers, so that equal reasons can be counted.
    reason = _NUMBER.sub("#", reason or "").strip()
    return {"outcome": outcome, "reason": reason, "failed": has_failed, **result}


def _simulate(scenario: Scenario, method: str, duration: float | None) -> MotionLog:
    """Simulates a scenario with a method other than `planner` and returns the log.

    Args:
        scenario: scenario that is configured for the method.
        method: name of the method.
        duration: time limit of the run [s]; None: six times the demonstrated duration after the
            last move of the goal, as in `simulate`.
    """
    if method == DIFFERENTIAL_IK:
        return simulate_differential_ik(scenario, duration)
    return simulate(scenario, avoid_obstacles=method != "nominal", duration=duration)


def _evaluate_run(scenario: Scenario, log: MotionLog, criteria: Criteria) -> dict[str, Any]:
    """Evaluates contacts, clearances, goal error and safety claims of a logged run on ground truth.

    Args:
        scenario: scenario of the run.
        log: log of the run.
        criteria: conditions of success; only whether DRPBench's rules apply is used here.

    Returns:
        The result described in `run_and_evaluate`, without outcome, reason and `failed`.
    """
    result = _without_motion(scenario) | motion_report(scenario, log)
    arm = len(robot_of(scenario).q_seed)
    q, lower, upper = log.q[:, :arm], log.position_lower[:arm], log.position_upper[:arm]
    result["beyond_limits"] = float(np.maximum(lower - q, q - upper).max(initial=0.0))
    if criteria.has_drp_rules:
        result["drp_outcome"] = drp_outcome(scenario, log, result["contacts"])
    if len(log.t) and last_change(scenario.obstacles) > 0.0:
        world = make_true_world(scenario)
        result["contact_events"] = contact_events(scenario, log, world)
        if len(log.observation_stamp):
            violated = run_violations(scenario, log, world)
            counts = {claim: int(instants.sum()) for claim, instants in violated.items()}
            result["claim_violations"] = {"instants": len(log.t), **counts}
    return result | {
        # Rounded to 0.1 ms; statistics over all scenes are computed from these values.
        "decision_latencies": np.round(layer_latencies(log), 4).tolist(),
        "wall_time": log.wall_time,
        "real_time_factor": log.simulated_time / log.wall_time if log.wall_time > 0.0 else None,
    }


_MAX_DRP_ERROR = 0.05
"""Maximum distance of the tool from the goal for a success by the rules of DRPBench [m]."""
_MAX_DRP_TURN = math.radians(15.0)
"""Maximum angle of the tool from the goal's orientation for a success by the rules of DRPBench
[rad]."""


def drp_outcome(scenario: Scenario, log: MotionLog, contacts: Sequence[str]) -> str:
    """Evaluates a run by the rules of the benchmark DRPBench: contacts until the end of the
    episode, and the tool pose there.

    Args:
        scenario: scenario of the run.
        log: log of the run; it may end before the episode if the robot is at rest.
        contacts: names "link - object" of the contacts of the whole run, by true geometry.

    Returns:
        "contact" for a contact with an obstacle or the table within the episode of 16.7 s;
        "success" if the tool is then within 5 cm and 15 degrees of the goal; else "stopped".
    """
    rows = log.t <= EPISODE
    q = log.q[rows]
    if not len(q):
        return "stopped"
    if contacts and robot_metrics(scenario, q, log.q_world[rows]).contacts:
        return "contact"
    (X_WE,) = make_robot_plant(robot_of(scenario)).tool_poses(q[-1:])
    error = math.dist(X_WE.translation(), scenario.task.goal)
    turn = X_WE.rotation().InvertAndCompose(end_rotations(scenario)[1]).ToAngleAxis().angle()
    return "success" if error <= _MAX_DRP_ERROR and turn <= _MAX_DRP_TURN else "stopped"


def _without_motion(scenario: Scenario) -> dict[str, Any]:
    """Returns the result of a run before it starts: the robot is at the start, without contact. A
    run replaces those values that it computes.
    """
    return {
        **dict.fromkeys(_UNKNOWN_KEYS),
        "contacts": [],
        "self_contacts": [],
        "requested_clearance": scenario.task.clearance,
        "goal_error": math.dist(scenario.task.start, scenario.task.goal),
        "stop_reason": "",
        "wall_time": 0.0,
        "real_time_factor": None,
    }


@dataclass(frozen=True)
class PandaSuite:
    """Set of scenes, and of the methods that are evaluated on them.

    Attributes:
        name: name of the evaluation, for example "panda".
        kind: kind of the scenes, for example "tabletop".
        seed: seed of the scenes.
        methods: names of methods, from `METHODS`.
        perception: source of the obstacles: "depth" (camera of the scene), "depth2" (two cameras
            beside the robot) or "truth" (exact obstacles).
        duration: time limit of a run [s]; None: six times the demonstrated duration after the last
            move of the goal.
        stem: prefix of the names of result files.
        drawings: number of a scene -> `functools.partial` that, called without arguments, returns
            the YAML text of the scenario; the positional arguments of the partial alone determine
            the text.
        criteria: conditions of success.

    Raises:
        ValueError: if a method is unknown.
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
        """Returns the perception with which a method is run: "truth" for methods that know the
        obstacles exactly (differential_ik, planner), else that of the suite.
        """
        return "truth" if method in TRUTH_ONLY else self.perception

    def scene_name(self, scene: int) -> str:
        """Returns the name, without suffix, of the file that stores a drawn scene.

        Args:
            scene: number of the scene.
        """
        return f"{self.stem}-scene{scene:04d}"

    def run_name(self, scene: int, method: str) -> str:
        """Returns the name, without suffix, of the file that stores the result of a method in a
        scene.

        Args:
            scene: number of the scene.
            method: name of the method.
        """
        return f"{self.scene_name(scene)}-{method}-{self.perception_of(method)}"


def panda_suite(
    kind: str,
    scenes: int,
    seed: int,
    methods: Sequence[str],
    perception: str = "depth",
    duration: float | None = None,
) -> PandaSuite:
    """Makes a suite of random scenes on which methods are evaluated.

    Scene i depends only on kind, seed and i, so that a larger suite contains a smaller one.

    Args:
        kind: kind of scenes, from `scenes.KINDS`, for example "tabletop".
        scenes: number of scenes.
        seed: seed of the scenes.
        methods: names of methods, from `METHODS`.
        perception: source of the obstacles: "depth" (camera of the scene), "depth2" (two cameras
            beside the robot) or "truth" (exact obstacles).
        duration: time limit of a run [s]; None: six times the demonstrated duration after the last
            move of the goal.

    Raises:
        ValueError: if the kind or a method is unknown.
    """
    check_choice("kind of scenes", KINDS, kind)
    drawings = {scene: partial(draw_text, seed, scene, kind) for scene in range(scenes)}
    of_runs, criteria = (tuple(methods), perception, duration), Criteria(has_drp_rules=DRP in kind)
    return PandaSuite("panda", kind, seed, *of_runs, f"{kind}-seed{seed}", drawings, criteria)


class PandaResults(NamedTuple):
    """Results of all methods in all scenes of a suite.

    Attributes:
        suite: the evaluated suite.
        scenarios: number of a scene -> YAML text of the drawn scenario.
        runs: method -> number of a scene -> result of `run_and_evaluate`.
        resumed: number of results that were read from disk.
    """

    suite: PandaSuite
    scenarios: dict[int, str]
    runs: dict[str, dict[int, dict[str, Any]]]
    resumed: int = 0


def evaluate_panda(
    suite: PandaSuite, *, workers: int | str = 1, folder: Path | None = None
) -> PandaResults:
    """Draws the scenes of a suite and runs each method on each scene.

    A stored result is reused if scene, method and package source are the same. Every other run is
    carried out, and its result is stored on completion.

    Args:
        suite: suite to evaluate.
        workers: number of worker processes, or address of a Dask scheduler.
        folder: folder of the results; None: results are not stored.

    Raises:
        ValueError: if the scheduler cannot be reached.
        RuntimeError: if the conditions of a scene hold for none of 5000 random motions.
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
    results, stored_count = resumed(tasks, folder, workers)
    runs = {of: {scene: results[of, scene] for scene in scenarios} for of in suite.methods}
    return PandaResults(suite, scenarios, runs, stored_count)


def draw_text(seed: int, scene: int, kind: str) -> str:
    """Draws a random scene with one depth camera and returns the YAML text of its scenario.

    Args:
        seed: seed of the evaluation.
        scene: number of the scene.
        kind: kind of scenes, from `scenes.KINDS`, for example "tabletop".
    """
    return scenario_text(draw_panda_scene(seed, scene, kind=kind))


def run_text(text: str, *arguments: Any) -> dict[str, Any]:
    """Parses the text of a scenario, runs a method on it, and returns the result, without log
    output.

    Args:
        text: YAML text of the scenario.
        arguments: arguments of `run_and_evaluate` after the scenario: method, perception, duration
            and criteria.
    """
    with quiet():
        return run_and_evaluate(parse_scenario(text), *arguments)
