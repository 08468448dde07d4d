"""Clearance of the whole arm among solids, beyond the requested clearances.

The robot is spheres in groups, a group a body (`drake_oa.robot.spheres`); the world is solids that
may move (`drake_oa.geometry.collision_scene`). What is asked is a table of clearances, a row a group and a
column a solid, so that what start and goal leave of one pair lowers no other.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drake_oa.common.compiled import compiled, leaf
from drake_oa.common.messages import BoolArray, FloatArray
from drake_oa.geometry.collision_scene import CollisionGeometries, ball_bound, geometry_distance
from drake_oa.robot.arm import Chain, Spheres, chain_poses

FAR = 0.3
"""By how much more than asked a clearance need not be known [m]."""
STRIDE = 0.012
"""Bound on how far any sphere moves between two configurations that are looked at [m]."""


class ClearanceRequirements(NamedTuple):
    """Requested clearances of the G groups of spheres.

    Attributes:
        of_geometries: (G, K) clearance of each group to each solid [m]; -inf: they may touch.
        of_self: clearance of the groups to each other [m].
        is_tool: (G,) whether a group is of the tool, else of the links.
    """

    of_geometries: FloatArray
    of_self: float
    is_tool: BoolArray


class ArmCollisionModel(NamedTuple):
    """Arm of spheres among solids, with requested clearances; now: the time [s]."""

    chain: Chain
    spheres: Spheres
    geometries: CollisionGeometries
    required: ClearanceRequirements
    now: float


@leaf
def placed(X: FloatArray, row: int, p: FloatArray, i: int) -> tuple[float, float, float]:
    """The point p[i] of frame X[row], in the world."""
    x, y, z = p[i, 0], p[i, 1], p[i, 2]
    return (
        X[row, 0] * x + X[row, 1] * y + X[row, 2] * z + X[row, 9],
        X[row, 3] * x + X[row, 4] * y + X[row, 5] * z + X[row, 10],
        X[row, 6] * x + X[row, 7] * y + X[row, 8] * z + X[row, 11],
    )


TOOL, LINKS, SELF = range(3)
"""Rows of clearances: of the tool and the links to solids, and of all to each other."""


@leaf
def place_bounds(X: FloatArray, spheres: Spheres, center: FloatArray) -> None:
    """Sets center (G, 3) to those of the groups' bounds in the world [m]."""
    for g in range(len(center)):
        x, y, z = placed(X, spheres.group_joint[g] + 1, spheres.bound, g)
        center[g, 0], center[g, 1], center[g, 2] = x, y, z


@leaf
def geometry_gap(
    X: FloatArray, spheres: Spheres, center: FloatArray, g: int, geometries: CollisionGeometries, k: int, t: float,
    keep: float, least: float, enough: float,
) -> float:  # fmt: skip
    """Computes the distance of group g to solid k less `keep`, or `least` if that is less [m].

    Args:
        X: (n + 2, 12) as `chain_poses` leaves them.
        spheres: of the arm.
        center: (G, 3), see `place_bounds`.
        g: row of the group.
        geometries: of the world.
        k: row of the solid.
        t: time [s].
        keep: clearance that is subtracted [m].
        least: value up to which the result is needed [m].
        enough: value below which any result does [m].
    """
    x, y, z = center[g, 0], center[g, 1], center[g, 2]
    far = spheres.bound[g, 3] + keep + least
    if ball_bound(geometries, k, x, y, z, t) >= far:
        return least
    of_group = geometry_distance(geometries, k, x, y, z, t)
    if of_group >= far:
        return least
    frame = spheres.group_joint[g] + 1
    for c in range(spheres.cluster[g], spheres.cluster[g + 1]):
        u, v, w = placed(X, frame, spheres.cluster_bound, c)
        far = spheres.cluster_bound[c, 3] + keep + least
        # No point is nearer by more than it is away.
        if of_group - far > 0.0:
            square = (u - x) ** 2 + (v - y) ** 2 + (w - z) ** 2
            if square <= (of_group - far) ** 2:
                continue
        if geometry_distance(geometries, k, u, v, w, t) >= far:
            continue
        for i in range(spheres.cluster_first[c], spheres.cluster_first[c + 1]):
            u, v, w = placed(X, frame, spheres.p_JS, i)
            d = geometry_distance(geometries, k, u, v, w, t)
            d -= spheres.radius[i] + keep
            if d < least:
                least = d
                if d < enough:
                    return least
    return least


