"""Commands `drake-oa scenarios`, `new`, `check` and `graph`, and the option types and helpers that
other commands share.
"""

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
    """Annotation of a command-line argument that is a scenario's name or file; the shell completes
    shipped names."""

Overrides = Annotated[tuple[str, ...], Parameter(name="--set")]
"""Annotation of the repeatable command-line option --set: new values of scenario fields, each as
"a.b=c"."""


Positive = Annotated[float, Parameter(validator=Number(gt=0.0, lt=math.inf))]
"""Annotation of a command-line option that must be a positive finite number."""
Rate = Annotated[float, Parameter(validator=Number(gt=0.0, lte=1.0))]
"""Annotation of a command-line option for the ratio of simulated time to wall time, in (0, 1]."""
Count = Annotated[int, Parameter(validator=Number(gte=1))]
"""Annotation of a command-line option for a number of scenes, processes or steps, at least 1."""
Seed = Annotated[int, Parameter(validator=Number(gte=0))]
"""Annotation of a command-line option for the seed of random numbers, at least 0."""


def open_scenario(name: str, overrides: Sequence[str], *outputs: Path | None) -> Scenario:
    """Loads a scenario, and checks that the output files of a command can be written.

    Args:
        name: name of a shipped scenario, or a file.
        overrides: new values of scenario fields, each as "a.b=c".
        outputs: output files of the command; None: no output.

    Raises:
        ValueError, OSError: if the scenario cannot be read, or a file cannot be written.
    """
    from drake_oa.scenario.loading import load_scenario, scenario_path

    scenario = load_scenario(name, overrides)
    check_outputs(*outputs, read=[scenario_path(name)])
    return scenario


@contextlib.contextmanager
def build_errors() -> Iterator[None]:
    """Converts a RuntimeError of Drake in the `with` block to a ScenarioError.

    Drake raises a RuntimeError for a wrong model or camera of a scenario; commands report a
    ScenarioError in one line. A MotionInterruptedError, the error of a simulation that has started,
    is not converted.
    """
    from drake_oa.common.config import ScenarioError
    from drake_oa.runs.simulation import MotionInterruptedError

    try:
        yield
    except MotionInterruptedError:
        raise
    except RuntimeError as error:
        raise ScenarioError(str(error)) from error


def check_end_contacts(scenario: Scenario) -> None:
    """Checks that the robot is not in contact at start and goal of a scenario.

    Raises:
        ValueError: naming the contacts.
    """
    from drake_oa.runs.scenario_check import end_contacts

    with build_errors():
        if contacts := end_contacts(scenario):
            raise ValueError(contacts)


def scenario_name(name_or_file: str) -> str:
    """Returns the name of a scenario from its shipped name or its file, without folder and suffix
    .scenario.yaml.
    """
    return Path(name_or_file).name.removesuffix(".scenario.yaml")


def scenarios(*, files: bool = False) -> None:
    """List the shipped scenarios with their descriptions.

    Args:
        files: print the path of each file instead; a copy is the beginning of a custom scenario.
    """
    from drake_oa.scenario.shipped import description, missing_package

    rows = []
    for name, path in shipped_scenarios().items():
        package = missing_package(path)
        requires = f" (requires {package}: pip install 'drake_oa[robots]')" if package else ""
        rows.append({"name": name, "text": str(path) if files else description(path) + requires})
    show(TextTable([Column(key, "", side="left") for key in ("name", "text")], rows))


SCHEMA = "scenario.schema.json"
"""Name of the file with the JSON schema of scenarios, which `drake-oa new` writes for editors."""


def new(name: str, /, *, like: str | None = None) -> int:
    """Write a new scenario with comments, which can be run without changes.

    The files are NAME.scenario.yaml and, in the same folder, scenario.schema.json, with which
    editors with a YAML language server complete and explain fields. Then:

        drake-oa check NAME.scenario.yaml
        drake-oa run NAME.scenario.yaml --html NAME.html

    Args:
        name: name of the scenario, or its file, which must not exist.
        like: shipped scenario to copy (default: a scenario with a box and a pole).
    """
    from drake_oa.common.files import package_file
    from drake_oa.scenario.loading import scenario_path, scenario_schema

    stem = scenario_name(name)
    if not re.fullmatch(r"[\w.-]+", stem):
        raise ValueError(f"NAME: '{stem}' must consist of letters, digits, '_', '-' and '.'")
    file = Path(name).with_name(f"{stem}.scenario.yaml")
    if file.exists():
        raise ValueError(f"{file} exists; choose another name, or delete the file")
    source = package_file("package://drake_oa/scenes/own.scenario.yaml")
    text = (scenario_path(like) if like else source).read_text("utf-8")
    head = f"# yaml-language-server: $schema={SCHEMA}\n"
    replace_text(file, text if text.startswith(head) else head + text)
    schema = file.with_name(SCHEMA)
    replace_json(schema, scenario_schema())
    print(f"{file}\n{schema}")
    return 0


