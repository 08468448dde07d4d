"""Conversion of MotionBenchMaker's motion planning problems to scenarios, and to suites (scenes and
methods) that `drake_oa.evaluation.panda` evaluates.

The task of a problem is to reach the goal's tool pose among the problem's obstacles. The
demonstration (the motion without avoidance) is a straight minimum-jerk motion of the tool from the
tool pose of the start configuration to that of the goal configuration. The tool rotates about a
fixed axis. The nominal posture, to which the arm's null space is attracted, moves from the start
configuration to the goal configuration. The grasped obstacle, which contains the goal position of
the tool point, is left out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.math import RollPitchYaw

from drake_oa.common.config import check_choice
from drake_oa.evaluation.cameras import obstacle_geometries, with_task_cameras
from drake_oa.evaluation.mbm.problems import (
    PANDA,
    Problem,
    ProblemText,
    load_robot,
    parse_problem,
    read_archive,
)
from drake_oa.evaluation.panda.evaluation import Criteria, PandaResults, PandaSuite
from drake_oa.evaluation.panda.tables import ALL, methods_metrics
from drake_oa.geometry.collision_scene import least_distances
from drake_oa.perception.config import GroundTruth
from drake_oa.robot.config import Robot
from drake_oa.robot.plant import make_robot_plant
from drake_oa.runs.metrics import robot_metrics
from drake_oa.scenario.loading import parse_scenario, scenario_text
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.task import Task

DURATION = 5.0
"""Duration of the demonstrated tool motion from start to goal of a motion planning problem [s]."""
CLEARANCE = 0.03
"""Maximum requested clearance of a motion planning problem [m]. The clearance of the robot at start
or goal is requested instead if it is less."""
MIN_CLEARANCE = 1e-3
"""Minimum requested clearance of a motion planning problem, even if the robot has less at start or
goal [m]."""

_FINGER_MARGIN = 1e-3
"""Minimum distance between the fingers and their joint limits [m]. At a limit, a step of the
simulated plant requires more computing time."""


def draw_problem(text: ProblemText, robot: str, seen: bool) -> str:
    """Converts a motion planning problem to the YAML text of a scenario.

    Args:
        text: MoveIt scene and planning request of the problem, both as YAML text.
        robot: YAML text of a scenario with the problem's robot.
        seen: whether two depth cameras perceive the obstacles; else perception is ground truth.
    """
    scenario = problem_scenario(parse_problem(text), parse_scenario(robot).robot or Robot())
    return scenario_text(with_task_cameras(scenario) if seen else scenario)


def problem_scenario(problem: Problem, robot: Robot) -> Scenario:
    """Converts a motion planning problem to a scenario with ground-truth perception.

    If the goal configuration exceeds the robot's joint limits, the task has no goal configuration,
    but only the tool pose of this configuration.

    Args:
        problem: problem with joint positions for all joints of the arm.
        robot: configuration of the problem's robot.

    Raises:
        ValueError: if the problem lacks the position of a joint of the arm.
    """
    robot_plant, n = make_robot_plant(robot), len(robot.q_seed)
    limits = robot_plant.limits
    lower, upper, names = limits.position_lower, limits.position_upper, limits.position_name
    arm = names[:n]
    for row, name in enumerate(names[n:], start=n):
        if name in problem.start:
            opening = problem.start[name]
            opening = np.clip(opening, lower[row] + _FINGER_MARGIN, upper[row] - _FINGER_MARGIN)
            robot = replace(robot, finger_opening=float(opening))
            break
    q = np.full((2, len(names)), robot.finger_opening)
    for row, positions in enumerate((problem.start, problem.goal)):
        if not positions.keys() >= set(arm):
            raise ValueError(
                f"{problem.name}: joints {', '.join(positions)} are not those of the robot, "
                f"{', '.join(arm)}; name a scenario with the problem's robot by --robot SCENARIO"
            )
        q[row, :n] = [positions[name] for name in arm]
    within = ((q[1] >= lower) & (q[1] <= upper))[:n].all()
    poses = robot_plant.tool_poses(q)
    start, goal = (X_WE.translation().tolist() for X_WE in poses)
    rpy = [RollPitchYaw(X_WE.rotation()).vector().tolist() for X_WE in poses]
    (q_start, q_goal), grasped = q[:, :n].tolist(), np.array([goal])
    scenario = Scenario(
        description=f"MotionBenchMaker {problem.name}",
        robot=robot,
        task=Task(
            start=start,
            goal=goal,
            rpy_start=rpy[0],
            rpy_goal=rpy[1],
            q_start=q_start,
            q_goal=q_goal if within else None,
            duration=DURATION,
        ),
        obstacles=[
            item
            for item in problem.obstacles
            if least_distances(obstacle_geometries([item]), grasped, 0.0, 0.0, 0.0)[0] >= 0.0
        ],
        perception=GroundTruth(),
        table_height=None,
    )
    available = robot_metrics(scenario, q).robot_clearance.min()
    # Rounded down, so that start and goal have the requested clearance.
    clearance = math.floor(1e4 * min(CLEARANCE, float(available))) / 1e4
    scenario.task.clearance = max(clearance, MIN_CLEARANCE)
    return scenario


_CRITERIA = Criteria(
    goal_error=0.01,
    orientation_error=math.radians(15.0),
    beyond_limits=1e-3,
    keeps_request=True,
    planner_states=200_000,
)
"""Conditions of success for runs on motion planning problems, as in published benchmarks on these
problems.

