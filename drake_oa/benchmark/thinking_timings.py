"""Processor time of a run's decisions beside the work that they count, for
`drake_oa.benchmark.benchmark`."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import astuple, dataclass

import numpy as np
from scipy.optimize import nnls

from drake_oa.common import thoughts
from drake_oa.common.work import Thinking, Work
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.scenario import Scenario

_LEAST = 2e-3
"""Decisions that are shorter weigh as much as those that take so long [s]."""


@dataclass(frozen=True)
class ThinkingTimings:
    """What the decisions of a run took.

    Attributes:
        decisions: how many there were.
        measured: their processor time, of all threads [s].
        modelled: the simulated time that they cost [s].
        fitted: the constants that fit these decisions best.
    """

    decisions: int
    measured: float
    modelled: float
    fitted: Thinking


def time_thinking(
    scenario: Scenario, duration: float | None = None, runs: int = 2
) -> ThinkingTimings:
    """Times the decisions of a scenario's motion, each the quickest of some runs.

    Args:
        scenario: whose.
        duration: time limit of a run [s]; None: that of `simulate`.
        runs: how many there are, at least 1.

    Raises:
        ValueError: if none costs time: the scenario's `thinking` is null.
    """
    if scenario.thinking is None:
        raise ValueError("thinking: this scenario has null, and its decisions cost no time")
    each = [_timed_run(scenario, duration) for _ in range(runs)]
    work = each[0][0]
    seconds = np.min([taken for _, taken in each], axis=0)
    # The columns are in the order of `Thinking`.
    amounts = np.column_stack([np.ones(len(work)), [astuple(one) for one in work]])
    weight = 1.0 / np.sqrt(np.maximum(seconds, _LEAST))
    fitted, _ = nnls(amounts * weight[:, None], seconds * weight)
    return ThinkingTimings(
        len(work),
        float(seconds.sum()),
        sum(map(scenario.thinking.seconds, work)),
        Thinking(*fitted.tolist()),
    )


def _timed_run(scenario: Scenario, duration: float | None) -> tuple[list[Work], list[float]]:
    """The work of each decision of a run, the same in every run, and its processor time [s]."""
    work: list[Work] = []
    taken: list[float] = []
    plain = thoughts.counted

    @contextmanager
    def timed() -> Iterator[Work]:
        begun = time.process_time()
        with plain() as account:
            yield account
        taken.append(time.process_time() - begun)
        work.append(account)

    thoughts.counted = timed
    try:
        simulate(scenario, duration=duration)
    finally:
        thoughts.counted = plain
    return work, taken
