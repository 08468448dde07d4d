"""A set of MotionBenchMaker's problems as a suite of `panda_evaluation`, and its figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from drake_oa.studies.mbm.problems import ProblemText, parse_problem, read_archive
from drake_oa.studies.mbm.robots import PANDA, load_robot
from drake_oa.studies.mbm.scenes import (
    draw_problem,
    draw_seen_problem,
    problem_scenario,
    robot_text,
)
from drake_oa.studies.panda.evaluation import Drawing, PandaResults, PandaSuite
from drake_oa.studies.panda.run import Criteria
from drake_oa.studies.panda.tables import ALL, methods_figures

METHODS = ("verified", "preplanned", "differential_ik", "planner")

_CRITERIA = Criteria(
    goal_error=0.01,
    orientation_error=math.radians(15.0),
    beyond_limits=1e-3,
    planner_asked=True,
    planner_states=200_000,
)
"""As the benchmarks on these problems count; a joint whose goal is its limit settles about it.
Three of the first six problems of `cage` take more than the 40 000 states of the random scenes."""


@dataclass(frozen=True)
class MbmSuite(PandaSuite):
    """One set of problems.

    Attributes:
        kind: the set's name.
        problems: as many as `scenes`.
        robot: text of a scenario with the robot.
    """

    name: ClassVar[str] = "mbm"
    problems: tuple[ProblemText, ...] = ()
    robot: str = ""

    def _check_kind(self) -> None:
        """The sets are those of the archive."""

    @property
    def numbers(self) -> Sequence[int]:
        """Of the problems in their set."""
        return [problem.number for problem in self.problems]

    @property
    def criteria(self) -> Criteria:
        """What runs are judged by."""
        return _CRITERIA

    def scene_name(self, scene: int) -> str:
        """Name of a problem's files."""
        return f"mbm-{self.kind}-scene{scene:04d}"

    def drawing(self, scene: int) -> tuple[Drawing, tuple[Any, ...]]:
        """What makes a problem's scenario, and its arguments."""
        (text,) = (problem for problem in self.problems if problem.number == scene)
        draw = draw_problem if self.perception == "truth" else draw_seen_problem
        return draw, (text, self.robot)


def mbm_suites(
    file: Path,
    robot: str | None,
    sets: Sequence[str],
    methods: Sequence[str],
    scenes: int | None,
    perception: str = "truth",
    duration: float | None = None,
) -> list[MbmSuite]:
    """One suite for each set of an archive.

    Args:
        file: see `problems.read_archive`.
        robot: see `robots.load_robot`; None: the Panda.
        sets: names of sets; none: all.
        methods: some of `METHODS`.
        scenes: how many of each set; None: all.
        perception: "truth", or "depth": by two cameras.
        duration: time limit of a run [s]; None: that of `simulate`.

    Raises:
        OSError: if the file cannot be read.
        ValueError: naming what is unknown, too many or does not fit.
    """
    for method in methods:
        if method not in METHODS:
            raise ValueError(f"unknown method {method!r}; mbm has: {', '.join(METHODS)}")
    if scenes is not None and scenes < 1:
        raise ValueError(f"--scenes must be at least 1, not {scenes}")
    arm = load_robot(robot or PANDA)
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
        MbmSuite(
            scenes=len(texts),
            seed=0,
            methods=tuple(dict.fromkeys(methods)),
            perception=perception,
            kind=name,
            duration=duration,
            problems=texts,
            robot=robot_text(arm),
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
