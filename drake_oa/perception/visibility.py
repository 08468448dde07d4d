"""What a frame says about remembered points: shown again, shown to be gone, or hidden.

Each point carries evidence. A frame that shows it adds one; a frame whose rays pass
through it takes away all but one, and the next such frame the rest: two frames confirm
a point, two remove it. One that is hidden (by the arm, another obstacle, a missing
pixel, the border of the image) stays as it is: a pixel without depth is unknown, never free, of
obstacles that move as well. Of several images one that sees through it is
enough, and it is hidden only if it is in all. Where the image shows something at the
point's depth but no cluster has a point there (grazing surfaces, the foot of an
obstacle) the evidence only decays.

What goes on beyond the image: a thing that is cut off by it is taken to be longer.

A post that the image shows the lower half of, or the upper half of which is too near, has no end
there, and nothing may pass over it. What is cut off is taken to go on upright for as far as it is
seen; what is cut off at the sides ends where it is seen to.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from drake_oa.common.messages import BoolArray, FloatArray, IntArray, ObstacleClouds
from drake_oa.geometry.distance_field import VOXEL
from drake_oa.geometry.pinhole import AT, EMPTY, FREE, HIDDEN, OUT, View, shown
from drake_oa.geometry.solids import Solids, least_distances
from drake_oa.perception.segmentation import Segmentation

_CERTAIN = 4
"""The most evidence that a point can have."""
_CONFIRMED = 2
"""From this much evidence on a point is handed on."""
SUPPORT_RADIUS = 0.012
"""Distance at which a point of a frame supports the remembered point [m]."""
SAME_RADIUS = 0.008
"""Distance at which a seen and a remembered point are the same point [m]."""
_SAYS = np.array([1, 3, 4, 0, 2])
"""How much HIDDEN, AT, FREE, OUT and EMPTY say: of several images the one counts that says most."""


class Looked(NamedTuple):
    """What V images of a frame show where N points should be.

    Attributes:
        shows: (N,) HIDDEN, AT, FREE, OUT or EMPTY, by the image that says most.
        each: (V, N) the same of each image.
        pixel: (V, N) their pixels in each, -1 outside it.
    """

    shows: IntArray
    each: IntArray
    pixel: IntArray


def mutual_nearest(
    query: FloatArray, points: FloatArray, radius: float
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Finds the nearest point to each query within a radius, and the nearest query to each point.

    Args:
        query: (Q, 3) [m].
        points: (N, 3) [m].
        radius: maximum distance [m].

    Returns:
        (Q,) index of the nearest point, -1 without one in the radius; (Q,) its distance and
        (N,) the distance of the nearest query, ``radius`` without one [m].
    """
    from_query, nearest = cKDTree(points).query(query, distance_upper_bound=radius)
    from_point, _ = cKDTree(query).query(points, distance_upper_bound=radius)
    nearest = np.where(np.isfinite(from_query), nearest, -1)
    return nearest, np.minimum(from_query, radius), np.minimum(from_point, radius)


def hidden_beyond(
    points: FloatArray, owner: IntArray, hidden: BoolArray, sides: FloatArray, slack: float
) -> FloatArray:
    """How much of what is remembered beyond each side is hidden in the frame.

    Args:
        points: (N, 3) remembered points in the world [m].
        owner: (N,) their obstacles.
        hidden: (N,) which of them the frame does not show.
        sides: (M, 3, 2) from `drake_oa.perception.velocity.tail_places` [m].
        slack: points no farther beyond a side belong to it [m].

    Returns:
        (M, 3, 2) shares in [0, 1]; 0 where nothing is remembered.
    """
    low, high = np.moveaxis(sides[owner], 2, 0)
    far = np.stack([points < low - slack, points > high + slack], axis=2).reshape(-1, 6)
    mine = (owner == np.arange(len(sides))[:, None]).astype(float)
    beyond, unseen = mine @ far, mine @ (far & hidden[:, None])
    return np.asarray((unseen / np.maximum(beyond, 1.0)).reshape(sides.shape))


def absorb(
    points: FloatArray,
    weight: IntArray,
    query: FloatArray,
    nearest: IntArray,
    most: int,
) -> None:
    """Moves remembered points to the mean of what was seen of them.

    Args:
        points: (N, 3) remembered points, changed [m].
        weight: (N,) how many frames each is the mean of, changed.
        query: (Q, 3) points of the frame [m].
        nearest: (Q,) the remembered point that each is.
        most: a mean never weighs more frames than this.
    """
    count = np.bincount(nearest, minlength=len(points))
    seen = count > 0
    weight[seen] = np.minimum(weight[seen] + 1, most)
    total = np.stack([np.bincount(nearest, along, len(points)) for along in query.T], axis=1)
    mean = total[seen] / count[seen, None]
    points[seen] += (mean - points[seen]) / weight[seen, None]


