"""`drake-oa evaluate panda`: methods on random scenes of the whole robot."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drake_oa.common.console import FAILED, INTERRUPTED, complain
from drake_oa.common.files import check_outputs, replace_text
from drake_oa.studies.scenes.progress import progress_bar

# Simulation and diagrams are imported where they are used: `--help` answers at once.
if TYPE_CHECKING:
    from drake_oa.studies.panda.evaluation import Keeping, PandaResults, PandaSuite

SUITE = "panda"
DEFAULT_SCENES = 100
RESULTS = Path("drake_oa_runs") / "evaluate-panda"
"""Where results go that nobody named, relative to the current folder."""

EPILOG = """\
panda: random scenes of kinds (--suite) in which the planned motion of 0.5 to 1.0 m would touch
something:
  tabletop             1 to 6 things on the table: boxes, cylinders, spheres, piles (default)
  moving               1 or 2 things cross the way at 0.1 to 0.4 m/s, up to 2 more stand there
  elbow                the hand's way is free by 5 cm and the elbow's is not: posts, boards
                       in the air, boxes on stands
  clutter6             six things on the table, three or more within 25 cm of the way
  moving_hard          2 to 4 things of 5 to 30 cm at 0.1 to 0.8 m/s enter from outside the image,
                       change speed, turn, stop, come back; up to 2 more stand there; not every
                       scene has a solution
Its methods (all by default; of tabletop all but planner):
  preplanned           the planned motion, blind to obstacles
  paper                the paper's regulation, which nothing checks, without a supervisor
  verified             proposals checked by roll-outs
  differential_ik      Drake's differential inverse kinematics with collision constraints, on
                       the same planned motion; it knows the obstacles exactly, and its tool
                       keeps the asked clearance as far as start and goal have it
  differential_ik_near the same, asked for 3 cm
  planner              a sampling-based planner that knows the obstacles exactly: RRT-Connect of
                       the package ompl (pip install 'drake_oa[peers]'), the whole robot 25 mm
                       from everything; it is not simulated, and success means solved
Its table:
  contacts             scenes in which a link, the hand or a finger touched an obstacle, the
                       table or another of the robot's, by SceneGraph, until all was at rest
  success              no contact, and the tool ends within 5 mm of the goal
  of solved            success in the scenes that planner solves, where it is among the methods
  stopped              the others: ended short of the goal without a contact, and why
  time limit           scenes that ended by it, arrived or not
  self                 scenes in which the robot touched itself
  short                scenes in which the tool came more than 1 mm nearer to what stands at rest
                       than start and goal leave of the asked clearance, and by how much at most
  clearance            least over all scenes, of hand and fingers (tool) and of any link
  duration             of the motion, median and longest scene
  goal error           largest of the scenes that were not stopped
  decision             what the regulation's decisions cost in simulated time: 99 % of them,
                       the longest, and the share that took longer than a frame
  real-time factor     simulated over real time, median and least scene
Below it: why runs were stopped, what was touched, and of what was looked at when the scenes
were drawn, what share was dropped for which reason.
Every scene is on disk as soon as it is done (--results), and the same command resumes.
--write-scenes DIR writes the scenes as scenario files for `drake-oa run`.
A Dask cluster's workers need this package, and are best started with --nthreads 1.
"""

_ONLY = {
    "kinds": "--suite",
    "perception": "--perception",
    "jobs": "--jobs",
    "scheduler": "--scheduler",
    "results": "--results",
    "logs": "--logs",
    "html_dir": "--html-dir",
    "duration": "--duration",
}
"""Options that only this suite takes, by their destination."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Adds the options of the suite `panda` to `drake-oa evaluate`."""
    group = parser.add_argument_group("only with panda; of mbm from --jobs on")
    group.add_argument(
        "--suite",
        action="append",
        metavar="KIND",
        dest="kinds",
        help="of the scenes, see below; may be repeated, or name several with commas",
    )
    group.add_argument(
        "--perception", metavar="P", help="depth (the camera, default) or truth (SceneGraph)"
    )
    group.add_argument("--jobs", type=int, metavar="N", help="processes at once (default: cores)")
    group.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="send the scenes to a running Dask cluster, as tcp://host:8786 "
        "(pip install 'drake_oa[cluster]')",
    )
    group.add_argument(
        "--results",
        type=Path,
        metavar="DIR",
        help=f"results scene by scene (default: beside --json as STEM.scenes, or {RESULTS})",
    )
    group.add_argument("--logs", type=Path, metavar="DIR", help="keep each run's log (.npz)")
    group.add_argument(
        "--html-dir",
        type=Path,
        metavar="DIR",
        help="write a page to play in a browser for each run of verified (or, without it, "
        "of each method)",
    )
    group.add_argument(
        "--duration", type=float, metavar="S", help="end each run after S simulated seconds"
    )


def refuse_options(options: argparse.Namespace) -> None:
    """For the other suites: raises ValueError for an option that only panda and mbm take."""
    for name, flag in _ONLY.items():
        if getattr(options, name) is not None:
            raise ValueError(f"{flag} goes with the suite panda, not with {options.suite}")


def run(options: argparse.Namespace) -> int:
    """Runs the suite; returns the exit status.

    Raises:
        ValueError: for bad input.
        OSError: for a file that cannot be written.
    """
    from drake_oa.studies.panda.tables import kinds_figures

    for value, flag in ((options.scenes_file, "--scenes-file"), (options.plot, "--plot")):
        if value is not None:
            raise ValueError(f"panda takes no {flag}")
    return run_suites(options, _suites, lambda _, figures: kinds_figures(figures))