@leaf
def pair_distance(
    X: FloatArray,
    spheres: Spheres,
    center: FloatArray,
    m: int,
    off: float,
    least: float,
    enough: float,
) -> float:
    """The distance of pair m of groups and `off`, or `least` if that is less [m].

    Args:
        X: (n + 2, 12) as `chain_poses` leaves them.
        spheres: of the arm.
        center: (G, 3) of the groups' bounds, in the world [m].
        m: which pair.
        off: what is added to the distance [m].
        least: up to which it need be known.
        enough: it need not be known where it is below.
    """
    a, b = spheres.pairs[m, 0], spheres.pairs[m, 1]
    x, y, z = (
        center[b, 0] - center[a, 0],
        center[b, 1] - center[a, 1],
        center[b, 2] - center[a, 2],
    )
    most = least - off + spheres.bound[a, 3] + spheres.bound[b, 3]
    if most <= 0.0 or x * x + y * y + z * z >= most * most:
        return least
    one, other = spheres.group_joint[a] + 1, spheres.group_joint[b] + 1
    for i in range(spheres.first[a], spheres.first[a + 1]):
        x, y, z = placed(X, one, spheres.p_JS, i)
        u, v, w = x - center[b, 0], y - center[b, 1], z - center[b, 2]
        most = least - off + spheres.radius[i] + spheres.bound[b, 3]
        if most <= 0.0 or u * u + v * v + w * w >= most * most:
            continue
        for j in range(spheres.first[b], spheres.first[b + 1]):
            u, v, w = placed(X, other, spheres.p_JS, j)
            u, v, w = u - x, v - y, w - z
            touching = spheres.radius[i] + spheres.radius[j] - off
            most, square = least + touching, u * u + v * v + w * w
            if most > 0.0 and square < most * most:
                least = math.sqrt(square) - touching
                if least < enough:
                    return least
    return least


@leaf
def lower_clearance_margins(
    X: FloatArray,
    t: float,
    spheres: Spheres,
    geometries: CollisionGeometries,
    required: ClearanceRequirements,
    center: FloatArray,
    least: FloatArray,
    enough: float,
) -> None:
    """Lowers least (3,) to the clearance_margin of a configuration over the requested clearances [m].

    Args:
        X: (n + 2, 12) as `chain_poses` leaves them.
        t: when [s].
        spheres, geometries, required: see `ArmCollisionModel`.
        center: (G, 3) to work in.
        least: (3,) of `TOOL`, `LINKS` and `SELF`.
        enough: where one of them is below it, the others need not be known.
    """
    place_bounds(X, spheres, center)
    for g in range(len(center)):
        row = TOOL if required.is_tool[g] else LINKS
        for k in range(len(geometries.ball)):
            keep = required.of_geometries[g, k]
            least[row] = geometry_gap(
                X, spheres, center, g, geometries, k, t, keep, least[row], enough
            )  # fmt: skip
            if least[row] < enough:
                return
    for m in range(len(spheres.pairs)):
        off = spheres.allowance[m] - required.of_self
        least[SELF] = pair_distance(X, spheres, center, m, off, least[SELF], enough)
        if least[SELF] < enough:
            return


