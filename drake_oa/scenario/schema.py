"""The form of a scenario as JSON Schema, from which editors complete and explain its fields.

Made from the dataclasses of `drake_oa.scenario.scenario`: types, units, ranges, and the comments
above the fields. Of a block with a tag, any of the blocks fits: JSON knows no tags.
"""

from __future__ import annotations

import dataclasses as dc
import inspect
import math
import re
import types
import typing
from typing import Any

import numpy as np

from drake_oa.common.config import schema_fields
from drake_oa.scenario.scenario import Scenario

_FIELD = re.compile(r"    (\w+):")


def json_schema() -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of a scenario file."""
    blocks: dict[str, Any] = {}
    _block(Scenario, blocks)
    whole = blocks.pop("Scenario")
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "drake_oa scenario"}
    return head | whole | {"$defs": blocks}


def comments(block: type) -> dict[str, str]:
    """Name -> the comment above it, of a dataclass's fields that have one."""
    found, above = {}, list[str]()
    own = [each for each in reversed(block.__mro__) if dc.is_dataclass(each)]
    for line in "\n".join(map(inspect.getsource, own)).splitlines():
        if line.strip().startswith("#"):
            above.append(line.strip().removeprefix("#").strip())
            continue
        if (field := _FIELD.match(line)) and above:
            found[field[1]] = " ".join(above)
        above = []
    return found


def _block(block: type, blocks: dict[str, Any]) -> dict[str, str]:
    """A reference to a block, which is written down once."""
    name = re.sub(r"\W", "", block.__name__, flags=re.ASCII)
    if name not in blocks:
        blocks[name] = {}
        texts = comments(block) if dc.is_dataclass(block) else {}
        defaults = _defaults(block)
        properties = {}
        for field, (kind, metadata) in (schema_fields(block) or {}).items():
            own = _kind(kind, metadata, blocks)
            if field in texts:
                own["description"] = texts[field]
            if field in defaults:
                own["default"] = defaults[field]
            properties[field] = own
        blocks[name] = {"type": "object", "properties": properties, "additionalProperties": False}
        if block.__doc__ and dc.is_dataclass(block):
            blocks[name]["description"] = " ".join(block.__doc__.split())
    return {"$ref": f"#/$defs/{name}"}


def _defaults(block: type) -> dict[str, Any]:
    """Name -> default, of a dataclass's fields whose default is plain."""
    if not dc.is_dataclass(block):
        return {}
    plain = {}
    for item in dc.fields(block):
        value = item.default
        if value is dc.MISSING and item.default_factory is not dc.MISSING:
            value = item.default_factory()
        parts = value if isinstance(value, list) else [value]
        if all(part is None or isinstance(part, bool | int | float | str) for part in parts):
            plain[item.name] = value
    return plain


def _kind(kind: Any, metadata: Any, blocks: dict[str, Any]) -> dict[str, Any]:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if "choices" in metadata:
        return {"enum": list(metadata["choices"])}
    if origin in (types.UnionType, typing.Union):
        return {"anyOf": [_kind(each, metadata, blocks) for each in arguments]}
    if kind is type(None):
        return {"type": "null"}
    if origin is list:
        size = metadata.get("size")
        counted = {"minItems": size, "maxItems": size} if size is not None else {}
        return {"type": "array", "items": _kind(arguments[0], metadata, blocks)} | counted
    if origin is dict:
        return {"type": "object", "additionalProperties": _kind(arguments[1], {}, blocks)}
    if kind is np.ndarray:
        return {"type": "array", "items": {"type": "number"}}
    if kind in (float, int):
        return {"type": "number" if kind is float else "integer"} | _range(metadata)
    if kind in (bool, str):
        return {"type": "boolean" if kind is bool else "string"}
    if schema_fields(kind) is not None:
        return _block(kind, blocks)
    return {}


def _range(metadata: Any) -> dict[str, float]:
    low, high = metadata.get("low", -math.inf), metadata.get("high", math.inf)
    found = {"exclusiveMinimum" if metadata.get("open_low") else "minimum": low, "maximum": high}
    return {name: value for name, value in found.items() if math.isfinite(value)}
