"""`drake-oa`: run scenarios, list them, draw their wiring, measure the layers."""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import math
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from threadpoolctl import threadpool_limits

from drake_oa import benchmark_command as benchmark
from drake_oa.command_line import BAD_INPUT, FAILED, INTERRUPTED, add_verbose, complain
from drake_oa.dmp import normalised_time
from drake_oa.experiments import command as evaluation
from drake_oa.kernel_cache import announced_compilation
from drake_oa.output_files import check_outputs, same_file
from drake_oa.scenario import Scenario, ScenarioError, load_scenario, shipped_scenarios
from drake_oa.training import command as training

# Diagrams and simulation are imported where they are used: `scenarios` and `--help`
# answer at once.
if TYPE_CHECKING:
    from pydrake.geometry import Meshcat

    from drake_oa.motion_log import MotionLog

_RECORDING_RATE = 15.0

_COMPILATION = {
    "run": "1 to 2 minutes",
    "evaluate": "1 minute",
    "train": "half a minute",
    "benchmark": "2 minutes",
}
"""About how long the kernels of a command take to compile."""

_EXAMPLES = """\
examples:
  drake-oa scenarios
  drake-oa run tabletop_box --html box.html --json box.json
  drake-oa run tabletop_box --set 'perception=!GroundTruth {}' --set task.clearance=0.1
  drake-oa run my.scenario.yaml --meshcat
  drake-oa graph tabletop_box > wiring.svg
"""

_RUN = """\
Simulates two motions from start to goal, the pre-planned one, blind to obstacles,
and the modulated one, bent round what perception sees, and prints for each:

  collisions       pairs of a robot link and an obstacle or the table that touched
  tool clearance   least distance of hand and fingers to an obstacle
  robot clearance  least distance of any link to an obstacle
  goal error       distance of the tool point to the goal at the end
  saturated        share of steps in which a torque limit was reached

Exit status: 0 when both motions reached the goal (or the asked --duration), 1 when one
did not (it failed, was held for good or ran out of time), 2 for bad input, 130 when
interrupted; what ran until then is reported and written all the same.
"""

