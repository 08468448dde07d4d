"""The work of a decision, counted where it is done, and the time that it costs.

A clock would make no two runs alike; a count is the same on every machine. `counted` opens an
account, and what dominates the decisions adds to it by `count`: roll-outs of motions, postures
of the arm along them, ways of evasion. `Thinking` makes seconds of it.
"""

# No postponed annotations here: yaml_load_typed reads the fields' types.
import dataclasses as dc
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from drake_oa.common.scenario_fields import number


@dc.dataclass
class Work:
    """What has been done.

    Attributes:
        searches: batches of motions that were rolled out.
        steps: their steps, of all motions, beside each of the obstacles.
        postures: postures of the arm, or of a tool that turns, that were measured.
        poses: poses of the arm on the ways of evasion that were looked at.
    """

    searches: int = 0
    steps: int = 0
    postures: int = 0
    poses: int = 0


@dc.dataclass
class Thinking:
    """What decisions cost in simulated time: processor time on two cores at 2.5 GHz."""

    # A decision, whatever it looks at [s].
    decision: float = number(1.4e-3, "s", 0.0, 1.0)
    # A batch of motions that is rolled out, and a step of a motion beside an obstacle [s].
    search: float = number(2.9e-3, "s", 0.0, 1.0)
    step: float = number(1.6e-8, "s", 0.0, 1.0)
    # A posture of the arm that is measured, and a pose of it on a way of evasion [s].
    posture: float = number(1.35e-5, "s", 0.0, 1.0)
    pose: float = number(2.2e-5, "s", 0.0, 1.0)

    def seconds(self, work: Work) -> float:
        """Time that a decision takes [s]."""
        return (
            self.decision
            + self.search * work.searches
            + self.step * work.steps
            + self.posture * work.postures
            + self.pose * work.poses
        )


_account: ContextVar[Work | None] = ContextVar("work", default=None)


@contextmanager
def counted() -> Iterator[Work]:
    """An account of what is done inside; one that is open already gets none of it."""
    work = Work()
    token = _account.set(work)
    try:
        yield work
    finally:
        _account.reset(token)


def count(**done: int) -> None:
    """Adds to the account that is open, by the names of `Work`; there need be none."""
    work = _account.get()
    if work is not None:
        for name, number_done in done.items():
            setattr(work, name, getattr(work, name) + number_done)
