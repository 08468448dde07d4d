"""The command `drake-oa benchmark`."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from drake_oa.app.command_line import add_verbose
from drake_oa.common.files import check_outputs, replace_text
from drake_oa.scenario.loading import load_scenario

_DESCRIPTION = """\
Times, each beside a baseline that is measured in the same run:

  rollouts      the paper's 12.5 million roll-outs of 1,000 steps, against NumPy and torch
  policy        one policy step with six obstacles, against movement_primitives' own
  verification  64 candidates rolled out among six obstacles, against the readable step
  run           the real-time factor of a scenario, against plant and camera alone, and
                what each layer takes of a simulated second
  perception    one depth image to ellipsoids, against rendering it
  thinking      the processor time of a run's decisions, against the simulated time that their
                work costs, and what that would be if it were calibrated on this run

torch and movement_primitives (pip install 'drake_oa[peers]') are used where installed.
"""

_EXAMPLES = """\
examples:
  drake-oa benchmark --json benchmark.json
  drake-oa benchmark --only rollouts --only verification
"""

PARTS = ("rollouts", "policy", "verification", "run", "perception", "thinking")
"""As in `drake_oa.benchmark.benchmark.PARTS`, which takes longer to import."""


def add_parser(commands: Any) -> None:
    """Adds the subcommand to those of `drake-oa`."""
    parser = commands.add_parser(
        "benchmark",
        help="time roll-outs, the layers and a run against baselines of the same run",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--scenario", default="tabletop_box", help="default: tabletop_box")
    parser.add_argument(
        "--only",
        action="append",
        choices=PARTS,
        metavar="PART",
        help="time this part only; may be repeated",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    add_verbose(parser)
    parser.set_defaults(action=_run)


def _run(options: argparse.Namespace) -> int:
    scenario = load_scenario(options.scenario)
    check_outputs(options.json)
    # Drake, the kernels and torch are imported where they are used: `--help` answers at once.
    from drake_oa.benchmark.benchmark import benchmark_table, run_benchmark

    figures = run_benchmark(scenario, options.only, on_part=_say)
    print(benchmark_table(figures))
    if options.json:
        replace_text(options.json, json.dumps(figures, indent=2, allow_nan=False) + "\n")
    return 0


def _say(part: str) -> None:
    print(f"timing {part} ...", file=sys.stderr)
