"""Tests of configuration blocks and of the JSON schema: checks and descriptions of each field."""

import dataclasses as dc
import math
import re
import typing
from collections.abc import Iterator
from typing import Any

import jsonschema
import pytest
from pydantic import ValidationError

from drake_oa.common.config import ScenarioError, json_schema, read_yaml, validate
from drake_oa.common.files import package_file
from drake_oa.perception.config import SegmentationConfig
from drake_oa.robot.config import Robot
from drake_oa.robot.inertias import Inertia
from drake_oa.scenario.loading import parse_scenario, scenario_schema
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.shipped import shipped_scenarios

SCHEMA = scenario_schema()
EDITOR = jsonschema.validators.validator_for(SCHEMA)(SCHEMA)


def blocks_in(kind: Any) -> set[Any]:
    """Returns the configuration blocks in a type, with those in their fields."""
    if hasattr(kind, "__pydantic_fields__"):
        fields = kind.__pydantic_fields__.values()
        return {kind}.union(*(blocks_in(field.annotation) for field in fields))
    return set().union(*map(blocks_in, typing.get_args(kind)))


OTHERS = {Inertia}
BLOCKS = sorted(blocks_in(Scenario) | OTHERS, key=lambda block: block.__name__)


def wrong_values(schema: dict[str, Any]) -> Iterator[Any]:
    """Yields invalid values of a field's schema: out of range, of another type, not finite."""
    kind = schema.get("type")
    if "anyOf" in schema:
        for option in schema["anyOf"]:
            if option.get("type") in ("number", "array", "string"):
                yield from wrong_values(option)
    if kind in ("number", "integer"):
        yield from ("text", math.nan, math.inf, [1.0])
        low = schema.get("exclusiveMinimum", schema.get("minimum", math.inf))
        if math.isfinite(low):
            yield low - 1 if "minimum" in schema else low
        if "maximum" in schema:
            yield schema["maximum"] * 1.001 + 1
    elif kind == "array":
        yield from (3, {"a": 1})
        size = schema.get("minItems", 1)
        yield from ([value] * size for value in wrong_values(schema["items"]))
        if size > 1 and size == schema.get("maxItems"):
            yield [0.1] * (size + 1)
    elif kind == "string":
        yield from (3, ["a"]) if "enum" not in schema else ("no such word",)
    elif {"type": "string"} not in schema.get("anyOf", ()):
        yield "text" if kind != "null" else object()


@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: block.__name__)
def test_each_field_rejects_wrong_values_and_is_described(block: Any) -> None:
    schema = json_schema(block)
    for name, field in schema["properties"].items():
        description = field.get("description", "")
        assert len(description.split()) > 1, name
        values = list(wrong_values(field))
        if math.inf in values:
            assert re.search(r"\[[^\]]+\]", description), f"{name}: no unit"
        for value in values:
            with pytest.raises(ScenarioError) as caught:
                validate(block, {name: value})
            assert any(re.match(rf"{name}\b", line) for line in caught.value.problems), value
        with pytest.raises(ScenarioError, match=rf"{name}_: is not a field \(did you mean"):
            validate(block, {f"{name}_": 1})


def test_blocks_are_checked_when_constructed_or_changed_in_python() -> None:
    robot = Robot()
    with pytest.raises(ValidationError, match="carried_mass"):
        dc.replace(robot, carried_mass=-1.0)
    with pytest.raises(ValidationError, match="p_HE"):
        robot.p_HE = [0.0, 0.0]
    with pytest.raises(ValidationError, match="must be greater than near"):
        SegmentationConfig(near=2.0, far=1.0)


def test_one_error_lists_every_wrong_field() -> None:
    text = """
seed: -1
task: {clearence: 0.1, duration: long, rpy_goal: [0, 0, 90]}
perception: !DepthCamra {}
inference: !Verified {generations: 2.5}
obstacles: [{name: a, shapes: [!Box {size: [1, 2]}]}, {name: b, shapes: [!Box {}],
             color: [2, 0, 0, 1]}]
cameras: [{name: c, fpz: 3}]
"""
    with pytest.raises(ScenarioError) as caught:
        parse_scenario(text)
    assert [line.split(":")[0] for line in caught.value.problems] == [
        "seed",
        "task.duration",
        "task.rpy_goal[2]",
        "task.clearence",
        "obstacles[0].shapes[0].size",
        "obstacles[1].color[0]",
        "cameras[0]",
        "perception",
        "inference.generations",
    ]
    message = str(caught.value)
    assert message.startswith("9 wrong fields:\n  seed: ")
    assert "did you mean clearance?" in message
    assert "did you mean !DepthCamera?" in message
    assert "90 degrees are 1.571 rad" in message


def untagged(data: Any) -> Any:
    """Returns plain data without tags, as an editor validates them."""
    if isinstance(data, dict):
        return {name: untagged(value) for name, value in data.items() if name != "_tag"}
    return [untagged(item) for item in data] if isinstance(data, list) else data


def test_the_schema_accepts_shipped_scenarios_and_the_template() -> None:
    EDITOR.check_schema(SCHEMA)
    own = package_file("package://drake_oa/scenes/own.scenario.yaml")
    for file in (own, *shipped_scenarios().values()):
        EDITOR.validate(untagged(read_yaml(file.read_text())))


@pytest.mark.parametrize(
    "text",
    ["task: {clearence: 0.1}", "task: {clearance: 3.0}", "seed: 1.5", "perception: {fps: 3}"],
)
def test_the_schema_rejects_wrong_fields(text: str) -> None:
    with pytest.raises(jsonschema.ValidationError):
        EDITOR.validate(read_yaml(text))