def check(scenario: ScenarioName, /, *, overrides: Overrides = (), plot: Path | None = None) -> int:
    """Check a scenario for errors, and print its clearances at start and goal.

    Each error line names a field, the problem and the valid values. The check has passes, and ends
    after the first pass with an error: YAML; all fields; fields that depend on others, such as
    names of cameras; configurations at start and goal; models, directives and poses out of reach;
    contacts at start and goal. Repeat it after each correction. Fields without a value have their
    defaults, and are not reported. Without errors the command prints a table with a row for start
    and goal, and these columns:

      tool clearance [m]   distance of hand and fingers to the nearest obstacle
      robot clearance [m]  distance of all links to the nearest obstacle
      contacts             pairs of a link and an object, or of two links, in contact

    Lines below the table state the requested clearance, the achievable clearance if that is less,
    joints whose speed or torque is not limited, models that are not obstacles, and the field of
    view of each camera. A last line states the fraction of the space near the arm, along its
    nominal motion, that no camera observes to be free, for example because it is outside all
    images.

    Exit status: 0 without errors, 1 with errors or with a contact at start or goal, 2 if the file
    cannot be read.

    Args:
        scenario: file, or name of a shipped scenario (see `drake-oa scenarios`).
        overrides: A.B=C replaces field B of block A of the scenario; may be repeated.
        plot: write an image (.png) of the station with the arm at the start (green) and the goal
            (red), and the images of the cameras, to this file.
    """
    from drake_oa.scenario.loading import scenario_path, scenario_problems

    check_outputs(plot, read=[scenario_path(scenario)])
    problems = scenario_problems(scenario, overrides)
    if not problems:
        from drake_oa.runs.camera_placement import view_note
        from drake_oa.runs.scenario_check import build_problems, end_contacts, end_table
        from drake_oa.scenario.obstacles import OBSTACLE_PREFIX
        from drake_oa.world.world_model import flat_directives

        chosen = open_scenario(scenario, overrides, plot)
        with quiet():
            problems = build_problems(chosen)
    for problem in problems:
        complain(problem)
    if problems:
        return FAILED
    if chosen.robot is None:
        print(f"{scenario}: no errors; clearances and --plot require a robot")
        return 0
    with build_errors(), quiet():
        table, contacts = end_table(chosen), end_contacts(chosen)
        view = view_note(chosen)
    show(table)
    models = [item.add_model.name for item in flat_directives(chosen.directives) if item.add_model]
    if others := [name for name in models if not name.startswith(OBSTACLE_PREFIX)]:
        print(f"not obstacles, since not named {OBSTACLE_PREFIX}...: {', '.join(others)}")
    for camera in chosen.cameras:
        sizes = (camera.width, camera.focal_x()), (camera.height, camera.focal_y())
        x, y = (2.0 * math.degrees(math.atan2(size / 2, focal)) for size, focal in sizes)
        print(f"camera '{camera.name}': field of view {x:.0f} x {y:.0f} deg")
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
    """Print the diagram of a scenario: its layers as SVG, or its systems as dot source or table.

    The diagram is that of the avoiding motion, with the systems of all layers.

    For example:

        drake-oa graph tabletop_box > layers.svg
        drake-oa graph tabletop_box --signals

    Args:
        scenario: name of a shipped scenario (see `drake-oa scenarios`), or a file.
        overrides: A.B=C replaces field B of block A of the scenario; may be repeated.
        dot: print all systems as dot source for Graphviz.
        signals: print a table with a row for each output port (output) and the input ports that
            are connected to it (read by), except those of log sinks.
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
