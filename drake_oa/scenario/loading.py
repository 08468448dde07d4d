"""Reads scenarios from files, and writes them as text.

The text becomes plain mappings (`pydrake.common.yaml.yaml_load`), overrides are merged into
them, every key, tag, type and range is checked against the dataclasses of
`drake_oa.scenario.scenario`, so that an error names the field and what would be valid, and
`yaml_load_typed` builds the `Scenario`.
"""

import dataclasses as dc
import os
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from pydrake.common.yaml import yaml_dump, yaml_dump_typed, yaml_load_typed

from drake_oa.common.config import (
    ScenarioError,
    apply_override,
    check,
    did_you_mean,
    problems,
    read_yaml,
)
from drake_oa.geometry.shapes import check_shapes
from drake_oa.perception.config import DepthCamera
from drake_oa.robot.config import check_robot
from drake_oa.scenario.faults import CameraDropout
from drake_oa.scenario.obstacles import check_obstacles
from drake_oa.scenario.perception import GivenEllipsoids, check_cameras, check_perception
from drake_oa.scenario.scenario import LAYERS, Scenario
from drake_oa.scenario.shipped import shipped_scenarios
from drake_oa.scenario.task import check_goals
from drake_oa.scenario.task_joints import follow_joints


def scenario_path(name_or_file: str) -> Path:
    """Finds a scenario by shipped name or by file.

    Raises:
        ScenarioError: if it is neither; lists the shipped names.
    """
    shipped = shipped_scenarios()
    if name_or_file in shipped:
        return shipped[name_or_file]
    path = Path(name_or_file)
    if path.is_file():
        return path
    near = did_you_mean(name_or_file, shipped)
    raise ScenarioError(
        f"unknown scenario '{name_or_file}'{near}: it is neither a file nor one of "
        f"{', '.join(shipped)}"
    )