def evidence_after(
    owner: IntArray,
    evidence: IntArray,
    confirmed: BoolArray,
    seen: IntArray,
    behind_itself: BoolArray,
    distance: FloatArray,
    found: BoolArray,
    settled: BoolArray,
) -> tuple[IntArray, BoolArray]:
    """Weighs N remembered points by a frame.

    Args:
        owner: (N,) their obstacles.
        evidence: (N,) for each.
        confirmed: (N,) whether a second frame has shown it.
        seen: (N,) what the frame shows at them.
        behind_itself: (N,) from `hidden_by_itself`.
        distance: (N,) from the frame's nearest point [m].
        found: (M,) obstacles that have a cluster in the frame.
        settled: (M,) those that rest, and are handed on: what is new of them is confirmed by
            a third frame.

    Returns:
        The evidence (N,) after it, 0 for points to be left out, and which are confirmed (N,).
    """
    hit = distance < np.where(confirmed, SUPPORT_RADIUS, SAME_RADIUS)
    gone = (seen == FREE) | ((seen == AT) & ~found[owner])
    fading = (seen == AT) | behind_itself
    less = np.where(gone, np.minimum(evidence, _CONFIRMED) - 1, evidence - fading)
    after = np.where(hit, np.minimum(evidence + 1, _CERTAIN), less)
    sure = confirmed | (after >= _CONFIRMED + settled[owner])
    after[~confirmed & ~hit & (gone | fading)] = 0
    return after, sure


def shown_at(
    p_WQ: FloatArray,
    missed: BoolArray,
    views: Sequence[View],
    margin: float,
    robot: Solids | None,
    robot_margin: float,
) -> Looked:
    """What the images of a frame show where points p_WQ (N, 3) [m] should be.

    As `shown`; a cloud (no images) is taken to show every point. Those that no point of the frame
    supports, `missed` (N,), are not asked for where the robot is within its margin [m].
    """
    if not len(views):
        none = np.zeros((0, len(p_WQ)), dtype=np.int64)
        return Looked(np.full(len(p_WQ), AT), none, none)
    each, pixel = np.stack([shown(p_WQ, view, margin) for view in views], axis=1)
    shows = each[_SAYS[each].argmax(axis=0), np.arange(len(p_WQ))]
    if robot is not None:
        # Only what seems to be gone needs the robot's excuse.
        asked = np.flatnonzero(missed & ((shows == AT) | (shows == FREE) | (shows == EMPTY)))
        d = least_distances(robot, p_WQ[asked], 0.0, robot_margin, robot_margin)
        shows[asked[d < robot_margin]] = OUT
    return Looked(shows, each, pixel)


def hidden_by_itself(
    looked: Looked, owner: IntArray, cluster_row: IntArray, frame: Segmentation
) -> BoolArray:
    """Finds hidden points (N,) behind their own obstacle: it moved or turned.

    They are so in each image that shows their place; another one may have seen them
    from behind.

    Args:
        looked: from `shown_at`.
        owner: (N,) their obstacles.
        cluster_row: (C,) obstacle of each cluster.
        frame: the frame.
    """
    before = np.zeros(looked.each.shape, dtype=bool)
    for image, view in enumerate(frame.views):
        row_at = np.full(view.z.size, -1)
        for row, surface in zip(cluster_row.tolist(), frame.pixels_in(image), strict=True):
            row_at[surface] = row
        is_own = row_at[looked.pixel[image]] == owner
        before[image] = (looked.each[image] == HIDDEN) & is_own
    return np.asarray(before.any(axis=0) & (before | (looked.pixel < 0)).all(axis=0))


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
    clouds = []
    for cloud in obstacles.clouds_W:
        ends = [end for X_WC, image in cameras for end in _ends(cloud, X_WC, image)]
        if seen_free is not None:
            ends = [end[~seen_free(end)] for end in ends]
        clouds.append(np.concatenate([cloud, *ends]) if any(map(len, ends)) else cloud)
    if all(one is other for one, other in zip(clouds, obstacles.clouds_W, strict=True)):
        return obstacles
    return replace(obstacles, clouds_W=tuple(clouds))


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
