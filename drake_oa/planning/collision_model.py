"""Clearance margins of the whole arm: distances to collision geometry minus required clearances.

Spheres in groups, one group per body, cover the robot (`drake_oa.robot.spheres`). Obstacles and
environment are collision geometries that may move (`drake_oa.geometry.collision_scene`). The
required clearances form a table with one row per group and one column per geometry. If start or
goal leave less clearance for one pair of group and geometry, only the requirement of this pair is
reduced.
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
"""Largest clearance margin (distance minus required clearance) that is computed exactly [m].

Larger margins are replaced by this value, so that distant geometries are skipped."""
SPHERE_STRIDE = 0.012
"""Maximum motion of the arm's covering spheres between two successive collision checks [m].

It applies to straight edges in joint space. The spheres may move farther where the clearance margin
(distance minus required clearance) at the first of the two configurations is larger than this
value."""


class ClearanceRequirements(NamedTuple):
    """Required clearances of the G groups of spheres that cover the robot, one group per body.

    Attributes:
        of_geometries: (G, K) required clearance of each group to each of K collision geometries
            [m]; -inf: contact is allowed.
        of_self: required clearance between two groups of the robot [m].
        is_tool: (G,) whether each group belongs to the tool; the others belong to the links.
    """

    of_geometries: FloatArray
    of_self: float
    is_tool: BoolArray


class ArmCollisionModel(NamedTuple):
    """Collision model of an arm: kinematics, covering spheres, obstacles, and required clearances.

    Attributes:
        chain: kinematic chain of the arm.
        spheres: spheres that cover the arm, in groups (one per body).
        geometries: collision geometries of the environment and the obstacles.
        required: required clearances between groups and geometries, and between groups.
        now: time at which the positions of moving geometries are evaluated [s].
    """

    chain: Chain
    spheres: Spheres
    geometries: CollisionGeometries
    required: ClearanceRequirements
    now: float


@leaf
def transform_point(X: FloatArray, row: int, p: FloatArray, i: int) -> tuple[float, float, float]:
    """Transforms a point from the frame of a link to the world [m].

    Args:
        X: (M, 12) poses of link frames in the world; a row is a rotation matrix, row by row, and a
            position [m].
        row: row of the link frame in X.
        p: (N, 3 or more) points in this frame, of which the first three columns are read [m].
        i: row of the point in p.

    Returns:
        World coordinates x, y and z of the point [m].
    """
    x, y, z = p[i, 0], p[i, 1], p[i, 2]
    return (
        X[row, 0] * x + X[row, 1] * y + X[row, 2] * z + X[row, 9],
        X[row, 3] * x + X[row, 4] * y + X[row, 5] * z + X[row, 10],
        X[row, 6] * x + X[row, 7] * y + X[row, 8] * z + X[row, 11],
    )


TOOL, LINKS, SELF = range(3)
"""Indices of an arm's clearance margins (distance minus required clearance) in arrays (3,).

