"""Configuration blocks: pydantic dataclasses that are read from YAML, checked, and written.

A block is declared with `@dataclass(config=BLOCK)`. Each field has its range (`pydantic.Field`)
and, as the string below it, its description with the unit in brackets. Values are checked when a
block is constructed or changed; `validate` builds a block from plain data, and reports all wrong
fields.
"""

from __future__ import annotations

import ast
import difflib
import inspect
import math
import re
import textwrap
import typing
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import is_dataclass
from functools import cache
from itertools import pairwise
from typing import Annotated, Any

import yaml
from pydantic import (
    AfterValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
)
from pydantic.json_schema import GenerateJsonSchema
from pydantic_core import CoreSchema, ErrorDetails, core_schema
from pydrake.common.yaml import yaml_dump, yaml_dump_typed, yaml_load, yaml_load_typed

_LCM_PROVIDERS = ("udpm", "tcpq", "memq")
"""Names of the LCM providers that both send and receive messages; a valid LCM URL begins with one
of these names. The provider `file` only records or replays."""

BLOCK = ConfigDict(
    extra="forbid",
    allow_inf_nan=False,
    validate_assignment=True,
    validate_default=True,
    arbitrary_types_allowed=True,
)
"""Pydantic settings of every configuration block, a dataclass that is read from YAML.

Unknown fields and non-finite numbers are errors. Values are checked at construction, defaults
included, and at each assignment."""


class ScenarioError(ValueError):
    """Error for a scenario (configuration of a run) that cannot be run, naming each wrong field.

    Attributes:
        problems: one line for each wrong field: its name, the problem and the valid values.
    """

    def __init__(self, *problems: str, file: str = "") -> None:
        """Joins the problems into one message.

        Args:
            problems: one line for each wrong field.
            file: name of the scenario file, with which the message begins; empty: no name.
        """
        start = f"{file}: " if file else ""
        lines = problems if len(problems) == 1 else [f"{len(problems)} wrong fields:", *problems]
        super().__init__(start + "\n  ".join(lines))
        self.problems = problems

    def of_file(self, name: str) -> ScenarioError:
        """Returns a copy of the error whose message begins with the name of the scenario file.

        Args:
            name: name of the file.
        """
        return ScenarioError(*self.problems, file=name)


@contextmanager
def field_errors(field: str, *kinds: type[Exception]) -> Iterator[None]:
    """Converts exceptions in the `with` block to a `ScenarioError` that names a field.

    Args:
        field: full name of the field, such as "task.goal", with which the message begins.
        kinds: types of the exceptions that are converted.

    Raises:
        ScenarioError: in place of an exception of one of these types.
    """
    try:
        yield
    except kinds as error:
        raise ScenarioError(f"{field}: {error}") from None


def _check_angle(angle: float) -> float:
    """Checks that an angle is in [-2 pi, 2 pi], and returns it [rad].

    Raises:
        ValueError: if the angle is more than one turn, and so probably in degrees.
    """
    if abs(angle) > 2.0 * math.pi:
        raise ValueError(
            f"{angle:g} rad is more than one turn; angles are in radians "
            f"({angle:g} degrees are {math.radians(angle):.4g} rad)"
        )
    return angle


def length(count: int) -> Any:
    """Returns the pydantic annotation of a list that must have exactly `count` items.

    The type of the list states the type of the items: `Annotated[list[float], length(3)]`.
    """
    return Field(min_length=count, max_length=count)


Vector3 = Annotated[list[float], length(3)]
"""Annotation of a configuration field that is a list of three numbers."""
Angles = Annotated[list[Annotated[float, AfterValidator(_check_angle)]], length(3)]
"""Annotation of a configuration field with roll, pitch and yaw, each in [-2 pi, 2 pi] [rad]."""


def above(name: str) -> AfterValidator:
    """Returns the pydantic validator of a number that must be greater than another field.

    Args:
        name: name of the other field, which the same configuration block defines before the number.
    """

    def check(value: float, info: ValidationInfo) -> float:
        if name in info.data and value <= info.data[name]:
            raise ValueError(f"{value:g} must be greater than {name}, {info.data[name]:g}")
        return value

    return AfterValidator(check)


