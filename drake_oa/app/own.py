"""`drake-oa new` and `drake-oa check`: scenarios of one's own."""

from __future__ import annotations

import json
import re
from pathlib import Path

from drake_oa.app.scenarios import Overrides, build_errors, quiet, scenario_name
from drake_oa.common.console import FAILED, TextTable, complain, show
from drake_oa.common.files import check_outputs, replace_text

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
    from drake_oa.scenario.loading import scenario_path
    from drake_oa.scenario.schema import json_schema
    from drake_oa.scenario.shipped import package_file

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
        replace_text(schema, json.dumps(json_schema(), indent=1) + "\n")
    print(f"{file}\n{schema}")
    return 0


def check(
    scenario: str, /, *, overrides: Overrides = (), plot: Path | None = None, no_plot: bool = False
) -> int:
    """Say all that is wrong with a scenario, and draw it.

    Where its fields are right the cell is built, and a table says what start and goal leave
    the arm. The picture, NAME.png unless --plot names another file, shows the cell with the arm
    at the start, and what each camera sees; green is the start, red the goal.

    Exit status: 0 when nothing is wrong, 1 when something is, 2 for a file that cannot be read.

    Args:
        scenario: a file, or a shipped name (see `drake-oa scenarios`).
        overrides: A.B=C replaces field B of block A of the scenario; may be repeated.
        plot: the picture's file.
        no_plot: draw nothing.
    """
    from drake_oa.scenario.loading import load_scenario, scenario_problems

    if plot is not None and no_plot:
        raise ValueError("--plot and --no-plot exclude each other")
    name = scenario_name(scenario)
    file = None if no_plot else plot or Path(f"{name}.png")
    check_outputs(file)
    wrong = scenario_problems(scenario, overrides)
    if not wrong:
        from drake_oa.runs.scenario_check import end_rows, unbuildable

        chosen = load_scenario(scenario, overrides)
        with quiet():
            wrong = unbuildable(chosen)
    for problem in wrong:
        complain(problem)
    if wrong:
        return FAILED
    if chosen.robot is None:
        print(f"{name}: nothing is wrong; without a robot there is nothing to draw")
        return 0
    with build_errors(), quiet():
        rows, notes = end_rows(chosen)
        if file is not None:
            from drake_oa.viewing.still import draw_scenario

            draw_scenario(chosen, file)
            notes = [*notes, f"picture: {file}"]
    header = ("", "tool clearance [m]", "robot clearance [m]", "touches")
    show(TextTable(header, rows, "lrrl", notes))
    return FAILED if any(row[-1] != "nothing" for row in rows) else 0
