"""Few spheres that provably enclose the surface of a body's collision shapes."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.spatial.distance import cdist

from drake_oa.common.console import announce_first_use
from drake_oa.common.files import package_file, read_arrays, replace_arrays, user_cache
from drake_oa.common.messages import BoolArray, FloatArray, IntArray
from drake_oa.geometry.directions import lattice
from drake_oa.geometry.solids import (
    CORNERS,
    PRIMITIVE,
    Solid,
    Solids,
    least_distances,
    outline_corners,
    solids_of,
    surface_points,
)

_MAX_CENTERS = 1500
"""Maximum number of candidate spheres of a body."""
_SURFACE = 300
"""Approximate number of candidates below the surface of a shape."""
_CHOICES = 12
"""Number of candidates that enclose a large cell from which it is not divided; 1 of a small one."""
_COARSE, _FINEST = 0.2, 0.07
"""Radii of the balls around small cells, and around the smallest, over the overshoot."""
_WIDER = 1.2
"""Factor of the overshoot while the spheres are too many."""
_DIGITS = 9
"""Decimals of lengths [m] that distinguish shapes: those of one model differ less by rounding."""
_VERSION = 2
"""Version of the covers in files, to be raised when these must be computed again."""
SHIPPED = package_file("package://drake_oa/panda/spheres.npz")
"""Covers of the Panda's bodies by `cover_key`: (K, 4) centers in the body's frame and radii [m]."""


@dataclass(frozen=True, eq=False)
class Cover:
    """Spheres that enclose a body's shapes.

    Attributes:
        centers: (K, 3) in the body's frame [m].
        radii: (K,) [m].
        overshoot: maximum distance of a point of the spheres from the shapes [m].
    """

    centers: FloatArray
    radii: FloatArray
    overshoot: float


def cover(solids: Sequence[Solid], overshoot: float, most: int = 200) -> Cover:
    """Computes spheres that enclose the surface of the union of a body's shapes.

    Candidates stand on a lattice in the shapes and below their surface, each as large as the
    overshoot allows: its radius is the depth of its center plus the overshoot. The surface is
    covered by cells, which are halved until enough candidates enclose the ball around each. A
    greedy set cover of the cells selects few candidates, and each shrinks as far as its cells
    allow.

    Args:
        solids: the body's shapes, at least one, at their poses in the body.
        overshoot: maximum distance by which the spheres may exceed the shapes [m].
        most: maximum number of spheres; the overshoot grows until it suffices.

    Raises:
        ValueError: for a shape that is not bounded.
    """
    scene, step = solids_of(solids), 2.7 * overshoot
    while True:
        centers = np.concatenate([_candidates(solid, overshoot, step) for solid in solids])
        if len(centers) <= _MAX_CENTERS:
            break
        step *= _WIDER
    while True:
        radii = np.maximum(-_distances(scene, centers), 0.0) + overshoot
        cells, need = _surface_cells(solids, scene, centers, radii, overshoot)
        is_open = ~(need <= radii).any(axis=1)
        if is_open.any():
            # On a sharp edge: cells there become candidates themselves.
            edge = cells[is_open]
            centers = np.concatenate([centers, edge[:: len(edge) // _SURFACE + 1]])
            continue
        chosen = _choose(need <= radii)
        if len(chosen) <= most:
            break
        overshoot *= _WIDER
    centers, radii, need = centers[chosen], radii[chosen], need[:, chosen]
    covers = need <= radii
    for k in range(len(chosen)):
        alone = covers[:, k] & (covers.sum(axis=1) == 1)
        radii[k] = need[alone, k].max(initial=0.0)
        covers[:, k] &= need[:, k] <= radii[k]
    return _measured(scene, centers[radii > 0.0], radii[radii > 0.0])


def _candidates(solid: Solid, inset: float, step: float) -> FloatArray:
    """Returns points (K, 3) in a shape, in the body's frame, on a lattice and below the surface.

    Args:
        solid: the shape.
        inset: depth of the outermost points, about [m].
        step: maximum distance of neighbors on the lattice [m].
    """
    half = np.maximum(solid.half_extents - inset, 0.0)
    is_rod = solid.kind == PRIMITIVE and not any(solid.size[:2])
    if is_rod:
        # Of a sphere or capsule, spheres about points of the axis are the deepest.
        half = np.array([0.0, 0.0, solid.size[2]])
    axes = [np.linspace(-h, h, 1 + math.ceil(2.0 * h / step)) for h in half]
    inner = solid.placed(lattice(*axes) + solid.center)
    inner = inner[_distances(solids_of([solid]), inner) <= 1e-9]
    if is_rod:
        return inner
    surface = solid.placed(surface_points(solid, _SURFACE))
    inwards = surface.mean(axis=0) - surface
    away = np.linalg.norm(inwards, axis=1, keepdims=True)
    return np.concatenate([inner, surface + inwards * np.minimum(1.0, inset / (away + 1e-9))])


def _surface_cells(
    solids: Sequence[Solid],
    scene: Solids,
    centers: FloatArray,
    radii: FloatArray,
    overshoot: float,
) -> tuple[FloatArray, FloatArray]:
    """Divides space into cells, and returns those with surface.

    Returns:
        Their middles (N, 3), and the radii (N, K) from which on balls about the centers enclose
        them [m].
    """
    corners = np.concatenate([solid.placed(outline_corners(solid)) for solid in solids])
    low, high = corners.min(axis=0), corners.max(axis=0)
    cells, half = 0.5 * (low + high)[None], 0.5 * float((high - low).max()) + 1e-9
    found, needed = [], []
    while len(cells):
        reach = math.sqrt(3.0) * half
        cells = cells[np.abs(_distances(scene, cells)) <= reach]
        need = cdist(cells, centers) + reach
        choices = _CHOICES if reach > _COARSE * overshoot else reach > _FINEST * overshoot
        done = (need <= radii).sum(axis=1) >= choices
        found.append(cells[done])
        needed.append(need[done])
        half /= 2.0
        cells = (cells[~done][:, None] + half * CORNERS).reshape(-1, 3)
    return np.concatenate(found), np.concatenate(needed)


def known_cover(solids: Sequence[Solid], overshoot: float, most: int, announce: str) -> Cover:
    """Reads a cover that is shipped or in the user's cache; else computes it, see `cover`.

    The Panda's bodies are in `SHIPPED`. The cache is the folder drake_oa/spheres; where it cannot
    be written, the cover is computed each time, which takes seconds.
    """
    key = cover_key(solids, overshoot, most)
    kept = user_cache("spheres") / f"{key}.npz"
    spheres = _shipped().get(key)
    try:
        spheres = read_arrays(kept)["spheres"] if spheres is None else spheres
    except (OSError, ValueError, KeyError):
        announce_first_use(announce)
        found = cover(solids, overshoot, most)
        spheres = np.column_stack([found.centers, found.radii])
        with suppress(OSError):
            replace_arrays(kept, {"spheres": spheres})
    return _measured(solids_of(solids), spheres[:, :3], spheres[:, 3])


@cache
def _shipped() -> dict[str, FloatArray]:
    return read_arrays(SHIPPED)


def cover_key(solids: Sequence[Solid], overshoot: float, most: int = 200) -> str:
    """Computes a digest of a body's shapes and of the requested cover; arguments as of `cover`."""
    found = hashlib.sha256(repr((_VERSION, overshoot, most)).encode())
    for solid in solids:
        corners = solid.placed(outline_corners(solid))
        for values in (solid.size, corners):
            # Without negative zeros.
            found.update(repr((np.round(values, _DIGITS) + 0.0).tolist()).encode())
    return found.hexdigest()[:32]


