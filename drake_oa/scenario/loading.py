"""Functions that read a scenario (all parameters of a run) from a YAML file, check it, and write it
as YAML text.

The text is read as plain data, overrides are merged into the data, and pydantic checks every field
while it builds the `Scenario`. Afterwards, fields of several blocks are checked for consistency.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pydrake.common.yaml import yaml_dump

from drake_oa.common.config import (
    ScenarioError,
    apply_override,
    did_you_mean,
    json_schema,
    plain_data,
    read_yaml,
    validate,
)
from drake_oa.perception.config import DepthCamera
from drake_oa.scenario.end_poses import follow_joints
from drake_oa.scenario.faults import CameraDropout
from drake_oa.scenario.obstacles import obstacle_problems
from drake_oa.scenario.perception import GivenEllipsoids, perception_problems
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.shipped import shipped_scenarios
from drake_oa.scenario.task import goal_problems


def scenario_path(name_or_file: str) -> Path:
    """Finds the file of a scenario by the name of a shipped scenario or by path.

    Raises:
        ScenarioError: if the argument is neither a shipped name nor a file; the message lists the
            shipped names.
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


def load_scenario(name_or_file: str, overrides: Sequence[str] = ()) -> Scenario:
    """Reads a scenario from its file, and applies overrides to its fields.

    Args:
        name_or_file: name of a shipped scenario (see `shipped_scenarios`), or path of a file.
        overrides: texts of the form "a.b=c", where the YAML value c replaces field b of block a. A
            value with a tag ("perception=!GroundTruth {}") replaces the whole block.

    Raises:
        ScenarioError: naming each wrong field and its valid values.
    """
    path = scenario_path(name_or_file)
    try:
        return parse_scenario(path.read_text("utf-8"), overrides, folder=path.parent)
    except UnicodeDecodeError as error:
        raise ScenarioError(str(error), file=path.name) from None
    except ScenarioError as error:
        raise error.of_file(path.name) from None


def scenario_problems(name_or_file: str, overrides: Sequence[str] = ()) -> list[str]:
    """Returns one error line for each wrong field of a scenario, without building its diagram.

    Raises:
        ScenarioError: for a file that does not exist.
    """
    scenario_path(name_or_file)
    try:
        load_scenario(name_or_file, overrides)
    except ScenarioError as error:
        return list(error.problems)
    return []


def parse_scenario(
    text: str, overrides: Sequence[str] = (), *, folder: Path | None = None
) -> Scenario:
    """Builds a `Scenario` from YAML text and from overrides.

    An override is a text "a.b=c", which replaces the value of field b in block a by c. Relative
    file names in the YAML text refer to `folder` (None: the current directory). Relative file names
    in overrides refer to the current directory.

    Raises:
        ScenarioError: listing every wrong field.
    """
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
    scenario: Scenario = validate(Scenario, data)
    problems = [
        *perception_problems(scenario.perception, scenario.cameras),
        *obstacle_problems(scenario.obstacles),
        *_robot_problems(scenario),
        *_fault_problems(scenario),
    ]
    stated = data.get("task") or {}
    if not problems:
        follow_joints(scenario, {name for name, value in stated.items() if value is not None})
    if problems := [*problems, *goal_problems(scenario.task)]:
        raise ScenarioError(*problems)
    return scenario


def scenario_schema() -> dict[str, Any]:
    """Returns the JSON Schema (draft 2020-12) of a scenario file."""
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "drake_oa scenario"}
    return json_schema(Scenario) | head


def _robot_problems(scenario: Scenario) -> Iterator[str]:
    """Yields an error line for a scenario without a robot whose perception block requires a
    robot.
    """
    if scenario.robot is None and not isinstance(scenario.perception, GivenEllipsoids):
        yield (
            "robot: null (a free point) requires 'perception: !GivenEllipsoids'; "
            f"the scenario has !{type(scenario.perception).__name__}"
        )


def _fault_problems(scenario: Scenario) -> Iterator[str]:
    """Yields an error line for each missing requirement of a fault: a robot for any fault; for a
    camera dropout, the perception `!DepthCamera` with the camera that the fault names.
    """
    source = scenario.perception
    for row, fault in enumerate(scenario.faults):
        name = f"faults[{row}]: !{type(fault).__name__}"
        if scenario.robot is None:
            yield f"{name} requires a robot; the scenario has null"
        if not isinstance(fault, CameraDropout):
            continue
        if not isinstance(source, DepthCamera):
            yield (
                f"{name} requires 'perception: !DepthCamera'; the scenario has "
                f"!{type(source).__name__}"
            )
        elif fault.camera and fault.camera not in source.names:
            yield (
                f"faults[{row}].camera: perception does not use camera '{fault.camera}'; valid: "
                f"{', '.join(source.names)}"
            )


def _resolve_files(data: dict[str, Any], base: Path) -> None:
    """Converts relative file names in the plain data of a scenario, in place, to absolute paths,
    and those in Drake model directives to URLs.

    URLs and other values remain unchanged. In `task.demonstration`, a single file becomes a list of
    one file, and an empty text becomes an empty list.

    Args:
        data: dictionary that was read from YAML, with a dictionary for each block.
        base: folder to which the file names are relative.
    """
    faults = data.get("faults")
    for block, field in (
        (data.get("perception"), "folder"),
        (data.get("perception"), "path"),
        (data.get("task"), "demonstration"),
        (data.get("inference"), "weights"),
        (data.get("inference"), "chain"),
        (data.get("robot"), "model"),
        *((fault, "inertias") for fault in (faults if isinstance(faults, list) else ())),
    ):
        if not isinstance(block, dict):
            continue
        files = block.get(field)
        if field == "demonstration" and isinstance(files, str):
            files = [files] if files else []
        if field in block:
            several = [_absolute(file, base) for file in files] if isinstance(files, list) else None
            block[field] = _absolute(files, base) if several is None else several
    directives = data.get("directives")
    for directive in directives if isinstance(directives, list) else ():
        for block in directive.values() if isinstance(directive, dict) else ():
            if isinstance(block, dict) and isinstance(
                file := _absolute(block.get("file"), base), str
            ):
                # In directives that are parsed from text, Drake accepts model files as URLs only.
                block["file"] = file if "://" in file else f"file://{file}"


def _absolute(file: Any, base: Path) -> Any:
    """Returns an absolute path for a relative file name in the folder `base`; URLs, and values that
    are not texts, are returned unchanged.
    """
    if isinstance(file, str) and file and "://" not in file:
        return str(base.absolute() / Path(file).expanduser())
    return file


def scenario_text(scenario: Scenario) -> str:
    """Returns a scenario as YAML text that includes all defaults, for example for a log file.

    `parse_scenario` builds the same scenario from the text.
    """
    text: str = yaml_dump(plain_data(scenario))
    return text
