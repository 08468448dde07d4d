"""`drake-oa scenarios`, `new`, `check`, `graph`, and shared parts of commands with a scenario."""

from __future__ import annotations

import contextlib
import math
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter
from cyclopts.validators import Number

from drake_oa.common.console import FAILED, Column, TextTable, complain, quiet, show
from drake_oa.common.files import check_outputs, replace_json, replace_text
from drake_oa.scenario.shipped import shipped_scenarios

if TYPE_CHECKING:
    from drake_oa.scenario.scenario import Scenario

    ScenarioName = str
else:
    ScenarioName = Annotated[
        str | Literal[tuple(shipped_scenarios())], Parameter(show_choices=False)
    ]
    """Name or file of a scenario; the shell completes the shipped names."""

Overrides = Annotated[tuple[str, ...], Parameter(name="--set")]
"""Fields to be replaced, as "a.b=c"; the option may be repeated."""


Positive = Annotated[float, Parameter(validator=Number(gt=0.0, lt=math.inf))]
"""Positive finite number."""
Rate = Annotated[float, Parameter(validator=Number(gt=0.0, lte=1.0))]
"""Simulated seconds in one of the wall clock."""
Count = Annotated[int, Parameter(validator=Number(gte=1))]
"""Number of scenes, processes or steps."""
Seed = Annotated[int, Parameter(validator=Number(gte=0))]
"""Seed of random numbers."""


def open_scenario(name: str, overrides: Sequence[str], *outputs: Path | None) -> Scenario:
    """Loads a scenario, and checks the files that the command is going to write.

    Raises:
        ValueError, OSError: for a scenario that cannot be read, or a file that cannot be written.
    """
    from drake_oa.scenario.loading import load_scenario, scenario_path

    scenario = load_scenario(name, overrides)
    check_outputs(*outputs, read=[scenario_path(name)])
    return scenario


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
    """Returns the name of a scenario: its shipped name, or that of its file."""
    return Path(name_or_file).name.removesuffix(".scenario.yaml")


def scenarios(*, files: bool = False) -> None:
    """List the shipped scenarios.

    Args:
        files: print where they are instead: copy one to start a scenario of your own.
    """
    from drake_oa.scenario.shipped import description, missing_package

    rows = []
    for name, path in shipped_scenarios().items():
        package = missing_package(path)
        needs = f" (needs {package}: pip install 'drake_oa[robots]')" if package else ""
        rows.append({"name": name, "text": str(path) if files else description(path) + needs})
    show(TextTable([Column(key, "", side="left") for key in ("name", "text")], rows))


SCHEMA = "scenario.schema.json"


def new(name: str, /, *, like: str | None = None) -> int:
    """Write a commented scenario of your own, which runs as it is.

    Writes NAME.scenario.yaml, and beside it scenario.schema.json, from which editors with a
    YAML language server complete fields and explain them. Then:

        drake-oa check NAME.scenario.yaml
        drake-oa run NAME.scenario.yaml --html NAME.html

    Args:
        name: of the scenario, or its file; files that exist are left alone.
        like: a shipped scenario to begin with, in place of a box and a pole.
    """
    from drake_oa.common.files import package_file
    from drake_oa.scenario.loading import scenario_path, scenario_schema

    stem = scenario_name(name)
    if not re.fullmatch(r"[\w.-]+", stem):
        raise ValueError(f"'{stem}': a name is made of letters, digits, '_', '-' and '.'")
    file = Path(name).with_name(f"{stem}.scenario.yaml")
    if file.exists():
        raise ValueError(f"{file} exists already; name another one")
    source = package_file("package://drake_oa/scenes/own.scenario.yaml")
    text = (scenario_path(like) if like else source).read_text("utf-8")
    head = f"# yaml-language-server: $schema={SCHEMA}\n"
    replace_text(file, text if text.startswith(head) else head + text)
    schema = file.with_name(SCHEMA)
    if not schema.exists():
        replace_json(schema, scenario_schema())
    print(f"{file}\n{schema}")
    return 0


def check(
    scenario: ScenarioName,
    /,
    *,
    overrides: Overrides = (),
    plot: Path | None = None,
) -> int:
    """Say all that is wrong with a scenario.

    Where its fields are right the cell is built, and a table says what start and goal leave
    the arm. A line says how much of the space near the arm its cameras do not see, at the start
    and on the way. The picture of --plot shows the cell with the arm at the start, and what each
    camera sees; green is the start, red the goal.

    Exit status: 0 when nothing is wrong, 1 when something is, 2 for a file that cannot be read.

    Args:
        scenario: a file, or a shipped name (see `drake-oa scenarios`).
        overrides: A.B=C replaces field B of block A of the scenario; may be repeated.
        plot: draw a picture, .png.
    """
    from drake_oa.scenario.loading import scenario_path, scenario_problems

    check_outputs(plot, read=[scenario_path(scenario)])
    wrong = scenario_problems(scenario, overrides)
    if not wrong:
        from drake_oa.runs.camera_placement import view_note
        from drake_oa.runs.scenario_check import build_problems, end_contacts, end_table

        chosen = open_scenario(scenario, overrides, plot)
        with quiet():
            wrong = build_problems(chosen)
    for problem in wrong:
        complain(problem)
    if wrong:
        return FAILED
    if chosen.robot is None:
        print(f"{scenario}: nothing is wrong; without a robot there is nothing to draw")
        return 0
    with build_errors(), quiet():
        table, contacts = end_table(chosen), end_contacts(chosen)
        view = view_note(chosen)
    show(table)
    if view:
        print(view)
    if plot is not None:
        from drake_oa.viewing.still import draw_scenario

        with build_errors(), quiet():
            draw_scenario(chosen, plot)
    if contacts:
        complain(contacts)
    return FAILED if contacts else 0


def graph(
    scenario: ScenarioName,
    /,
    *,
    overrides: Overrides = (),
    dot: bool = False,
    signals: bool = False,
) -> None:
    """Print the layers of a scenario's diagram as SVG, or all systems as dot source or as a table.

    The diagram is that of the scenario's avoiding motion.

    For example:

        drake-oa graph tabletop_box > layers.svg
        drake-oa graph tabletop_box --signals

    Args:
        scenario: a shipped name (see `drake-oa scenarios`) or a file.
        overrides: A.B=C replaces field B of block A of the scenario; may be repeated.
        dot: print the source of a graph of all systems, for Graphviz.
        signals: print each output port with the inputs that read it, loggers left out.
    """
    from drake_oa.common.signal_builder import connections
    from drake_oa.diagrams.avoidance import build_avoidance
    from drake_oa.scenario.loading import load_scenario
    from drake_oa.viewing.layer_figure import layer_figure

    chosen = load_scenario(scenario, overrides)
    with build_errors():
        diagram = build_avoidance(chosen)
    if signals:
        readers: dict[str, list[str]] = {}
        for source, reader in connections(diagram):
            if not reader.startswith("log_"):
                readers.setdefault(source, []).append(reader)
        rows = [{"output": of, "read by": ", ".join(names)} for of, names in readers.items()]
        show(TextTable([Column(key, side="left") for key in ("output", "read by")], rows))
        return
    figure = diagram.GetGraphvizString(max_depth=1) if dot else layer_figure(diagram)
    sys.stdout.write(figure)
