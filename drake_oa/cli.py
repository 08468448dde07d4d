"""`drake-oa`: run scenarios, list them, draw their wiring, measure the layers."""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import math
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from threadpoolctl import threadpool_limits

from drake_oa.scenario import ScenarioError, load_scenario, shipped_scenarios

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat

_EXAMPLES = """examples:
  drake-oa scenarios
  drake-oa run tabletop_box --html box.html --json box.json
  drake-oa run tabletop_box --set 'perception=!GroundTruth {}' --set task.clearance=0.1
  drake-oa run my.scenario.yaml --meshcat
  drake-oa graph tabletop_box > wiring.svg
"""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="drake-oa",
        description="Reactive obstacle avoidance for a manipulator, as Drake systems.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    run = commands.add_parser(
        "run",
        help="simulate a scenario and print what was kept and touched",
        description="Simulates the pre-planned motion, blind to obstacles, and then the "
        "modulated one, and prints both. Exit status: 0 when both ran to their end, "
        "1 when a motion was cut short, 2 for bad input.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _add_scenario(run)
    run.add_argument("--meshcat", action="store_true", help="show it in the browser while it runs")
    run.add_argument("--html", type=Path, metavar="FILE", help="write the recording as one page")
    run.add_argument("--json", type=Path, metavar="FILE", help="write the report")
    run.add_argument("--log", type=Path, metavar="FILE", help="write both motions' logs (.npz)")
    run.add_argument(
        "--duration", type=float, metavar="S", help="stop each motion after S simulated seconds"
    )
    run.set_defaults(action=_run)

    scenarios = commands.add_parser("scenarios", help="list the shipped scenarios")
    scenarios.set_defaults(action=_scenarios)

    graph = commands.add_parser(
        "graph",
        help="print a scenario's wiring: SVG when Graphviz' dot is installed, else dot source",
    )
    _add_scenario(graph)
    graph.add_argument("--depth", type=int, default=1, help="levels of nested diagrams (default 1)")
    graph.set_defaults(action=_graph)

    bench = commands.add_parser(
        "benchmark",
        help="time the layers and a run against Drake alone",
        description="Prints the real-time factor of a scenario, of one policy step with six "
        "obstacles and of one frame of perception, each beside a baseline in the same run.",
    )
    bench.add_argument("--scenario", default="tabletop_box", help="default: tabletop_box")
    bench.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    bench.set_defaults(action=_benchmark)
    return parser


def _add_scenario(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "scenario", metavar="SCENARIO", help="a shipped name (see `drake-oa scenarios`) or a file"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="A.B=C",
        dest="overrides",
        help="replace a field of the scenario; the value is YAML. May be repeated",
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit status."""
    logging.basicConfig(format="%(levelname)s: %(message)s", level=logging.WARNING)
    options = _parser().parse_args(arguments)
    try:
        # Many small matrices: more BLAS threads only wait for each other.
        with threadpool_limits(limits=1):
            return options.action(options)
    except (ScenarioError, ValueError, OSError) as error:
        print(f"drake-oa: error: {error}", file=sys.stderr)
        return 2


def _scenarios(_: argparse.Namespace) -> int:
    shipped = shipped_scenarios()
    width = max(map(len, shipped))
    for name in shipped:
        print(f"{name:<{width}}  {load_scenario(name).description}")
    return 0


def _graph(options: argparse.Namespace) -> int:
    from drake_oa.diagrams.avoidance import build_avoidance

    diagram = build_avoidance(load_scenario(options.scenario, options.overrides))
    source = diagram.GetGraphvizString(max_depth=options.depth)
    dot = shutil.which("dot")
    if dot:
        answer = subprocess.run(
            [dot, "-Tsvg"], input=source, capture_output=True, text=True, check=False
        )
        if answer.returncode == 0:
            source = answer.stdout
    print(source)
    return 0


@contextlib.contextmanager
def _progress(label: str, alpha_k: float) -> Iterator[Callable[[float, float], None] | None]:
    """A progress bar over normalised time on a terminal; nothing when piped."""
    if not sys.stderr.isatty():
        yield None
        return
    from tqdm import tqdm

    with tqdm(total=100, desc=label, unit="%", bar_format="{l_bar}{bar}| {postfix}") as bar:

        def show(time: float, phase: float) -> None:
            share = int(-100.0 * math.log(max(phase, 1e-300)) / alpha_k)
            if share > bar.n:
                bar.set_postfix_str(f"t = {time:.2f} s", refresh=False)
                bar.update(share - bar.n)

        yield show


def _run(options: argparse.Namespace) -> int:
    from drake_oa.motion_log import save_logs
    from drake_oa.report import report_table, run_report
    from drake_oa.simulation import MotionInterruptedError, simulate

    if options.duration is not None and not options.duration > 0.0:
        raise ScenarioError(f"--duration: {options.duration} must be positive [s]")
    scenario = load_scenario(options.scenario, options.overrides)
    name = Path(options.scenario).name.removesuffix(".scenario.yaml")
    meshcat = _start_meshcat(options)
    logs = {}
    failure: MotionInterruptedError | None = None
    for motion in ("preplanned", "modulated"):
        shown = meshcat if motion == "modulated" else None
        try:
            with _progress(motion, scenario.policy.alpha_k) as show:
                logs[motion] = simulate(
                    scenario,
                    modulated=motion == "modulated",
                    duration=options.duration,
                    meshcat=shown,
                    on_progress=show,
                )
        except MotionInterruptedError as error:
            logs[motion], failure = error.log, error
        if options.log:
            # Written after each motion, so that nothing is lost by what comes next.
            options.log.parent.mkdir(parents=True, exist_ok=True)
            save_logs(options.log, logs)
        if failure is not None:
            break
    if meshcat is not None and options.html:
        options.html.parent.mkdir(parents=True, exist_ok=True)
        options.html.write_text(meshcat.StaticHtml())
    report = run_report(name, scenario, logs)
    print(report_table(report))
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(report, indent=2) + "\n")
    if failure is not None:
        print(f"drake-oa: error: cut short: {failure}", file=sys.stderr)
        return 1
    if options.meshcat and sys.stdin.isatty():
        input("press Enter to close the viewer ")
    return 0


def _start_meshcat(options: argparse.Namespace) -> Meshcat | None:
    if not (options.meshcat or options.html):
        return None
    from pydrake.geometry import Meshcat, MeshcatParams

    # Drake's default host is every interface.
    meshcat = Meshcat(MeshcatParams(host="localhost"))
    if options.meshcat:
        print(f"viewer: {meshcat.web_url()}", file=sys.stderr)
    return meshcat


def _benchmark(options: argparse.Namespace) -> int:
    from drake_oa.benchmark import benchmark_table, run_benchmark

    figures = run_benchmark(load_scenario(options.scenario))
    print(benchmark_table(figures))
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(figures, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