They are those of the tool to collision geometries, of the links to collision geometries, and
between bodies of the arm."""


@leaf
def place_bounds(X: FloatArray, spheres: Spheres, center: FloatArray) -> None:
    """Computes the world positions of the bounding spheres' centers, one per group of spheres.

    Args:
        X: (n + 2, 12) poses of the world, the joint frames and the tool in the world frame; a row
            is a rotation matrix, row by row, and a position [m].
        spheres: G groups of spheres that cover the arm, one group per body.
        center: (G, 3) centers in the world frame, set in place [m].
    """
    for g in range(len(center)):
        x, y, z = transform_point(X, spheres.group_joint[g] + 1, spheres.bound, g)
        center[g, 0], center[g, 1], center[g, 2] = x, y, z


@leaf
def group_bound(
    spheres: Spheres, center: FloatArray, g: int, geometries: CollisionGeometries, k: int, t: float
) -> float:
    """Computes a lower bound of the distance from group g to collision geometry k at time t [m],
    by their bounding spheres.

    A group consists of the spheres that cover one body of the arm.

    Args:
        spheres: spheres that cover the arm.
        center: (G, 3) centers of the groups' bounding spheres in the world frame [m].
        g: index of the group.
        geometries: collision geometries, which may move.
        k: index of the geometry.
        t: time at which the position of the geometry is evaluated [s].
    """
    x, y, z = center[g, 0], center[g, 1], center[g, 2]
    return ball_bound(geometries, k, x, y, z, t) - spheres.bound[g, 3]


@leaf
def geometry_gap(
    X: FloatArray, spheres: Spheres, center: FloatArray, g: int,
    geometries: CollisionGeometries, k: int, t: float,
    clearance: float, upper_bound: float, stop_below: float,
) -> float:  # fmt: skip
    """Computes the clearance margin of one group of robot spheres to one collision geometry [m].

    The result is min(d - clearance, upper_bound), with the distance d from the group, the spheres
    that cover one body, to the geometry. Bounding spheres of the group and of its clusters (sets of
    neighboring spheres) exclude spheres that cannot lower the result. This function is called only
    if the faster `group_bound`, a lower bound of d, is below clearance + upper_bound.

    Args:
        X: (n + 2, 12) poses of the world, the joint frames and the tool in the world frame; a row
            is a rotation matrix, row by row, and a position [m].
        spheres: spheres that cover the arm.
        center: (G, 3) centers of the groups' bounding spheres in the world frame [m].
        g: index of the group.
        geometries: collision geometries, which may move.
        k: index of the geometry.
        t: time at which the position of the geometry is evaluated [s].
        clearance: required clearance, which is subtracted from the distance [m].
        upper_bound: upper bound of the result [m].
        stop_below: value below which the computation stops; the result is then not necessarily
            the minimum over the spheres [m].
    """
    x, y, z = center[g, 0], center[g, 1], center[g, 2]
    center_distance = geometry_distance(geometries, k, x, y, z, t)
    if center_distance >= spheres.bound[g, 3] + clearance + upper_bound:
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
        if ball_bound(geometries, k, u, v, w, t) >= cutoff:
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
def pair_bound(spheres: Spheres, center: FloatArray, m: int) -> float:
    """Computes a lower bound of the distance between the two groups of pair m [m], by their
    bounding spheres.

    A group consists of the spheres that cover one body of the arm.

    Args:
        spheres: spheres that cover the arm.
        center: (G, 3) centers of the groups' bounding spheres in the world frame [m].
        m: row of `spheres.pairs`, which contains the indices of the two groups.
    """
    a, b = spheres.pairs[m, 0], spheres.pairs[m, 1]
    x, y, z = center[b, 0] - center[a, 0], center[b, 1] - center[a, 1], center[b, 2] - center[a, 2]
    return math.sqrt(x * x + y * y + z * z) - spheres.bound[a, 3] - spheres.bound[b, 3]


@leaf
def _cluster_distance(
    X: FloatArray, spheres: Spheres, frame_a: int, a: int, frame_b: int, b: int,
    offset: float, upper_bound: float, stop_below: float,
) -> float:  # fmt: skip
    """Computes the distance between two clusters of robot spheres plus an offset [m].

    The result is min(d + offset, upper_bound), with the distance d between the clusters. A cluster
    is a set of neighboring spheres of one body.

    Args:
        X: (n + 2, 12) poses of the world, the joint frames and the tool in the world frame; a row
            is a rotation matrix, row by row, and a position [m].
        spheres: spheres that cover the arm.
        frame_a, a: row in X of the frame of the first cluster, and index of this cluster.
        frame_b, b: row in X of the frame of the second cluster, and index of this cluster.
        offset: offset added to d [m].
        upper_bound: upper bound of the result [m].
        stop_below: value below which the computation stops; the result is then not necessarily
            the minimum over the spheres [m].
    """
    for i in range(spheres.cluster_first[a], spheres.cluster_first[a + 1]):
        x, y, z = transform_point(X, frame_a, spheres.p_JS, i)
        for j in range(spheres.cluster_first[b], spheres.cluster_first[b + 1]):
            u, v, w = transform_point(X, frame_b, spheres.p_JS, j)
            contact_distance = spheres.radius[i] + spheres.radius[j] - offset
            cutoff = upper_bound + contact_distance
            square = (u - x) ** 2 + (v - y) ** 2 + (w - z) ** 2
            if cutoff > 0.0 and square < cutoff * cutoff:
                upper_bound = math.sqrt(square) - contact_distance
                if upper_bound < stop_below:
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
    """Computes the distance between two groups of robot spheres plus an offset [m].

    The result is min(d + offset, upper_bound), with the distance d between the groups. A group
    consists of the spheres that cover one body.

    Args:
        X: (n + 2, 12) poses of the world, the joint frames and the tool in the world frame; a row
            is a rotation matrix, row by row, and a position [m].
        spheres: spheres that cover the arm.
        center: (G, 3) centers of the groups' bounding spheres in the world frame [m].
        m: row of `spheres.pairs`, which contains the indices of the two groups.
        offset: offset added to d [m]: allowance minus required clearance. The allowance
            (`spheres.allowance`) is the overlap up to which the spheres of the two bodies do not
            count as in contact, because the exact shapes are smaller than the spheres.
        upper_bound: upper bound of the result [m].
        stop_below: value below which the computation stops; the result is then not necessarily
            the minimum over the spheres [m].
    """
    a, b = spheres.pairs[m, 0], spheres.pairs[m, 1]
    frame_a, frame_b = spheres.group_joint[a] + 1, spheres.group_joint[b] + 1
    for c in range(spheres.cluster[a], spheres.cluster[a + 1]):
        x, y, z = transform_point(X, frame_a, spheres.cluster_bound, c)
        u, v, w = x - center[b, 0], y - center[b, 1], z - center[b, 2]
        radius = spheres.cluster_bound[c, 3] - offset
        cutoff = upper_bound + radius + spheres.bound[b, 3]
        if cutoff <= 0.0 or u * u + v * v + w * w >= cutoff * cutoff:
            continue
        for e in range(spheres.cluster[b], spheres.cluster[b + 1]):
            u, v, w = transform_point(X, frame_b, spheres.cluster_bound, e)
            cutoff = upper_bound + radius + spheres.cluster_bound[e, 3]
            square = (u - x) ** 2 + (v - y) ** 2 + (w - z) ** 2
            if cutoff > 0.0 and square < cutoff * cutoff:
                upper_bound = _cluster_distance(
                    X, spheres, frame_a, c, frame_b, e, offset, upper_bound, stop_below
                )
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
    """Updates the arm's three smallest clearance margins, in place, with one more configuration.

    A clearance margin is distance minus required clearance. Each of the three margins is replaced
    only by a smaller one, so that repeated calls give the minima along a motion.

    Args:
        X: (n + 2, 12) link poses of the configuration, as computed by `chain_poses`.
        t: time at which the positions of the geometries are evaluated [s].
        spheres: spheres that cover the arm, in G groups (one group per body).
        geometries: collision geometries of environment and obstacles.
        required: required clearances between groups and geometries, and between groups.
        center: (G, 3) work array.
        margins: (3,) smallest margins so far, at the indices `TOOL`, `LINKS`, `SELF` [m].
        stop_below: margin below which the computation stops [m].
    """
    place_bounds(X, spheres, center)
    for g in range(len(center)):
        row = TOOL if required.is_tool[g] else LINKS
        for k in range(len(geometries.ball)):
            clearance = required.of_geometries[g, k]
            if group_bound(spheres, center, g, geometries, k, t) < clearance + margins[row]:
                margins[row] = geometry_gap(
                    X, spheres, center, g, geometries, k, t, clearance, margins[row], stop_below
                )  # fmt: skip
            if margins[row] < stop_below:
                return
    for m in range(len(spheres.pairs)):
        offset = spheres.allowance[m] - required.of_self
        if pair_bound(spheres, center, m) + offset < margins[SELF]:
            margins[SELF] = pair_distance(X, spheres, center, m, offset, margins[SELF], stop_below)
        if margins[SELF] < stop_below:
            return


@compiled
def clearance_margin(
    world: ArmCollisionModel, q: FloatArray, max_margin: float, X: FloatArray, center: FloatArray
) -> float:
    """Computes the minimum clearance margin of the arm at one configuration [m].

    A clearance margin is distance minus required clearance. The computation stops at the first
    negative margin, which is not necessarily the minimum.

    Args:
        world: collision model of the arm.
        q: (n,) configuration [rad].
        max_margin: upper bound of the result [m].
        X: (n + 2, 12) work array for the poses of the links.
        center: (G, 3) work array for the bounding spheres of the G bodies.
    """
    margins = np.full(3, max_margin)
    chain_poses(q, world.chain.X_PJ, X)
    lower_clearance_margins(
        X, world.now, world.spheres, world.geometries, world.required, center, margins, 0.0
    )
    return min(margins[0], min(margins[1], margins[2]))


def is_collision_free(world: ArmCollisionModel, q: FloatArray) -> bool:
    """Checks whether the arm satisfies joint limits and required clearances at a configuration.

    Args:
        world: collision model of the arm, with the required clearances.
        q: (n,) configuration [rad].
    """
    is_within = (world.chain.lower <= q).all() and (q <= world.chain.upper).all()
    return bool(is_within and min_clearance_margin(world, q[None]) >= 0.0)


@compiled
def free_fraction(
    world: ArmCollisionModel, q_start: FloatArray, q_end: FloatArray, stride: float = SPHERE_STRIDE
) -> tuple[float, int]:
    """Computes the collision-free fraction of a straight joint-space edge, from its start on.

    The edge is checked at single configurations. From a checked configuration to the next one, no
    sphere of the arm moves farther than the clearance margin (distance minus required clearance) of
    the former, or than `stride` if `stride` is larger. Between them, the clearance can fall below
    the required one by at most half of `stride`.

    Args:
        world: collision model of the arm, with the required clearances.
        q_start: (n,) configuration at the start of the edge [rad].
        q_end: (n,) configuration at the end of the edge [rad].
        stride: maximum displacement of the spheres between two checked configurations, where the
            clearance margin is smaller than this value [m].

    Returns:
        Collision-free fraction, 1 for the entire edge, and number of checked configurations.
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
    """Computes the minimum clearance margin of the arm over T configurations [m].

    A clearance margin is distance minus required clearance. The result is at most 0.3 m (`FAR`). A
    negative result may not be the smallest margin: in each configuration, the computation stops at
    the first negative margin.

    Args:
        world: collision model of the arm, with the required clearances.
        q: (T, n) configurations [rad].
    """
    X, center = np.empty((q.shape[1] + 2, 12)), np.empty((len(world.spheres.group_joint), 3))
    margin = FAR
    for row in range(len(q)):
        margin = min(margin, clearance_margin(world, q[row], FAR, X, center))
    return margin


