"""`drake-oa evaluate`: runs methods on a suite of scenes and prints their figures."""

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
"""Default folder of results, relative to the current folder."""

Methods = Annotated[tuple[str, ...], Parameter(name="--method")]
"""Names of methods; the option may be repeated."""

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
    """Compare methods on scenes of ellipsoids.

    table1, table2, table3, figure_familiar and figure_dead_zone, commands of their own, are the
    paper's, its print beside; panda and mbm move the whole robot. For each method it prints:

      collisions       scenes in which an obstacle was touched
      clearance        least distance to an obstacle over the whole motion
      short            scenes more than 1 mm short of the feasible clearance:
                       min(Delta, distance of the start, distance of the goal)
      goal error       distance to the goal at the end of the motion: of the scaled
                       duration tau T; `verified` goes on until it has arrived, to
                       2 tau T at most, and `paper` to 2 T
      path ratio       length of the path over that of the straight line

    An independent float64 check judges the motions, on samples four times finer.

    Suites:

      novel      the paper's random obstacles at baselines of 0.5 to 2 m (4000)
      hit        novel with random orientations, the straight line in collision (1000)

    Methods (default: paper and verified):

      paper                the paper's own regressor chain, as `table2` reads it
      verified             the running system's search among roll-outs, from terms on 16 sides
                           without those of the regressor chain
      original             the coupling term that the paper starts from

    --json writes {"suite", "seed", "versions", "methods": {NAME: {...}}}.

    For example:

        drake-oa evaluate novel --json novel.json
        drake-oa evaluate hit --method paper --method original --scenes 200 --seed 7

    Args:
        suite: which scenes, see above.
        methods: a method, see above; may be repeated.
        scenes: how many.
        seed: of the scenes.
        json: write the figures.
    """
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
    """Runs methods on a suite of ellipsoids and prints their tables.

    Args:
        name: of the suite.
        methods: names of methods.
        count: number of scenes; None: that of the suite.
        seed: of the scenes; None for scenes without one.
        json: where the figures go.
        notes: lines below the first table.
        terms: whether both coupling terms alone are compared as well.
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
    print(f"{name}: {len(drawn)} scenes; in {hit} an obstacle is on the straight line")
    print("where feasible: mean over the scenes in which Delta itself is feasible\n")
    show(*map(term_table, more.values()), *evaluation_tables(metrics, notes))


# The whole robot ------------------------------------------------------------------------


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Runs:
    """Options of runs of the whole robot, and files of their results.

    Attributes:
        jobs: processes at once (default: cores).
        scheduler: send the scenes to a running Dask cluster, as tcp://host:8786
            (pip install 'drake_oa[cluster]').
        duration: end each run after so many simulated seconds.
        json: write the figures.
        results: folder of the results, scene by scene (default: beside --json as STEM.scenes,
            or drake_oa_runs/evaluate-panda).
        write_scenes: write the scenes as scenario files for `drake-oa run` to this folder.
    """

    jobs: Count | None = None
    scheduler: str | None = None
    duration: Positive | None = None
    json: Path | None = None
    results: Path | None = None
    write_scenes: Path | None = None


RUNS = Runs()


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
    """Run the whole robot, seeing, in random scenes of several kinds.

    In each the planned motion of 0.5 to 1.0 m would touch something. Kinds (--suite):

      tabletop     1 to 6 things on the table: boxes, cylinders, spheres, piles
      moving       1 or 2 things cross the way at 0.1 to 0.4 m/s, up to 2 more stand there
      elbow        the hand's way is free by 5 cm and the elbow's is not: posts, boards in
                   the air, boxes on stands
      clutter6     six things on the table, three or more within 25 cm of the way
      moving_hard  2 to 4 things of 5 to 30 cm at 0.1 to 0.8 m/s enter from outside the
                   image, change speed, turn, stop, come back; up to 2 more stand there;
                   not every scene has a solution
      moving_high  as moving_hard, and the middle of one thing at least passes 0.6 to 1.0 m up
      drp          boxes by the parameters of DRPBench, of one level or several (--level):
                   sudden1 to 3, floating1 and 2, goal_blocked1 and 2, moving_goal_blocked1
                   to 4 (default: these 11); floating1_at_0.18, _at_0.5, _at_1.0 and _at_1.6:
                   floating1 with boxes of this speed [m/s]

    Methods (default: the first four):

      nominal       the planned motion, blind to obstacles
      paper            the paper's method alone, which nothing checks
      verified         motions of the whole arm, verified by roll-outs among the obstacles, or a
                       planned path that the primitives imitate; among moving obstacles
                       maneuvers of the whole arm
      differential_ik  Drake's differential inverse kinematics with collision constraints, on
                       the same planned motion; it knows the obstacles exactly, and its tool
                       keeps the requested clearance as far as start and goal have it
      planner          a sampling-based planner that knows the obstacles exactly: RRT-Connect
                       of the package ompl (pip install 'drake_oa[baselines]'), the whole robot
                       25 mm from everything; among moving obstacles a search in time that
                       knows their courses, 5 mm from everything. It is not simulated, and
                       success means solved

    It prints:

      contacts    scenes in which a link, the hand or a finger touched an obstacle, the
                  table or another of the robot's, by SceneGraph, until all was at rest
      success     no contact, and the tool ends within 5 mm of the goal
      avoidable   contacts among moving things for which at least one of 500 joint motions
                  from the state 0.2 s before stays clear; by view: and the obstacle's
                  velocity was observed in time
      claims A, B     logged instants of all scenes at which a point of the arm approaches
                  a moving obstacle that could reach it from where it was seen (A), or is
                  faster than 0.25 m/s toward where sight is lacking (B)
      DRPBench    contacts and success by its rules: no contact with an obstacle or the table
                  within its episode of 16.7 s, and then within 5 cm and 15 degrees of the goal
      clearance   minimum over all scenes, of hand and fingers
      duration    of the motion, median

    --json writes more figures, and the result of each scene. Below the table: why runs were
    stopped, and what was touched.

    Every scene is on disk as soon as it is done (--results), and the same command
    resumes. A Dask cluster's workers need this package, and are best started with
    --nthreads 1.

    For example:

        drake-oa evaluate panda --scenes 20 --perception truth --method verified
        drake-oa evaluate panda --suite moving --suite elbow --jobs 2 --json changing.json
        drake-oa evaluate panda --suite drp --level floating1 --perception truth --scenes 10

    Args:
        kinds: of the scenes; may be repeated.
        levels: of drp; may be repeated.
        methods: a method, see above; may be repeated.
        scenes: how many of each kind.
        seed: of the scenes.
        perception: depth (the camera) or truth (SceneGraph).
        cameras: 2: two beside the robot, 2.1 m from the workspace's middle, in place of one.
        runs: how runs are made.
    """
    from drake_oa.evaluation.panda.evaluation import panda_suite
    from drake_oa.evaluation.panda.scenes import suite_kinds
    from drake_oa.evaluation.panda.tables import kinds_metrics

    if cameras == 2 and perception != "depth":
        raise ValueError(f"--cameras 2 needs --perception depth, not {perception}")
    sees = "depth2" if cameras == 2 else perception
    suites = [
        panda_suite(kind, scenes, seed, methods, sees, runs.duration)
        for kind in suite_kinds(kinds, levels)
    ]
    heading = f"panda: {scenes} scenes of seed {seed}"
    return run_suites(runs, suites, heading, kinds_metrics)


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
    """Run the whole robot on MotionBenchMaker's problems, of a file.

    They are those of Chamzas et al., RA-L 2022 (data BSD-3-Clause, Rice University), as VAMP's
    repository (github.com/KavrakiLab/vamp) carries them: a .tar.bz2 with folders <set>_<robot> of
    scene0001.yaml and request0001.yaml. Sets of the Panda and of the UR5: table_pick,
    table_under_pick, bookshelf_small, bookshelf_tall, bookshelf_thin, box, cage.

    The demonstration is the tool's straight minimum-jerk motion from FK(start) to
    FK(goal), 5 s, with the turn between them; the posture leads from the start's joints
    to the goal's. The obstacles are known exactly, or with --perception depth seen by two
    cameras, 1.2 m left and right of and above the middle between start and goal; what the goal
    grasps (the tool point is inside) is left out. Requested are 3 cm, or what the whole robot
    has at start and goal, and the supervisor stops no farther from obstacles.

    Success: the simulated arm ends within 1 cm and 15 degrees of the goal, no contact
    with the scene or itself, and no joint is more than 1 mrad beyond its limit. Methods:

      verified, nominal, differential_ik
                            as of `drake-oa evaluate panda`
      planner               RRT-Connect from the start's joints to the goal's, the whole
                            robot at the requested clearance from the same shapes, 200 000
                            states at most; not simulated

    --json has a block for each set, and `all`.

    For example:

        drake-oa evaluate mbm --problems motionbenchmaker_panda.tar.bz2 --scenes 6

    Args:
        problems: the file, .tar.bz2.
        robot: panda (default), ur5 (with its gripper; pip install 'drake_oa[robots]'), or a
            scenario whose robot block is of the problems' robot.
        sets: of the problems (default: all); may be repeated.
        methods: a method, see above; may be repeated.
        scenes: the first N of each set.
        perception: truth (SceneGraph) or depth (two cameras).
        runs: how runs are made.
    """
    from drake_oa.evaluation.mbm.suite import mbm_metrics, mbm_suites

    suites = mbm_suites(problems, robot, sets, methods, scenes, perception, runs.duration)
    heading = f"mbm: {sum(len(suite.drawings) for suite in suites)} problems"
    return run_suites(runs, suites, heading, mbm_metrics)


@evaluate.command
def sources(
    *,
    kinds: Annotated[tuple[str, ...], Parameter(name="--suite")] = (
        "tabletop",
        "clutter6",
        "elbow",
        "moving",
    ),
    problems: Path | None = None,
    scenes: Count = 20,
    count: Count = 10,
    seed: Seed = 0,
    runs: Runs = RUNS,
) -> int:
    """Count the sources of the executed motions, and evaluate without each of them.

    Sources: nominal (the demonstrated motion), chain (the rows of the paper's regressor chain
    together, with heading guidance), search (the local search) and
    joint_path (a path in the joints that the primitives imitate). It prints the table of `drake-oa
    evaluate panda` for `verified` and without chain, search and joint_path, and below it the
    number of scenes in which a motion of each source was executed.

    For example:

        drake-oa evaluate sources --scenes 5 --suite tabletop
        drake-oa evaluate sources --problems motionbenchmaker_panda.tar.bz2 --seed 1000

    Args:
        kinds: of the scenes of the Panda, see `drake-oa evaluate panda`, perceived by its camera.
        problems: file of MotionBenchMaker's problems, see `drake-oa evaluate mbm`.
        scenes: number of scenes of each kind.
        count: number of problems of each set.
        seed: of the scenes.
        runs: how runs are made.
    """
    from drake_oa.evaluation.mbm.suite import mbm_suites
    from drake_oa.evaluation.panda.evaluation import WITHOUT, panda_suite
    from drake_oa.evaluation.panda.tables import kinds_metrics

    methods = ("verified", *WITHOUT)
    suites = [panda_suite(kind, scenes, seed, methods, "depth", runs.duration) for kind in kinds]
    if problems is not None:
        suites += mbm_suites(problems, None, (), methods, count, "truth", runs.duration)
    heading = f"sources: seed {seed}"
    return run_suites(runs, suites, heading, kinds_metrics)


def run_suites(
    runs: Runs,
    suites: Sequence[PandaSuite],
    heading: str,
    together: Callable[[Sequence[PandaResults], Sequence[dict[str, Any]]], dict[str, Any]],
    table: Callable[[Mapping[str, Any]], TextTable] | None = None,
) -> int:
    """Runs several suites of the whole robot, and tells; returns the exit status.

    Args:
        runs: how.
        suites: the suites.
        heading: begins the line above the table.
        together: what is written of the results and figures of each.
        table: of that, what is shown; None: the table of `panda`.
    """
    if runs.jobs is not None and runs.scheduler is not None:
        raise ValueError("--jobs and --scheduler exclude each other")

    from joblib import cpu_count

    from drake_oa.evaluation.panda.evaluation import PLANNER, evaluate_panda
    from drake_oa.evaluation.panda.scenes import MOVING_KINDS, seen_by
    from drake_oa.evaluation.panda.tables import panda_metrics, panda_table
    from drake_oa.scenario.loading import parse_scenario, scenario_text

    if any(PLANNER in suite.methods for suite in suites if suite.kind not in MOVING_KINDS):
        import_extra("ompl.base", "baselines")
    beside = RESULTS if runs.json is None else runs.json.with_name(f"{runs.json.stem}.scenes")
    folder = runs.results or beside
    folders = filter(None, (folder, runs.write_scenes))
    check_outputs(runs.json, *(each / ".writable" for each in folders))
    workers = runs.scheduler or runs.jobs or cpu_count()
    results = [evaluate_panda(suite, workers=workers, folder=folder) for suite in suites]
    metrics = [panda_metrics(found, workers) for found in results]
    whole = together(results, metrics)
    replace_json(runs.json, whole)
    for found in results if runs.write_scenes else ():
        for scene, text in found.scenarios.items():
            seen = seen_by(parse_scenario(text), found.suite.perception)
            file = f"{runs.write_scenes}/{found.suite.scene_name(scene)}.scenario.yaml"
            replace_text(Path(file), scenario_text(seen))
    resumed = sum(found.resumed for found in results)
    taken = f"; {resumed} runs were on disk" if resumed else ""
    kinds = ", ".join(found.suite.kind for found in results)
    print(f"{heading}, {kinds}, {results[0].suite.perception}{taken}\n")
    all_of = [whole["all"]] if "all" in whole else []
    show(panda_table([*metrics, *all_of]) if table is None else table(whole))
    done = [run for found in results for of in found.runs.values() for run in of.values()]
    failed = [run["stop_reason"] for run in done if run["failed"]]
    if failed:
        complain(f"{len(failed)} of {len(done)} runs failed; the first: {failed[0]}")
    return FAILED if failed else 0
