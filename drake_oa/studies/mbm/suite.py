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
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.math import RollPitchYaw

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.shapes import pose
from drake_oa.geometry.solids import least_distances, shape_solids, solids_of
from drake_oa.perception.config import GroundTruth
from drake_oa.robot.config import Robot
from drake_oa.robot.plant import RobotPlant, make_robot_plant
from drake_oa.runs.metrics import robot_metrics
from drake_oa.scenario.loading import parse_scenario, scenario_text
from drake_oa.scenario.obstacles import Obstacle
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.task import Task
from drake_oa.studies.cameras import with_two
from drake_oa.studies.mbm.problems import (
    PANDA,
    Problem,
    ProblemText,
    load_robot,
    parse_problem,
    read_archive,
)
from drake_oa.studies.panda.evaluation import (
    WITHOUT,
    Criteria,
    Drawing,
    PandaResults,
    PandaSuite,
    check_methods,
)
from drake_oa.studies.panda.tables import ALL, methods_figures

DURATION = 5.0
"""Of the demonstrated motion [s]."""
CLEARANCE, LEAST_CLEARANCE = 0.03, 1e-3
"""That is asked for where start and goal leave it, and where they leave none [m]."""

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
    """The scenario of a problem.

    A goal with joints beyond the robot's limits is asked for as a pose, without joints.

    Raises:
        ValueError: if the problem's joints are not those of the robot.
    """
    robot_plant, n = make_robot_plant(robot), len(robot.q_seed)
    limits = robot_plant.limits
    lower, upper = limits.position_lower, limits.position_upper
    arm, fingers = limits.position_name[:n], limits.position_name[n:]
    for row, name in enumerate(fingers, start=n):
        if name in problem.start:
            margin = _FINGER_MARGIN
            opening = np.clip(problem.start[name], lower[row] + margin, upper[row] - margin)
            robot = replace(robot, finger_opening=float(opening))
            break
    q = {
        end: _positions(problem, joints, arm, robot_plant, robot)
        for end, joints in (("start", problem.start), ("goal", problem.goal))
    }
    X_WE = dict(zip(q, robot_plant.tool_poses(np.stack(list(q.values()))), strict=True))
    within = ((q["goal"] >= lower) & (q["goal"] <= upper))[:n].all()
    rpy = {end: RollPitchYaw(X.rotation()).vector().tolist() for end, X in X_WE.items()}
    grasped = X_WE["goal"].translation()
    scenario = Scenario(
        description=f"MotionBenchMaker {problem.name}",
        robot=robot,
        task=Task(
            start=X_WE["start"].translation().tolist(),
            goal=grasped.tolist(),
            rpy_start=rpy["start"],
            rpy_goal=rpy["goal"],
            q_start=q["start"][:n].tolist(),
            q_goal=q["goal"][:n].tolist() if within else None,
            duration=DURATION,
        ),
        obstacles=[item for item in problem.obstacles if not _holds(item, grasped)],
        perception=GroundTruth(),
        table_height=None,
    )
    left = robot_metrics(scenario, np.stack([q["start"], q["goal"]])).robot_clearance.min()
    # Rounded down: the ends themselves keep it.
    asked = math.floor(1e4 * min(CLEARANCE, float(left))) / 1e4
    scenario.task.clearance = max(asked, LEAST_CLEARANCE)
    return scenario


def _positions(
    problem: Problem,
    given: Mapping[str, float],
    arm: Sequence[str],
    robot_plant: RobotPlant,
    robot: Robot,
) -> FloatArray:
    missing = [name for name in arm if name not in given]
    if missing:
        raise ValueError(
            f"{problem.name}: is of the joints {', '.join(given)}, and the robot's are "
            f"{', '.join(arm)}; --robot SCENARIO names a scenario with the problem's robot"
        )
    q = np.full(robot_plant.plant.num_positions(), robot.finger_opening)
    q[: len(arm)] = [given[name] for name in arm]
    return q


def _holds(obstacle: Obstacle, p_WQ: FloatArray) -> bool:
    """Whether a point is inside an obstacle."""
    solids = solids_of(shape_solids(obstacle.shapes, pose(obstacle).GetAsMatrix4()))
    points = np.array([p_WQ], dtype=float)
    return bool(least_distances(solids, points, 0.0, 0.0, 0.0)[0] < 0.0)


METHODS = ("verified", "preplanned", "differential_ik", "planner", *WITHOUT)

_CRITERIA = Criteria(
    goal_error=0.01,
    orientation_error=math.radians(15.0),
    beyond_limits=1e-3,
    planner_asked=True,
    planner_states=200_000,
)
"""As the benchmarks on these problems count; a joint whose goal is its limit settles about it.
Three of the first six problems of `cage` take more than the 40 000 states of the random scenes."""


def mbm_suites(
    file: Path,
    robot: str | None,
    sets: Sequence[str],
    methods: Sequence[str],
    scenes: int | None,
    perception: str = "truth",
    duration: float | None = None,
) -> list[PandaSuite]:
    """One suite for each set of an archive.

    Args:
        file: see `problems.read_archive`.
        robot: see `problems.load_robot`; None: the Panda.
        sets: names of sets; none: all.
        methods: some of `METHODS`.
        scenes: how many of each set; None: all.
        perception: "truth", or "depth": by two cameras.
        duration: time limit of a run [s]; None: that of `simulate`.

    Raises:
        OSError: if the file cannot be read.
        ValueError: naming what is unknown, too many or does not fit.
    """
    chosen_methods = check_methods("mbm", methods, METHODS)
    if scenes is not None and scenes < 1:
        raise ValueError(f"--scenes must be at least 1, not {scenes}")
    arm = load_robot(robot or PANDA)
    robot_text = scenario_text(Scenario(robot=arm))
    known = read_archive(file)
    chosen = {}
    for name in sets or list(known):
        if name not in known:
            raise ValueError(f"unknown set {name!r}; {file} has: {', '.join(known)}")
        if scenes is not None and scenes > len(known[name]):
            raise ValueError(f"--scenes {scenes}: the set {name} has {len(known[name])}")
        chosen[name] = tuple(known[name][:scenes])
        for text in chosen[name]:
            parse_problem(text)
        # Another robot's joints are told before anything is computed.
        problem_scenario(parse_problem(chosen[name][0]), arm)
    return [
        PandaSuite(
            "mbm",
            name,
            0,
            chosen_methods,
            perception,
            duration,
            {
                text.number: Drawing(
                    f"mbm-{name}-scene{text.number:04d}",
                    draw_problem,
                    (text, robot_text, perception != "truth"),
                )
                for text in texts
            },
            _CRITERIA,
        )
        for name, texts in chosen.items()
    ]


def mbm_figures(
    results: Sequence[PandaResults], figures: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """{"suite", "sets": {set: figures}, "all": figures}.

    Args:
        results: of each set.
        figures: of each, see `panda_figures`.
    """
    first = results[0].suite
    together = methods_figures(
        {
            method: {
                (of.suite.kind, scene): run
                for of in results
                for scene, run in of.runs[method].items()
            }
            for method in first.methods
        },
        {method: all(of.complete(method) for of in results) for method in first.methods},
    )
    for method, found in together["methods"].items():
        found["perception"] = first.perception_of(method)
    shared = ("perception", "duration", "jobs", "versions")
    return {
        "suite": first.name,
        "sets": {of["kind"]: of for of in figures},
        ALL: {"kind": ALL, **{name: figures[0][name] for name in shared}, **together},
    }
