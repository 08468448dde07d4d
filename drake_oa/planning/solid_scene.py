"""What is in the world besides the robot, as it travels between systems."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from drake_oa.common.messages import Frozen
from drake_oa.geometry.solids import Solids, solids_of


@dataclass(frozen=True, eq=False)
class SolidScene(Frozen):
    """The solids of one observation.

    Attributes:
        stamp: when the world was so [s]; -inf before the first observation.
        solids: K of them.
        labels: what to call each in a message.
        note: empty, or why there is no newer observation.
    """

    stamp: float = -math.inf
    solids: Solids = field(default_factory=lambda: solids_of([]))
    labels: tuple[str, ...] = ()
    note: str = ""

    def __post_init__(self) -> None:
        """Leaves the arrays unlocked: the kernels are compiled for such, and change none."""

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def moves(self) -> bool:
        """Whether any of them does."""
        return bool(self.solids.ball[:, 4:7].any())

    def same_as(self, other: SolidScene) -> bool:
        """Whether nothing has moved or changed since another observation."""
        if self is other:
            return True
        if self.moves or other.moves or self.labels != other.labels:
            return False
        if self.solids is other.solids:
            return True
        # Those at rest have no stamp.
        pairs = zip(self.solids._asdict().values(), other.solids._asdict().values(), strict=True)
        return all(np.array_equal(np.asarray(one), np.asarray(two)) for one, two in pairs)
