"""`drake-oa evaluate mbm`: methods on MotionBenchMaker's problems."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from drake_oa.app import evaluate_panda as panda

# Simulation and diagrams are imported where they are used: `--help` answers at once.
if TYPE_CHECKING:
    from drake_oa.studies.mbm.suite import MbmSuite

SUITE = "mbm"
METHODS = ("verified", "preplanned", "planner")
DEFAULT_METHODS = ("verified", "planner")

EPILOG = f"""\
{SUITE}: MotionBenchMaker's problems (Chamzas et al., RA-L 2022; data BSD-3-Clause, Rice
University), as VAMP's repository (github.com/KavrakiLab/vamp) carries them: --problems FILE.tar.bz2
with folders <set>_<robot> of scene0001.yaml and request0001.yaml. Sets of the Panda: table_pick,
table_under_pick, bookshelf_small, bookshelf_tall, bookshelf_thin, box, cage.
The demonstration is the tool's straight minimum-jerk motion from FK(start) to FK(goal), 5 s, with
the turn between them; the posture leads from the start's joints to the goal's. The obstacles are
known exactly; what the goal grasps (the tool point is inside) is left out. Asked for are 3 cm, or
what the whole robot has at start and goal, and the supervisor stops no farther from obstacles.
Success: the simulated arm ends within 1 cm and 15 degrees of the goal, no contact with the scene
or itself, and no joint is more than 1 mrad beyond its limit. Its methods:
  verified, preplanned as of panda
  planner              RRT-Connect from the start's joints to the goal's, the whole robot at the
                       asked clearance from the same shapes, 200 000 states at most; not simulated
By default verified and planner. --json has a block for each set, and `all`.
"""

_ONLY = {"problems": "--problems", "robot": "--robot", "sets": "--sets"}
_NOT_HERE = {
    "kinds": "--suite",
    "perception": "--perception",
    "scenes_file": "--scenes-file",
    "plot": "--plot",
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Adds the options of the suite `mbm` to `drake-oa evaluate`."""
    group = parser.add_argument_group(f"only with {SUITE}")
    group.add_argument("--problems", type=Path, metavar="F.tar.bz2", help="the problems")
    group.add_argument(
        "--robot",
        metavar="R",
        help="panda (default), or a scenario whose robot block is of the problems' robot",
    )
    group.add_argument(
        "--sets",
        action="append",
        metavar="S",
        help="of the problems (default: all); may be repeated, or name several with commas",
    )


def refuse_options(options: argparse.Namespace) -> None:
    """For the other suites: raises ValueError for an option that only mbm takes."""
    for name, flag in _ONLY.items():
        if getattr(options, name) is not None:
            raise ValueError(f"{flag} goes with the suite {SUITE}, not with {options.suite}")


def run(options: argparse.Namespace) -> int:
    """Runs the suite; returns the exit status.

    Raises:
        ValueError: for bad input.
        OSError: for a file that cannot be read or written.
    """
    for name, flag in _NOT_HERE.items():
        if getattr(options, name) is not None:
            raise ValueError(f"{SUITE} takes no {flag}")
    if options.seed:
        raise ValueError(f"{SUITE} takes no --seed: nothing is drawn")
    if options.problems is None:
        raise ValueError(f"{SUITE} needs --problems FILE.tar.bz2, see drake-oa evaluate --help")
    from drake_oa.studies.mbm.suite import mbm_figures

    return panda.run_suites(options, _suites, mbm_figures)


def _suites(options: argparse.Namespace) -> list[MbmSuite]:
    """One for each set that is asked for."""
    from drake_oa.studies.mbm.problems import parse_problem, read_archive
    from drake_oa.studies.mbm.scenes import PANDA, load_robot, problem_scenario, robot_text
    from drake_oa.studies.mbm.suite import MbmSuite

    methods = tuple(dict.fromkeys(options.methods or DEFAULT_METHODS))
    for method in methods:
        if method not in METHODS:
            raise ValueError(f"unknown method {method!r}; {SUITE} has: {', '.join(METHODS)}")
    if options.scenes is not None and options.scenes < 1:
        raise ValueError(f"--scenes must be at least 1, not {options.scenes}")
    robot = load_robot(options.robot or PANDA)
    known = read_archive(options.problems)
    named = ",".join(options.sets or known).split(",")
    chosen = {}
    for name in dict.fromkeys(name.strip() for name in named):
        if name not in known:
            raise ValueError(f"unknown set {name!r}; {options.problems} has: {', '.join(known)}")
        if options.scenes is not None and options.scenes > len(known[name]):
            raise ValueError(f"--scenes {options.scenes}: the set {name} has {len(known[name])}")
        chosen[name] = tuple(known[name][: options.scenes])
        for text in chosen[name]:
            parse_problem(text)
        # Another robot's joints are told before anything is computed.
        problem_scenario(parse_problem(chosen[name][0]), robot)
    return [
        MbmSuite(
            scenes=len(texts),
            seed=0,
            methods=methods,
            perception="truth",
            kind=name,
            duration=options.duration,
            problems=texts,
            robot=robot_text(robot),
        )
        for name, texts in chosen.items()
    ]
