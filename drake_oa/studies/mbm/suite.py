"""A set of MotionBenchMaker's problems as a suite of `panda_evaluation`, and its figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from drake_oa.studies.mbm.problems import ProblemText
from drake_oa.studies.mbm.scenes import draw_problem
from drake_oa.studies.panda.evaluation import Drawing, PandaResults, PandaSuite
from drake_oa.studies.panda.run import Criteria
from drake_oa.studies.panda.tables import ALL, methods_figures

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
        return draw_problem, (text, self.robot)


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
