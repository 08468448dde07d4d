"""Seeded rejection sampling of ellipsoids and scenes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from drake_oa.common.messages import BoolArray, FloatArray
from drake_oa.common.numba_tools import kernel_arrays
from drake_oa.studies.scenes.judge_kernels import Bodies, segment_distances
from drake_oa.studies.scenes.scenes import Scenes, joined

Draw = Callable[[np.random.Generator, int], Scenes]


def accepted(
    rng: np.random.Generator, count: int, draw: Draw, keep: Callable[[Scenes], BoolArray]
) -> Scenes:
    """`count` scenes that `keep` accepts, from batches that `draw` proposes."""
    parts: list[Scenes] = []
    found, batch = 0, max(256, 2 * count)
    while found < count:
        proposed = draw(rng, batch)
        kept = proposed.rows(keep(proposed))
        parts.append(kept)
        found += len(kept)
        # What is missing at the rate seen so far, and a little more; never an endless batch.
        rate = max(len(kept) / batch, 1e-3)
        batch = int(np.clip(1.1 * (count - found) / rate, 256, 200_000))
    return joined(parts).rows(slice(count))


def random_rotations(rng: np.random.Generator, count: int) -> FloatArray:
    """(count, 3, 3) rotations, uniform over all: from unit quaternions (Shoemake 1992)."""
    w, x, y, z = rng.standard_normal((4, count))
    size = w * w + x * x + y * y + z * z
    s = 2.0 / size
    R = np.empty((count, 3, 3))
    R[:, 0, 0] = 1.0 - s * (y * y + z * z)
    R[:, 1, 1] = 1.0 - s * (x * x + z * z)
    R[:, 2, 2] = 1.0 - s * (x * x + y * y)
    for i, j, a, b, c in ((0, 1, x, y, z), (2, 0, z, x, y), (1, 2, y, z, x)):
        R[:, i, j] = s * (a * b - w * c)
        R[:, j, i] = s * (a * b + w * c)
    return R


def segment_distance(
    begin: FloatArray, end: FloatArray, center: FloatArray, R: FloatArray, semi_axes: FloatArray
) -> FloatArray:
    """Least signed distance (N,) of segments (N, 3) to (N, 3) to N ellipsoids at rest [m]."""
    bodies = Bodies(*kernel_arrays(center, R, semi_axes, np.zeros_like(center)))
    out = np.empty(len(center))
    segment_distances(*kernel_arrays(begin, end), bodies, out)
    return out


def line_distance(scenes: Scenes) -> FloatArray:
    """Signed distance (N, M) of the straight line from start to goal to each obstacle.

    The obstacles are taken as they stand at t = 0; inf for absent ones.
    """
    there = scenes.present
    distance = np.full(there.shape, np.inf)
    goal = np.broadcast_to(scenes.goal[:, None, :], scenes.center.shape)[there]
    distance[there] = segment_distance(
        np.zeros_like(goal), goal, scenes.center[there], scenes.R[there], scenes.semi_axes[there]
    )
    return distance


def line_hits(scenes: Scenes) -> BoolArray:
    """Whether the straight line from start to goal meets each obstacle at t = 0, (N, M)."""
    turned = np.swapaxes(scenes.R, -1, -2)
    begin = -np.einsum("nmij,nmj->nmi", turned, scenes.center) / scenes.semi_axes
    way = turned[..., 0] * scenes.baseline[:, None, None] / scenes.semi_axes
    along = -(begin * way).sum(axis=-1) / (way * way).sum(axis=-1)
    nearest = begin + np.clip(along, 0.0, 1.0)[..., None] * way
    return np.asarray((nearest * nearest).sum(axis=-1) < 1.0)