The tool ends within 1 cm and 15 degrees of the goal. Joints may exceed their limits by 1 mrad,
since a joint with its goal at a limit settles around it. The method `planner` (RRT-Connect) plans
with the requested clearance and may check 200,000 configurations: the 40,000 of `drake-oa evaluate
panda` are too few for three of the first six problems of the set `cage`."""


def mbm_suites(
    file: Path,
    robot: str | None,
    sets: Sequence[str],
    methods: Sequence[str],
    scenes: int | None,
    perception: str = "truth",
    duration: float | None = None,
) -> list[PandaSuite]:
    """Makes a suite of scenes and methods for each set of motion planning problems in an archive.

    Each problem is a scene of the suite; the evaluation runs each method in each scene.

    Args:
        file: archive (.tar.bz2) of problems, see `problems.read_archive`.
        robot: "panda", "ur5", or name or file of a scenario with the robot; None: the Panda.
        sets: names of sets; empty: all sets.
        methods: names of methods, from `panda.evaluation.METHODS`.
        scenes: number of problems of each set, from the first one; None: all.
        perception: "truth" (ground truth) or "depth" (two cameras).
        duration: time limit of a run [s]; None: 6 times the duration of the demonstration.

    Raises:
        OSError: if the file cannot be read.
        ValueError: if a set is unknown, has fewer than `scenes` problems, or is of another robot.
    """
    arm, archive = load_robot(robot or PANDA), read_archive(file)
    robot_text, suites = scenario_text(Scenario(robot=arm)), []
    check_choice(f"set of {file}", archive, *sets)
    for name in sets or archive:
        texts = archive[name][:scenes]
        if len(texts) < (scenes or 0):
            raise ValueError(f"--scenes {scenes}: the set {name} has {len(texts)} problems")
        problems = [parse_problem(text) for text in texts]
        # Reject the joints of another robot before any run starts.
        problem_scenario(problems[0], arm)
        seen = perception != "truth"
        drawings = {text.number: partial(draw_problem, text, robot_text, seen) for text in texts}
        stem, of_runs = f"mbm-{name}", (tuple(methods), perception, duration)
        suites.append(PandaSuite("mbm", name, 0, *of_runs, stem, drawings, _CRITERIA))
    return suites


def mbm_metrics(
    results: Sequence[PandaResults], metrics: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Returns the JSON of an evaluation on MotionBenchMaker's motion planning problems.

    Keys: "suite", the suite's name; "sets", name of a set -> its metrics, the result of
    `panda_metrics`; and "all", the metrics of each method over all sets together, the result of
    `methods_metrics`, with "perception", "duration", "jobs" and "versions" of the first set.

    Args:
        results: results of `panda.evaluation.evaluate_panda`, one for the suite of each set.
        metrics: results of `panda_metrics` for the same suites.
    """
    first = results[0].suite
    runs = {
        method: {(of.suite.kind, n): run for of in results for n, run in of.runs[method].items()}
        for method in first.methods
    }
    joint_metrics = methods_metrics(runs)
    for method, entry in joint_metrics["methods"].items():
        entry["perception"] = first.perception_of(method)
    shared = ("perception", "duration", "jobs", "versions")
    return {
        "suite": first.name,
        "sets": {of["kind"]: of for of in metrics},
        ALL: {"kind": ALL, **{name: metrics[0][name] for name in shared}, **joint_metrics},
    }
