"""Tests of the comparison with stored results."""

from __future__ import annotations

from typing import Any

import pytest

from tests.regression.comparison import metric_failures, run_failures, suite_failures

_RUN: dict[str, Any] = {
    "ended": "goal",
    "contacts": [],
    "tool_clearance_min": 0.15,
    "robot_clearance_min": 0.1,
    "duration": 5.0,
}


@pytest.mark.parametrize(
    ("change", "failure"),
    [
        ({}, ""),
        ({"duration": 5.14, "robot_clearance_min": 0.0985, "tool_clearance_min": 0.3}, ""),
        ({"contacts": ["box/hand"]}, "new contact: box/hand"),
        ({"ended": "stop"}, "termination: goal -> stop"),
        ({"robot_clearance_min": 0.0979}, "robot_clearance_min: 0.1 -> 0.0979 m"),
        ({"tool_clearance_min": None}, "tool_clearance_min: 0.15 -> None m"),
        ({"duration": 5.16}, "duration: 5.0 -> 5.16 s"),
    ],
)
def test_worse_run_fails(change: dict[str, Any], failure: str) -> None:
    assert "".join(run_failures(_RUN, _RUN | change)) == failure


def _suite(*, successes: int, touched: int = 0, scenes: int = 20) -> dict[str, Any]:
    """Returns results of a suite, the first scenes successful or in contact."""
    return {
        f"scene{number}": {
            "success": number < successes,
            "contacts": ["box/hand"] if number < touched else [],
        }
        for number in range(scenes)
    }


@pytest.mark.parametrize(
    ("before", "after", "fails"),
    [
        # One-sided exact McNemar test: 4 losses without a gain have p = 0.0625, 5 have 0.031.
        (_suite(successes=15), _suite(successes=11), False),
        (_suite(successes=15), _suite(successes=10), True),
        (_suite(successes=10), _suite(successes=20), False),
        (_suite(successes=15), _suite(successes=15, touched=1), False),
        (_suite(successes=15), _suite(successes=15, touched=2), True),
        (_suite(successes=15), _suite(successes=15, scenes=19), True),
    ],
)
def test_worse_suite_fails(before: dict[str, Any], after: dict[str, Any], fails: bool) -> None:
    assert bool(list(suite_failures(before, after))) == fails


def test_changed_table_fails() -> None:
    table = {"a": {"nmse": 0.5, "signs": [1, -1]}}
    assert not list(metric_failures(table, {"a": {"nmse": 0.5 + 1e-8, "signs": [1, -1]}}))
    assert list(metric_failures(table, {"a": {"nmse": 0.51, "signs": [1, -1]}}))
    assert list(metric_failures(table, {"a": {"nmse": 0.5, "signs": [1, 1]}}))
