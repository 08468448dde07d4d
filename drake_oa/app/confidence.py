"""`drake-oa evaluate confidence`: whether what the chain says of itself is so."""

from __future__ import annotations

from pathlib import Path

from drake_oa.app.evaluate import write_json
from drake_oa.common.console import progress_bar, show
from drake_oa.common.files import check_outputs, software_versions


def confidence(
    *,
    scenes: int = 30_000,
    suite_scenes: int = 4000,
    trials: int = 3,
    seed: int = 0,
    json: Path | None = None,
    plot: Path | None = None,
) -> None:
    """Put the probability that the chain of `regulation: !Paper` tells beside what happens.

    In new scenes of the kind that it was fitted to, inside and outside of the chain's range, the
    bare in_range beside; in the suites of one ellipsoid a scene; and in runs of the four scenarios.
    What is asked is kept where nothing is touched, the clearance short by no more than 1 % of the
    baseline and the goal missed by no more.

      calibration error  mean difference of stated probability and share kept, over ten bins
      Brier score        mean squared error of the probability

    For example:

        drake-oa evaluate confidence --seed 1000 --plot uncertainty.png --json uncertainty.json

    Args:
        scenes: of the kind that it was fitted to.
        suite_scenes: of each of novel, posed, hit and head-on.
        trials: runs of each scenario; their seeds follow each other.
        seed: of the scenes, and of the first trial.
        json: write the figures.
        plot: write the reliability plot: .png, .svg or .pdf.
    """
    from drake_oa.studies.confidence import (
        confidence_figures,
        confidence_tables,
        plot_reliability,
    )
    from drake_oa.studies.scenes.paper_method import paper_chain
    from drake_oa.studies.scenes.plots import check_plot_file

    if scenes < 1 or suite_scenes < 1 or trials < 0:
        raise ValueError(
            "--scenes and --suite-scenes must be at least 1 and --trials 0, not "
            f"{scenes}, {suite_scenes} and {trials}"
        )
    if plot is not None:
        check_plot_file(plot)
    check_outputs(json, plot)
    with progress_bar(1.0) as bar:
        whole = confidence_figures(
            paper_chain(True, "running"), scenes, suite_scenes, trials, seed, bar
        )
    whole["versions"] = dict(item.split(" ", 1) for item in software_versions())
    if json is not None:
        write_json(json, whole)
    show(*confidence_tables(whole))
    if plot is not None:
        plot_reliability(plot, whole)
