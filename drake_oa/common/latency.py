"""Decisions that take time: their work, its duration, and the decision in force meanwhile.

A clock would make no two runs alike; a count is the same on every machine. `counted` opens an
account, and what dominates the decisions adds to it by `count`: roll-outs of motions,
configurations of the arm along them. `LatencyModel` makes seconds of it.
"""

import dataclasses as dc
import math
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Generic, Self, TypeVar

from pydantic import Field
from pydantic.dataclasses import dataclass

from drake_oa.common.config import BLOCK
from drake_oa.common.messages import Frozen


@dataclass(config=BLOCK)
class LatencyModel:
    """Simulated duration of decisions: a model of processor time on two cores at 2.5 GHz."""

    decision: float = Field(default=1e-3, ge=0.0, le=1.0)
    """Time of one decision, independent of its work [s]. Raising it makes every decision later."""
    search: float = Field(default=1e-3, ge=0.0, le=1.0)
    """Time of one batch of rolled-out motions [s]. Raising it makes searches later."""
    step: float = Field(default=1e-7, ge=0.0, le=1.0)
    """Time of one time step of one rolled-out motion [s]. Raising it makes searches later."""
    configuration: float = Field(default=5e-6, ge=0.0, le=1.0)
    """Time of one clearance computation of the whole arm [s]. Raising it makes searches and
    maneuvers later."""

    def seconds(self, work: Counter[str]) -> float:
        """Time that a decision takes [s]."""
        return (
            self.decision
            + self.search * work["searches"]
            + self.step * work["steps"]
            + self.configuration * work["configurations"]
        )


_account: ContextVar[Counter[str]] = ContextVar("work")


@contextmanager
def counted() -> Iterator[Counter[str]]:
    """Opens an account of the work in the block, which an outer account receives, too.

    Yields:
        Numbers of "searches" (batches of motions that were rolled out), "steps" (of all of these
        motions) and "configurations" (of the arm that were measured against the solids).
    """
    work = Counter[str]()
    token = _account.set(work)
    try:
        yield work
    finally:
        _account.reset(token)
        count(**work)


def count(**done: int) -> None:
    """Adds to the account that is open, if one is, by the names that `counted` lists."""
    _account.get(Counter()).update(done)


T = TypeVar("T")


@dc.dataclass(frozen=True, eq=False)
class PendingDecision(Frozen, Generic[T]):
    """Decision in force and decision being made; one core makes one after the other.

    A decision is computed when it begins, from what is known then, and is in force from
    `due` on; until then what was in force stays so.

    Attributes:
        active: the decision to go by.
        pending: the one that is being made; None: none is.
        due: when that is made [s].
        begun: when the last one began [s]; NaN: none has.
        cost: time that it takes [s].
    """

    active: T
    pending: T | None = None
    due: float = math.inf
    begun: float = math.nan
    cost: float = 0.0

    def start(
        self, decide: Callable[[T], T], time: float, compute_latency: LatencyModel | None
    ) -> Self:
        """Begins a decision, unless one is being made.

        Args:
            decide: makes it, given the one in force.
            time: now [s].
            compute_latency: what it costs; None: it is in force at once.
        """
        if self.pending is not None:
            return self
        with counted() as work:
            after = decide(self.active)
        if compute_latency is None:
            return dc.replace(self, active=after)
        cost = compute_latency.seconds(work)
        return dc.replace(self, pending=after, due=time + cost, begun=time, cost=cost)

    def completed(self, time: float) -> T | None:
        """The decision that has been made by now and is not in force yet [s]; None: none."""
        return self.pending if self.due <= time else None

    def activated(self) -> Self:
        """The pending decision in force."""
        if self.pending is None:
            return self
        return dc.replace(self, active=self.pending, pending=None, due=math.inf)

    def discarded(self) -> Self:
        """Without the pending decision."""
        return dc.replace(self, pending=None, due=math.inf)

    @property
    def last(self) -> tuple[float, float]:
        """Begin and duration of the last decision [s], for a port of size 2."""
        return (self.begun, self.cost)
