"""Configuration blocks: typed fields with units and ranges, and YAML data held against them.

A block is a dataclass whose fields are made by `number`, `count`, `choice` and `vector`.
`read_yaml` and `apply_override` make plain mappings, a block's tag under "_tag"; `check`
compares them with dataclasses (and Drake's own schemas), so that an error names the field.
"""

from __future__ import annotations

import dataclasses as dc
import difflib
import math
import types
import typing
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import yaml
from pydrake.common.yaml import yaml_load

_TURN = 2.0 * math.pi
"""Largest magnitude of a roll, pitch or yaw [rad]."""
_LCM_PROVIDERS = ("udpm", "tcpq", "memq")
"""Providers of LCM that carry messages both ways; `file` only records or replays."""
_MOST = 100_000
"""Most values of a YAML text, counted again wherever an alias stands for them."""


class ScenarioError(ValueError):
    """A scenario that cannot be run: says which field, and what would be valid."""


def number(
    default: float,
    unit: str,
    low: float = -math.inf,
    high: float = math.inf,
    *,
    open_low: bool = False,
    below: str = "",
) -> Any:
    """A finite number in [low, high], or in (low, high] with `open_low`.

    With `below` it must be less than the field of that name, see `check_values`.
    """
    metadata = {"unit": unit, "low": low, "high": high, "open_low": open_low, "below": below}
    return dc.field(default=default, metadata=metadata)


def choice(default: str, *others: str) -> Any:
    """One of some words."""
    return dc.field(default=default, metadata={"choices": (default, *others)})


def count(default: int, low: int, high: int) -> Any:
    """A whole number in [low, high]."""
    return dc.field(default=default, metadata={"unit": "1", "low": low, "high": high})


def vector(
    default: list[float], unit: str, size: int | None = None, *, within: float = math.inf
) -> Any:
    """`size` finite numbers, each in [-within, within]; None: as many as the default has."""
    size = len(default) if size is None else size
    return dc.field(
        default_factory=lambda: list(default),
        metadata={"unit": unit, "size": size, "low": -within, "high": within},
    )


def roll_pitch_yaw(default: list[float] | None = None) -> Any:
    """Three angles [rad], each at most one turn either way; null without a default."""
    metadata = {"unit": "rad", "size": 3, "low": -_TURN, "high": _TURN}
    if default is None:
        return dc.field(default=None, metadata=metadata)
    return dc.field(default_factory=lambda: list(default), metadata=metadata)


def read_yaml(text: str) -> Any:
    """Plain data of a YAML text, a block's tag under the key "_tag"."""
    try:
        root = yaml.compose(text, Loader=yaml.SafeLoader)
        if root is None:
            # Drake takes an empty text for no text at all.
            return None
        check_size(root)
        _check_nodes(root)
        return yaml_load(data=text)
    except ScenarioError:
        raise
    except RecursionError:
        raise ScenarioError("not valid YAML: too many blocks or lists within each other") from None
    except (yaml.YAMLError, ValueError) as error:
        raise ScenarioError(f"not valid YAML: {error}") from None


def check_size(root: yaml.Node) -> None:
    """Refuses what aliases blow up, or what holds itself, before anything follows them.

    Raises:
        ScenarioError: if there are more than `_MOST` values.
    """
    count, left = 0, [root]
    while left:
        node = left.pop()
        count += 1
        if count > _MOST:
            raise ScenarioError(
                f"holds more than {_MOST} values (what an alias repeats is counted again)"
            )
        if isinstance(node, yaml.MappingNode):
            left += [item for pair in node.value for item in pair]
        elif isinstance(node, yaml.SequenceNode):
            left += node.value


def _check_nodes(node: yaml.Node, where: str = "") -> None:
    """Refuses what would be lost, or not be understood, in plain data."""
    if node.tag.startswith("!") and not isinstance(node, yaml.MappingNode):
        prefix = f"{where.rstrip('.')}: " if where else ""
        raise ScenarioError(f"{prefix}tag {node.tag} needs a block: write '{node.tag} {{}}'")
    if isinstance(node, yaml.MappingNode):
        seen = set()
        for key, value in node.value:
            line = key.start_mark.line + 1
            if not key.tag.endswith((":str", ":merge")):
                shown = f"'{key.value}'" if isinstance(key, yaml.ScalarNode) else "a block or list"
                raise ScenarioError(f"a field's name must be text, not {shown} (line {line})")
            name = f"{where}{key.value}"
            if key.value in seen:
                raise ScenarioError(f"'{name}' is given twice (line {line})")
            seen.add(key.value)
            _check_nodes(value, f"{name}.")
    elif isinstance(node, yaml.SequenceNode):
        for number, item in enumerate(node.value):
            _check_nodes(item, f"{where}{number}.")


