"""Ablation study of MotionGuard in random scenes with moving obstacles.

    python -m tests.regression.ablation --suite moving_hard --scenes 20 --seed 1000 \\
        --perception truth --jobs 2 --results ablation

runs `verified` and the variants below in the same scenes, and prints a table. Each result is stored
on completion, and the same command resumes an interrupted ablation.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from drake_oa.common.console import show
from drake_oa.common.files import source_digest
from drake_oa.evaluation.panda.evaluation import evaluate_panda, panda_suite
from drake_oa.evaluation.panda.scenes import draw_panda_scene
from drake_oa.evaluation.panda.tables import panda_metrics, panda_table
from drake_oa.scenario.loading import scenario_text

VARIANTS: dict[str, dict[str, dict[str, float]]] = {
    "unchanged": {},
    "without claims": {"guard": {"obstacle_speed": 0.0}},
    "without contact reaction": {"guard": {"contact_error": 1.0}},
    "fixed orientation": {"task": {"turn_limit": 0.05}},
    "half the candidates": {"guard": {"candidates": 48, "refinements": 24}},
}
"""Name of a variant -> block of the scenario -> changed fields and their values."""


def variant_text(seed: int, index: int, kind: str, variant: str) -> str:
    """Draws a scene and returns its text with the changed fields of a variant."""
    scenario, blocks = draw_panda_scene(seed, index, kind=kind), VARIANTS[variant].items()
    fields = {of: replace(getattr(scenario, of), **to) for of, to in blocks}
    return scenario_text(replace(scenario, **fields))


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs all variants and prints their table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--suite", default="moving_hard")
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--perception", default="truth")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--results", type=Path, default=Path("drake_oa_runs/ablation"))
    options = parser.parse_args(arguments)
    suite = panda_suite(
        options.suite, options.scenes, options.seed, ["verified"], options.perception
    )
    metrics = []
    for variant in VARIANTS:
        drawings = {
            scene: partial(variant_text, *draw.args, variant)
            for scene, draw in suite.drawings.items()
        }
        of_variant = replace(suite, drawings=drawings)
        folder = options.results / f"{options.suite}-{variant.replace(' ', '_')}"
        results = evaluate_panda(of_variant, workers=options.jobs, folder=folder)
        metrics.append(panda_metrics(results) | {"kind": variant})
        print(f"{variant}: completed", flush=True)
    show(panda_table(metrics))
    print(f"source digest: {source_digest()[:12]}")


if __name__ == "__main__":
    main()
