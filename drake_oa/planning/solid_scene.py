"""What is in the world besides the robot, as it travels between systems.

What goes on beyond the image: a thing that is cut off by it is taken to be longer.

A post that the image shows the lower half of, or the upper half of which is too near, has no end
there, and nothing may pass over it. What is cut off is taken to go on upright for as far as it is
seen; what is cut off at the sides ends where it is seen to.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from drake_oa.common.messages import BoolArray, FloatArray, Frozen, ObstacleClouds
from drake_oa.geometry.distance_field import VOXEL
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


_LONGEST = 0.5
"""What is cut off goes on for no more [m]."""
_NEAR = 1.5 * VOXEL
"""A point so near to the border of the image may be the last that it shows [m]."""


class ImageRange(NamedTuple):
    """Upright extent of what a pinhole camera sees.

    Attributes:
        fy, cy, height: focal length, centre and height of the image along its columns [pixel].
        near: what has less depth is not seen [m].
    """

    fy: float
    cy: float
    height: int
    near: float = 0.0


def with_unseen_ends(
    obstacles: ObstacleClouds,
    cameras: Sequence[tuple[FloatArray, ImageRange]],
    seen_free: Callable[[FloatArray], BoolArray] | None = None,
) -> ObstacleClouds:
    """The obstacles, with more points where the image cuts them off.

    Args:
        obstacles: what is seen.
        cameras: of each the pose X_WC (4, 4) (x right, y down, z forward), and its image.
        seen_free: tells of points (N, 3) [m] which of them another camera sees through: they are
            not there. None: nobody knows.

    Returns:
        `obstacles` itself where none is cut off.
    """
    clouds = tuple(_with_ends(cloud, cameras, seen_free) for cloud in obstacles.clouds_W)
    if all(one is other for one, other in zip(clouds, obstacles.clouds_W, strict=True)):
        return obstacles
    return replace(obstacles, clouds_W=clouds)


def _with_ends(
    cloud: FloatArray,
    cameras: Sequence[tuple[FloatArray, ImageRange]],
    seen_free: Callable[[FloatArray], BoolArray] | None,
) -> FloatArray:
    """A cloud (N, 3), with its ends; as it is where it is not finite."""
    if not np.isfinite(cloud).all():
        return cloud
    ends = [end for X_WC, image in cameras for end in _ends(cloud, X_WC, image)]
    if seen_free is not None:
        ends = [end[~seen_free(end)] for end in ends]
    return np.concatenate([cloud, *ends]) if any(map(len, ends)) else cloud


def _ends(cloud: FloatArray, X_WC: FloatArray, image: ImageRange) -> Iterator[FloatArray]:
    """What goes on beyond each border (M, 3) of an image that cuts off a cloud (N, 3)."""
    _, y, z = ((cloud - X_WC[:3, 3]) @ X_WC[:3, :3]).T
    # How far the points are from the borders, at their depth; up and down in the image, and
    # nearer, is so in the world.
    top, bottom = y + z * image.cy / image.fy, z * (image.height - image.cy) / image.fy - y
    vertical = np.array([0.0, 0.0, 1.0])
    up = vertical * math.copysign(1.0, -X_WC[2, 1])
    nearer = vertical * math.copysign(1.0, -X_WC[2, 2])
    for gap, way in ((top, up), (bottom, -up), (z - image.near, nearer)):
        last = cloud[(np.abs(gap) <= _NEAR) & (z > 0.0)]
        if not len(last):
            continue
        along = cloud @ way
        length = min(float(np.ptp(along)), _LONGEST)
        steps = VOXEL * np.arange(1, 1 + math.floor(length / VOXEL))
        yield (last[:, None] + steps[:, None] * way).reshape(-1, 3)