@compiled
def clearance_margin(
    world: ArmCollisionModel, q: FloatArray, far: float, X: FloatArray, center: FloatArray
) -> float:
    """Computes the clearance_margin of a configuration over the requested clearances, at most `far` [m]."""
    least = np.full(3, far)
    chain_poses(q, world.chain.X_PJ, X)
    lower_clearance_margins(
        X, world.now, world.spheres, world.geometries, world.required, center, least, 0.0
    )
    return min(least[0], min(least[1], least[2]))


def is_collision_free(world: ArmCollisionModel, q: FloatArray) -> bool:
    """Checks whether a configuration (n,) keeps the limits and the requested clearances now."""
    is_within = (world.chain.lower <= q).all() and (q <= world.chain.upper).all()
    return bool(is_within and min_clearance_margin(world, q[None]) >= 0.0)


@compiled
def share_clear(
    world: ArmCollisionModel, one: FloatArray, other: FloatArray, stride: float = STRIDE
) -> tuple[float, int]:
    """Computes the share of the straight way between two configurations (n,) that is clear.

    No step moves a sphere by more than the clearance_margin over the requested clearances, or by `stride`
    [m]: at most half of it can be lost between two steps.

    Returns:
        The share, 1 for all of it, and the number of checked configurations.
    """
    n = len(one)
    X, center, q = np.empty((n + 2, 12)), np.empty((len(world.spheres.group_joint), 3)), np.empty(n)
    bound = 0.0
    for i in range(n):
        bound += world.chain.reach[i] * abs(other[i] - one[i])
    if bound == 0.0:
        return 1.0, 0
    step = stride / bound
    share, clear, checked = min(step, 1.0), 0.0, 0
    while True:
        for i in range(n):
            q[i] = one[i] + share * (other[i] - one[i])
        kept = clearance_margin(world, q, FAR, X, center)
        checked += 1
        if kept < 0.0:
            return clear, checked
        if share == 1.0:
            return 1.0, checked
        clear, share = share, min(share + max(step, kept / bound), 1.0)


@compiled
def min_clearance_margin(world: ArmCollisionModel, q: FloatArray) -> float:
    """The least `clearance_margin` of configurations (T, n) now [m]."""
    X, center = np.empty((q.shape[1] + 2, 12)), np.empty((len(world.spheres.group_joint), 3))
    least = FAR
    for row in range(len(q)):
        least = min(least, clearance_margin(world, q[row], FAR, X, center))
    return least


@compiled
def self_distance(chain: Chain, spheres: Spheres, q: FloatArray) -> float:
    """Computes the distance of the arm to itself at a configuration (n,), at most `FAR` [m].

    Exact where it is negative, where `clearance_margin` ends at the first that is.
    """
    X, center, least = np.empty((len(q) + 2, 12)), np.empty((len(spheres.group_joint), 3)), FAR
    chain_poses(q, chain.X_PJ, X)
    place_bounds(X, spheres, center)
    for m in range(len(spheres.pairs)):
        least = pair_distance(X, spheres, center, m, spheres.allowance[m], least, -np.inf)
    return least


@compiled
def group_distances(
    chain: Chain,
    spheres: Spheres,
    geometries: CollisionGeometries,
    q: FloatArray,
    t: float,
    most: float,
) -> FloatArray:
    """Computes the least distances (G, K) of groups to solids along configurations (T, n) [m].

    Args:
        chain, spheres, geometries: see `ArmCollisionModel`.
        q: (T, n) configurations [rad].
        t: time at which the solids are where they are [s].
        most: distance above which none is computed exactly [m].
    """
    found = np.full((len(spheres.group_joint), len(geometries.ball)), most)
    X, center = np.empty((q.shape[1] + 2, 12)), np.empty((len(spheres.group_joint), 3))
    for row in range(len(q)):
        chain_poses(q[row], chain.X_PJ, X)
        place_bounds(X, spheres, center)
        for g in range(len(center)):
            for k in range(len(geometries.ball)):
                least = found[g, k]
                found[g, k] = geometry_gap(
                    X, spheres, center, g, geometries, k, t, 0.0, least, -np.inf
                )  # fmt: skip
    return found
