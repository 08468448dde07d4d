"""`drake-oa`: run scenarios, list them, draw their wiring, measure the layers."""

from __future__ import annotations

import argparse
import logging
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from importlib.metadata import version

from threadpoolctl import threadpool_limits

from drake_oa.app import benchmark_command as benchmark
from drake_oa.app import evaluate as evaluation
from drake_oa.app import perceive_command, plot_command, replay_command, run_command
from drake_oa.app import train as training
from drake_oa.app.command_line import add_scenario, add_verbose, build_errors
from drake_oa.common.console import BAD_INPUT, FAILED, INTERRUPTED, complain
from drake_oa.common.kernel_cache import announced_compilation
from drake_oa.common.schema_check import ScenarioError
from drake_oa.scenario.loading import load_scenario, shipped_scenarios

_COMPILATION = {
    "run": "2 to 4 minutes",
    "evaluate": "2 to 4 minutes",
    "train": "half a minute",
    "benchmark": "2 minutes",
    "perceive": "half a minute",
}
"""About how long the kernels of a command take to compile."""

_EXAMPLES = """\
examples:
  drake-oa scenarios
  drake-oa run tabletop_box --html box.html --json box.json
  drake-oa run tabletop_box --set 'perception=!GroundTruth {}' --set task.clearance=0.1
  drake-oa run my.scenario.yaml --meshcat
  drake-oa replay drake_oa_runs/tabletop_box-20250131T120000Z.npz --meshcat
  drake-oa plot drake_oa_runs/tabletop_box-20250131T120000Z.npz
  drake-oa graph tabletop_box > wiring.svg
"""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="drake-oa",
        description="Reactive obstacle avoidance for a manipulator, as Drake systems.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    versions = f"drake-oa {version('drake_oa')} (drake {version('drake')})"
    parser.add_argument("--version", action="version", version=versions)
    parser.set_defaults(verbose=False)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    run_command.add_parser(commands)
    replay_command.add_parser(commands)
    plot_command.add_parser(commands)

    scenarios = commands.add_parser(
        "scenarios",
        help="list the shipped scenarios",
        description="Lists the shipped scenarios. --files prints where they are: copy one to "
        "start a scenario of your own.",
    )
    scenarios.add_argument("--files", action="store_true", help="print the files' paths instead")
    scenarios.set_defaults(action=_scenarios)

    graph = commands.add_parser(
        "graph",
        help="print a scenario's wiring as SVG, by Graphviz' dot, or as dot source",
        description="Prints the diagram of a scenario's modulated motion as SVG, which takes "
        "`dot` of Graphviz, or with --dot as Graphviz source, which takes nothing.",
        epilog="example:\n  drake-oa graph tabletop_box > wiring.svg\n",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_scenario(graph)
    add_verbose(graph)
    graph.add_argument("--depth", type=int, default=1, help="levels of nested diagrams (default 1)")
    graph.add_argument("--dot", action="store_true", help="print the Graphviz source")
    graph.set_defaults(action=_graph)

    perceive_command.add_parser(commands)
    benchmark.add_parser(commands)
    evaluation.add_parser(commands)
    training.add_parser(commands)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit status."""
    options = _parser().parse_args(arguments)
    level = logging.INFO if options.verbose else logging.WARNING
    logging.basicConfig(format="%(levelname)s: %(message)s", level=level)
    logging.getLogger("drake").setLevel(level)
    try:
        # Many small matrices: more BLAS threads only wait for each other.
        with threadpool_limits(limits=1), announced_compilation(_COMPILATION.get(options.command)):
            status: int = options.action(options)
            sys.stdout.flush()
            return status
    except BrokenPipeError:
        # Whoever read our output has seen enough. Python flushes once more at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except (ScenarioError, ValueError, OSError) as error:
        if options.verbose:
            logging.getLogger(__name__).info("where it happened", exc_info=True)
        complain(str(error))
        return BAD_INPUT
    except KeyboardInterrupt:
        complain("interrupted")
        return INTERRUPTED


def _scenarios(options: argparse.Namespace) -> int:
    shipped = shipped_scenarios()
    width = max(map(len, shipped))
    for name, path in shipped.items():
        print(f"{name:<{width}}  {path if options.files else load_scenario(name).description}")
    return 0


def _graph(options: argparse.Namespace) -> int:
    from drake_oa.diagrams.avoidance import build_avoidance

    if options.depth < 0:
        raise ValueError(f"--depth must be at least 0, not {options.depth}")
    scenario = load_scenario(options.scenario, options.overrides)
    dot = None if options.dot else shutil.which("dot")
    if dot is None and not options.dot:
        raise ValueError(
            "an SVG takes Graphviz, whose `dot` is not on the PATH; --dot prints the source"
        )
    with build_errors():
        diagram = build_avoidance(scenario)
    text = diagram.GetGraphvizString(max_depth=options.depth)
    if dot:
        answer = subprocess.run(
            [dot, "-Tsvg"], input=text, capture_output=True, text=True, check=False
        )
        if answer.returncode != 0:
            raise OSError(f"{dot} failed ({answer.stderr.strip()}); --dot prints the source")
        text = answer.stdout
    sys.stdout.write(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
