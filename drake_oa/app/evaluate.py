"""`drake-oa evaluate`: runs methods on a suite of scenes and prints what they kept."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drake_oa.app import evaluate_mbm as mbm
from drake_oa.app import evaluate_panda as panda
from drake_oa.app.command_line import add_verbose
from drake_oa.common.console import FAILED, INTERRUPTED, complain
from drake_oa.common.files import check_outputs, replace_text, same_file
from drake_oa.studies.scenes.progress import progress_bar

# Suites, methods and kernels are imported where they are used: `--help` answers at once.
if TYPE_CHECKING:
    from drake_oa.common.messages import FloatArray
    from drake_oa.studies.scenes.dead_zone import Comparison
    from drake_oa.studies.scenes.evaluation import Evaluation, Outcome
    from drake_oa.studies.scenes.methods import Method, Motions
    from drake_oa.studies.scenes.scenes import Scenes

_DESCRIPTION = """\
Runs methods on the same scenes and prints, for each method:

  collisions       scenes in which an obstacle was touched
  clearance        least distance to an obstacle over the whole motion
  short            scenes more than 1 mm short of the feasible clearance:
                   min(Delta, distance of the start, distance of the goal)
  goal error       distance to the goal at the end of the motion: of the scaled duration
                   tau T; `verified` goes on until it has arrived, to 2 tau T at most
  path ratio       length of the path over that of the straight line
  step, seconds    computing time of a policy step, and of all scenes

An independent float64 check judges the motions, on samples four times finer than theirs.
"""

_EPILOG = """\
suites:
{suites}

{panda}
{mbm}
methods of the other suites (default: paper and verified; for dead-zone original and paper):
  paper                the paper's own regressor chain, as printed
  verified             proposals checked by roll-outs, as the running system does it
  verified_constant    the same with a chain that always proposes the same, to tell what the
                       trained networks add
  original             the coupling term that the paper starts from
  movement_primitives  the package of that name (pip install 'drake_oa[peers]')

A scenes file (.npz) replaces the suite's scenes: `baseline` (N,), `center` (N, M, 3),
`semi_axes` (N, M, 3), `R` (N, M, 3, 3), `velocity` (N, M, 3), `clearance` (N,), in metres
and m/s, NaN rows for absent obstacles; the start is the origin, the goal (baseline, 0, 0).
SUITE then only names the result; `familiar` runs the file's scenes in its 12 settings, each
with its own clearance; `dead-zone` takes no file. --write-scenes writes the suite's scenes
in the same form.

--json writes {{"suite", "seed", "versions", "methods": {{NAME: {{...}}}}}}, after every method;
what was computed so far is in it, with "complete": false, when a method fails or the command is
interrupted. The figures of `familiar` are over the settings that ask for a clearance and
scale the duration; "settings" has all twelve.

Exit status: 0 when all was run, 1 when a method failed, 2 for bad input, 130 when
interrupted.

examples:
  drake-oa evaluate novel --json novel.json --plot novel.png
  drake-oa evaluate hit --method paper --method original --scenes 200 --seed 7
  drake-oa evaluate clutter --scenes-file mine.npz --method verified
  drake-oa evaluate panda --scenes 20 --perception truth --method verified --json panda.json
  drake-oa evaluate panda --suite moving,elbow,clutter6 --jobs 2 --json changing.json
  drake-oa evaluate mbm --problems motionbenchmaker_panda.tar.bz2 --scenes 6 --json mbm.json
