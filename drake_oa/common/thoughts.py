"""Decisions that take time: what a system goes by while it thinks, and what it has thought."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Generic, Self, TypeVar

import numpy as np

from drake_oa.common.messages import FloatArray, Frozen, PolicyState
from drake_oa.common.work import Thinking, counted

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class ForMotion(Frozen, Generic[T]):
    """A decision on a motion, and the start and goal (3,) that the motion had then [m].

    They are NaN of one that was made before there was a motion.
    """

    decision: T
    p_WS: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    p_WG: FloatArray = field(default_factory=lambda: np.full(3, np.nan))

    def fits(self, policy: PolicyState, p_WG: FloatArray) -> bool:
        """Whether the motion that is under way now is the same."""
        return np.array_equal(policy.p_WS, self.p_WS) and np.array_equal(p_WG, self.p_WG)


@dataclass(frozen=True, eq=False)
class Thoughts(Frozen, Generic[T]):
    """What one core has decided, and is deciding: it makes one decision after the other.

    A decision is computed when it begins, from what is known then, and is in force from
    `due` on; until then what was in force stays so.

    Attributes:
        in_force: the decision to go by.
        pending: the one that is being made; None: none is.
        due: when that is made [s].
        begun: when the last one began [s]; NaN: none has.
        cost: time that it takes [s].
    """

    in_force: T
    pending: T | None = None
    due: float = math.inf
    begun: float = math.nan
    cost: float = 0.0

    def thought(self, decide: Callable[[T], T], time: float, thinking: Thinking | None) -> Self:
        """Begins a decision, unless one is being made.

        Args:
            decide: makes it, given the one in force.
            time: now [s].
            thinking: what it costs; None: it is in force at once.
        """
        if self.pending is not None:
            return self
        with counted() as work:
            after = decide(self.in_force)
        if thinking is None:
            return replace(self, in_force=after)
        cost = thinking.seconds(work)
        return replace(self, pending=after, due=time + cost, begun=time, cost=cost)

    def made(self, time: float) -> T | None:
        """The decision that has been made by now and is not in force yet [s]; None: none."""
        return self.pending if self.due <= time else None

    def taken(self) -> Self:
        """The pending decision in force."""
        if self.pending is None:
            return self
        return replace(self, in_force=self.pending, pending=None, due=math.inf)

    def dropped(self) -> Self:
        """Without the pending decision."""
        return replace(self, pending=None, due=math.inf)

    @property
    def last(self) -> tuple[float, float]:
        """When the last decision began, and what it costs [s]; for a port of size 2."""
        return (self.begun, self.cost)
