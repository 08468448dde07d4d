"""Clearance margins of the whole arm: distances to collision geometry minus required clearances.

The robot is covered by spheres in groups, one group per body (`drake_oa.robot.spheres`). The
environment is a collision scene whose geometries may move (`drake_oa.geometry.collision_scene`).
The required clearances are a table with one row per group and one column per geometry, so that a
requirement reduced at start or goal does not affect other pairs.
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
"""Upper bound up to which clearance margins are computed exactly [m]."""
SPHERE_STRIDE = 0.012
"""Maximum displacement of any sphere between two checked configurations of an edge [m]."""


class ClearanceRequirements(NamedTuple):
    """Required clearances of the G groups of robot spheres.

    Attributes:
        of_geometries: (G, K) clearance of each group to each collision geometry [m]; -inf: contact
            is allowed.
        of_self: clearance between groups [m].
        is_tool: (G,) whether a group belongs to the tool; else to the links.
    """

    of_geometries: FloatArray
    of_self: float
    is_tool: BoolArray


class ArmCollisionModel(NamedTuple):
    """Collision model of an arm: spheres, collision geometries, and required clearances.

    Attributes:
        chain, spheres: kinematics and spheres of the arm.
        geometries: collision geometries of the environment and the obstacles.
        required: required clearances.
        now: time at which moving geometries are evaluated [s].
    """

    chain: Chain
    spheres: Spheres
    geometries: CollisionGeometries
    required: ClearanceRequirements
    now: float


@leaf
def transform_point(X: FloatArray, row: int, p: FloatArray, i: int) -> tuple[float, float, float]:
    """Returns the world position of point p[i] (N, 3), given in frame X[row] (M, 12) [m]."""
    x, y, z = p[i, 0], p[i, 1], p[i, 2]
    return (
        X[row, 0] * x + X[row, 1] * y + X[row, 2] * z + X[row, 9],
        X[row, 3] * x + X[row, 4] * y + X[row, 5] * z + X[row, 10],
        X[row, 6] * x + X[row, 7] * y + X[row, 8] * z + X[row, 11],
    )


TOOL, LINKS, SELF = range(3)
"""Indices of clearance margins: tool to geometries, links to geometries, and self-distance."""


@leaf
def place_bounds(X: FloatArray, spheres: Spheres, center: FloatArray) -> None:
    """Writes the world positions of the groups' bounding spheres into center (G, 3) [m]."""
    for g in range(len(center)):
        x, y, z = transform_point(X, spheres.group_joint[g] + 1, spheres.bound, g)
        center[g, 0], center[g, 1], center[g, 2] = x, y, z


@leaf
def geometry_gap(
    X: FloatArray, spheres: Spheres, center: FloatArray, g: int,
    geometries: CollisionGeometries, k: int, t: float,
    clearance: float, upper_bound: float, stop_below: float,
) -> float:  # fmt: skip
    """Computes min(distance of group g to geometry k - clearance, upper_bound) [m].

    Bounding spheres of groups and clusters skip spheres that cannot lower the result.

    Args:
        X: (n + 2, 12) link poses of `chain_poses`.
        spheres: spheres of the arm.
        center: (G, 3) centers of bounding spheres, see `place_bounds` [m].
        g: index of the group.
        geometries: collision geometries.
        k: index of the geometry.
        t: time [s].
        clearance: clearance that is subtracted [m].
        upper_bound: upper bound of the result [m].
        stop_below: value below which the first result is returned, even if it is not the minimum
            [m].
    """
    x, y, z = center[g, 0], center[g, 1], center[g, 2]
    cutoff = spheres.bound[g, 3] + clearance + upper_bound
    if ball_bound(geometries, k, x, y, z, t) >= cutoff:
        return upper_bound
    center_distance = geometry_distance(geometries, k, x, y, z, t)
    if center_distance >= cutoff:
        return upper_bound
    frame = spheres.group_joint[g] + 1
    for c in range(spheres.cluster[g], spheres.cluster[g + 1]):
        u, v, w = transform_point(X, frame, spheres.cluster_bound, c)
        cutoff = spheres.cluster_bound[c, 3] + clearance + upper_bound
        # The distance function has Lipschitz constant 1: within this radius it exceeds the cutoff.
        if center_distance - cutoff > 0.0:
            square = (u - x) ** 2 + (v - y) ** 2 + (w - z) ** 2
            if square <= (center_distance - cutoff) ** 2:
                continue
        if geometry_distance(geometries, k, u, v, w, t) >= cutoff:
            continue
        for i in range(spheres.cluster_first[c], spheres.cluster_first[c + 1]):
            u, v, w = transform_point(X, frame, spheres.p_JS, i)
            d = geometry_distance(geometries, k, u, v, w, t)
            d -= spheres.radius[i] + clearance
            if d < upper_bound:
                upper_bound = d
                if d < stop_below:
                    return upper_bound
    return upper_bound