"""

_SUITES = {
    "familiar": "the paper's 100 training ellipses, each in its 12 settings",
    "novel": "the paper's random obstacles at baselines of 0.5, 1, 1.5 and 2 m (4000)",
    "posed": "novel with random orientations (1000)",
    "hit": "posed, with the straight line in collision (1000)",
    "head-on": "posed, centres within 1 cm of the line or exactly on it (1000)",
    "clutter": "six small ellipsoids, at least one in the way (1000)",
    "moving": "one small ellipsoid that moves into the unmodulated robot (1000)",
    "dead-zone": "a point obstacle on the line and up to 10 cm beside it (41), and both terms",
    panda.SUITE: f"the whole robot, seeing, in random scenes of 4 kinds ({panda.DEFAULT_SCENES})",
    mbm.SUITE: "the whole robot on MotionBenchMaker's problems, of a file (all in it)",
}


def add_parser(commands: Any) -> None:
    """Adds the command `evaluate` to the subparsers of `drake-oa`."""
    width = max(map(len, _SUITES))
    suites = "\n".join(f"  {name:<{width}}  {text}" for name, text in _SUITES.items())
    parser = commands.add_parser(
        "evaluate",
        help="compare methods on the paper's experiments and beyond",
        description=_DESCRIPTION,
        epilog=_EPILOG.format(suites=suites, panda=panda.EPILOG, mbm=mbm.EPILOG),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("suite", metavar="SUITE", help="which scenes, see below")
    parser.add_argument(
        "--method",
        action="append",
        metavar="M",
        dest="methods",
        help="a method, see below; may be repeated",
    )
    parser.add_argument(
        "--scenes",
        type=int,
        metavar="N",
        help="how many (familiar: a square, N ellipses); with --scenes-file, the first N",
    )
    parser.add_argument(
        "--seed", type=int, default=0, metavar="S", help="of the scenes (default 0)"
    )
    parser.add_argument("--scenes-file", type=Path, metavar="F.npz", help="run these scenes")
    parser.add_argument(
        "--write-scenes",
        type=Path,
        metavar="F.npz",
        help="write the scenes (panda: a folder of scenario files)",
    )
    parser.add_argument("--json", type=Path, metavar="F", help="write the figures")
    parser.add_argument("--plot", type=Path, metavar="F", help="write a plot: .png, .svg or .pdf")
    add_verbose(parser)
    panda.add_options(parser)
    mbm.add_options(parser)
    parser.set_defaults(action=run)


def run(options: argparse.Namespace) -> int:
    """Runs the command; returns its exit status.

    Raises:
        ValueError: for bad input.
        OSError: for a file that cannot be read or written.
    """
    if options.suite == mbm.SUITE:
        return mbm.run(options)
    mbm.refuse_options(options)
    if options.suite == panda.SUITE:
        return panda.run(options)
    if options.suite not in _SUITES:
        raise ValueError(f"unknown suite {options.suite!r}; valid: {', '.join(_SUITES)}")
    panda.refuse_options(options)

    from drake_oa.common.provenance import software_versions
    from drake_oa.studies.scenes.evaluation import evaluate
    from drake_oa.studies.scenes.figures import evaluation_figures, evaluation_table
    from drake_oa.studies.scenes.scenes import save_scenes
    from drake_oa.studies.scenes.suites import find_suite

    suite = find_suite(options.suite)
    methods = _methods(options.methods or suite.methods)
    _check_outputs(options)
    scenes = _scenes(options)
    if options.write_scenes is not None:
        save_scenes(options.write_scenes, scenes)
    versions = software_versions()
    seed = options.seed if options.scenes_file is None else None
    terms = _terms(scenes) if options.suite == "dead-zone" else []
    paths: dict[str, FloatArray] = {}

    def figures(outcomes: Mapping[str, Outcome]) -> dict[str, Any]:
        found = evaluation_figures(options.suite, seed, versions, suite.cases, outcomes)
        if terms and "original" in found["methods"]:
            found["methods"]["original"]["terms"] = _term_figures(terms)
        return found

    def keep(outcomes: Mapping[str, Outcome]) -> None:
        if options.json is not None:
            text = json.dumps(figures(outcomes), indent=2, allow_nan=False)
            replace_text(options.json, text + "\n")

    def keep_paths(name: str, motions: Motions) -> None:
        if terms:
            paths.setdefault(name, motions.path)

    with progress_bar(len(scenes) * len(suite.cases) * len(methods)) as on_progress:
        evaluation = evaluate(
            scenes,
            suite.cases,
            methods,
            on_progress=on_progress,
            on_method=keep,
            on_motions=keep_paths,
        )
    print(_heading(options.suite, scenes))
    print(evaluation_table(figures(evaluation.outcomes)))
    if terms:
        print(_term_text(terms))
    if options.plot is not None:
        from drake_oa.studies.scenes.plots import plot_evaluation

        plot_evaluation(
            options.plot, options.suite, scenes, suite.cases, evaluation.outcomes, paths, terms
        )
    return _status(evaluation)


def _methods(names: Sequence[str]) -> dict[str, Method]:
    """The methods by name; all names are checked before the first is loaded."""
    from drake_oa.studies.scenes.methods import check_method, load_method

    for name in names:
        check_method(name)
    return {name: load_method(name) for name in names}


def _terms(scenes: Scenes) -> list[Comparison]:
    from drake_oa.studies.scenes.dead_zone import compare_terms

    return compare_terms(scenes)


def _term_figures(terms: Sequence[Comparison]) -> list[dict[str, float]]:
    from drake_oa.studies.scenes.dead_zone import term_figures

    return term_figures(terms)


def _term_text(terms: Sequence[Comparison]) -> str:
    from drake_oa.studies.scenes.dead_zone import term_figures, term_table

    return f"\n{term_table(term_figures(terms))}"


def _scenes(options: argparse.Namespace) -> Scenes:
    from drake_oa.common.memory import check_memory
    from drake_oa.studies.scenes.scenes import load_scenes
    from drake_oa.studies.scenes.suites import draw_scenes, find_suite

    if options.scenes is not None and options.scenes < 1:
        raise ValueError(f"--scenes must be at least 1, not {options.scenes}")
    if options.scenes_file is None:
        if options.scenes is not None:
            size = options.scenes * find_suite(options.suite).bytes_per_scene
            check_memory(f"--scenes {options.scenes}", size)
        return draw_scenes(options.suite, options.scenes, options.seed)
    if options.suite == "dead-zone":
        raise ValueError("dead-zone has scenes of its own: it takes no --scenes-file")
    scenes = load_scenes(options.scenes_file)
    if options.scenes is not None:
        if options.scenes > len(scenes):
            raise ValueError(
                f"--scenes {options.scenes}: {options.scenes_file} holds {len(scenes)}"
            )
        scenes = scenes.rows(slice(options.scenes))
    return scenes


def _heading(suite: str, scenes: Scenes) -> str:
    from drake_oa.studies.scenes.sampling import line_hits

    hit = int(line_hits(scenes).any(axis=1).sum())
    return (
        f"{suite}: {len(scenes)} scenes; in {hit} an obstacle is on the straight line at t = 0\n"
        "where feasible: mean over the scenes in which Delta itself is feasible\n"
    )


def _status(evaluation: Evaluation) -> int:
    for name, outcome in evaluation.outcomes.items():
        if outcome.error is not None:
            complain(f"{name} failed: {outcome.error}")
    if evaluation.interrupted:
        complain("interrupted")
        return INTERRUPTED
    return 0 if all(o.complete for o in evaluation.outcomes.values()) else FAILED


def _check_outputs(options: argparse.Namespace) -> None:
    if options.plot is not None:
        from drake_oa.studies.scenes.plots import check_plot_file

        check_plot_file(options.plot)
    outputs = (options.json, options.plot, options.write_scenes)
    if same_file(*outputs, options.scenes_file):
        raise ValueError(
            "--json, --plot, --write-scenes and --scenes-file must name different files"
        )
    check_outputs(*outputs)
