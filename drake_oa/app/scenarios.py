"""`drake-oa scenarios` and `drake-oa graph`, and what commands share that take a scenario."""

from __future__ import annotations

import contextlib
import logging
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from drake_oa.common.console import TextTable, show

Overrides = Annotated[tuple[str, ...], Parameter(name="--set")]
"""Fields to be replaced, as "a.b=c"; the option may be repeated."""


@contextlib.contextmanager
def build_errors() -> Iterator[None]:
    """Drake refuses a model or a camera by RuntimeError: bad input, not a bug of ours."""
    from drake_oa.common.config import ScenarioError
    from drake_oa.runs.simulation import MotionInterruptedError

    try:
        yield
    except MotionInterruptedError:
        raise
    except RuntimeError as error:
        raise ScenarioError(str(error)) from error


def scenario_name(name_or_file: str) -> str:
    """What a scenario is called: its shipped name, or its file's."""
    return Path(name_or_file).name.removesuffix(".scenario.yaml")


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Holds back what is logged, where the same is logged again or runs over and over."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)


def scenarios(*, files: bool = False) -> None:
    """List the shipped scenarios.

    Args:
        files: print where they are instead: copy one to start a scenario of your own.
    """
    from drake_oa.scenario.shipped import description, shipped_scenarios

    shipped = shipped_scenarios()
    if files:
        width = max(map(len, shipped))
        for name, path in shipped.items():
            print(f"{name:<{width}}  {path}")
        return
    rows = [(name, description(path)) for name, path in shipped.items()]
    show(TextTable((), rows, "ll"))


def graph(
    scenario: str,
    /,
    *,
    overrides: Overrides = (),
    depth: int = 1,
    dot: bool = False,
    signals: bool = False,
) -> None:
    """Print a scenario's wiring as SVG, by Graphviz' dot, as dot source, or as a table.

    The diagram is that of the scenario's modulated motion.

    For example:

        drake-oa graph tabletop_box > wiring.svg
        drake-oa graph tabletop_box --signals

    Args:
        scenario: a shipped name (see `drake-oa scenarios`) or a file.
        overrides: A.B=C replaces field B of block A of the scenario; may be repeated.
        depth: levels of nested diagrams.
        dot: print the Graphviz source, which takes no Graphviz.
        signals: print each output port with the inputs that read it, loggers left out.
    """
    from drake_oa.common.wires import connections
    from drake_oa.diagrams.avoidance import build_avoidance
    from drake_oa.scenario.loading import load_scenario

    if depth < 0:
        raise ValueError(f"--depth must be at least 0, not {depth}")
    chosen = load_scenario(scenario, overrides)
    program = None if dot or signals else shutil.which("dot")
    if program is None and not (dot or signals):
        raise ValueError(
            "an SVG takes Graphviz, whose `dot` is not on the PATH; --dot prints the source, "
            "--signals a table"
        )
    with build_errors():
        diagram = build_avoidance(chosen)
    if signals:
        readers: dict[str, list[str]] = {}
        for source, reader in connections(diagram):
            if not reader.startswith("log_"):
                readers.setdefault(source, []).append(reader)
        rows = [(source, ", ".join(names)) for source, names in readers.items()]
        show(TextTable(("output", "read by"), rows, "ll"))
        return
    text = diagram.GetGraphvizString(max_depth=depth)
    if program:
        answer = subprocess.run(
            [program, "-Tsvg"], input=text, capture_output=True, text=True, check=False
        )
        if answer.returncode != 0:
            raise OSError(f"{program} failed ({answer.stderr.strip()}); --dot prints the source")
        text = answer.stdout
    sys.stdout.write(text)
