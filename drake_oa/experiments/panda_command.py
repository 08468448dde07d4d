"""`drake-oa evaluate panda`: methods on random table-top scenes of the whole robot."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drake_oa.command_line import FAILED, INTERRUPTED, complain
from drake_oa.experiments.progress import progress_bar
from drake_oa.output_files import check_outputs, replace_text

# Simulation and diagrams are imported where they are used: `--help` answers at once.
if TYPE_CHECKING:
    from drake_oa.experiments.panda_evaluation import Keeping, PandaResults, PandaSuite

SUITE = "panda"
DEFAULT_SCENES = 100
RESULTS = Path("drake_oa_runs") / "evaluate-panda"
"""Where results go that nobody named, relative to the current folder."""

EPILOG = """\
panda: random table-top scenes of 1 to 6 things (boxes, cylinders, spheres, piles) in which
the planned motion of 0.5 to 1.0 m would touch one. Its methods (all by default):
  preplanned           the planned motion, blind to obstacles
  paper                the paper's regulation, which nothing checks, without a supervisor
  verified             proposals checked by roll-outs
  differential_ik      Drake's differential inverse kinematics with collision constraints, on
                       the same planned motion; it knows the obstacles exactly, and its tool
                       keeps the asked clearance as far as start and goal have it
  differential_ik_near the same, asked for 3 cm
Its table:
  contacts             scenes in which a link, the hand or a finger touched an obstacle or the
                       table, by SceneGraph
  success              no contact, and the tool ends within 5 mm of the goal
  stopped              the others: ended short of the goal without a contact, and why
  clearance            least over all scenes, of hand and fingers (tool) and of any link
  goal error           largest of the scenes that were not stopped
  real-time factor     simulated over real time, median and least scene
Every scene is on disk as soon as it is done (--results), and the same command resumes.
--write-scenes DIR writes the scenes as scenario files for `drake-oa run`.
A Dask cluster's workers need this package, and are best started with --nthreads 1.
"""

_ONLY = {
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
    group = parser.add_argument_group("only with panda")
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
    """For the other suites: raises ValueError for an option that only panda takes."""
    for name, flag in _ONLY.items():
        if getattr(options, name) is not None:
            raise ValueError(f"{flag} goes with the suite panda, not with {options.suite}")


def run(options: argparse.Namespace) -> int:
    """Runs the suite; returns the exit status.

    Raises:
        ValueError: for bad input.
        OSError: for a file that cannot be written.
    """
    for value, flag in ((options.scenes_file, "--scenes-file"), (options.plot, "--plot")):
        if value is not None:
            raise ValueError(f"panda takes no {flag}")
    if options.jobs is not None and options.scheduler is not None:
        raise ValueError("--jobs and --scheduler exclude each other")
    if options.jobs is not None and options.jobs < 1:
        raise ValueError(f"--jobs must be at least 1, not {options.jobs}")

    from drake_oa.experiments.panda_evaluation import evaluate_panda
    from drake_oa.experiments.panda_tables import panda_figures, panda_table
    from drake_oa.provenance import software_versions

    suite = _suite(options)
    check_outputs(options.json)
    keeping = _keeping(options, suite)
    jobs = 1 if options.scheduler is not None else options.jobs or _cores()
    with progress_bar(suite.scenes * (1 + len(suite.methods))) as on_progress:
        results = evaluate_panda(
            suite, jobs=jobs, scheduler=options.scheduler, keeping=keeping, on_progress=on_progress
        )
    shared = None if options.scheduler is not None else jobs
    figures = panda_figures(results, software_versions(), shared)
    if options.json is not None:
        replace_text(options.json, json.dumps(figures, indent=2, allow_nan=False) + "\n")
    if options.write_scenes is not None:
        _write_scenes(options.write_scenes, results)
    print(_heading(results))
    print(panda_table(figures))
    return _status(results, keeping)


def _suite(options: argparse.Namespace) -> PandaSuite:
    from drake_oa.experiments.panda_evaluation import PandaSuite
    from drake_oa.experiments.panda_run import DEFAULT_METHODS

    methods = tuple(dict.fromkeys(options.methods or DEFAULT_METHODS))
    return PandaSuite(
        scenes=DEFAULT_SCENES if options.scenes is None else options.scenes,
        seed=options.seed,
        methods=methods,
        perception=options.perception or "depth",
        duration=options.duration,
    )


def _keeping(options: argparse.Namespace, suite: PandaSuite) -> Keeping:
    from drake_oa.experiments.panda_evaluation import Keeping
    from drake_oa.experiments.panda_results import ResultFolder

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
    shown = frozenset({"verified"} & set(suite.methods) or suite.methods)
    return Keeping(ResultFolder(folder), options.logs, options.html_dir, shown)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _write_scenes(folder: Path, results: PandaResults) -> None:
    from drake_oa.experiments.panda_evaluation import scene_name
    from drake_oa.experiments.panda_run import with_perception
    from drake_oa.scenario import parse_scenario, scenario_text

    for scene, text in results.scenarios.items():
        seen = with_perception(parse_scenario(text), results.suite.perception)
        file = folder / f"{scene_name(results.suite, scene)}.scenario.yaml"
        replace_text(file, scenario_text(seen))


def _heading(results: PandaResults) -> str:
    suite = results.suite
    taken = f"; {results.resumed} runs were on disk" if results.resumed else ""
    return f"panda: {suite.scenes} scenes of seed {suite.seed}, {suite.perception}{taken}\n"


def _status(results: PandaResults, keeping: Keeping) -> int:
    runs: list[dict[str, Any]] = [run for of in results.runs.values() for run in of.values()]
    failed = [run["stop_reason"] for run in runs if run["failed"]]
    if failed:
        complain(f"{len(failed)} of {len(runs)} runs failed; the first: {failed[0]}")
    if results.interrupted:
        where = keeping.folder.path if keeping.folder else "nowhere"
        complain(f"interrupted: {len(runs)} runs are in {where}; the same command resumes")
        return INTERRUPTED
    return FAILED if failed else 0
