"""Command `drake-oa evaluate`: runs methods of obstacle avoidance on suites of test scenes, and
prints their metrics.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import App, Parameter

from drake_oa.app.scenarios import Count, Positive, Seed
from drake_oa.common.console import FAILED, complain, show
from drake_oa.common.files import check_outputs, import_extra, replace_json, replace_text

# Suites, methods and kernels are imported where they are used: `--help` answers at once.
if TYPE_CHECKING:
    from drake_oa.common.console import TextTable
    from drake_oa.evaluation.panda.evaluation import PandaResults, PandaSuite

RESULTS = Path("drake_oa_runs") / "evaluate-panda"
"""Default folder for the result files of evaluations with the whole robot, relative to the current
folder."""

Methods = Annotated[tuple[str, ...], Parameter(name="--method")]
"""Annotation of the repeatable command-line option --method: names of the methods to evaluate."""

evaluate = App(name="evaluate")
for _name in ("table1", "table2", "table3", "figure_familiar", "figure_dead_zone"):
    evaluate.command(f"drake_oa.app.paper_tables:{_name}", name=_name)


# Scenes of ellipsoids -------------------------------------------------------------------


@evaluate.default
def synthetic(
    suite: str,
    /,
    *,
    methods: Methods = ("paper", "verified"),
    scenes: Count | None = None,
    seed: Seed = 0,
    json: Path | None = None,
) -> None:
    """Compare methods on scenes of a point and an ellipsoid.

    The subcommands table1, table2, table3, figure_familiar and figure_dead_zone reproduce tables
    and figures of the paper (Pairet et al., RA-L 2019) beside its published values. The subcommands
    panda, mbm and sources simulate the whole robot.

    The table has a row for each method, and these columns:

      collisions               number of scenes in which the motion is in collision
      mean clearance [m]       mean over the scenes of the minimum clearance of a motion
      mean if achievable [m]   the same mean over the scenes whose achievable clearance is the
                               requested clearance Delta
      min. clearance [m]       minimum clearance over all scenes
      scenes with shortfall    number of scenes with more than 1 mm less than the achievable
                               clearance min(Delta, distance of start, distance of goal)
      max. goal error [mm]     maximum distance to the goal at the end of a motion. Motions end
                               on arrival: of verified between tau T and 2 tau T, of paper and
                               original between T and 2 T. Motions of movement_primitives end at
                               T. T is the demonstrated duration, tau the temporal scaling
      mean path ratio          mean length of the path over that of the straight line

    All columns are computed in float64, independently of the methods, from motions that are
    interpolated at three or more instants between two samples.

    Suites (number of scenes):

      novel      the paper's random obstacles within 0.15 m of the straight line from start to goal,
                 which is 0.5 to 2 m long (4000)
      hit        as novel, but the obstacles have random orientations and the straight line from
                 start to goal is in collision (1000)
      familiar   the scenes of figure_familiar: ellipses of the paper's training set in the middle
                 of a 1 m line; the number of scenes must be a square (100)
      dead-zone  the scenes of figure_dead_zone: a sphere of 2.5 cm on or beside the middle of a
                 1 m line (41)
      demo       the scenes of table2: as novel, but every obstacle's center is at least as far
                 from start and goal as the longest possible obstacle requires (4000)

    Methods (default: paper and verified):

      paper      the paper's coupling term with the parameters of its regressor chain, as in table2
      verified   the search of `drake-oa run` among simulated candidate motions (roll-outs): its
                 first candidates pass the obstacle on 16 sides, and none is from the regressor
                 chain
      original   the coupling term of Hoffmann et al., which the paper improves
      movement_primitives
                 the package of this name, with its own coupling term
                 (pip install 'drake_oa[baselines]')

    --json writes {"suite", "seed", "versions", "methods": {NAME: {...}}}.

    For example:

        drake-oa evaluate novel --json novel.json
        drake-oa evaluate hit --method paper --method original --scenes 200 --seed 7

    Args:
        suite: suite of scenes, see above.
        methods: method, see above; may be repeated.
        scenes: number of scenes (default: that of the suite).
        seed: seed of the scenes; without effect for familiar and dead-zone.
        json: write the metrics to this file.
    """
    from drake_oa.common.config import check_choice
    from drake_oa.evaluation.scenes.suites import SUITES

    check_choice("suite or subcommand", [*SUITES, *(n for n in evaluate if n[0] != "-")], suite)
    evaluate_points(suite, methods, scenes, seed, json)


def evaluate_points(
    name: str,
    methods: Sequence[str],
    count: int | None,
    seed: int | None,
    json: Path | None,
    *,
    notes: Sequence[str] = (),
    terms: bool = False,
) -> None:
    """Runs methods on a suite of scenes in which a point moves past an ellipsoid, and prints tables
    of their metrics.

    Args:
        name: name of the suite.
        methods: names of the methods.
        count: number of scenes; None: that of the suite.
        seed: seed of the scenes; None for scenes without random numbers.
        json: file to which the metrics are written, or None.
        notes: lines below the first table.
        terms: whether the paper's coupling term and that of Hoffmann et al. are also compared at
            equal strength, with constant parameters instead of those of a method.
    """
    from drake_oa.evaluation.scenes.evaluation import (
        compare_terms,
        evaluate,
        evaluation_metrics,
        evaluation_tables,
        term_table,
    )
    from drake_oa.evaluation.scenes.methods import load_methods
    from drake_oa.evaluation.scenes.suites import SUITES, draw_scenes, line_distance

    drawn, suite = draw_scenes(name, count, seed or 0), SUITES[name]
    chosen = load_methods(methods)
    check_outputs(json)
    more = {"terms": compare_terms(drawn)} if terms else {}
    outcomes = {of: evaluate(of, chosen[of], drawn, suite.settings) for of in chosen}
    metrics = evaluation_metrics(name, seed, suite.settings, outcomes) | more
    replace_json(json, metrics)
    hit = int((line_distance(drawn) < 0.0).sum())
    print(f"{name}: {len(drawn)} scenes; the straight line is in collision in {hit}\n")
    show(*map(term_table, more.values()), *evaluation_tables(metrics, notes))


# The whole robot ------------------------------------------------------------------------


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Runs:
    """Command-line options that all evaluations with the whole robot share: parallel processes,
    duration, and result files.

    Attributes:
        jobs: number of parallel processes (default: number of cores).
        scheduler: run the scenes on a Dask cluster with this address, for example tcp://host:8786
            (pip install 'drake_oa[cluster]').
        duration: end each run at this simulated time [s].
        json: write the metrics to this file.
        results: folder of the results, one file per scene and method (default: NAME.scenes beside
            the file NAME.json of --json, or drake_oa_runs/evaluate-panda without --json).
        write_scenes: write the scenes to this folder as scenario files for `drake-oa run`.
    """

    jobs: Count | None = None
    scheduler: str | None = None
    duration: Positive | None = None
    json: Path | None = None
    results: Path | None = None
    write_scenes: Path | None = None


RUNS = Runs()
"""Default values of the command-line options that all evaluations with the whole robot share."""


@evaluate.command
def panda(
    *,
    kinds: Annotated[tuple[str, ...], Parameter(name="--suite")] = ("tabletop",),
    levels: Annotated[tuple[str, ...], Parameter(name="--level")] = (),
    methods: Methods = ("nominal", "paper", "verified", "differential_ik"),
    scenes: Count = 100,
    seed: Seed = 0,
    perception: Literal["depth", "truth"] = "depth",
    cameras: Literal[1, 2] = 1,
    runs: Runs = RUNS,
) -> int:
    """Evaluate methods with the whole robot in random scenes of several kinds.

    In each scene the nominal motion, which avoids nothing and is 0.5 to 1.0 m long, is in contact.
    Kinds (--suite):

      tabletop     1 to 6 objects on the table: boxes, cylinders, spheres, piles
      moving       1 or 2 objects cross the nominal path at 0.1 to 0.4 m/s, with up to 2 resting
                   objects
      elbow        objects that only the elbow touches, while the hand has 5 cm of clearance:
                   posts, boards in the air, boxes on stands
      clutter6     six objects on the table, at least three within 25 cm of the nominal path
      moving_hard  2 to 4 objects of 5 to 30 cm enter the image at 0.1 to 0.8 m/s, change speed
                   and direction, stop and return, with up to 2 resting objects; not every scene
                   has a solution
      moving_high  as moving_hard; the center of at least one object is 0.6 to 1.0 m high
      drp          boxes by the parameters of the benchmark DRPBench, in one or several levels
                   (--level):
                   sudden1 to 3 (a box appears on the nominal path), floating1 and 2 (three boxes
                   fly to and fro in front of the robot), goal_blocked1 and 2 (a box appears at the
                   goal), moving_goal_blocked1 to 4 (boxes fly to and fro through the goal)
                   (default: all of these 11). Further levels: floating1_at_0.18, _at_0.5, _at_1.0
                   and _at_1.6, which are floating1 with this speed of the boxes [m/s]

    Methods (default: the first four):

      nominal          the nominal motion
      paper            the method of Pairet et al., RA-L 2019, without verification by simulation
      verified         motions of the whole arm that are verified among the obstacles by simulation
                       (roll-outs), or a joint path that the movement primitives imitate; among
                       moving obstacles also maneuvers of the whole arm
      differential_ik  for comparison: Drake's differential inverse kinematics with collision
                       constraints along the nominal motion; it knows the obstacles exactly, and
                       requests the achievable clearance
      planner          for comparison: the planner RRT-Connect of the package ompl
                       (pip install 'drake_oa[baselines]'), which knows the obstacles exactly, with
                       25 mm clearance of the whole robot; among moving obstacles a search in space
                       and time that knows their trajectories, with 5 mm. Its path is not
                       simulated: success means that it has found one

    The table has a row for each kind and method, and these columns:

      contacts                     number of scenes with a contact of the robot with an obstacle,
                                   the table or itself, by SceneGraph, until the world is at rest
      avoidable by physics, by view
                                   numbers of contacts, in scenes with moving obstacles, that could
                                   have been avoided. By physics: at least one of 500 joint motions
                                   from the state 0.2 s before the contact avoids it. By view: a
                                   joint motion from one of five states 0.05 to 0.5 s before it
                                   does, and the velocity of the obstacle was observed at least
                                   0.1 s before the latest of these states
      success                      number of scenes without contact and with the tool within 5 mm of
                                   the goal at the end
      violations of claims A, B    numbers of logged instants that violate a claim of passive motion
                                   safety. (A): a point of the arm approaches a moving obstacle that
                                   can have reached it since the last observation. (B): a point of
                                   the arm moves faster than 0.25 m/s toward space that no camera
                                   has observed
      DRPBench contacts, success   numbers of scenes by DRPBench's rules. Contact: with an obstacle
                                   or the table within 16.7 s. Success: no contact in this time, and
                                   the tool within 5 cm and 15 degrees of the goal at its end
      min. tool clearance [m]      minimum clearance of hand and fingers over all scenes
      median duration [s]          median duration of the motions

    Lines below the table list the reasons of stops, the pairs in contact, and the sources of the
    executed motions. --json has further metrics, and the result of each scene.

    The result of each scene is written at once (--results); the same command resumes an interrupted
    evaluation. Workers of a Dask cluster require this package; start them with --nthreads 1.

    For example:

        drake-oa evaluate panda --scenes 20 --perception truth --method verified
        drake-oa evaluate panda --suite moving --suite elbow --jobs 2 --json changing.json
        drake-oa evaluate panda --suite drp --level floating1 --perception truth --scenes 10

    Args:
        kinds: kind of scenes, see above; may be repeated.
        levels: level of drp; may be repeated.
        methods: method, see above; may be repeated.
        scenes: number of scenes of each kind.
        seed: seed of the scenes.
        perception: source of the obstacles: depth (camera) or truth (SceneGraph).
        cameras: number of cameras; 2: on both sides of the robot, 2.1 m from the center of the
            workspace.
        runs: options of the runs.
    """
    from drake_oa.common.config import check_choice
    from drake_oa.evaluation.panda.evaluation import panda_suite
    from drake_oa.evaluation.panda.scenes import DRP, KINDS, suite_kinds
    from drake_oa.evaluation.panda.tables import kinds_metrics

    check_choice("suite", [DRP, *KINDS], *kinds)
    if cameras == 2 and perception != "depth":
        raise ValueError(f"--cameras 2 requires --perception depth, not {perception}")
    source = "depth2" if cameras == 2 else perception
    suites = [
        panda_suite(kind, scenes, seed, methods, source, runs.duration)
        for kind in suite_kinds(kinds, levels)
    ]
    return run_suites(runs, suites, f"panda: {scenes} scenes of seed {seed}", kinds_metrics)


@evaluate.command
def mbm(
    *,
    problems: Path,
    robot: str | None = None,
    sets: tuple[str, ...] = (),
    methods: Methods = ("verified", "planner"),
    scenes: Count | None = None,
    perception: Literal["depth", "truth"] = "truth",
    runs: Runs = RUNS,
) -> int:
    """Evaluate methods with the whole robot on the problems of MotionBenchMaker.

    The problems are those of Chamzas et al., RA-L 2022 (data BSD-3-Clause, Rice University), in the
    form of VAMP's repository (github.com/KavrakiLab/vamp): a .tar.bz2 with folders <set>_<robot> of
    scene0001.yaml and request0001.yaml. Sets of the Panda and of the UR5: table_pick,
    table_under_pick, bookshelf_small, bookshelf_tall, bookshelf_thin, box, cage.

    The demonstration is a straight minimum-jerk motion of the tool from FK(start) to FK(goal) in
    5 s, with the rotation between them. The nominal posture leads from the start configuration to
    the goal configuration. Obstacles are known exactly, or with --perception depth perceived by two
    cameras. These are 1.2 m from the middle between start and goal, to the left and right of the
    direction to the robot's base, at the first of the elevations 35, 50, 65, 80 and 20 degrees at
    which no object is near the camera or the beginning of its optical axis. An object that the goal
    grasps (the tool point is inside) is omitted. The requested clearance is 3 cm, or the clearance
    of the whole robot at start or goal if that is less, but at least 1 mm. The motion guard, the
    system that commands the joints, requires a distance of 4 mm from resting obstacles, or less if
    the arm or its verified motion is closer.

    Success: the arm comes to rest within 1 cm and 15 degrees of the goal, without contact (with
    itself included), and no joint was ever more than 1 mrad beyond its limit. Methods:

      verified, nominal, differential_ik
                            as in `drake-oa evaluate panda`
      planner               RRT-Connect from the start configuration to the goal configuration, with
                            the requested clearance of the whole robot, at most 200 000 states; not
                            simulated

    The table is that of `drake-oa evaluate panda`, with a row for each set and method, and a row
    `all` for each method over all sets. --json has a block for each set, and `all`.

    For example:

        drake-oa evaluate mbm --problems motionbenchmaker_panda.tar.bz2 --scenes 6

    Args:
        problems: file of the problems, .tar.bz2.
        robot: panda (default), ur5 (with a gripper; pip install 'drake_oa[robots]'), or a
            scenario with the block `robot` of the problems' robot.
        sets: set of problems (default: all sets); may be repeated.
        methods: method, see above; may be repeated.
        scenes: number of problems of each set (default: all problems).
        perception: source of the obstacles: truth (SceneGraph) or depth (two cameras).
        runs: options of the runs.
    """
    from drake_oa.evaluation.mbm.suite import mbm_metrics, mbm_suites

    suites = mbm_suites(problems, robot, sets, methods, scenes, perception, runs.duration)
    heading = f"mbm: {sum(len(suite.drawings) for suite in suites)} problems"
    return run_suites(runs, suites, heading, mbm_metrics)


_SOURCE_KINDS = ("tabletop", "clutter6", "elbow", "moving")
"""Default kinds of scenes of `drake-oa evaluate sources`."""


@evaluate.command
def sources(
    *,
    kinds: Annotated[tuple[str, ...], Parameter(name="--suite")] = _SOURCE_KINDS,
    problems: Path | None = None,
    scenes: Count = 20,
    count: Count = 10,
    seed: Seed = 0,
    runs: Runs = RUNS,
) -> int:
    """Evaluate the method verified, and its variants that lack one source of motions each.

    Sources of the executed motion: nominal (the nominal motion), chain (parameters of the regressor
    chain of Pairet et al., RA-L 2019, with a coupling term that turns the motion to the selected
    side), search (among simulated motions) and joint_path (a joint path that the movement
    primitives imitate). The table is that of `drake-oa evaluate panda`, for `verified` and for
    `verified` without chain, without search and without joint_path. Lines below the table state for
    each source in how many scenes one of its motions was executed.

    For example:

        drake-oa evaluate sources --scenes 5 --suite tabletop
        drake-oa evaluate sources --problems motionbenchmaker_panda.tar.bz2 --seed 1000

    Args:
        kinds: kind of scenes of `drake-oa evaluate panda`, perceived by the camera; may be
            repeated.
        problems: file of MotionBenchMaker's problems, see `drake-oa evaluate mbm`.
        scenes: number of scenes of each kind.
        count: number of MotionBenchMaker's problems of each set, with --problems.
        seed: seed of the scenes.
        runs: options of the runs.
    """
    from drake_oa.evaluation.mbm.suite import mbm_suites
    from drake_oa.evaluation.panda.evaluation import ABLATIONS, panda_suite
    from drake_oa.evaluation.panda.tables import kinds_metrics

    methods = ("verified", *ABLATIONS)
    suites = [panda_suite(kind, scenes, seed, methods, "depth", runs.duration) for kind in kinds]
    if problems is not None:
        suites += mbm_suites(problems, None, (), methods, count, "truth", runs.duration)
    return run_suites(runs, suites, f"sources: seed {seed}", kinds_metrics)


def run_suites(
    runs: Runs,
    suites: Sequence[PandaSuite],
    heading: str,
    merge: Callable[[Sequence[PandaResults], Sequence[dict[str, Any]]], dict[str, Any]],
    table: Callable[[Mapping[str, Any]], TextTable] | None = None,
) -> int:
    """Runs suites of scenes with the whole robot, prints the table of their metrics, and returns
    the exit status.

    Args:
        runs: command-line options of the runs.
        suites: suites to run.
        heading: beginning of the line above the table.
        merge: function that returns the JSON data of the whole evaluation, for --json and `table`;
            its arguments are the results and the metrics of all suites.
        table: function that returns the table of these data; None: the table of `drake-oa
            evaluate panda`.

    Returns:
        0, or `FAILED` (1) if a run raised an exception.
    """
    if runs.jobs is not None and runs.scheduler is not None:
        raise ValueError("--jobs and --scheduler exclude each other")

    from joblib import cpu_count

    from drake_oa.evaluation.panda.evaluation import PLANNER, evaluate_panda
    from drake_oa.evaluation.panda.scenes import MOVING_KINDS, with_perception
    from drake_oa.evaluation.panda.tables import panda_metrics, panda_table
    from drake_oa.scenario.loading import parse_scenario, scenario_text

    if any(PLANNER in suite.methods for suite in suites if suite.kind not in MOVING_KINDS):
        import_extra("ompl.base", "baselines")
    default = RESULTS if runs.json is None else runs.json.with_name(f"{runs.json.stem}.scenes")
    folder = runs.results or default
    check_outputs(runs.json, *(f / ".writable" for f in (folder, runs.write_scenes) if f))
    workers = runs.scheduler or runs.jobs or cpu_count()
    results = [evaluate_panda(suite, workers=workers, folder=folder) for suite in suites]
    metrics = [panda_metrics(result, workers) for result in results]
    output = merge(results, metrics)
    replace_json(runs.json, output)
    for result in results if runs.write_scenes else ():
        for scene, text in result.scenarios.items():
            scenario = with_perception(parse_scenario(text), result.suite.perception)
            file = f"{runs.write_scenes}/{result.suite.scene_name(scene)}.scenario.yaml"
            replace_text(Path(file), scenario_text(scenario))
    n_resumed = sum(result.resumed for result in results)
    note = f"; {n_resumed} results read from {folder}" if n_resumed else ""
    kinds = ", ".join(result.suite.kind for result in results)
    print(f"{heading}, {kinds}, {results[0].suite.perception}{note}\n")
    all_of = [output["all"]] if "all" in output else []
    show(panda_table([*metrics, *all_of]) if table is None else table(output))
    all_runs = [run for result in results for of in result.runs.values() for run in of.values()]
    failures = [run["stop_reason"] for run in all_runs if run["failed"]]
    if failures:
        complain(f"{len(failures)} of {len(all_runs)} runs failed; the first: {failures[0]}")
    return FAILED if failures else 0