def run_suites(
    options: argparse.Namespace,
    make_suites: Callable[[argparse.Namespace], Sequence[PandaSuite]],
    together: Callable[[Sequence[PandaResults], Sequence[dict[str, Any]]], dict[str, Any]],
) -> int:
    """Runs several suites of the whole robot, and tells; returns the exit status.

    Args:
        options: of the command.
        make_suites: makes the suites.
        together: what is written of the results and figures of each.
    """
    if options.jobs is not None and options.scheduler is not None:
        raise ValueError("--jobs and --scheduler exclude each other")
    if options.jobs is not None and options.jobs < 1:
        raise ValueError(f"--jobs must be at least 1, not {options.jobs}")

    from drake_oa.common.provenance import software_versions
    from drake_oa.studies.panda.evaluation import evaluate_panda
    from drake_oa.studies.panda.run import PLANNER
    from drake_oa.studies.panda.sampling_planner import check_planner
    from drake_oa.studies.panda.tables import panda_figures, panda_tables

    suites = make_suites(options)
    if any(PLANNER in suite.methods for suite in suites):
        check_planner()
    check_outputs(options.json)
    keeping = _keeping(options, suites)
    jobs = 1 if options.scheduler is not None else options.jobs or _cores()
    results = []
    with progress_bar(sum(suite.scenes * (1 + len(suite.methods)) for suite in suites)) as progress:
        for suite in suites:
            results.append(
                evaluate_panda(
                    suite,
                    jobs=jobs,
                    scheduler=options.scheduler,
                    keeping=keeping,
                    on_progress=progress,
                )
            )
            if results[-1].interrupted:
                break
    shared = None if options.scheduler is not None else jobs
    versions = software_versions()
    figures = [panda_figures(found, versions, shared) for found in results]
    whole = together(results, figures)
    if options.json is not None:
        text = json.dumps(whole, indent=2, allow_nan=False)
        replace_text(options.json, text + "\n")
    if options.write_scenes is not None:
        for found in results:
            _write_scenes(options.write_scenes, found)
    print(_heading(results))
    print(panda_tables([*figures, *([whole["all"]] if "all" in whole else [])]))
    return _status(results, keeping)


def _suites(options: argparse.Namespace) -> list[PandaSuite]:
    """One for each kind of scenes that is asked for."""
    from drake_oa.studies.panda.evaluation import PandaSuite
    from drake_oa.studies.panda.run import default_methods

    named = ",".join(options.kinds or ["tabletop"]).split(",")
    suites = [
        PandaSuite(
            scenes=DEFAULT_SCENES if options.scenes is None else options.scenes,
            seed=options.seed,
            methods=tuple(dict.fromkeys(options.methods or default_methods(kind))),
            perception=options.perception or "depth",
            kind=kind,
            duration=options.duration,
        )
        for kind in dict.fromkeys(kind.strip() for kind in named)
    ]
    return suites


def _keeping(options: argparse.Namespace, suites: Sequence[PandaSuite]) -> Keeping:
    from drake_oa.studies.panda.evaluation import Keeping
    from drake_oa.studies.panda.results import ResultFolder

    folder = options.results
    if folder is None:
        json_file = options.json
        # A device, as /dev/stdout, has no place beside it.
        beside = json_file is not None and (json_file.is_file() or not json_file.exists())
        folder = json_file.with_name(f"{json_file.stem}.scenes") if beside else RESULTS
    for other in (options.logs, options.html_dir, options.write_scenes):
        if other is not None:
            # Told apart from a file, and made, before anything is computed.
            ResultFolder(other)
    methods = frozenset(method for suite in suites for method in suite.methods)
    shown = frozenset({"verified"} & methods or methods)
    return Keeping(ResultFolder(folder), options.logs, options.html_dir, shown)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _write_scenes(folder: Path, results: PandaResults) -> None:
    from drake_oa.scenario.loading import parse_scenario, scenario_text
    from drake_oa.studies.panda.run import with_perception

    for scene, text in results.scenarios.items():
        seen = with_perception(parse_scenario(text), results.suite.perception)
        file = folder / f"{results.suite.scene_name(scene)}.scenario.yaml"
        replace_text(file, scenario_text(seen))


def _heading(results: Sequence[PandaResults]) -> str:
    suite = results[0].suite
    resumed = sum(found.resumed for found in results)
    taken = f"; {resumed} runs were on disk" if resumed else ""
    kinds = ", ".join(found.suite.kind for found in results)
    if suite.name != "panda":
        scenes = sum(found.suite.scenes for found in results)
        return f"{suite.name}: {scenes} problems, {kinds}, {suite.perception}{taken}\n"
    return (
        f"panda: {suite.scenes} scenes of seed {suite.seed}, {kinds}, {suite.perception}{taken}\n"
    )


def _status(results: Sequence[PandaResults], keeping: Keeping) -> int:
    runs: list[dict[str, Any]] = [
        run for found in results for of in found.runs.values() for run in of.values()
    ]
    failed = [run["stop_reason"] for run in runs if run["failed"]]
    if failed:
        complain(f"{len(failed)} of {len(runs)} runs failed; the first: {failed[0]}")
    if any(found.interrupted for found in results):
        where = keeping.folder.path if keeping.folder else "nowhere"
        complain(f"interrupted: {len(runs)} runs are in {where}; the same command resumes")
        return INTERRUPTED
    return FAILED if failed else 0