def load_scenario(name_or_file: str, overrides: typing.Sequence[str] = ()) -> Scenario:
    """Reads a scenario and applies overrides.

    Args:
        name_or_file: a shipped name (see `shipped_scenarios`) or a path.
        overrides: texts "a.b=c": c, read as YAML, replaces field b of block a.
            A value with a tag ("perception=!GroundTruth {}") replaces the block.

    Raises:
        ScenarioError: naming the field and what would be valid.
    """
    path = scenario_path(name_or_file)
    try:
        return parse_scenario(path.read_text("utf-8"), overrides, folder=path.parent)
    except (ScenarioError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{path.name}: {error}") from None


def parse_scenario(
    text: str, overrides: typing.Sequence[str] = (), *, folder: Path | None = None
) -> Scenario:
    """Builds a `Scenario` from YAML text; see `load_scenario`.

    Relative file names in it are relative to `folder` (None: the current directory),
    those in overrides to the current directory.
    """
    data = _data(text, overrides, folder)
    check(data, Scenario, "", {})
    scenario = _typed(data)
    for each in _whole_checks(scenario):
        each()
    _follow_joints(scenario, data)
    return scenario


def scenario_problems(name_or_file: str, overrides: typing.Sequence[str] = ()) -> list[str]:
    """All that is wrong with a scenario, a line each; what only shows when it is built is not.

    Raises:
        ScenarioError: for a file that is not there, or that is no YAML.
    """
    path = scenario_path(name_or_file)
    try:
        data = _data(path.read_text("utf-8"), overrides, path.parent)
    except (ScenarioError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{path.name}: {error}") from None
    found = list(problems(data, Scenario, "", {}))
    if found:
        return found
    try:
        scenario = _typed(data)
    except ScenarioError as error:
        return [str(error)]
    for each in [*_whole_checks(scenario), lambda: _follow_joints(scenario, data)]:
        try:
            each()
        except ScenarioError as error:
            found.append(str(error))
    return found


def _data(text: str, overrides: typing.Sequence[str], folder: Path | None) -> dict[str, Any]:
    """Plain data of a scenario's text, its files' names absolute."""
    data = read_yaml(text)
    data = {} if data is None else data
    if not isinstance(data, dict):
        raise ScenarioError(
            f"expected a block of field: value, not the {type(data).__name__} {data!r}"
        )
    _resolve_files(data, folder or Path())
    for override in overrides:
        apply_override(data, override)
    _resolve_files(data, Path())
    return data


def _typed(data: dict[str, Any]) -> Scenario:
    try:
        scenario: Scenario = yaml_load_typed(
            schema=Scenario, data=yaml_dump(data), defaults=Scenario()
        )
    except (RuntimeError, ValueError, TypeError) as error:
        raise ScenarioError(str(error)) from None
    return scenario


def _follow_joints(scenario: Scenario, data: dict[str, Any]) -> None:
    stated = {name for name, value in (data.get("task") or {}).items() if value is not None}
    follow_joints(scenario, stated)


def _whole_checks(scenario: Scenario) -> list[Callable[[], None]]:
    """What no single field can tell; each raises a `ScenarioError`."""
    task = scenario.task
    return [
        lambda: check_cameras(scenario.cameras),
        lambda: check_obstacles(scenario.obstacles),
        lambda: _check_robot(scenario),
        lambda: _check_faults(scenario),
        lambda: check_perception(scenario.perception, scenario.cameras),
        lambda: _check_supervisor(scenario),
        lambda: _check_view(scenario),
        lambda: check_goals(task.start, task.goal, task.goal_moves),
    ]


def _check_robot(scenario: Scenario) -> None:
    if scenario.robot is not None:
        check_shapes(scenario.robot.carried, "robot.carried")
        check_robot(scenario.robot)
    elif not isinstance(scenario.perception, GivenEllipsoids):
        raise ScenarioError(
            "robot: null (a free point) needs 'perception: !GivenEllipsoids'; "
            f"it has !{type(scenario.perception).__name__}"
        )


def _check_view(scenario: Scenario) -> None:
    for row, layer in enumerate(scenario.view.show or ()):
        if layer not in LAYERS:
            near = did_you_mean(layer, LAYERS)
            raise ScenarioError(
                f"view.show[{row}]: '{layer}' is not one of {', '.join(LAYERS)}{near}"
            )


def _check_supervisor(scenario: Scenario) -> None:
    supervisor = scenario.supervisor
    if supervisor is not None and supervisor.tracking_hold <= supervisor.tracking_slow:
        raise ScenarioError(
            f"supervisor.tracking_hold: {supervisor.tracking_hold} must be more than "
            f"supervisor.tracking_slow, {supervisor.tracking_slow} [m]"
        )


def _check_faults(scenario: Scenario) -> None:
    """Refuses faults of something that the scenario does not have."""
    for number, fault in enumerate(scenario.faults):
        what = f"faults[{number}]: !{type(fault).__name__}"
        if isinstance(fault, CameraDropout):
            if not isinstance(scenario.perception, DepthCamera):
                raise ScenarioError(
                    f"{what} needs 'perception: !DepthCamera'; it has "
                    f"!{type(scenario.perception).__name__}"
                )
            names = scenario.perception.names
            if fault.camera and fault.camera not in names:
                raise ScenarioError(
                    f"faults[{number}].camera: perception does not see by '{fault.camera}', but by "
                    f"{', '.join(names)}"
                )
        if scenario.robot is None:
            raise ScenarioError(f"{what} needs a robot; this scenario has null")


def _resolve_files(data: dict[str, Any], base: Path) -> None:
    """Makes relative file names absolute, those of models URLs; URLs, and what is no text, stay.

    Where a list of files is asked for, one alone stands for a list of it, and "" for none.
    """
    for name, field in (
        ("perception", "folder"),
        ("task", "demonstration"),
        ("regulation", "weights"),
        ("robot", "model"),
    ):
        block = data.get(name)
        if not isinstance(block, dict):
            continue
        files = block.get(field)
        if field == "demonstration" and isinstance(files, str):
            files = [files] if files else []
        if isinstance(files, list):
            block[field] = [_absolute(file, base) for file in files]
        elif field in block:
            block[field] = _absolute(files, base)
    directives = data.get("directives")
    for directive in directives if isinstance(directives, list) else ():
        for block in directive.values() if isinstance(directive, dict) else ():
            if isinstance(block, dict) and isinstance(
                file := _absolute(block.get("file"), base), str
            ):
                # Drake takes a text's model files as URLs only.
                block["file"] = file if "://" in file else Path(file).as_uri()


def _absolute(file: Any, base: Path) -> Any:
    if isinstance(file, str) and file and "://" not in file:
        return str(base.absolute() / Path(file).expanduser())
    return file


def scenario_files(scenario: Scenario) -> Iterator[Path]:
    """Yields the files that fields of a scenario name, and those in folders that they name."""
    stack = [read_yaml(scenario_text(scenario))]
    while stack:
        value = stack.pop()
        if isinstance(value, dict | list):
            stack += value.values() if isinstance(value, dict) else value
        elif isinstance(value, str):
            file = unquote(value.removeprefix("file://")) if value.startswith("file:") else value
            if os.path.isabs(file) and os.path.exists(file):
                yield from Path(file).iterdir() if os.path.isdir(file) else [Path(file)]


def scenario_text(scenario: Scenario) -> str:
    """The scenario as YAML, defaults included, as it is written into a log.

    `parse_scenario` makes the same scenario of it.
    """
    text: str = yaml_dump_typed(scenario)
    data = read_yaml(text)
    # yaml_dump_typed leaves nulls out; reading that back would give the defaults.
    return yaml_dump(data) if _add_nulls(scenario, data) else text


def _add_nulls(value: Any, data: Any) -> bool:
    """Writes the fields of a dataclass that are None into its mapping; says if any was."""
    found = False
    if isinstance(value, list):
        for inner, place in zip(value, data, strict=True):
            found |= _add_nulls(inner, place)
    if not dc.is_dataclass(value):
        return found
    for item in dc.fields(value):
        inner = getattr(value, item.name)
        if inner is None:
            data[item.name], found = None, True
        elif item.name in data:
            found |= _add_nulls(inner, data[item.name])
    return found