_RUN_EXAMPLES = """\
A.B=C replaces field B of block A of the scenario; C is YAML, a tag swaps the block:
  --set task.clearance=0.1
  --set 'task.goal=[0.5, 0.4, 0.35]'
  --set 'perception=!GroundTruth {}'
  --set 'perception=!RecordedClouds {folder: /data/clouds, loop: true}'
A mistyped name is answered with the valid ones.
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
    _add_run(commands)

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
        help="print a scenario's wiring: SVG when Graphviz' dot is installed, else dot source",
        description="Prints the diagram of a scenario's modulated motion as SVG, or as Graphviz "
        "source where `dot` is not installed.",
        epilog="example:\n  drake-oa graph tabletop_box > wiring.svg\n",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _add_scenario(graph)
    add_verbose(graph)
    graph.add_argument("--depth", type=int, default=1, help="levels of nested diagrams (default 1)")
    graph.add_argument("--dot", action="store_true", help="the Graphviz source in any case")
    graph.set_defaults(action=_graph)

    benchmark.add_parser(commands)
    evaluation.add_parser(commands)
    training.add_parser(commands)
    return parser


def _add_run(commands: Any) -> None:
    run = commands.add_parser(
        "run",
        help="simulate a scenario and print what was kept and touched",
        description=_RUN,
        epilog=_RUN_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _add_scenario(run)
    run.add_argument("--meshcat", action="store_true", help="show it in a browser while it runs")
    run.add_argument(
        "--html",
        type=Path,
        metavar="FILE",
        help="write the modulated motion as one page to play and pause in a browser",
    )
    run.add_argument("--json", type=Path, metavar="FILE", help="write the report")
    run.add_argument("--log", type=Path, metavar="FILE", help="write both motions' logs (.npz)")
    run.add_argument(
        "--duration", type=float, metavar="S", help="stop each motion after S simulated seconds"
    )
    add_verbose(run)
    run.set_defaults(action=_run)


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
        help="replace a field of the scenario; may be repeated",
    )


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

    scenario = load_scenario(options.scenario, options.overrides)
    with _build_errors():
        diagram = build_avoidance(scenario)
    text = diagram.GetGraphvizString(max_depth=options.depth)
    dot = None if options.dot else shutil.which("dot")
    if dot:
        answer = subprocess.run(
            [dot, "-Tsvg"], input=text, capture_output=True, text=True, check=False
        )
        if answer.returncode != 0:
            raise OSError(f"{dot} failed ({answer.stderr.strip()}); --dot prints the source")
        text = answer.stdout
    sys.stdout.write(text)
    return 0


def _run(options: argparse.Namespace) -> int:
    scenario = load_scenario(options.scenario, options.overrides)
    if options.duration is not None and not 0.0 < options.duration < math.inf:
        raise ScenarioError(f"--duration: {options.duration} must be positive [s]")
    outputs = (options.html, options.json, options.log)
    if same_file(*outputs):
        raise ScenarioError("--html, --json and --log must name different files")
    check_outputs(*outputs)
    meshcat = _start_meshcat(options)
    with _interrupt_between_steps() as raise_if_asked:
        logs, failure = _simulate_both(options, scenario, meshcat, raise_if_asked)
        status = _report(options, scenario, logs)
    if isinstance(failure, KeyboardInterrupt):
        complain("interrupted")
        return INTERRUPTED
    if failure is not None:
        complain(f"cut short: {next(reversed(logs.values())).stop_reason}")
        return FAILED
    if options.meshcat and sys.stdin.isatty():
        with contextlib.suppress(EOFError, KeyboardInterrupt):
            input("press Enter to close the viewer ")
    return status


def _simulate_both(
    options: argparse.Namespace,
    scenario: Scenario,
    meshcat: Meshcat | None,
    raise_if_asked: Callable[[], None],
) -> tuple[dict[str, MotionLog], BaseException | None]:
    """The logs of both motions, or of what ran until one was cut short, and by what."""
    from drake_oa.diagrams.avoidance import build_avoidance
    from drake_oa.motion_log import save_logs
    from drake_oa.simulation import MotionInterruptedError, simulate

    with _build_errors(), _quiet():
        # What the modulated motion lacks is told before the first one is simulated.
        build_avoidance(scenario)
    logs: dict[str, MotionLog] = {}
    failure: BaseException | None = None
    for motion in ("preplanned", "modulated"):
        shown = meshcat if motion == "modulated" else None
        try:
            with (
                _build_errors(),
                _recording(shown, options.html),
                _progress(motion, scenario, options.duration, raise_if_asked) as on_progress,
            ):
                logs[motion] = simulate(
                    scenario,
                    modulated=motion == "modulated",
                    duration=options.duration,
                    meshcat=shown,
                    on_progress=on_progress,
                )
        except MotionInterruptedError as error:
            logs[motion], failure = error.log, error.__cause__ or error
            if options.verbose:
                logging.getLogger(__name__).info("where it happened", exc_info=True)
        if options.log:
            # After each motion, so that nothing is lost by what comes next.
            save_logs(options.log, logs)
        if failure is not None:
            break
    return logs, failure


def _report(options: argparse.Namespace, scenario: Scenario, logs: dict[str, MotionLog]) -> int:
    """Prints and writes the report; the status says whether all motions got there."""
    from drake_oa.report import report_table, run_report

    name = Path(options.scenario).name.removesuffix(".scenario.yaml")
    report = run_report(name, scenario, logs)
    print(report_table(report))
    if options.json:
        options.json.write_text(json.dumps(report, indent=2) + "\n")
    ended = {"goal"}
    if options.duration is not None:
        ended.add(f"time limit of {options.duration:g} s")
    return 0 if all(log.stop_reason in ended for log in logs.values()) else FAILED


@contextlib.contextmanager
def _build_errors() -> Iterator[None]:
    """Drake refuses a model or a camera by RuntimeError: bad input, not a bug of ours."""
    from drake_oa.simulation import MotionInterruptedError

    try:
        yield
    except MotionInterruptedError:
        raise
    except RuntimeError as error:
        raise ScenarioError(str(error)) from error


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Holds back what is logged again when the same is built to be run."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)


@contextlib.contextmanager
def _recording(meshcat: Meshcat | None, html: Path | None) -> Iterator[None]:
    """Records what is shown in the viewer, also when it is cut short, and writes the page."""
    if meshcat is None:
        yield
        return
    meshcat.DeleteRecording()
    meshcat.StartRecording(frames_per_second=_RECORDING_RATE)
    try:
        yield
    finally:
        meshcat.StopRecording()
        meshcat.PublishRecording()
        if html is not None:
            html.write_text(meshcat.StaticHtml())


@contextlib.contextmanager
def _progress(
    label: str, scenario: Scenario, duration: float | None, each_step: Callable[[], None]
) -> Iterator[Callable[[float, float], None]]:
    """A bar over the motion on a terminal; nothing when piped."""
    if not sys.stderr.isatty():
        yield lambda time, phase: each_step()
        return
    from tqdm import tqdm
    from tqdm.contrib.logging import logging_redirect_tqdm

    layout = "{desc} {percentage:3.0f}%|{bar:30}|"
    with tqdm(total=100, desc=f"{label:>10}", bar_format=layout, leave=False) as bar:

        def show(time: float, phase: float) -> None:
            each_step()
            share = normalised_time(phase, scenario.policy.alpha_k)
            if duration is not None:
                share = max(share, time / duration)
            percent = min(100, int(100.0 * share))
            if percent > bar.n:
                bar.set_description_str(f"{label:>10} {time:6.2f} s", refresh=False)
                bar.update(percent - bar.n)

        with logging_redirect_tqdm():
            yield show


@contextlib.contextmanager
def _interrupt_between_steps() -> Iterator[Callable[[], None]]:
    """Holds Ctrl-C back until it is asked for, by what this yields, between two steps.

    Raised anywhere, it would also strike inside numba's and Drake's own callbacks, and
    leave them half done. A second one is raised at once.
    """
    before = signal.getsignal(signal.SIGINT)
    asked = False

    def ask(_: int, __: object) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True
        print("\nstopping (Ctrl-C again: at once) ...", file=sys.stderr)

    def raise_if_asked() -> None:
        if asked:
            raise KeyboardInterrupt

    in_main = threading.current_thread() is threading.main_thread()
    if not in_main or before is not signal.default_int_handler:
        yield raise_if_asked
        return
    signal.signal(signal.SIGINT, ask)
    try:
        yield raise_if_asked
    finally:
        signal.signal(signal.SIGINT, before)


def _start_meshcat(options: argparse.Namespace) -> Meshcat | None:
    if not (options.meshcat or options.html):
        return None
    from pydrake.geometry import Meshcat, MeshcatParams

    # Drake's default host is every interface.
    meshcat = Meshcat(MeshcatParams(host="localhost"))
    if options.meshcat:
        print(f"viewer: {meshcat.web_url()}", file=sys.stderr)
    return meshcat


if __name__ == "__main__":
    sys.exit(main())