def apply_override(data: dict[str, Any], override: str) -> None:
    """Merges "a.b=c" into plain data: c, read as YAML, replaces field b of block a.

    A block without a tag is merged into the block that is there.
    """
    key, equals, text = override.partition("=")
    if not equals or not all(map(str.strip, key.split("."))):
        raise ScenarioError(f"override '{override}' must have the form field.subfield=value")
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


def schema_fields(schema: type) -> dict[str, tuple[Any, Any]] | None:
    """Name -> (type, metadata) of the fields of a block, ours or Drake's; None: it is none."""
    if dc.is_dataclass(schema):
        hints = typing.get_type_hints(schema)
        return {item.name: (hints[item.name], item.metadata) for item in dc.fields(schema)}
    if hasattr(schema, "__fields__"):
        return {item.name: (item.type, {}) for item in schema.__fields__}
    return None


def check(data: Any, schema: Any, where: str, metadata: Any) -> None:
    """Holds plain YAML data against a type; raises with the first field's full name."""
    for problem in problems(data, schema, where, metadata):
        raise ScenarioError(problem)


def problems(data: Any, schema: Any, where: str, metadata: Any) -> Iterator[str]:
    """All that is wrong with plain YAML data, a line a field.

    Args:
        data: what `read_yaml` made.
        schema: the type that it is to have.
        where: full name of the field; empty for the whole.
        metadata: of the field: unit, range, number of values, choices.
    """
    origin, arguments = typing.get_origin(schema), typing.get_args(schema)
    if origin in (types.UnionType, typing.Union):
        yield from _union_problems(data, arguments, where, metadata)
    elif "choices" in metadata:
        if data not in metadata["choices"]:
            yield f"{where}: {data!r} is not one of {', '.join(metadata['choices'])}"
    elif origin in (list, typing.List):  # noqa: UP006
        if not isinstance(data, list):
            yield f"{where}: expected a list, not {data!r}"
            return
        size = metadata.get("size")
        if size is not None and len(data) != size:
            yield f"{where}: expected {size} numbers, not {len(data)}"
        of_item = {key: metadata[key] for key in ("unit", "low", "high") if key in metadata}
        for number, item in enumerate(data):
            yield from problems(item, arguments[0], f"{where}[{number}]", of_item)
    elif schema is np.ndarray and isinstance(data, list):
        for number, item in enumerate(data):
            if not isinstance(item, list):
                yield from _number_problems(item, float, f"{where}[{number}]", {})
    elif origin is dict:
        if problem := _block_problem(data, where):
            yield problem
            return
        for name, value in data.items():
            yield from problems(value, arguments[1], f"{where}.{name}", {})
    elif schema in (float, int):
        yield from _number_problems(data, schema, where, metadata)
    elif schema in (bool, str):
        if not isinstance(data, schema):
            kind = "true or false" if schema is bool else "text"
            yield f"{where}: expected {kind}, not {data!r}"
    elif (known := schema_fields(schema)) is not None:
        if problem := _block_problem(data, where):
            yield problem
            return
        for name, value in data.items():
            full_name = f"{where}.{name}" if where else name
            if name not in known:
                valid = ", ".join(known) or "none"
                yield f"{full_name} is not a field{did_you_mean(name, known)}; valid here: {valid}"
                continue
            kind, extra = known[name]
            yield from problems(value, kind, full_name, extra)


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """` (did you mean ...?)`, where one of those that are known is much like a word."""
    near = difflib.get_close_matches(word, known, 1)
    return f" (did you mean {near[0]}?)" if near else ""


