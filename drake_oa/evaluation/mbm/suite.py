"""Problems of MotionBenchMaker as scenarios, and sets of them as suites of the Panda's evaluation.

A problem: reach the goal's tool pose among its obstacles. The demonstration is the tool's straight
minimum-jerk motion from where the start has it to where the goal has it, with the turn between them
about a fixed axis; the posture leads from the start's joints to the goal's. Nothing else is taken
from the problem. What the goal grasps, an obstacle with the tool point inside it, is left out.
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
from drake_oa.evaluation.cameras import obstacle_geometries, with_two
from drake_oa.evaluation.mbm.problems import (
    PANDA,
    Problem,
    ProblemText,
    load_robot,
    parse_problem,
    read_archive,
)
from drake_oa.evaluation.panda.evaluation import (
    Criteria,
    PandaResults,
    PandaSuite,
)
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
"""Duration of the demonstrated motion [s]."""
CLEARANCE, LEAST_CLEARANCE = 0.03, 1e-3
"""Requested clearance where start and goal leave it, and where they leave none [m]."""

_FINGER_MARGIN = 1e-3
"""Fingers stay so far within their limits [m]: at a limit the plant's steps cost more."""


def draw_problem(text: ProblemText, robot: str, seen: bool) -> str:
    """Makes the scenario's text of a problem.

    Args:
        text: the problem.
        robot: a scenario's text with the robot.
        seen: whether by two cameras; else everything is known.
    """
    scenario = problem_scenario(parse_problem(text), parse_scenario(robot).robot or Robot())
    return scenario_text(with_two(scenario) if seen else scenario)


def problem_scenario(problem: Problem, robot: Robot) -> Scenario:
    """Makes the scenario of a problem.

    A goal with joints beyond the robot's limits is asked for as a pose, without joints.

    Raises:
        ValueError: if the problem's joints are not those of the robot.
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
    for row, given in enumerate((problem.start, problem.goal)):
        if not given.keys() >= set(arm):
            raise ValueError(
                f"{problem.name}: is of the joints {', '.join(given)}, and the robot's are "
                f"{', '.join(arm)}; --robot SCENARIO names a scenario with the problem's robot"
            )
        q[row, :n] = [given[name] for name in arm]
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
    left = robot_metrics(scenario, q).robot_clearance.min()
    # Rounded down: the ends themselves keep it.
    requested = math.floor(1e4 * min(CLEARANCE, float(left))) / 1e4
    scenario.task.clearance = max(requested, LEAST_CLEARANCE)
    return scenario


_CRITERIA = Criteria(
    goal_error=0.01,
    orientation_error=math.radians(15.0),
    beyond_limits=1e-3,
    planner_asked=True,
    planner_states=200_000,
)
"""Conditions of success as in the benchmarks on these problems; a joint whose goal is its limit
settles about it. Three of the first six problems of `cage` take more than the 40 000 states of the
random scenes."""


def mbm_suites(
    file: Path,
    robot: str | None,
    sets: Sequence[str],
    methods: Sequence[str],
    scenes: int | None,
    perception: str = "truth",
    duration: float | None = None,
) -> list[PandaSuite]:
    """Makes a suite for each set of an archive.

    Args:
        file: see `problems.read_archive`.
        robot: see `problems.load_robot`; None: the Panda.
        sets: names of sets; none: all.
        methods: some of `evaluation.METHODS`.
        scenes: how many of each set; None: all.
        perception: "truth", or "depth": by two cameras.
        duration: time limit of a run [s]; None: that of `simulate`.

    Raises:
        OSError: if the file cannot be read.
        ValueError: naming what is unknown, too many or does not fit.
    """
    arm, known = load_robot(robot or PANDA), read_archive(file)
    robot_text, suites = scenario_text(Scenario(robot=arm)), []
    check_choice(f"set of {file}", known, *sets)
    for name in sets or known:
        texts = known[name][:scenes]
        if len(texts) < (scenes or 0):
            raise ValueError(f"--scenes {scenes}: the set {name} has {len(texts)}")
        problems = [parse_problem(text) for text in texts]
        # Another robot's joints are told before anything is computed.
        problem_scenario(problems[0], arm)
        seen = perception != "truth"
        drawings = {text.number: partial(draw_problem, text, robot_text, seen) for text in texts}
        stem, of_runs = f"mbm-{name}", (tuple(methods), perception, duration)
        suites.append(PandaSuite("mbm", name, 0, *of_runs, stem, drawings, _CRITERIA))
    return suites


def mbm_metrics(
    results: Sequence[PandaResults], metrics: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Returns {"suite", "sets": {set: figures}, "all": figures}.

    Args:
        results: of each set.
        metrics: of each, see `panda_metrics`.
    """
    first = results[0].suite
    together = methods_metrics(
        {
            method: {
                (of.suite.kind, scene): run
                for of in results
                for scene, run in of.runs[method].items()
            }
            for method in first.methods
        }
    )
    for method, found in together["methods"].items():
        found["perception"] = first.perception_of(method)
    shared = ("perception", "duration", "jobs", "versions")
    return {
        "suite": first.name,
        "sets": {of["kind"]: of for of in metrics},
        ALL: {"kind": ALL, **{name: metrics[0][name] for name in shared}, **together},
    }
