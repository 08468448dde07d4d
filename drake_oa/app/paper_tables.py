"""`drake-oa evaluate table1` and so on: each table and figure of the paper, its print beside."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from drake_oa.app.evaluate import (
    RUNS,
    Methods,
    Runs,
    counted,
    drawn_scenes,
    evaluated,
    evaluation_status,
    load_methods,
    run_suites,
)
from drake_oa.common.console import show
from drake_oa.common.files import check_outputs, check_plot_file, replace_json
from drake_oa.studies.scenes.reading import READING, Reading

# Suites, methods and kernels are imported where they are used: `--help` answers at once.
if TYPE_CHECKING:
    from drake_oa.common.messages import FloatArray
    from drake_oa.studies.scenes.evaluation import Outcome
    from drake_oa.studies.scenes.scenes import Motions, Scenes


Level = Annotated[Reading, Parameter(name="*")]
"""Reading of the action level, each field an option."""


def table1(*, json: Path | None = None) -> int:
    """Print the paper's Table I: errors of the chains as shipped, the print beside.

    NMSE of the three networks of each chain, as training measured them and wrote them into the
    weights; `drake-oa train --recipe paper` trains them again.

    Args:
        json: write the figures.
    """
    from drake_oa.common.files import software_versions
    from drake_oa.studies.paper_tables import table_one, table_one_figures

    check_outputs(json)
    whole = table_one_figures(software_versions())
    show(*table_one(whole))
    replace_json(json, whole)
    return 0


def table2(
    *,
    scenes: int = 4000,
    seed: int = 0,
    sampling: Literal["printed", "demo", "narrow", "near"] = "demo",
    distance: Literal["plane", "space"] = "plane",
    level: Level = READING,
    ablation: bool = False,
    json: Path | None = None,
) -> int:
    """Run the paper's Table II: 4 x 1,000 novel scenes, the print beside.

    What the print leaves open are options; by default they are as they agree best with it.

    For example:

        drake-oa evaluate table2 --seed 1000 --ablation --json table2.json
        drake-oa evaluate table2 --sampling printed --law printed --tau extreme --time tau

    Args:
        scenes: how many, over all four baselines.
        seed: of the scenes.
        sampling: where obstacles are along the baseline. printed: 5 cm from both ends to their
            own extent; demo: to that of the longest, as in the released demo program; narrow: so,
            and within 0.2 m aside, as there, not 0.4; near: as demo, with straight lines that come
            nearer than 0.10 m, not 0.15.
        distance: where the clearance is taken: in the P-plane, to the section, or in space.
        level: how the action level is read.
        ablation: after these, every other reading of one option at a time.
        json: write the figures, after every reading.
    """
    from drake_oa.common.files import software_versions
    from drake_oa.studies.paper_tables import (
        Choice,
        choices,
        judge_choice,
        table_two,
        table_two_figures,
    )

    check_outputs(json)
    choice = Choice(sampling=sampling, distance=distance, reading=level)
    chosen = choices(choice, ablation)
    samplings = dict.fromkeys(of.sampling for of in chosen.values())
    drawn: dict[str, Scenes] = {name: drawn_scenes(name, scenes, seed) for name in samplings}
    versions = software_versions()
    outcomes: dict[str, Outcome] = {}
    with counted(scenes * len(chosen)) as progress:
        for name, of in chosen.items():
            evaluation = judge_choice(name, of, drawn[of.sampling], progress)
            outcomes |= evaluation.outcomes
            whole = table_two_figures(chosen, outcomes, drawn, seed, versions)
            replace_json(json, whole)
            if evaluation.interrupted:
                break
    print(f"table2: {scenes} scenes of seed {seed}\n")
    show(*table_two(whole))
    return evaluation_status(type(evaluation)(outcomes, evaluation.interrupted))


def table3(
    *,
    methods: Methods = ("preplanned", "paper"),
    trials: int = 11,
    seed: int = 0,
    perception: Literal["depth", "truth"] = "depth",
    runs: Runs = RUNS,
) -> int:
    """Run the paper's Table III: three kinds of obstacles before the whole robot.

    The scenarios paper_box, paper_irregular and paper_clutter, each with the camera's noise of
    consecutive seeds; the paper's figures stand beside. Methods: preplanned, blind to obstacles,
    and paper, the paper's regulation and nothing else.

    For example:

        drake-oa evaluate table3 --json table3.json

    Args:
        methods: a method, see above; may be repeated.
        trials: how many of each kind.
        seed: of the first trial's noise.
        perception: depth (the camera) or truth (SceneGraph).
        runs: how runs are made.
    """
    from drake_oa.studies.paper_tables import table_three, trial_suites, trials_figures

    suites = trial_suites(methods, trials, seed, perception, runs.duration)
    heading = f"table3: {trials} trials of seed {seed}"
    return run_suites(runs, suites, heading, trials_figures, table_three)


def figure_familiar(
    *,
    methods: Methods = ("paper",),
    scenes: int = 100,
    level: Level = READING,
    json: Path | None = None,
    plot: Path | None = None,
) -> int:
    """Run the paper's figure of familiar scenes: its 100 ellipses, each in its 12 settings.

    Six models, RC(lambda') and RC(lambda', Delta) for five Delta, with tau scaled and not; the
    paper's figures stand beside. --json has "settings", and over those that ask for a clearance
    and scale tau the figures of other suites; --plot draws the paper's boxes.

    For example:

        drake-oa evaluate figure_familiar --plot familiar.png
        drake-oa evaluate figure_familiar --method paper --method verified

    Args:
        methods: those of `drake-oa evaluate SUITE`; may be repeated.
        scenes: how many ellipses, a square.
        level: how the method `paper` reads its action level.
        json: write the figures.
        plot: write the figure: .png, .svg or .pdf.
    """
    from drake_oa.studies.plots import plot_familiar
    from drake_oa.studies.scenes.evaluation import familiar_tables
    from drake_oa.studies.scenes.paper_method import paper_chain, run
    from drake_oa.studies.scenes.suites import find_suite

    suite = "familiar"
    chosen = load_methods(methods)
    if "paper" in chosen:
        paper_chain(False, level.chain)
        chosen["paper"] = partial(run, reading=level)
    check_plot_file("--plot", plot)
    check_outputs(json, plot)
    drawn, cases = drawn_scenes(suite, scenes, 0), find_suite(suite).cases
    evaluation, figures = evaluated(suite, None, drawn, cases, chosen, json)
    print(f"figure_familiar: {len(drawn)} ellipses in {len(cases)} settings\n")
    show(*familiar_tables(figures))
    if plot is not None:
        plot_familiar(plot, cases, evaluation.outcomes)
    return evaluation_status(evaluation)


def figure_dead_zone(
    *,
    methods: Methods = ("original", "paper"),
    scenes: int = 41,
    json: Path | None = None,
    plot: Path | None = None,
) -> int:
    """Run the paper's dead-zone figure: both coupling terms, and a point obstacle on the line.

    The obstacle is exactly on the line in the first scene, and 10 um to 10 cm off it in the
    others. Both terms alone, of the same peak and area, and methods that regulate them.

    For example:

        drake-oa evaluate figure_dead_zone --plot dead_zone.png

    Args:
        methods: those of `drake-oa evaluate SUITE`; may be repeated.
        scenes: how many places of the obstacle.
        json: write the figures.
        plot: write the figure: .png, .svg or .pdf.
    """
    from drake_oa.studies.plots import plot_dead_zone
    from drake_oa.studies.scenes.evaluation import (
        compare_terms,
        evaluation_tables,
        term_figures,
        term_table,
    )
    from drake_oa.studies.scenes.suites import find_suite

    suite = "dead-zone"
    chosen = load_methods(methods)
    check_plot_file("--plot", plot)
    check_outputs(json, plot)
    drawn = drawn_scenes(suite, scenes, 0)
    terms = compare_terms(drawn)
    more = {"terms": term_figures(terms)}
    paths: dict[str, FloatArray] = {}

    def keep_paths(name: str, motions: Motions) -> None:
        paths.setdefault(name, motions.path)

    evaluation, figures = evaluated(
        suite, None, drawn, find_suite(suite).cases, chosen, json, on_motions=keep_paths, more=more
    )
    print(f"figure_dead_zone: a point obstacle in {len(drawn)} places\n")
    show(term_table(more["terms"]), *evaluation_tables(figures))
    if plot is not None:
        plot_dead_zone(plot, drawn, evaluation.outcomes, paths, terms)
    return evaluation_status(evaluation)