def check_values(config: Any, where: str = "") -> None:
    """Holds a configuration that was made in Python against its fields, as `check` does a file's.

    What no single field can tell is checked too: a field whose metadata has `below` must be less
    than the field that this names.

    Args:
        config: a dataclass.
        where: its full name; empty: that of its class.

    Raises:
        ScenarioError: naming the field and what would be valid.
    """
    where = where or type(config).__name__
    for name, (kind, metadata) in (schema_fields(type(config)) or {}).items():
        value, full_name = getattr(config, name), f"{where}.{name}"
        parts = value if isinstance(value, list) else [value]
        if any(map(dc.is_dataclass, parts)):
            for row, part in enumerate(parts):
                check_values(part, f"{full_name}[{row}]" if parts is value else full_name)
        elif not hasattr(type(value), "__fields__"):
            check(value, kind, full_name, metadata)
        other = metadata.get("below")
        if other and not value < (limit := getattr(config, other)):
            raise ScenarioError(f"{full_name} must be less than {other}, not {value} and {limit}")


def check_lcm_url(url: str, field: str) -> None:
    """Refuses a URL whose messages cannot be both sent and received by LCM.

    Args:
        url: PROVIDER://ADDRESS. LCM itself only prints that it does not know a provider.
        field: name of the field or option, for errors.

    Raises:
        ScenarioError: naming the valid providers.
    """
    provider, separator, _ = url.partition("://")
    if not separator or provider not in _LCM_PROVIDERS:
        raise ScenarioError(
            f"{field}: '{url}' must begin with one of "
            f"{', '.join(f'{name}://' for name in _LCM_PROVIDERS)}"
        )


def _block_problem(data: Any, where: str) -> str | None:
    if not isinstance(data, dict):
        return f"{where}: expected a block of name: value, not {data!r}"
    if "_tag" in data:
        return f"{where or 'scenario'}: takes no tag, but has {data['_tag']}"
    return None


def _union_problems(
    data: Any, options: tuple[Any, ...], where: str, metadata: Any
) -> Iterator[str]:
    if type(None) in options and data is None:
        return
    choices = [option for option in options if option is not type(None)]
    tags = tagged(choices)
    tag = data.get("_tag") if isinstance(data, dict) else None
    if not isinstance(data, dict) and len(tags) == len(choices) > 1:
        yield f"{where}: expected one of {', '.join(tags)} with a block, not {data!r}"
    elif tag is None or len(choices) == 1:
        yield from problems(data, choices[0], where, metadata)
    elif tag in tags:
        block = {name: value for name, value in data.items() if name != "_tag"}
        yield from problems(block, tags[tag], where, metadata)
    else:
        near = did_you_mean(str(tag), tags)
        yield f"{where}: tag {tag} is not one of {', '.join(tags)}{near}"


def tagged(choices: Iterable[Any]) -> dict[str, Any]:
    """Tag -> type, of the types that are blocks."""
    # Drake's templates carry their arguments in their names, but not in their tags.
    return {
        f"!{choice.__name__.partition('𝓣')[0]}": choice
        for choice in choices
        if schema_fields(choice) is not None
    }


def _number_problems(data: Any, schema: type, where: str, metadata: Any) -> Iterator[str]:
    valid = (int,) if schema is int else (int, float)
    unit = f" [{metadata['unit']}]" if metadata.get("unit") else ""
    if isinstance(data, bool) or not isinstance(data, valid):
        kind, hint = ("a whole number", "") if schema is int else ("a number", _number_form(data))
        yield f"{where}: expected {kind}{unit}, not {data!r}{hint}"
        return
    if not math.isfinite(data):
        yield f"{where}: must be a finite number{unit}, not {data}"
        return
    low, high = metadata.get("low", -math.inf), metadata.get("high", math.inf)
    above = data > low if metadata.get("open_low") else data >= low
    if above and data <= high:
        return
    if high == _TURN:
        yield (
            f"{where}: {data:g} rad is more than one turn; angles are in radians "
            f"({data:g} degrees are {math.radians(data):.4g} rad)"
        )
    else:
        left = "(" if metadata.get("open_low") else "["
        yield f"{where}: {data} is outside {left}{low:g}, {high:g}]{unit}"


def _number_form(data: Any) -> str:
    """How to write a number that YAML 1.1 reads as text, such as 1e-1."""
    try:
        value = float(data) if isinstance(data, str) else math.nan
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        return ""
    scientific = np.format_float_scientific(value, trim="0", exp_digits=1)
    plain = "" if "e" in repr(value) else f"{value!r} or "
    return f", which is text in YAML; write {plain}{scientific}"
