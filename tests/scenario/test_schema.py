"""The JSON Schema holds what is shipped, explains every field of ours, and refuses a wrong one."""

from typing import Any

import jsonschema
import pytest

from drake_oa.common.config import read_yaml
from drake_oa.scenario.schema import comments, json_schema
from drake_oa.scenario.shipped import package_file, shipped_scenarios
from drake_oa.scenario.task import Task

SCHEMA = json_schema()


def untagged(data: Any) -> Any:
    """As editors see it."""
    if isinstance(data, dict):
        return {name: untagged(value) for name, value in data.items() if name != "_tag"}
    return [untagged(item) for item in data] if isinstance(data, list) else data


@pytest.mark.parametrize("name", shipped_scenarios())
def test_what_is_shipped_fits(name: str) -> None:
    jsonschema.validate(untagged(read_yaml(shipped_scenarios()[name].read_text())), SCHEMA)


def test_the_template_fits() -> None:
    text = package_file("package://drake_oa/scenes/own.scenario.yaml").read_text()
    jsonschema.validate(untagged(read_yaml(text)), SCHEMA)


@pytest.mark.parametrize(
    "text",
    [
        "task: {clearence: 0.1}",
        "task: {clearance: 3.0}",
        "task: {start: [0.4, 0.1]}",
        "seed: 1.5",
        "perception: {fps: 3}",
    ],
)
def test_what_does_not_fit_is_refused(text: str) -> None:
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(read_yaml(text), SCHEMA)


def test_comments_become_descriptions() -> None:
    assert comments(Task)["clearance"] == "Asked distance between tool and obstacle, Delta [m]."
    clearance = SCHEMA["$defs"]["Task"]["properties"]["clearance"]
    assert clearance["description"] == comments(Task)["clearance"]
    assert (clearance["exclusiveMinimum"], clearance["maximum"]) == (0.0, 2.0)
    assert clearance["default"] == 0.15
