"""Ablation of MotionGuard in random scenes with moving obstacles.

    python -m tests.regression.ablation --suite moving_hard --scenes 20 --seed 1000 \\
        --perception truth --jobs 2 --results ablation

runs `verified` and the variants below in the same scenes, and prints a table. Each run is on disk
as soon as it is done, and the same command resumes.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from drake_oa.common.console import show
from drake_oa.common.files import source_digest
from drake_oa.scenario.loading import parse_scenario, scenario_text
from drake_oa.scenario.scenario import Scenario
from drake_oa.studies.panda.evaluation import (
    SCENE_SUFFIX,
    Keeping,
    draw_text,
    evaluate_panda,
    panda_suite,
)
from drake_oa.studies.panda.tables import panda_figures, panda_table
from drake_oa.studies.results import ResultFolder

VARIANTS: dict[str, dict[str, dict[str, float]]] = {
    "all": {},
    "without claims": {"guard": {"obstacle_speed": 0.0}},
    "without contact reaction": {"guard": {"contact_error": 1.0}},
    "fixed orientation": {"task": {"turn_limit": 0.05}},
    "half the candidates": {"guard": {"candidates": 48, "refinements": 24}},
}
"""Name of a variant -> block of the scenario -> fields and their values."""


def changed(scenario: Scenario, variant: str) -> Scenario:
    """Returns the scenario with the fields of a variant."""
    blocks = VARIANTS[variant].items()
    return replace(scenario, **{of: replace(getattr(scenario, of), **to) for of, to in blocks})


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs all variants and prints their table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--suite", default="moving_hard")
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--perception", default="truth")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--results", type=Path, default=Path("drake_oa_runs/ablation"))
    given = parser.parse_args(arguments)
    texts = [draw_text(given.seed, scene, given.suite)[0] for scene in range(given.scenes)]
    found = []
    for variant in VARIANTS:
        folder = given.results / f"{given.suite}-{variant.replace(' ', '_')}"
        folder.mkdir(parents=True, exist_ok=True)
        for scene, text in enumerate(texts):
            name = f"{given.suite}-seed{given.seed}-scene{scene:04d}{SCENE_SUFFIX}"
            (folder / name).write_text(scenario_text(changed(parse_scenario(text), variant)))
        suite = panda_suite(
            given.suite, given.scenes, given.seed, ["verified"], given.perception, folder=folder
        )
        keeping = Keeping(ResultFolder(folder / "results"))
        results = evaluate_panda(suite, jobs=given.jobs, keeping=keeping)
        found.append(panda_figures(results, ()) | {"kind": variant})
        print(f"{variant}: done", flush=True)
    show(panda_table(found))
    print(f"source digest: {source_digest()[:12]}")


if __name__ == "__main__":
    main()