class Tagged:
    """Annotation of a field whose value is one of several configuration blocks, distinguished by
    their YAML tags.

    The tag of a block is an exclamation mark and the name of its class, such as `!GroundTruth`. A
    mapping without a tag belongs to the first block in the type of the field, such as `Verified` in
    `Verified | Paper`. In plain data the tag is the value of the key "_tag".
    """

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        blocks = {f"!{block.__name__}": block for block in typing.get_args(source)}

        def tag(value: Any) -> str:
            if isinstance(value, Mapping):
                return str(value.get("_tag", next(iter(blocks))))
            return f"!{type(value).__name__}"

        return core_schema.tagged_union_schema(
            {
                name: core_schema.no_info_before_validator_function(
                    _without_tag, handler.generate_schema(block)
                )
                for name, block in blocks.items()
            },
            tag,
            serialization=core_schema.wrap_serializer_function_ser_schema(
                lambda value, handler: {"_tag": tag(value), **handler(value)}
            ),
        )

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        # A JSON schema does not contain YAML tags, so several blocks may match.
        return {"anyOf": handler(schema)["oneOf"]}


def _without_tag(data: Any) -> Any:
    """Returns the plain data of a configuration block without the key "_tag", which stores the YAML
    tag of the block; data that are no mapping are returned unchanged.
    """
    if isinstance(data, Mapping):
        return {name: value for name, value in data.items() if name != "_tag"}
    return data


class DrakeStruct:
    """Annotation of a configuration field whose type is a struct of Drake that Drake reads from
    YAML, such as `Transform`.
    """

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        def load(value: Any) -> Any:
            if isinstance(value, source):
                return value
            try:
                return yaml_load_typed(schema=source, data=yaml_dump(value))
            except (RuntimeError, ValueError, TypeError, AttributeError) as error:
                known = ", ".join(field.name for field in source.__fields__)
                raise ValueError(f"{error}; valid fields: {known}") from None

        return core_schema.no_info_plain_validator_function(
            load,
            serialization=core_schema.plain_serializer_function_ser_schema(
                lambda value: yaml_load(data=yaml_dump_typed(value))
            ),
            metadata={"pydantic_js_functions": [lambda *_: _struct_schema(source)]},
        )


def _struct_schema(struct: Any) -> dict[str, Any]:
    """Returns the JSON schema of a struct of Drake, which contains the names of its fields only."""
    properties = {
        field.name: _struct_schema(field.type) if hasattr(field.type, "__fields__") else {}
        for field in struct.__fields__
    }
    return {"type": "object", "properties": properties, "additionalProperties": False}


def validate(kind: Any, data: Any, where: str = "") -> Any:
    """Builds a configuration block, or a value that contains blocks, from plain data, and checks
    all its fields.

    Args:
        kind: class of a block, or a type that contains such classes, such as a list of blocks.
        data: plain data (dictionaries, lists, numbers, texts), as `read_yaml` returns them.
        where: name of the field with these data, for errors; empty for a whole file.

    Raises:
        ScenarioError: listing every wrong field.
    """
    try:
        return TypeAdapter(kind).validate_python(data)
    except ValidationError as error:
        details = error.errors(include_url=False)
        raise ScenarioError(*(_problem(kind, each, where) for each in details)) from None


class _BlockSchema(GenerateJsonSchema):
    """Generator of the JSON schema of a configuration block (a dataclass that is read from YAML),
    with field descriptions.
    """

    def dataclass_schema(self, schema: core_schema.DataclassSchema) -> dict[str, Any]:
        result, block = super().dataclass_schema(schema), typing.cast(Any, schema["cls"])
        for name, text in _descriptions(block).items():
            result["properties"][name]["description"] = text
        return result


def json_schema(block: type) -> dict[str, Any]:
    """Returns the JSON schema of a configuration block, with the description of each field, for
    editors.
    """
    return TypeAdapter(block).json_schema(schema_generator=_BlockSchema)


@cache
def _descriptions(block: type) -> dict[str, str]:
    """Returns the descriptions of all fields of a configuration block, inherited ones included, by
    the name of the field.

    The descriptions are the strings below the fields in the source, which is read at the first
    call. Pydantic would read the source of every block at its import.
    """
    descriptions: dict[str, str] = {}
    for base in filter(is_dataclass, reversed(block.__mro__)):
        # A block that is defined in an interactive session or in a module that is no longer loaded
        # has no source.
        with suppress(OSError, TypeError):
            source: Any = ast.parse(textwrap.dedent(inspect.getsource(base)))
            for field, text in pairwise(source.body[0].body):
                match field, text:
                    case ast.AnnAssign(ast.Name(name)), ast.Expr(ast.Constant(str(value))):
                        descriptions[name] = inspect.cleandoc(value)
    return descriptions


