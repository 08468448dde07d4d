"""Subcommands of `drake-oa evaluate` for the tables and figures of Pairet et al., RA-L 2019."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from drake_oa.app.evaluate import RUNS, Methods, Runs, evaluate_points, run_suites
from drake_oa.app.scenarios import Count, Seed
from drake_oa.common.console import show
from drake_oa.common.files import check_outputs, replace_json

# Suites, methods and kernels are imported where they are used: `--help` answers at once.


def table1(*, json: Path | None = None) -> None:
    """Print Table I of Pairet et al., RA-L 2019: errors of networks, with published values.

    A regressor chain consists of three networks that compute the parameters kappa, psi and alpha of
    a coupling term. The table of each shipped chain has a row for each network, and these columns:

      train NMSE, published   normalized mean squared error on the rows of the training set
      test NMSE, published    normalized mean squared error on the rows of the test set
      lowest NMSE             estimate of the least NMSE that any function of the network's inputs
                              can reach
      rows                    number of training and test rows

    The errors are those that the training has stored in the weights. `drake-oa train --recipe
    paper` repeats the training.

    Args:
        json: write the metrics to this file.
    """
    from drake_oa.evaluation.paper_tables import table_one, table_one_metrics

    check_outputs(json)
    whole = table_one_metrics()
    show(*table_one(whole))
    replace_json(json, whole)


def table2(*, scenes: Count = 4000, seed: Seed = 0, json: Path | None = None) -> None:
    """Reproduce Table II of Pairet et al., RA-L 2019: novel scenes, with published values.

    The scenes, 1,000 for each of four baselines (distances from start to goal), have random
    obstacles. The table has a row for each baseline, followed by a row of published values, and
    these columns:

      collisions            number of scenes in which the motion is in collision
      mean clearance [m]    mean over the scenes of the minimum clearance of a motion
      min. clearance [m]    minimum clearance over all scenes
      mean goal error [mm]  mean distance to the goal at the end of a motion
      max. goal error [mm]  maximum distance to the goal at the end of a motion
      differing metrics     metrics that differ from the published value by more than the tolerances
                            below the table

    Where the paper leaves open how scenes, motions or clearances are computed, the variant with the
    best agreement is used; see docs/results/paper.md.

    For example:

        drake-oa evaluate table2 --seed 1000 --json table2.json

    Args:
        scenes: number of scenes of all four baselines together.
        seed: seed of the scenes.
        json: write the metrics to this file.
    """
    from drake_oa.evaluation.paper_tables import evaluate_novel, table_two, table_two_metrics
    from drake_oa.evaluation.scenes.suites import draw_scenes

    check_outputs(json)
    drawn = draw_scenes("demo", scenes, seed)
    whole = table_two_metrics(evaluate_novel(drawn), drawn, seed)
    replace_json(json, whole)
    print(f"table2: {scenes} scenes of seed {seed}\n")
    show(table_two(whole))


def table3(
    *,
    methods: Methods = ("nominal", "paper"),
    trials: Count = 11,
    seed: Seed = 0,
    perception: Literal["depth", "truth"] = "depth",
    runs: Runs = RUNS,
) -> int:
    """Reproduce Table III of Pairet et al., RA-L 2019: trials with the whole robot.

    A trial is a run of the scenario paper_box, paper_irregular or paper_clutter, three kinds of
    obstacles, with its own noise of the camera. Methods: nominal, which avoids nothing, and paper,
    the paper's method, whose motions are not verified by simulation before they are executed. The
    table has a row for each kind of obstacles and method, and these columns:

      trials                           number of trials
      touched objects                  number of different objects in contact in any trial
      mean clearance [m], published    mean over the trials of the tool's minimum clearance
      trials with shortfall            number of trials with less than the requested clearance
      mean goal error [mm], published  mean distance of the tool to the goal at the end

    For example:

        drake-oa evaluate table3 --json table3.json

    Args:
        methods: method, see above; may be repeated.
        trials: number of trials of each scenario.
        seed: seed of the noise in the first trial; later ones have the following seeds.
        perception: source of the obstacles: depth (camera) or truth (SceneGraph).
        runs: options of the runs.
    """
    from drake_oa.evaluation.paper_tables import table_three, trial_suites, trials_metrics

    suites = trial_suites(methods, trials, seed, perception, runs.duration)
    heading = f"table3: {trials} trials of seed {seed}"
    return run_suites(runs, suites, heading, trials_metrics, table_three)


def figure_familiar(
    *, methods: Methods = ("paper",), scenes: Count = 100, json: Path | None = None
) -> None:
    """Reproduce the figure of familiar scenes of Pairet et al., RA-L 2019.

    Each of 100 ellipses is evaluated in 12 settings: regressor chains without requested clearance,
    RC(lambda'), and with one of five requested clearances, RC(lambda', Delta), each with and
    without temporal scaling. Tables have the columns of `drake-oa evaluate SUITE`. The first table
    has a row for each method, with metrics over the settings that have both Delta and temporal
    scaling. A further table for each method has a row for each setting; --json has these rows under
    "settings".

    For example:

        drake-oa evaluate figure_familiar --json familiar.json
        drake-oa evaluate figure_familiar --method paper --method verified

    Args:
        methods: method of `drake-oa evaluate SUITE`; may be repeated.
        scenes: number of ellipses, a square number.
        json: write the metrics to this file.
    """
    notes = (
        "published: no collision in any setting; goal error below 30 mm with temporal scaling, and",
        'without it convergence "rapidly deteriorates" with larger Delta; clearances as box plots',
    )
    evaluate_points("familiar", methods, scenes, None, json, notes=notes)


def figure_dead_zone(
    *, methods: Methods = ("original", "paper"), scenes: Count = 41, json: Path | None = None
) -> None:
    """Reproduce the dead-zone figure of Pairet et al., RA-L 2019: two coupling terms.

    The original coupling term, of Hoffmann et al., has a dead zone: it does not turn a motion that
    heads exactly for an obstacle. The paper's coupling term has none. The baseline is the line from
    start to goal. A point obstacle is exactly on it in the first scene, and 10 um to 10 cm beside
    it in the others. The first table compares both terms with equal peak and area, with a row for
    each gain gamma of the original term:

      clearance head-on: original [mm], dead-zone free [mm]
                                             minimum clearance in the first scene
      collisions: original, dead-zone free   number of scenes in collision

    The second table compares methods; its columns are those of `drake-oa evaluate SUITE`.

    For example:

        drake-oa evaluate figure_dead_zone --json dead_zone.json

    Args:
        methods: method of `drake-oa evaluate SUITE`; may be repeated.
        scenes: number of positions of the obstacle.
        json: write the metrics to this file.
    """
    evaluate_points("dead-zone", methods, scenes, None, json, terms=True)
