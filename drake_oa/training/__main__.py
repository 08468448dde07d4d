"""`python -m drake_oa.training`: explores, trains, validates and writes the weights."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from tqdm import tqdm

from drake_oa.provenance import source_commit
from drake_oa.regressor import save_chain
from drake_oa.training.chain import Score, train_chain
from drake_oa.training.dataset import Exploration, build_training_set
from drake_oa.training.levenberg_marquardt import Schedule
from drake_oa.training.validation import Validation, validate


def main(arguments: list[str] | None = None) -> int:
    """Trains the regressor chain and prints how good it is."""
    parser = argparse.ArgumentParser(
        prog="python -m drake_oa.training",
        description="Trains the regressor chain on roll-outs of the action level.",
    )
    parser.add_argument(
        "--out", type=Path, required=True, help="weights file, .npz or .safetensors"
    )
    parser.add_argument("--seed", type=int, default=0, help="of scatter, split and first weights")
    parser.add_argument(
        "--iterations", type=int, default=Schedule.iterations, help="steps a network at most"
    )
    options = parser.parse_args(arguments)
    if options.out.suffix not in (".npz", ".safetensors"):
        parser.error(f"--out must end in .npz or .safetensors, not {options.out.name!r}")
    if options.iterations < 1:
        parser.error(f"--iterations must be at least 1, not {options.iterations}")

    begin = time.perf_counter()
    exploration = Exploration()
    with _Bar() as bar:
        rows = build_training_set(exploration, options.seed, bar.to)
        explored = time.perf_counter()
        chain, scores = train_chain(
            rows,
            exploration,
            options.seed,
            Schedule(iterations=options.iterations),
            commit=source_commit(),
            progress=lambda name, k, _: bar.to(f"train {name}", (k + 1) / options.iterations),
        )
    end = time.perf_counter()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    save_chain(chain, options.out)
    print(
        f"{rows.rollouts:,} roll-outs in {explored - begin:.0f} s, "
        f"trained in {end - explored:.0f} s, seed {options.seed}\n"
    )
    print(score_table(scores))
    print()
    print(
        validation_table(
            {
                "on the baseline": validate(chain),
                "up to 0.2 L beside it": validate(chain, beside=0.2),
            }
        )
    )
    print(f"\nwritten: {options.out}")
    return 0


def score_table(scores: list[Score]) -> str:
    """Markdown table of the networks' normalised mean squared errors."""
    lines = ["| target | NMSE train | NMSE test | rows |", "|---|---|---|---|"]
    lines += [f"| ln {s.target} | {s.train:.2g} | {s.test:.2g} | {s.rows:,} |" for s in scores]
    return "\n".join(lines)


def validation_table(outcomes: dict[str, Validation]) -> str:
    """Markdown table of what the proposals did when rolled out; lengths in mm a metre."""
    lines = [
        "| centre | scenes | contacts | kept | excess worst | excess mean "
        "| goal within 2 mm | goal worst | path ratio |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {name} | {v.scenes:,} | {v.contacts} | {v.kept:.2%} | {1e3 * v.excess_least:.1f} "
        f"| {1e3 * v.excess_mean:.1f} | {v.arrived:.1%} | {1e3 * v.goal_error_largest:.1f} "
        f"| {v.length_mean:.3f} |"
        for name, v in outcomes.items()
    ]
    return "\n".join(lines)


class _Bar:
    """One progress bar a stage, on a terminal only."""

    def __init__(self) -> None:
        self._bar: tqdm | None = None
        self._stage = ""

    def __enter__(self) -> _Bar:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def to(self, stage: str, fraction: float) -> None:
        if stage != self._stage:
            if self._bar is not None:
                self._bar.close()
            self._stage = stage
            self._bar = tqdm(
                total=100,
                desc=stage,
                disable=not sys.stderr.isatty(),
                bar_format="{desc:12} {percentage:3.0f}% |{bar}| {remaining} left",
            )
        if self._bar is not None:
            self._bar.update(100.0 * fraction - self._bar.n)


if __name__ == "__main__":
    sys.exit(main())