def plain_data(value: Any) -> Any:
    """Converts a configuration block to plain data (dictionaries, lists, numbers, texts), defaults
    included.
    """
    return TypeAdapter(type(value)).dump_python(value)


def _problem(kind: Any, error: ErrorDetails, where: str) -> str:
    """Converts an error of pydantic to one line with the full name of the field, the problem and
    the valid values.

    Args:
        kind: type that was validated.
        error: details of the error.
        where: name of the field with the validated data; empty for a whole file.
    """
    place, block, unit, limits = where, _block(kind), "", list[str]()
    for part in error["loc"]:
        if isinstance(part, int):
            place += f"[{part}]"
            continue
        if part.startswith("!"):
            block = _block(kind, part)
            continue
        place += f".{part}" if place else part
        if part in (fields := getattr(block, "__pydantic_fields__", {})):
            bracket = re.search(r" \[[^]-]+\]", _descriptions(block).get(part, "").split("\n\n")[0])
            kind, unit = fields[part].annotation, bracket[0] if bracket else ""
            block, limits = _block(kind), _limits(fields[part].metadata)
    context, value = error.get("ctx", {}), error["input"]
    if error["type"] in ("unexpected_keyword_argument", "extra_forbidden"):
        if error["loc"][-1] == "_tag":
            return f"{place.removesuffix('._tag')}: must have no tag, not {value}"
        names = list(getattr(block, "__dataclass_fields__", {}))
        near, valid = did_you_mean(str(error["loc"][-1]), names), ", ".join(names) or "none"
        return f"{place}: is not a field{near}; valid fields: {valid}"
    if error["type"] == "union_tag_invalid":
        tags = context["expected_tags"].replace("'", "")
        if not isinstance(value, Mapping):
            return f"{place}: expected one of {tags} with its fields, not {value!r}"
        tag = context["tag"]
        return f"{place}: tag {tag} is not one of {tags}{did_you_mean(tag, tags.split(', '))}"
    if error["type"] == "value_error":
        return f"{place}: {context['error']}{unit}"
    if error["type"].startswith(("greater", "less")) and limits:
        return f"{place}: must be {' and '.join(limits)}{unit}, not {value!r}"
    if error["type"] == "missing":
        return f"{place}: is missing"
    if error["type"] in ("dataclass_type", "dict_type"):
        return f"{place}: expected a block of field: value, not {value!r}"
    message = re.sub(r"List (.*) items? after.*", r"\1 values", error["msg"])
    return f"{place}: {message.removeprefix('Input ')}{unit}, not {value!r}"


def _limits(metadata: Iterable[Any]) -> list[str]:
    """Returns the limits of a numeric field as texts such as ">= 0".

    Args:
        metadata: metadata of the field from pydantic, such as `annotated_types.Ge(0)`.
    """
    signs = {"gt": ">", "ge": ">=", "le": "<="}
    return [
        f"{sign} {getattr(item, name):g}"
        for item in metadata
        for name, sign in signs.items()
        if hasattr(item, name)
    ]


def _block(kind: Any, tag: str = "") -> Any:
    """Finds the first configuration block in a type, such as a list or union of blocks; None if
    there is none.

    Args:
        kind: type or annotation.
        tag: YAML tag of the block to find; empty: any block.
    """
    if isinstance(kind, type) and hasattr(kind, "__dataclass_fields__"):
        return kind if tag in ("", f"!{kind.__name__}") else None
    blocks = (_block(each, tag) for each in typing.get_args(kind))
    return next((block for block in blocks if block is not None), None)


def check_choice(subject: str, choices: Collection[str], *names: str) -> None:
    """Checks that names are among the valid choices, for example of a command-line option.

    Args:
        subject: noun for the error message, such as "method".
        choices: valid names.
        names: names to check.

    Raises:
        ValueError: for the first name that is not a choice; lists the choices.
    """
    for name in names:
        if name not in choices:
            raise ValueError(f"unknown {subject} {name!r}; valid: {', '.join(choices)}")