@leaf
def pair_distance(
    X: FloatArray,
    spheres: Spheres,
    center: FloatArray,
    m: int,
    offset: float,
    upper_bound: float,
    stop_below: float,
) -> float:
    """Computes min(distance between the groups of pair m + offset, upper_bound) [m].

    Args:
        X: (n + 2, 12) link poses of `chain_poses`.
        spheres: spheres of the arm.
        center: (G, 3) centers of bounding spheres, see `place_bounds` [m].
        m: index of the pair.
        offset: offset added to the distance [m].
        upper_bound: upper bound of the result [m].
        stop_below: value below which the first result is returned, even if it is not the minimum
            [m].
    """
    a, b = spheres.pairs[m, 0], spheres.pairs[m, 1]
    x, y, z = (
        center[b, 0] - center[a, 0],
        center[b, 1] - center[a, 1],
        center[b, 2] - center[a, 2],
    )
    cutoff = upper_bound - offset + spheres.bound[a, 3] + spheres.bound[b, 3]
    if cutoff <= 0.0 or x * x + y * y + z * z >= cutoff * cutoff:
        return upper_bound
    frame_a, frame_b = spheres.group_joint[a] + 1, spheres.group_joint[b] + 1
    for i in range(spheres.first[a], spheres.first[a + 1]):
        x, y, z = transform_point(X, frame_a, spheres.p_JS, i)
        u, v, w = x - center[b, 0], y - center[b, 1], z - center[b, 2]
        cutoff = upper_bound - offset + spheres.radius[i] + spheres.bound[b, 3]
        if cutoff <= 0.0 or u * u + v * v + w * w >= cutoff * cutoff:
            continue
        for j in range(spheres.first[b], spheres.first[b + 1]):
            u, v, w = transform_point(X, frame_b, spheres.p_JS, j)
            u, v, w = u - x, v - y, w - z
            contact_distance = spheres.radius[i] + spheres.radius[j] - offset
            cutoff, square = upper_bound + contact_distance, u * u + v * v + w * w
            if cutoff > 0.0 and square < cutoff * cutoff:
                upper_bound = math.sqrt(square) - contact_distance
                if upper_bound < stop_below:
                    return upper_bound
    return upper_bound


@leaf
def lower_clearance_margins(
    X: FloatArray,
    t: float,
    spheres: Spheres,
    geometries: CollisionGeometries,
    required: ClearanceRequirements,
    center: FloatArray,
    margins: FloatArray,
    stop_below: float,
) -> None:
    """Lowers margins (3,), in place, to the clearance margins of a configuration.

    Args:
        X: (n + 2, 12) link poses of `chain_poses`.
        t: time [s].
        spheres, geometries, required: attributes of `ArmCollisionModel`.
        center: (G, 3) work array.
        margins: (3,) margins `TOOL`, `LINKS`, `SELF` so far, upper bounds of the result [m].
        stop_below: margin below which the computation stops [m].
    """
    place_bounds(X, spheres, center)
    for g in range(len(center)):
        row = TOOL if required.is_tool[g] else LINKS
        for k in range(len(geometries.ball)):
            clearance = required.of_geometries[g, k]
            margins[row] = geometry_gap(
                X, spheres, center, g, geometries, k, t, clearance, margins[row], stop_below
            )  # fmt: skip
            if margins[row] < stop_below:
                return
    for m in range(len(spheres.pairs)):
        offset = spheres.allowance[m] - required.of_self
        margins[SELF] = pair_distance(X, spheres, center, m, offset, margins[SELF], stop_below)
        if margins[SELF] < stop_below:
            return