def _measured(scene: Solids, centers: FloatArray, radii: FloatArray) -> Cover:
    """Balls that enclose shapes, with how near they fit."""
    return Cover(centers, radii, max(0.0, float((radii + _distances(scene, centers)).max())))


def _distances(scene: Solids, points: FloatArray) -> FloatArray:
    """Computes the signed distances (N,) of points (N, 3) to the nearest solid [m]."""
    return least_distances(scene, np.ascontiguousarray(points), 0.0, np.inf, -np.inf)


def _choose(covers: BoolArray) -> IntArray:
    """Rows of a few of K balls that cover N points, every point being in one at least.

    The point that the fewest balls cover is served first, by the ball that covers the most of
    what is left; balls that turn out superfluous go. Greedy set cover from the corners inwards.

    Args:
        covers: (N, K) which ball covers which point.
    """
    options, gain = covers.sum(axis=1), covers.sum(axis=0)
    times = np.zeros(len(covers), dtype=np.int64)
    chosen = []
    for n in np.argsort(options, kind="stable"):
        if times[n] == 0 < options[n]:
            best = int(np.where(covers[n], gain, -1).argmax())
            chosen.append(best)
            gain -= covers[covers[:, best] & (times == 0)].sum(axis=0)
            times += covers[:, best]
    kept = []
    for best in chosen:
        if (times[covers[:, best]] == 1).any():
            kept.append(best)
        else:
            times -= covers[:, best]
    return np.array(kept, dtype=np.int64)
