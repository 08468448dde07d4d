"""Simulated compute latency: work counters, duration of a decision, and the decision in progress.

A decision is one periodic computation of a layer, such as the search for a motion. Its measured
duration would differ between runs; counted work is the same on every machine. `counted` opens
counters, and the roll-outs (simulations of motions) and clearance computations of a decision add to
them by `count`. `LatencyModel` converts the counts to seconds.
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
    """Model that converts the counted work of a decision to its simulated compute latency.

    A decision is one periodic computation of the motion search or of the motion guard. The default
    times are those of two cores of a Xeon at 2.1 GHz.
    """

    decision: float = Field(default=1e-3, ge=0.0, le=1.0)
    """Constant compute time of one decision (computation of a motion or maneuver), to which the
    times of its searches, steps, clearances and claims are added [s]. Raising it delays every
    decision."""
    search: float = Field(default=2.5e-3, ge=0.0, le=1.0)
    """Constant compute time of one batch of roll-outs (simulations of candidate motions), to which
    the times of its time steps are added [s]. Raising it delays searches."""
    step: float = Field(default=4e-7, ge=0.0, le=1.0)
    """Compute time of one time step in the roll-out (simulation) of one candidate motion [s].
    Raising it delays searches."""
    configuration: float = Field(default=5e-6, ge=0.0, le=1.0)
    """Compute time of the clearance of the whole arm in one configuration [s]. Raising it delays
    searches and maneuvers."""
    claim: float = Field(default=2e-4, ge=0.0, le=1.0)
    """Compute time to check one trajectory for claim (A) of passive motion safety: where a moving
    obstacle may reach the arm, the arm rests or moves away [s]. A check for claim (B), which limits
    the speed toward unobserved space, requires three times this time. Raising it delays
    maneuvers."""

    def seconds(self, work: Counter[str]) -> float:
        """Returns the compute latency of a decision [s].

        Args:
            work: numbers of "searches" (batches of roll-outs), "steps" (time steps of roll-outs),
                "configurations" (computations of the arm's clearance) and "claims" (checks of
                trajectories for passive motion safety) in the decision, as `counted` yields them.
        """
        return (
            self.decision
            + self.search * work["searches"]
            + self.step * work["steps"]
            + self.configuration * work["configurations"]
            + self.claim * work["claims"]
        )


_account: ContextVar[Counter[str]] = ContextVar("work")
"""Counters of the computing work in the innermost `with counted()` block.

`counted` creates new counters at the beginning of the block, and `count` increases them. The
counters are "searches" (batches of roll-outs), "steps" (time steps of roll-outs), "configurations"
(computations of the arm's clearance) and "claims" (checks of trajectories for passive motion
safety)."""


@contextmanager
def counted() -> Iterator[Counter[str]]:
    """Counts the computing work that the functions called in the `with` block report by `count`.

    The counts are also added to an enclosing `counted` block.

    Yields:
        Numbers of "searches" (batches of roll-outs), "steps" (time steps of all roll-outs; for a
        point among ellipsoids, once more for each ellipsoid),
        "configurations" (computations of the whole arm's clearance in one configuration) and
        "claims" (checks of a trajectory's speed near moving obstacles, counted as 1, and near
        unobserved space, counted as 3).
    """
    work = Counter[str]()
    token = _account.set(work)
    try:
        yield work
    finally:
        _account.reset(token)
        count(**work)


def count(**work: int) -> None:
    """Reports computing work, which is added to the counters of the enclosing `counted` block.

    Does nothing outside of such a block.

    Args:
        work: numbers to add to the counters "searches" (batches of roll-outs), "steps" (time steps
            of roll-outs), "configurations" (computations of the arm's clearance) and "claims"
            (checks of trajectories for passive motion safety).
    """
    _account.get(Counter()).update(work)


T = TypeVar("T")


@dc.dataclass(frozen=True, eq=False)
class PendingDecision(Frozen, Generic[T]):
    """Active decision of a layer, and the next decision while it is computed with simulated
    latency.

    Only one decision is computed at a time. It uses the inputs at its start. It is completed at the
    simulated time `due`, and becomes active when the system that stores it then calls `activate`.

    =========  ===========================  ================================================
    State      Condition                    Method and next state
    =========  ===========================  ================================================
    idle       `pending` is None            `start`: computing; without latency model: idle,
                                            and the new decision is active at once
    computing  `pending` set, time < due    `discard`: idle
    completed  `pending` set, time >= due   `activate` or `discard`: idle
    =========  ===========================  ================================================

    Attributes:
        active: decision that is executed.
        pending: decision in progress or completed, not active yet; None: there is no such decision.
        due: simulated time at which the pending decision is completed [s]; inf without one.
        start_time: simulated time of the start of the last decision [s]; NaN before the first, and
            always without latency model.
        latency: compute latency of the last decision [s]; 0 before the first, and always without
            latency model.
    """

    active: T
    pending: T | None = None
    due: float = math.inf
    start_time: float = math.nan
    latency: float = 0.0

    def start(
        self, decide: Callable[[T], T], time: float, compute_latency: LatencyModel | None
    ) -> Self:
        """Starts a decision unless one is pending, and returns the resulting `PendingDecision`.

        Args:
            decide: function that computes the decision from the active one.
            time: current simulated time [s].
            compute_latency: model of the decision's compute latency; None: no latency, the
                decision is active at once.
        """
        if self.pending is not None:
            return self
        with counted() as work:
            result = decide(self.active)
        if compute_latency is None:
            return dc.replace(self, active=result)
        latency = compute_latency.seconds(work)
        due = time + latency
        return dc.replace(self, pending=result, due=due, start_time=time, latency=latency)

    def result_at(self, time: float) -> T | None:
        """Returns the pending decision if it is completed at a simulated time [s], else None."""
        return self.pending if self.due <= time else None

    def activate(self) -> Self:
        """Returns a `PendingDecision` whose active decision is the pending one; `self` if none is
        pending.
        """
        if self.pending is None:
            return self
        return dc.replace(self, active=self.pending, pending=None, due=math.inf)

    def discard(self) -> Self:
        """Returns a `PendingDecision` with none pending; the discarded one never becomes active."""
        return dc.replace(self, pending=None, due=math.inf)

    @property
    def timing(self) -> tuple[float, float]:
        """Start (simulated time) and compute latency of the last decision [s].

        They are NaN and 0 before the first decision, and always without latency model.
        """
        return (self.start_time, self.latency)
