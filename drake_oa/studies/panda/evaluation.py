"""Methods on random scenes of the Panda: drawn and run in parallel, kept one by one."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any, ClassVar

from pydrake.geometry import Meshcat

from drake_oa.common.files import replace_text
from drake_oa.runs.motion_log import MotionLog, save_logs
from drake_oa.scenario.loading import parse_scenario, scenario_text
from drake_oa.scenario.scenario import Scenario
from drake_oa.studies.panda.run import (
    PLANNER,
    TRUTH_ONLY,
    Criteria,
    check_panda_method,
    run_and_judge,
)
from drake_oa.studies.panda.scenes import (
    GENERATOR,
    MOVING_KINDS,
    check_kind,
    check_perception,
    draw_panda_scene,
)
from drake_oa.studies.parallel import Call
from drake_oa.studies.results import ResultFolder, Task, content_key, resumed
from drake_oa.studies.tally import Counts, Tally

Drawing = Callable[..., tuple[str, Counts]]
"""Makes a scenario's text, and tells what was dropped while it was drawn."""

_WARM_UP = 0.02
"""Simulated time in which all kernels of a method are used once [s]."""


@dataclass(frozen=True)
class PandaSuite:
    """What is evaluated.

    Attributes:
        scenes: how many.
        seed: of the scenes.
        methods: names, see `panda_run`.
        perception: "depth" or "truth".
        kind: of the scenes, see `panda_scenes`.
        duration: time limit of a run [s]; None: that of `simulate`.

    Raises:
        ValueError: for no scenes, a negative seed, an unknown name or a limit that is
            not positive.
    """

    name: ClassVar[str] = "panda"
    scenes: int
    seed: int
    methods: tuple[str, ...]
    perception: str = "depth"
    kind: str = "tabletop"
    duration: float | None = None

    def __post_init__(self) -> None:
        if self.scenes < 1:
            raise ValueError(f"--scenes must be at least 1, not {self.scenes}")
        if self.seed < 0:
            raise ValueError(f"--seed must be 0 or more, not {self.seed}")
        if self.duration is not None and not 0.0 < self.duration < float("inf"):
            raise ValueError(f"--duration must be positive [s], not {self.duration}")
        self._check_kind()
        check_perception(self.perception)
        for method in self.methods:
            check_panda_method(method)
        if PLANNER in self.methods and self.kind in MOVING_KINDS:
            raise ValueError(
                f"--method {PLANNER}: plans among obstacles at rest, those of {self.kind} move; "
                "valid kinds: tabletop, elbow, clutter6"
            )

    def _check_kind(self) -> None:
        check_kind(self.kind)

    @property
    def numbers(self) -> Sequence[int]:
        """Of the scenes."""
        return range(self.scenes)

    @property
    def criteria(self) -> Criteria:
        """What runs are judged by."""
        return Criteria()

    def scene_name(self, scene: int) -> str:
        """Name of a scene's files."""
        return f"{self.kind}-seed{self.seed}-scene{scene:04d}"

    def drawing(self, scene: int) -> tuple[Drawing, tuple[Any, ...]]:
        """What draws a scene, and its arguments, on which alone that depends."""
        return draw_text, (self.seed, scene, self.kind)

    def perception_of(self, method: str) -> str:
        """What a method sees by."""
        return "truth" if method in TRUTH_ONLY else self.perception


@dataclass
class PandaResults:
    """What is known so far.

    Attributes:
        suite: what is evaluated.
        scenarios: scene -> the scenario's text, as it was drawn.
        tallies: scene -> what was dropped while it was drawn, see `tally`.
        runs: method -> scene -> result, see `run_and_judge`.
        resumed: results that were on disk.
        interrupted: whether it was ended by an interrupt.
    """

    suite: PandaSuite
    scenarios: dict[int, str] = field(default_factory=dict)
    tallies: dict[int, Counts] = field(default_factory=dict)
    runs: dict[str, dict[int, dict[str, Any]]] = field(default_factory=dict)
    resumed: int = 0
    interrupted: bool = False

    def complete(self, method: str) -> bool:
        """Whether a method has run on all scenes."""
        return len(self.runs.get(method, {})) == self.suite.scenes


@dataclass(frozen=True)
class Keeping:
    """What is kept, and where; None: nowhere.

    Attributes:
        folder: for the results, which an evaluation resumes from.
        logs: for the log of each run (.npz).
        pages: for a page of each run of `page_methods` to play in a browser (.html).
        page_methods: names of methods.
    """

    folder: ResultFolder | None = None
    logs: Path | None = None
    pages: Path | None = None
    page_methods: frozenset[str] = frozenset()

    def files(self, name: str, method: str) -> list[Path]:
        """The files that a run is to leave besides its result; the planner has no run."""
        if method == PLANNER:
            return []
        found = [] if self.logs is None else [self.logs / f"{name}.npz"]
        if self.pages is not None and method in self.page_methods:
            found.append(self.pages / f"{name}.html")
        return found


