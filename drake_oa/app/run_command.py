"""The command `drake-oa run`."""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import math
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from drake_oa.app.command_line import add_scenario, add_verbose, build_errors
from drake_oa.common.console import FAILED, INTERRUPTED, TERMINATED, complain
from drake_oa.common.files import check_outputs, check_space, replace_text, reserve_file, same_file
from drake_oa.common.schema_check import ScenarioError
from drake_oa.policy.dmp import normalised_time
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario

# Diagrams and simulation are imported where they are used: `--help` answers at once.
if TYPE_CHECKING:
    from pydrake.geometry import Meshcat

    from drake_oa.runs.motion_log import MotionLog

LOG_FOLDER = Path("drake_oa_runs")
"""Where logs go that nobody named, relative to the current folder."""

_LOG_SPACE = 32 * 2**20
"""Space that a log may need [byte]; one of two motions of 20 s takes some 4 MB."""

_DESCRIPTION = """\
Simulates two motions from start to goal, the pre-planned one, blind to obstacles,
and the modulated one, bent round what perception sees, and prints for each:

  collisions       pairs of a robot link and an obstacle or the table that touched
  tool clearance   least distance of hand and fingers to an obstacle
  robot clearance  least distance of any link to an obstacle
  feasible         the asked clearance, or what start and goal leave the tool
  short by         what the tool lacked of that to what stands at rest
  goal error       distance of the tool point to the goal at the end
  saturated        share of steps in which a torque limit was reached

All of it by the true geometry, until all that moves has come to rest.

Both motions go into one log, which `drake-oa replay` shows again and `drake-oa plot`
draws: drake_oa_runs/SCENARIO-TIME.npz unless --log names another file.

Exit status: 0 when the tool of the modulated motion reached the goal (or the asked
--duration), 1 when it did not (it failed, was held for good or ran out of time), 2 for bad
input, 130 when interrupted (143 by SIGTERM); what ran until then is reported and written all
the same.
"""

_EXAMPLES = """\
A.B=C replaces field B of block A of the scenario; C is YAML, a tag swaps the block:
  --set task.clearance=0.1
  --set 'task.goal=[0.5, 0.4, 0.35]'
  --set 'perception=!GroundTruth {}'
  --set 'perception=!RecordedClouds {folder: /data/clouds, loop: true}'
A mistyped name is answered with the valid ones.
"""