@compiled
def clearance_margin(
    world: ArmCollisionModel, q: FloatArray, max_margin: float, X: FloatArray, center: FloatArray
) -> float:
    """Computes the minimum clearance margin of a configuration, at most `max_margin` [m].

    Args:
        world: collision model.
        q: (n,) configuration [rad].
        max_margin: upper bound of the result [m].
        X, center: (n + 2, 12) and (G, 3) work arrays.
    """
    margins = np.full(3, max_margin)
    chain_poses(q, world.chain.X_PJ, X)
    lower_clearance_margins(
        X, world.now, world.spheres, world.geometries, world.required, center, margins, 0.0
    )
    return min(margins[0], min(margins[1], margins[2]))


def is_collision_free(world: ArmCollisionModel, q: FloatArray) -> bool:
    """Checks whether a configuration (n,) satisfies joint limits and required clearances."""
    is_within = (world.chain.lower <= q).all() and (q <= world.chain.upper).all()
    return bool(is_within and min_clearance_margin(world, q[None]) >= 0.0)


@compiled
def free_fraction(
    world: ArmCollisionModel, q_start: FloatArray, q_end: FloatArray, stride: float = SPHERE_STRIDE
) -> tuple[float, int]:
    """Computes the collision-free fraction of the straight edge between two configurations (n,).

    Between two checked configurations, no sphere moves by more than the clearance margin of the
    first one, or by `stride` [m] if that is larger. The clearance can be violated by at most half
    of `stride`.

    Returns:
        Fraction from `q_start` on, 1 for the entire edge, and number of checked configurations.
    """
    n = len(q_start)
    X, center, q = np.empty((n + 2, 12)), np.empty((len(world.spheres.group_joint), 3)), np.empty(n)
    bound = 0.0
    for i in range(n):
        bound += world.chain.reach[i] * abs(q_end[i] - q_start[i])
    if bound == 0.0:
        return 1.0, 0
    step = stride / bound
    fraction, free, checked = min(step, 1.0), 0.0, 0
    while True:
        for i in range(n):
            q[i] = q_start[i] + fraction * (q_end[i] - q_start[i])
        margin = clearance_margin(world, q, FAR, X, center)
        checked += 1
        if margin < 0.0:
            return free, checked
        if fraction == 1.0:
            return 1.0, checked
        free, fraction = fraction, min(fraction + max(step, margin / bound), 1.0)


@compiled
def min_clearance_margin(world: ArmCollisionModel, q: FloatArray) -> float:
    """Computes the minimum clearance margin over configurations (T, n), at most `FAR` [m]."""
    X, center = np.empty((q.shape[1] + 2, 12)), np.empty((len(world.spheres.group_joint), 3))
    margin = FAR
    for row in range(len(q)):
        margin = min(margin, clearance_margin(world, q[row], FAR, X, center))
    return margin


@compiled
def self_distance(chain: Chain, spheres: Spheres, q: FloatArray) -> float:
    """Computes the minimum distance between the arm's groups at a configuration (n,) [m].

    At most `FAR`. Negative distances are exact, whereas `clearance_margin` stops at the first one.
    """
    X, center, distance = np.empty((len(q) + 2, 12)), np.empty((len(spheres.group_joint), 3)), FAR
    chain_poses(q, chain.X_PJ, X)
    place_bounds(X, spheres, center)
    for m in range(len(spheres.pairs)):
        distance = pair_distance(X, spheres, center, m, spheres.allowance[m], distance, -np.inf)
    return distance


@compiled
def group_distances(
    chain: Chain,
    spheres: Spheres,
    geometries: CollisionGeometries,
    q: FloatArray,
    t: float,
    max_distance: float,
) -> FloatArray:
    """Computes minimum distances (G, K) of groups to geometries over configurations (T, n) [m].

    Args:
        chain, spheres, geometries: attributes of `ArmCollisionModel`.
        q: (T, n) configurations [rad].
        t: time at which the geometries are evaluated [s].
        max_distance: upper bound of the distances [m].
    """
    distances = np.full((len(spheres.group_joint), len(geometries.ball)), max_distance)
    X, center = np.empty((q.shape[1] + 2, 12)), np.empty((len(spheres.group_joint), 3))
    for row in range(len(q)):
        chain_poses(q[row], chain.X_PJ, X)
        place_bounds(X, spheres, center)
        for g in range(len(center)):
            for k in range(len(geometries.ball)):
                upper_bound = distances[g, k]
                distances[g, k] = geometry_gap(
                    X, spheres, center, g, geometries, k, t, 0.0, upper_bound, -np.inf
                )  # fmt: skip
    return distances
