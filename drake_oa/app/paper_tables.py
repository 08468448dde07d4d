"""`drake-oa evaluate table1` and so on: each table and figure of the paper, its print beside."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from drake_oa.app.evaluate import (
    RUNS,
    Methods,
    Runs,
    evaluate_points,
    run_suites,
)
from drake_oa.app.scenarios import Count, Seed
from drake_oa.common.console import show
from drake_oa.common.files import check_outputs, replace_json

# Suites, methods and kernels are imported where they are used: `--help` answers at once.


def table1(*, json: Path | None = None) -> None:
    """Print the paper's Table I: errors of the chains as shipped, the print beside.

    NMSE of the three networks of each chain, as training measured them and wrote them into the
    weights; `drake-oa train --recipe paper` trains them again.

    Args:
        json: write the figures.
    """
    from drake_oa.evaluation.paper_tables import table_one, table_one_metrics

    check_outputs(json)
    whole = table_one_metrics()
    show(*table_one(whole))
    replace_json(json, whole)


def table2(*, scenes: Count = 4000, seed: Seed = 0, json: Path | None = None) -> None:
    """Run the paper's Table II: 4 x 1,000 novel scenes, the print beside.

    What the print leaves open is read as it agrees best with it: see docs/results/paper.md.

    For example:

        drake-oa evaluate table2 --seed 1000 --json table2.json

    Args:
        scenes: how many, over all four baselines.
        seed: of the scenes.
        json: write the figures.
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
    """Run the paper's Table III: three kinds of obstacles before the whole robot.

    The scenarios paper_box, paper_irregular and paper_clutter, each with the camera's noise of
    consecutive seeds; the paper's figures stand beside. Methods: nominal, blind to obstacles,
    and paper, the paper's inference and nothing else.

    For example:

        drake-oa evaluate table3 --json table3.json

    Args:
        methods: a method, see above; may be repeated.
        trials: how many of each kind.
        seed: of the first trial's noise.
        perception: depth (the camera) or truth (SceneGraph).
        runs: how runs are made.
    """
    from drake_oa.evaluation.paper_tables import table_three, trial_suites, trials_metrics

    suites = trial_suites(methods, trials, seed, perception, runs.duration)
    heading = f"table3: {trials} trials of seed {seed}"
    return run_suites(runs, suites, heading, trials_metrics, table_three)


def figure_familiar(
    *,
    methods: Methods = ("paper",),
    scenes: Count = 100,
    json: Path | None = None,
) -> None:
    """Run the paper's figure of familiar scenes: its 100 ellipses, each in its 12 settings.

    Six models, RC(lambda') and RC(lambda', Delta) for five Delta, with tau scaled and not; the
    paper's figures stand beside. --json has "settings", and over those that ask for a clearance
    and scale tau the figures of other suites.

    For example:

        drake-oa evaluate figure_familiar --json familiar.json
        drake-oa evaluate figure_familiar --method paper --method verified

    Args:
        methods: those of `drake-oa evaluate SUITE`; may be repeated.
        scenes: how many ellipses, a square.
        json: write the figures.
    """
    notes = (
        "print: no collision in any setting; the goal within 30 mm where tau is scaled; else",
        'convergence "rapidly deteriorates" as Delta grows; clearances are drawn as boxes only',
    )
    evaluate_points("familiar", methods, scenes, None, json, notes=notes)


def figure_dead_zone(
    *,
    methods: Methods = ("original", "paper"),
    scenes: Count = 41,
    json: Path | None = None,
) -> None:
    """Run the paper's dead-zone figure: both coupling terms, and a point obstacle on the line.

    The obstacle is exactly on the line in the first scene, and 10 um to 10 cm off it in the
    others. Both terms alone, of the same peak and area, and methods that regulate them.

    For example:

        drake-oa evaluate figure_dead_zone --json dead_zone.json

    Args:
        methods: those of `drake-oa evaluate SUITE`; may be repeated.
        scenes: how many places of the obstacle.
        json: write the figures.
    """
    evaluate_points("dead-zone", methods, scenes, None, json, terms=True)