@compiled
def self_distance(chain: Chain, spheres: Spheres, q: FloatArray) -> float:
    """Computes the minimum distance between bodies of the arm at a configuration [m].

    Covering spheres represent the bodies. Because the spheres are larger than the exact shapes, an
    allowance is added to the distance of the spheres: the overlap up to which the two bodies do not
    count as in contact (`spheres.allowance`). The result is at most 0.3 m (`FAR`), and negative if
    the spheres of two bodies overlap by more than the allowance.

    Args:
        chain: kinematic chain of the arm.
        spheres: spheres that cover the arm, with the pairs of bodies that can collide.
        q: (n,) configuration [rad].
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
    """Computes the minimum distance of each body of the arm to each geometry over T configurations.

    Covering spheres in G groups represent the bodies.

    Args:
        chain: kinematic chain of the arm.
        spheres: spheres that cover the arm.
        geometries: K collision geometries, which may move.
        q: (T, n) configurations [rad].
        t: time at which the positions of the geometries are evaluated [s].
        max_distance: upper bound of the distances [m].

    Returns:
        (G, K) minimum distances of G groups (bodies) to K collision geometries over all
        configurations [m].
    """
    distances = np.full((len(spheres.group_joint), len(geometries.ball)), max_distance)
    X, center = np.empty((q.shape[1] + 2, 12)), np.empty((len(spheres.group_joint), 3))
    for row in range(len(q)):
        chain_poses(q[row], chain.X_PJ, X)
        place_bounds(X, spheres, center)
        for g in range(len(center)):
            for k in range(len(geometries.ball)):
                upper_bound = distances[g, k]
                if group_bound(spheres, center, g, geometries, k, t) < upper_bound:
                    distances[g, k] = geometry_gap(
                        X, spheres, center, g, geometries, k, t, 0.0, upper_bound, -np.inf
                    )  # fmt: skip
    return distances