def did_you_mean(word: str, choices: Iterable[str]) -> str:
    """Returns the text " (did you mean ...?)" with the valid choice that is most similar to a word;
    "" if none is similar.
    """
    near = difflib.get_close_matches(word, choices, 1)
    return f" (did you mean {near[0]}?)" if near else ""


def check_lcm_url(url: str, field: str) -> str:
    """Checks that LCM can both send and receive messages at a URL, and returns it.

    Args:
        url: PROVIDER://ADDRESS. LCM itself only logs an unknown provider.
        field: name of the scenario field or command-line option, for errors.

    Raises:
        ScenarioError: naming the valid providers.
    """
    provider, separator, _ = url.partition("://")
    if not separator or provider not in _LCM_PROVIDERS:
        raise ScenarioError(
            f"{field}: '{url}' must begin with one of "
            f"{', '.join(f'{name}://' for name in _LCM_PROVIDERS)}"
        )
    return url


def read_yaml(text: str) -> Any:
    """Parses a YAML text to plain data (dictionaries, lists, numbers, texts).

    The tag of a mapping becomes the value of its key "_tag".

    Raises:
        ScenarioError: if the text is not valid YAML, or a mapping has a key twice.
    """
    try:
        root = yaml.compose(text, Loader=yaml.SafeLoader)
        if root is None:
            # yaml_load of Drake does not accept an empty text.
            return None
        _check_nodes(root)
        return yaml_load(data=text)
    except ScenarioError:
        raise
    except RecursionError:
        raise ScenarioError("not valid YAML: blocks or lists are nested too deeply") from None
    except (yaml.YAMLError, ValueError) as error:
        raise ScenarioError(f"not valid YAML: {error}") from None


def _check_nodes(node: yaml.Node, where: str = "") -> None:
    """Checks that plain data can represent a YAML node: only mappings have tags, and keys are
    unique texts.

    Args:
        node: node to check, with all nodes below it.
        where: name of the field with the node, followed by "."; empty for the root.

    Raises:
        ScenarioError: naming the field or the line.
    """
    if node.tag.startswith("!") and not isinstance(node, yaml.MappingNode):
        prefix = f"{where.rstrip('.')}: " if where else ""
        raise ScenarioError(f"{prefix}tag {node.tag} requires a block: write '{node.tag} {{}}'")
    if isinstance(node, yaml.MappingNode):
        names = set()
        for key, value in node.value:
            line = key.start_mark.line + 1
            if not key.tag.endswith((":str", ":merge")):
                text = f"'{key.value}'" if isinstance(key, yaml.ScalarNode) else "a block or list"
                raise ScenarioError(f"a field's name must be text, not {text} (line {line})")
            name = f"{where}{key.value}"
            if key.value in names:
                raise ScenarioError(f"'{name}' is given twice (line {line})")
            names.add(key.value)
            _check_nodes(value, f"{name}.")
    elif isinstance(node, yaml.SequenceNode):
        for number, item in enumerate(node.value):
            _check_nodes(item, f"{where}{number}.")


def apply_override(data: dict[str, Any], override: str) -> None:
    """Applies an override "a.b=c" to plain data: the value c, read as YAML, replaces field b of
    block a.

    If c is a block without a tag, its fields are merged into an existing block b.

    Args:
        data: plain data of a scenario (dictionaries, lists, numbers, texts), modified in place.
        override: text of the form "a.b=c", such as "task.clearance=0.1".

    Raises:
        ScenarioError: if the override has another form, c is not valid YAML, or a is not a block.
    """
    key, equals, text = override.partition("=")
    if not equals or not all(map(str.strip, key.split("."))):
        raise ScenarioError(f"override '{override}' must have the form FIELD.SUBFIELD=VALUE")
    try:
        value = read_yaml(f"value: {text}")["value"]
    except ScenarioError as error:
        raise ScenarioError(f"override '{override}': {error}") from None
    block = data
    *parents, leaf = key.strip().split(".")
    for name in parents:
        child = block.get(name)
        if child is None:
            child = block[name] = {}
        if not isinstance(child, dict):
            raise ScenarioError(f"override '{override}': '{name}' is not a block")
        block = child
    if isinstance(value, dict) and isinstance(block.get(leaf), dict) and "_tag" not in value:
        block[leaf] |= value
    else:
        block[leaf] = value
