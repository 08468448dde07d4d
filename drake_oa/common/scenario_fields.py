"""Fields of scenario blocks: a default with the unit and range that `check` holds it to."""

# No postponed annotations here: yaml_load_typed reads the fields' types.
import dataclasses as dc
import math
from typing import Any


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

    With `below` it must be less than the field of that name, see `schema_check.check_values`.
    """
    metadata = {"unit": unit, "low": low, "high": high, "open_low": open_low, "below": below}
    return dc.field(default=default, metadata=metadata)


def choice(default: str, *others: str) -> Any:
    """One of some words."""
    return dc.field(default=default, metadata={"choices": (default, *others)})


def count(default: int, low: int, high: int) -> Any:
    """A whole number in [low, high]."""
    return dc.field(default=default, metadata={"unit": "1", "low": low, "high": high})


def vector(default: list[float], unit: str, size: int | None = None) -> Any:
    """`size` finite numbers; None: as many as the default has."""
    return dc.field(
        default_factory=lambda: list(default),
        metadata={"unit": unit, "size": len(default) if size is None else size},
    )