def add_parser(commands: Any) -> None:
    """Adds the subcommand to those of `drake-oa`."""
    parser = commands.add_parser(
        "run",
        help="simulate a scenario and print what was kept and touched",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_scenario(parser)
    parser.add_argument("--meshcat", action="store_true", help="show it in a browser while it runs")
    parser.add_argument(
        "--html",
        type=Path,
        metavar="FILE",
        help="write the modulated motion as one page to play and pause in a browser",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the report")
    log = parser.add_mutually_exclusive_group()
    log.add_argument(
        "--log", type=Path, metavar="FILE", help="write the log here, in place of an earlier one"
    )
    log.add_argument("--no-log", action="store_true", help="write no log")
    parser.add_argument(
        "--duration", type=float, metavar="S", help="stop each motion after S simulated seconds"
    )
    add_verbose(parser)
    parser.set_defaults(action=_run)


def _run(options: argparse.Namespace) -> int:
    scenario = load_scenario(options.scenario, options.overrides)
    if options.duration is not None and not 0.0 < options.duration < math.inf:
        raise ScenarioError(f"--duration: {options.duration} must be positive [s]")
    outputs = (options.html, options.json, options.log)
    if same_file(*outputs):
        raise ScenarioError("--html, --json and --log must name different files")
    check_outputs(*outputs)
    with _log_file(options) as log_file, _stop_between_steps() as raise_if_asked:
        meshcat = _viewer(options)
        logs, failure, log_error = _simulate_both(
            options, scenario, meshcat, log_file, raise_if_asked
        )
        status = _report(options, scenario, logs)
        if log_file is not None and log_error is None:
            print(f"log: {log_file}", file=sys.stderr)
    if log_error is not None:
        complain(log_error)
        status = FAILED
    if isinstance(failure, Terminated):
        complain("terminated")
        return TERMINATED
    if isinstance(failure, KeyboardInterrupt):
        complain("interrupted")
        return INTERRUPTED
    if failure is not None:
        complain(f"cut short: {next(reversed(logs.values())).stop_reason}")
        return FAILED
    if options.meshcat:
        from drake_oa.viewing.viewer import wait_for_viewer

        wait_for_viewer()
    return status


def _scenario_name(options: argparse.Namespace) -> str:
    return Path(options.scenario).name.removesuffix(".scenario.yaml")


@contextlib.contextmanager
def _log_file(options: argparse.Namespace) -> Iterator[Path | None]:
    """The log's file: the one that was named, or one that is nobody else's."""
    if options.no_log:
        yield None
        return
    if options.log is not None:
        check_space(options.log, _LOG_SPACE)
        if options.log.is_file() and options.log.stat().st_size:
            print(f"{options.log} will be replaced by this run's log", file=sys.stderr)
        yield options.log
        return
    otherwise = "--log names another file, --no-log writes none"
    try:
        # Two runs may start within one second: whoever comes second takes another name.
        file = reserve_file(LOG_FOLDER, _scenario_name(options), ".npz")
    except ValueError as error:
        raise ValueError(f"{error}; {otherwise}") from None
    try:
        try:
            check_space(file, _LOG_SPACE)
        except ValueError as error:
            raise ValueError(f"{error}; {otherwise}") from None
        yield file
    finally:
        if file.stat().st_size == 0:
            file.unlink()


def _simulate_both(
    options: argparse.Namespace,
    scenario: Scenario,
    meshcat: Meshcat | None,
    log_file: Path | None,
    raise_if_asked: Callable[[], None],
) -> tuple[dict[str, MotionLog], BaseException | None, str | None]:
    """The logs of both motions, or of what ran until one was cut short, and by what.

    The third value says why the log could not be written, or is None.
    """
    from drake_oa.diagrams.avoidance import build_avoidance
    from drake_oa.runs.motion_log import save_logs
    from drake_oa.runs.simulation import MotionInterruptedError, simulate
    from drake_oa.viewing.viewer import recording

    with build_errors(), _quiet():
        # What the modulated motion lacks is told before the first one is simulated.
        build_avoidance(scenario)
    logs: dict[str, MotionLog] = {}
    failure: BaseException | None = None
    log_error: str | None = None
    for motion in ("preplanned", "modulated"):
        shown = meshcat if motion == "modulated" else None
        try:
            with (
                build_errors(),
                recording(shown, options.html),
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
        if log_file is not None:
            # After each motion, so that nothing is lost by what comes next.
            try:
                save_logs(log_file, logs)
                log_error = None
            except OSError as error:
                # A disk that is full by now must not cost the report as well.
                log_error = f"cannot write {log_file}: {error.strerror or error}"
        if failure is not None:
            break
    return logs, failure, log_error


def _report(options: argparse.Namespace, scenario: Scenario, logs: dict[str, MotionLog]) -> int:
    """Prints and writes the report; the status says whether all motions got there."""
    from drake_oa.runs.report import report_table, run_report

    report = run_report(_scenario_name(options), scenario, logs)
    print(report_table(report))
    if options.json:
        replace_text(options.json, json.dumps(report, indent=2) + "\n")
    ended = {"goal"}
    if options.duration is not None:
        ended.add(f"time limit of {options.duration:g} s")
    # The pre-planned motion may end at what it runs into.
    last = logs.get("modulated") or next(iter(logs.values()))
    return 0 if last.stop_reason in ended else FAILED


def _viewer(options: argparse.Namespace) -> Meshcat | None:
    if not (options.meshcat or options.html):
        return None
    from drake_oa.viewing.viewer import start_viewer

    return start_viewer(announce=options.meshcat)


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


class Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP: ends a run as Ctrl-C does."""

    def __str__(self) -> str:
        return "terminated"


@contextlib.contextmanager
def _stop_between_steps() -> Iterator[Callable[[], None]]:
    """Holds Ctrl-C and SIGTERM back until asked for, by what this yields, between two steps.

    Raised anywhere, it would also strike inside numba's and Drake's own callbacks, and
    leave them half done. A second one is raised at once.
    """
    asked: list[type[KeyboardInterrupt]] = []

    def ask(number: int, _: FrameType | None) -> None:
        kind = KeyboardInterrupt if number == signal.SIGINT else Terminated
        if asked:
            raise kind
        asked.append(kind)
        again = "Ctrl-C again: at once" if kind is KeyboardInterrupt else "terminated"
        print(f"\nstopping ({again}) ...", file=sys.stderr)

    def raise_if_asked() -> None:
        if asked:
            raise asked[0]

    # What somebody else handles, or ignores as nohup does, stays theirs.
    default = (signal.default_int_handler, signal.SIG_DFL)
    before = {
        number: signal.getsignal(number)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    }
    ours = [number for number, handler in before.items() if handler in default]
    if threading.current_thread() is not threading.main_thread():
        ours = []
    for number in ours:
        signal.signal(number, ask)
    try:
        yield raise_if_asked
    finally:
        for number in ours:
            signal.signal(number, before[number])
