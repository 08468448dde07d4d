"""How many candidates the generators of scenes looked at, and why they dropped them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

Counts = Mapping[str, Mapping[str, int]]
"""What was looked at -> why it was dropped, "" for what was taken -> how often."""


class Tally:
    """Counts what is dropped while a scene is drawn, each candidate for its first reason."""

    def __init__(self) -> None:
        """Nothing counted."""
        self._counts: dict[str, Counter[str]] = {}

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        """Plain data, see `Counts`."""
        return {what: dict(found) for what, found in self._counts.items()}

    def takes(self, what: str, reason: str) -> bool:
        """Counts a candidate; whether it is taken.

        Args:
            what: it is a candidate for, in the plural: "scenes".
            reason: why it is dropped, in a few plain words; "": it is taken.
        """
        self._counts.setdefault(what, Counter())[reason] += 1
        return not reason


def drawn_figures(counts: Iterable[Counts]) -> dict[str, dict[str, Any]]:
    """What -> {"looked_at", "dropped": {reason: share, the greatest first}} of all scenes."""
    total: dict[str, Counter[str]] = {}
    for of_scene in counts:
        for what, found in of_scene.items():
            total.setdefault(what, Counter()).update(found)
    return {
        what: {
            "looked_at": found.total(),
            "dropped": {
                reason: count / found.total() for reason, count in found.most_common() if reason
            },
        }
        for what, found in total.items()
    }


def drawn_lines(drawn: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The same in words, a line each."""
    return [
        f"{what} looked at: {of['looked_at']}; dropped: "
        + (", ".join(f"{share:.1%} ({why})" for why, share in of["dropped"].items()) or "none")
        for what, of in drawn.items()
    ]