def evaluate_panda(
    suite: PandaSuite,
    *,
    jobs: int = 1,
    scheduler: str | None = None,
    keeping: Keeping | None = None,
    on_progress: Callable[[str, int], None] | None = None,
) -> PandaResults:
    """Draws the scenes and runs each method on each.

    A result on disk whose key is that of the scene, the method and the present source is
    taken; all others are made, and written as soon as each is done. Where a log or a page
    is asked for and is not there, the run is made anew.

    Args:
        suite: what to evaluate.
        jobs: processes at once.
        scheduler: address of a Dask scheduler to send the work to instead.
        keeping: what to keep.
        on_progress: called with what was done and how many of it.

    Returns:
        All results; after an interrupt those that were finished, with `interrupted`.

    Raises:
        ValueError: if the scheduler cannot be reached.
        RuntimeError: if a scene cannot be drawn.
    """
    keeping = keeping or Keeping()
    on_progress = on_progress or (lambda what, count: None)
    results = PandaResults(suite, runs={method: {} for method in suite.methods})
    results_of = partial(resumed, folder=keeping.folder, jobs=jobs, scheduler=scheduler)
    try:
        for scene, drawn, _, _ in results_of(_draw, _drawing_tasks(suite)):
            results.scenarios[scene], results.tallies[scene] = drawn["scenario"], drawn["tally"]
            on_progress("scenes drawn", 1)
        tasks = _run_tasks(results, keeping)
        for place, result, log, known in results_of(run_text, tasks, prepare=_compile_kernels):
            scene, method = place
            results.runs[method][scene] = result
            results.resumed += known
            if log is not None:
                _write_files(tasks[place].files, log)
            on_progress(method, 1)
    except KeyboardInterrupt:
        results.interrupted = True
    results.scenarios = dict(sorted(results.scenarios.items()))
    results.runs = {method: dict(sorted(runs.items())) for method, runs in results.runs.items()}
    return results


def run_name(suite: PandaSuite, scene: int, method: str) -> str:
    """Name of a run's files: that of the scene, the method and what it sees by."""
    return f"{suite.scene_name(scene)}-{method}-{suite.perception_of(method)}"


def _drawing_tasks(suite: PandaSuite) -> dict[int, Task]:
    tasks = {}
    for scene in suite.numbers:
        draw, arguments = suite.drawing(scene)
        key = content_key("scene", GENERATOR, draw.__name__, repr(arguments))
        tasks[scene] = Task(suite.scene_name(scene), key, (draw, arguments))
    return tasks


def _draw(draw: Drawing, arguments: tuple[Any, ...]) -> tuple[dict[str, Any], None]:
    text, counts = draw(*arguments)
    return {"scenario": text, "tally": counts}, None


def _run_tasks(results: PandaResults, keeping: Keeping) -> dict[tuple[int, str], Task]:
    """(scene, method) -> its run."""
    suite, tasks = results.suite, {}
    for scene, text in sorted(results.scenarios.items()):
        for method in suite.methods:
            sees, name = suite.perception_of(method), run_name(suite, scene, method)
            key = content_key("run", text, method, sees, suite.duration, repr(suite.criteria))
            files = tuple(keeping.files(name, method))
            call = (text, method, sees, suite.duration, bool(files), suite.criteria)
            tasks[scene, method] = Task(name, key, call, files)
    return tasks


def _write_files(files: Sequence[Path], log: MotionLog) -> None:
    """Writes a run's log and page; a log without an instant has no page."""
    for file in files:
        file.parent.mkdir(parents=True, exist_ok=True)
        if file.suffix == ".npz":
            save_logs(file, {log_name(log): log})
        elif len(log.t):
            _write_page(file, log)


def log_name(log: MotionLog) -> str:
    """Name of a motion in a log file."""
    return "modulated" if log.modulated else "preplanned"


def _write_page(path: Path, log: MotionLog) -> None:
    """Replays a log into a page to play and pause in a browser."""
    from pydrake.systems.analysis import Simulator

    from drake_oa.runs.replay import build_replay
    from drake_oa.viewing.viewer import recording

    meshcat = _viewer()
    meshcat.Delete()
    diagram = build_replay(parse_scenario(log.scenario), log, meshcat)
    with recording(meshcat):
        Simulator(diagram).AdvanceTo(log.simulated_time)
    replace_text(path, meshcat.StaticHtml())


@cache
def _viewer() -> Meshcat:
    from drake_oa.viewing.viewer import start_viewer

    return start_viewer(browser=False)


def _compile_kernels(calls: Sequence[Call]) -> None:
    """Runs the beginning of a scene by each method, so that the workers need not compile."""
    for text, method, sees, *_, criteria in {call[1]: call for call in calls}.values():
        if method != PLANNER:
            run_text(text, method, sees, _WARM_UP, False, criteria)


def draw_text(seed: int, scene: int, kind: str) -> tuple[str, Counts]:
    """A scene's scenario as text, and what was dropped while it was drawn."""
    tally = Tally()
    return scenario_text(draw_panda_scene(seed, scene, kind=kind, tally=tally)), tally.counts


def run_text(
    text: str,
    method: str,
    perception: str,
    duration: float | None,
    wants_log: bool,
    criteria: Criteria,
) -> tuple[dict[str, Any], MotionLog | None]:
    """Runs a scenario's text; the result, and the log if it is wanted."""
    with _quiet():
        scenario: Scenario = parse_scenario(text)
        run = run_and_judge(scenario, method, perception, duration=duration, criteria=criteria)
    return run.result, run.log if wants_log else None


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Holds back the notes of a run: they are in its result."""
    loggers = {logging.getLogger("drake_oa"): logging.ERROR}
    loggers[logging.getLogger("drake")] = logging.WARNING
    before = {logger: logger.level for logger in loggers}
    for logger, level in loggers.items():
        logger.setLevel(level)
    try:
        yield
    finally:
        for logger, level in before.items():
            logger.setLevel(level)
