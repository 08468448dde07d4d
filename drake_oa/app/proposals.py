"""`drake-oa evaluate proposals`: what the networks that lead the search are worth."""

from __future__ import annotations

import json as json_text
from functools import partial
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from drake_oa.common.console import progress_bar, show
from drake_oa.common.files import check_outputs, replace_text


def proposals(
    *,
    suites: Annotated[tuple[str, ...], Parameter(name="--suite")] = (),
    scenes: int = 1000,
    arm_scenes: int = 50,
    seed: int = 0,
    json: Path | None = None,
) -> None:
    """Compare what leads the search, at 31 roll-outs a decision, with the full search.

      trained    the network that is shipped (`drake-oa train --recipe proposals`)
      chain      the regressor chain (`--recipe project`), asked for the shadow on 24 sides
      constant   the same with a constant for what the networks of the chain say
      random     the proposal network before any training
      none       what is drawn all over the ranges

    One decision from rest a scene, one after another. In novel, posed, hit, head-on and clutter
    (see `drake-oa evaluate --help`) the whole motion is judged. In tabletop and clutter6 (see
    `drake-oa evaluate panda --help`) it is what the arm keeps of the true solids, without a path
    in the joints, which the running system looks for where no term will do.

    For example:

        drake-oa evaluate proposals --seed 1000 --json proposals.json

    Args:
        suites: a suite; may be repeated; without one, all.
        scenes: of each suite of ellipsoids.
        arm_scenes: of each suite before the arm.
        seed: of the scenes.
        json: file for the figures.
    """
    check_outputs(*([json] if json else []))
    from drake_oa.studies.proposals import ARM, ELLIPSOIDS, compare, proposals_table

    found = {}
    for suite in suites or (*ELLIPSOIDS, *ARM):
        with progress_bar(1.0) as bar:
            count = arm_scenes if suite in ARM else scenes
            found[suite] = compare(suite, count, seed, partial(bar, suite))
        show(proposals_table(suite, found[suite]))
        if json:
            told = {"seed": seed, "scenes": scenes, "arm_scenes": arm_scenes, "suites": found}
            replace_text(json, json_text.dumps(told, indent=1))
