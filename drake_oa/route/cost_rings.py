"""Cost rings, and the selection of the sides on which obstacles are passed.

A cost ring rates directions omega in which an obstacle can be passed. The directions form a circle
around the line from start to goal, in the YZ plane of the local frame L (x from start to goal, z
up). The direction with the minimum total cost is selected, by (12) of Pairet et al., RA-L 2019:

    min_omega  eta_table(omega) + eta_length(omega) + eta_limits(omega)

eta_table is 1 for directions that lead too close to the table, and eta_length grows with the length
of the detour. eta_limits is the sum of two rings, both computed by inverse kinematics along the
path. One is 1 for paths that the arm cannot reach, the other for reachable paths close to a joint
limit. A ring is a function that maps a `RingScene` to an (M, K) array of costs
in [0, 1]; `select_directions` also adds user-supplied rings to the sum.

With several obstacles along the baseline (the line from start to goal) the best side of one depends
on that of the next: the leg (straight segment) between their passing points has a length and may
intersect a third obstacle. A passing point is beside an obstacle, in the direction of the side and
with the requested clearance (`ring_scene`). Obstacles without a passage between them form a group
(`overlap_groups`). The selection minimizes the sum of three terms: the costs by the rings, the
scaled excess length of the path, and the obstruction of the legs. With N groups in their order
along the baseline, and the direction omega_i of group i, this sum is

    sum_i eta_i(omega_i) + N (l(omega_1, ..., omega_N) - l_min) / max(l_max - l_min, 0.1 N L)
          + 2 sum over the legs of their obstruction.

eta_i is the sum of the rings of group i except the length ring, as a mean over the obstacles of the
group. l is the length of the path from
start via the passing points to the goal. l_min and l_max are its minimum and maximum over all
combinations of directions, and L is the length of the baseline. The obstruction of a leg, from 0
(free) to 1 (intersects an obstacle), is computed by `obstruction`. With one obstacle no leg is
obstructed, and the sum equals that of (12). Each term depends on consecutive groups only. Dynamic
programming (Viterbi) thus finds the minimum of all K^N combinations of K directions in N K^2 steps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.sparse.csgraph import connected_components

from drake_oa.common.messages import BoolArray, EllipsoidSet, FloatArray, IntArray, TablePlane
from drake_oa.geometry.ellipsoid import signed_distance

FORBIDDEN = 1.0
"""Smallest cost by which a cost ring forbids a direction of passing an obstacle [-]."""
JOINT_MARGIN = 0.1
"""Distance from a joint limit below which a path past an obstacle is forbidden [rad]."""
_HYSTERESIS = 0.2
"""Minimum reduction of the total cost for which the passing side of obstacles changes [-]."""
LEAST_SPREAD = 0.1
"""Length difference by which costs of path lengths are at least divided, over the baseline [-].

The baseline is the distance from start to goal. The cost of a path past an obstacle is the excess
of its length over the shortest path, divided by the difference between the longest and the shortest
path. If this difference is smaller than the constant times the baseline, the latter is the divisor,
so that all costs are below 1."""


@dataclass(frozen=True, eq=False)
class RingScene:
    """Input of the cost rings: M obstacles and K directions in which each of them can be passed.

    Positions and directions are in the world frame. The baseline is the line from start to goal.

    Attributes:
        p_WS: (3,) start [m].
        p_WG: (3,) goal [m].
        ellipsoids: M obstacles, dilated by the tool.
        table: support plane; None: unknown.
        angles: (K,) angles of the directions [rad], 0 along y and pi/2 along z of the local frame
            (x from start to goal, z up).
        directions_W: (K, 3) directions omega, unit vectors orthogonal to the baseline.
        p_WP: (M, K, 3) passing points of paths past each obstacle in each direction [m]. They have
            at least the requested clearance from the obstacle. They are displaced from the baseline
            along omega, unless the baseline itself has this clearance.
        detour: (M, K) distances of the passing points from the baseline [m].
        requested_clearance: requested clearance Delta [m].
        joint_margin: (M, K) minimum distance of the joints from their limits on the path via the
            passing point [rad]; -inf if the arm cannot follow the path, inf if unknown.
        straight_margin: minimum distance of the joints from their limits on the baseline [rad].
    """

    p_WS: FloatArray
    p_WG: FloatArray
    ellipsoids: EllipsoidSet
    table: TablePlane | None
    angles: FloatArray
    directions_W: FloatArray
    p_WP: FloatArray
    detour: FloatArray
    requested_clearance: float
    joint_margin: FloatArray
    straight_margin: float


Ring = Callable[[RingScene], FloatArray]
"""Cost ring: function that rates K directions of passing M obstacles.

The argument is the scene, the result (M, K) costs in [0, 1], of which 1 forbids a direction."""
JointMargins = Callable[[FloatArray], FloatArray]
"""Function that computes the joint margins along N paths of the tool point.

A joint margin is the minimum distance of the joints from their limits. The argument contains P
corners of each path in the world frame, (N, P, 3) [m]. The result (N, P) [rad] contains for each
corner the joint margin on the leg (straight segment) that ends at this corner, and for the first
corner the joint margin at this point. If the arm cannot reach a corner, the results for this corner
and all following corners of the path are -inf."""


def ring_scene(
    p_WS: FloatArray,
    p_WG: FloatArray,
    R_WL: FloatArray,
    ellipsoids: EllipsoidSet,
    table: TablePlane | None,
    *,
    requested_clearance: float,
    n_directions: int = 36,
    joint_margins: JointMargins | None = None,
) -> RingScene:
    """Computes the input of the cost rings: directions, passing points and joint margins.

    A joint margin is the minimum distance of the joints from their limits on a path. A passing
    point is a point beside an obstacle, displaced from the baseline (line from start to goal) along
    a direction omega until it has the clearance Delta from the obstacle. Let c_i be the center of
    ellipsoid i, h_i its support function about c_i, and b the point of the baseline nearest to c_i.
    The passing point is

        p_P = b + omega max(0, h_i(omega) + Delta - omega . (b - c_i)).

    The plane through p_P with normal omega thus has the distance Delta from the obstacle, or more
    if the maximum is 0.

    Args:
        p_WS: (3,) start in the world frame [m].
        p_WG: (3,) goal in the world frame [m].
        R_WL: (3, 3) local frame, x from start to goal, z up.
        ellipsoids: ellipsoids of M obstacles, dilated by the tool.
        table: support plane; None: unknown.
        requested_clearance: requested clearance Delta [m].
        n_directions: number K of directions, evenly spaced around the baseline.
        joint_margins: function that computes the joint margins of the arm along paths; None: the
            margins are inf (unknown).
    """
    angles: FloatArray = np.arange(n_directions, dtype=float) * (2.0 * np.pi / n_directions)
    circle_L = np.stack([np.zeros(n_directions), np.cos(angles), np.sin(angles)], axis=1)
    directions_W = circle_L @ R_WL.T
    length = float(np.linalg.norm(p_WG - p_WS))
    along = np.clip((ellipsoids.p_WO - p_WS) @ R_WL[:, 0], 0.0, length)
    p_WB = p_WS + along[:, None] * R_WL[:, 0]
    support = support_of(ellipsoids, np.broadcast_to(directions_W, (len(along), n_directions, 3)))
    detour = np.maximum(
        0.0, support + requested_clearance - (p_WB - ellipsoids.p_WO) @ directions_W.T
    )
    p_WP = p_WB[:, None, :] + detour[:, :, None] * directions_W
    margin, straight = np.full(detour.shape, np.inf), np.inf
    if joint_margins is not None and detour.size:
        paths = np.stack(np.broadcast_arrays(p_WS, p_WP, p_WG), axis=2).reshape(-1, 3, 3)
        margin = joint_margins(paths).min(axis=1).reshape(detour.shape)
        straight = float(joint_margins(np.stack([p_WS, p_WG])[None]).min())
    return RingScene(
        p_WS=p_WS,
        p_WG=p_WG,
        ellipsoids=ellipsoids,
        table=table,
        angles=angles,
        directions_W=directions_W,
        p_WP=p_WP,
        detour=detour,
        requested_clearance=requested_clearance,
        joint_margin=margin,
        straight_margin=straight,
    )


def length_ring(scene: RingScene) -> FloatArray:
    """Computes the length ring: costs (M, K) of the path past M obstacles in K directions each.

    The cost of the shortest path past an obstacle is 0, that of the longest at most 1:

        (l - l_min) / max(l_max - l_min, 0.1 L)

    l is the length of the path from the start via the passing point (beside the obstacle, with the
    requested clearance) to the goal. l_min and l_max are the smallest and the largest l over the
    directions, and L is the distance from start to goal. For an obstacle on the line from start to
    goal, all lengths are about equal. Without the term 0.1 L, the side on which this obstacle is
    passed would change with each millimeter of motion, in spite of the hysteresis.
    """
    length = np.linalg.norm(scene.p_WP - scene.p_WS, axis=2)
    length = length + np.linalg.norm(scene.p_WG - scene.p_WP, axis=2)
    if not length.size:
        return length
    low, high = length.min(axis=1, keepdims=True), length.max(axis=1, keepdims=True)
    min_range = LEAST_SPREAD * float(np.linalg.norm(scene.p_WG - scene.p_WS))
    return np.asarray((length - low) / np.maximum(high - low, min_range))


def table_ring(scene: RingScene, *, height: float) -> FloatArray:
    """Computes the table ring: costs (M, K), 1 for a passing point too close to the table, else 0.

    A passing point is beside an obstacle in one of the directions, with the requested clearance.
    All costs are 0 if the support plane is unknown.

    Args:
        scene: M obstacles and K directions in which they can be passed.
        height: minimum height of the tool point E above the table [m]: extent of the tool below E
            plus a margin.
    """
    if scene.table is None:
        return np.zeros(scene.detour.shape)
    return (scene.table.height(scene.p_WP) < height).astype(float)


def reach_ring(scene: RingScene) -> FloatArray:
    """Computes the workspace ring: costs (M, K), 1 if the arm cannot follow the path, else 0.

    The path leads from the start via the passing point of one of M obstacles, in one of K
    directions, to the goal. The passing point has the requested clearance from the obstacle.
    """
    return np.isneginf(scene.joint_margin).astype(float)


def joint_limits_ring(scene: RingScene) -> FloatArray:
    """Computes the joint limit ring: costs (M, K), 1 for a path near a joint limit, else 0.

    The paths lead from the start past one of M obstacles, in one of K directions, to the goal. The
    joint margin of a path is the minimum distance of the joints from their limits. A path is near a
    joint limit if its joint margin is below 0.1 rad (`JOINT_MARGIN`) and below that of the straight
    path from start to goal. Paths out of reach have the cost 0 here.
    """
    is_near = scene.joint_margin < min(JOINT_MARGIN, scene.straight_margin)
    return (is_near & ~np.isneginf(scene.joint_margin)).astype(float)


_SAMPLES = 41
"""Number of points of the baseline at which `remaining_clearance` computes distances."""


def remaining_clearance(scene: RingScene) -> FloatArray:
    """Computes the clearances (M,) at which guidance leads the motion past M obstacles [m].

    Heading guidance is the coupling term that turns the motion to the selected side. Each clearance
    is the requested one, or the distance of start or goal from the obstacle if that is smaller. No
    guidance is needed, and the result is 0, in two cases: the baseline (line from start to goal)
    already has this clearance, or the point of the baseline nearest to the obstacle is the start or
    the goal.
    """
    shapes = scene.ellipsoids
    share = np.linspace(0.0, 1.0, _SAMPLES)[:, None, None]
    points = scene.p_WS + share * (scene.p_WG - scene.p_WS)
    distance = signed_distance(points, shapes.p_WO, shapes.R_WO, shapes.semi_axes)
    achievable_clearance = np.minimum(scene.requested_clearance, distance[[0, -1]].min(axis=0))
    nearest = distance.argmin(axis=0)
    between = (nearest > 0) & (nearest < _SAMPLES - 1)
    return np.where(
        between & (distance.min(axis=0) < achievable_clearance), achievable_clearance, 0.0
    )


def path_length(scene: RingScene, index: IntArray) -> float:
    """Computes the length of the path from start via the selected passing points to the goal [m].

    Each obstacle has one passing point on the selected side, with the requested clearance; points
    on the line from start to goal are left out. The length is length(pi-hat) in section IV-E of
    Pairet et al., RA-L 2019, and scales the duration of the motion.

    Args:
        scene: M obstacles and K directions in which they can be passed.
        index: (M,) index of the selected direction for each obstacle.
    """
    rows = np.flatnonzero(scene.detour[np.arange(len(index)), index] > 0.0)
    points = scene.p_WP[rows, index[rows]]
    baseline = scene.p_WG - scene.p_WS
    points = points[np.argsort(points @ baseline, kind="stable")]
    path = np.concatenate([scene.p_WS[None], points, scene.p_WG[None]])
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def select_directions(
    scene: RingScene, rings: Mapping[str, Ring], *, previous: IntArray | None = None
) -> tuple[IntArray, dict[str, FloatArray], BoolArray]:
    """Selects for each obstacle the passing direction omega_d, by the minimum total cost.

    Obstacles without a passage between them form a group (`overlap_groups`), which is passed on one
    side. The total cost is the sum of the groups' costs by the rings, of the scaled length of the
    path past all groups, and of the obstruction of the path between them; the module docstring has
    the equation. The cost of a group is the mean of the members' costs, and a direction forbidden
    for one member is forbidden for the group. Among directions of equal cost the one with the
    lowest angle is selected.

    Args:
        scene: M obstacles and K directions in which they can be passed.
        rings: cost rings by name; with a ring "length", the path length is part of the cost.
        previous: (M,) index of each obstacle's direction in the last decision, -1 for new
            obstacles. A group changes its side only if this side is forbidden, or if another side
            reduces the total cost by at least 0.2 (`_HYSTERESIS`).

    Returns:
        Index (M,) of each obstacle's selected direction; costs (M, K) by the name of the ring; and
        booleans (M,), True for an obstacle of which every direction is forbidden.

    Raises:
        ValueError: if the costs of a ring have another shape or are not finite; names the ring.
    """
    count, width = scene.detour.shape
    costs = {name: np.asarray(ring(scene), dtype=float) for name, ring in rings.items()}
    for name, cost in costs.items():
        if cost.shape != (count, width):
            raise ValueError(
                f"ring '{name}' returned shape {cost.shape}; it must be ({count}, {width}), "
                "obstacles by directions"
            )
        if not np.isfinite(cost).all():
            raise ValueError(f"ring '{name}' returned costs that are not finite")
    index, blocked = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=bool)
    if not count:
        return index, costs, blocked
    groups = groups_along_baseline(scene)
    others = [cost for name, cost in costs.items() if name != "length"]
    rings_sum = sum(others, np.zeros((count, width)))
    forbidden = np.any([cost >= FORBIDDEN for cost in [*others, np.zeros((count, width))]], axis=0)
    shut = np.array([forbidden[rows].any(axis=0) for rows in groups])
    choice, pair = sequence_costs(
        scene,
        groups,
        np.array([rings_sum[rows].mean(axis=0) for rows in groups]),
        shut,
        counts_length="length" in costs,
    )
    for row, rows in enumerate(groups):
        for side in [] if previous is None else previous[rows][previous[rows] >= 0][:1]:
            # The discount keeps the side unless another one saves more than the hysteresis.
            choice[row, side] -= _HYSTERESIS * (not shut[row, side])
    for rows, side, is_shut in zip(groups, best_sequence(choice, pair)[0], shut, strict=True):
        index[rows], blocked[rows] = side, is_shut.all()
    return index, costs, blocked


_OBSTRUCTED = 2.0
"""Cost of a straight path segment that intersects an obstacle, in the selection of sides [-].

With a smaller value shorter paths through obstacles are selected, and several coupling terms act
at once near the obstacle; a larger value has little effect. The value is discussed in
docs/decisions/0021-sides-chosen-together.md."""


def support_of(ellipsoids: EllipsoidSet, directions: FloatArray) -> FloatArray:
    """Computes how far M ellipsoids extend from their centers along given directions.

    Args:
        ellipsoids: M ellipsoids.
        directions: (M, J, 3) unit directions in the world frame.

    Returns:
        (M, J) values of the support function h(omega) = max omega . (p - c) over the points p of
        an ellipsoid with center c [m].
    """
    axes = ellipsoids.R_WO * ellipsoids.semi_axes[:, None]
    return np.asarray(np.linalg.norm(directions @ axes, axis=2))


def overlap_groups(ellipsoids: EllipsoidSet, requested_clearance: float) -> IntArray:
    """Divides M obstacles into groups without a passage between the members.

    Two obstacles are linked if their gap along the line of centers is less than twice the requested
    clearance. The groups are the connected components.

    Args:
        ellipsoids: ellipsoids of M obstacles.
        requested_clearance: requested clearance [m].

    Returns:
        (M,) number of the group to which each obstacle belongs.
    """
    gap = ellipsoids.p_WO[:, None] - ellipsoids.p_WO
    distance = np.linalg.norm(gap, axis=2)
    reach = support_of(ellipsoids, gap / np.maximum(distance, 1e-300)[:, :, None])
    linked = distance < reach + reach.T + 2.0 * requested_clearance
    return np.asarray(connected_components(linked, directed=False)[1])


def groups_along_baseline(scene: RingScene) -> list[IntArray]:
    """Returns the obstacles in each group of `overlap_groups`, with groups from start to goal.

    A group consists of obstacles without a passage between them.

    Args:
        scene: M obstacles, and start and goal of the motion.

    Returns:
        For each group an array with the row numbers of its obstacles in `scene`.
    """
    numbers = overlap_groups(scene.ellipsoids, scene.requested_clearance)
    groups = [np.flatnonzero(numbers == number) for number in np.unique(numbers)]
    place = scene.ellipsoids.p_WO @ (scene.p_WG - scene.p_WS)
    return sorted(groups, key=lambda rows: float(place[rows].mean()))


def best_sequence(choice: FloatArray, pair: FloatArray) -> tuple[IntArray, float]:
    """Finds the sequence of N choices with the minimum total cost, by the Viterbi algorithm.

    Args:
        choice: (N, K) costs of each of K choices at each of N stages.
        pair: (N - 1, K, K) costs of each pair of choices at two consecutive stages.

    Returns:
        Indices (N,) of the choices, the lowest indices if costs are equal, and their total cost.
    """
    onward, after = choice[-1], []
    for stage in range(len(pair) - 1, -1, -1):
        total = pair[stage] + onward
        after.append(total.argmin(axis=1))
        onward = choice[stage] + total.min(axis=1)
    index = [int(onward.argmin())]
    for following in reversed(after):
        index.append(int(following[index[-1]]))
    return np.array(index), float(onward.min())


def sequence_costs(
    scene: RingScene,
    groups: list[IntArray],
    rings: FloatArray,
    shut: BoolArray,
    *,
    counts_length: bool,
) -> tuple[FloatArray, FloatArray]:
    """Computes the costs of passing N groups of obstacles on K sides each, for `best_sequence`.

    The path leads from the start via one passing point per group to the goal; a leg is a straight
    segment between two of these points. Each single obstacle has a passing point on each side, with
    the requested clearance; a group uses that of its obstacle which is farthest from the line from
    start to goal. Obstacles on a leg cost more, except those of the first group on the leg from the
    start, and those of the last group on the leg to the goal: coupling terms bend the motion around
    these.

    Args:
        scene: M obstacles and K directions in which they can be passed.
        groups: row numbers of the obstacles in each group, from start to goal.
        rings: (N, K) sums of the cost rings (costs of passing an obstacle in each direction) for
            each group and side, without the ring of the path length.
        shut: (N, K) whether a cost ring forbids the direction; the direction then costs more than
            all other terms together.
        counts_length: whether the path length is part of the cost.

    Returns:
        Costs (N, K) of the side of each group, and costs (N - 1, K, K) of the sides of each pair of
        consecutive groups.
    """
    count, width = rings.shape
    farthest = [rows[scene.detour[rows].argmax(axis=0)] for rows in groups]
    p = np.stack([scene.p_WP[rows, np.arange(width)] for rows in farthest])
    stages = [scene.p_WS[None], *p, scene.p_WG[None]]
    counts = np.ones((count + 1, len(scene.detour)), dtype=bool)
    counts[0, groups[0]], counts[-1, groups[-1]] = False, False
    legs = list(pairwise(stages))
    length = [np.linalg.norm(b - a[:, None], axis=2) for a, b in legs]
    obstructed_costs = [
        obstruction(a, b, scene.ellipsoids, mask, scene.requested_clearance)
        for (a, b), mask in zip(legs, counts, strict=True)
    ]

    def chain(legs: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Sorts costs of legs into costs of single sides and costs of pairs of sides.

        A leg is a straight path segment between the passing points of two consecutive groups.

        Args:
            legs: array of costs for each leg, in which a row is a side of the group where the leg
                begins, and a column a side of the group where it ends. The first leg begins at the
                start (one row), and the last ends at the goal (one column).

        Returns:
            Costs (N, K) of single sides, and costs (N - 1, K, K) of pairs of consecutive sides.
        """
        choice = np.zeros((count, width))
        choice[0] += legs[0][0]
        choice[-1] += legs[-1][:, 0]
        return choice, np.array(legs[1:-1]).reshape(-1, width, width)

    lengths, between = chain(length)
    shortest = best_sequence(lengths, between)[1]
    longest = -best_sequence(-lengths, -between)[1]
    spread = LEAST_SPREAD * float(np.linalg.norm(scene.p_WG - scene.p_WS))
    scale = count / max(longest - shortest, count * spread) if counts_length else 0.0
    choice, pair = chain(obstructed_costs)
    all_else = float(rings.max(axis=1).sum()) + count + _OBSTRUCTED * (count + 1)
    # Only the length in excess of the shortest path is a cost.
    lengths[0] -= shortest
    choice = rings + scale * lengths + _OBSTRUCTED * choice + (all_else + 1.0) * shut
    return choice, scale * between + _OBSTRUCTED * pair


def obstruction(
    p_WA: FloatArray,
    p_WB: FloatArray,
    ellipsoids: EllipsoidSet,
    counts: BoolArray,
    clearance: float,
) -> FloatArray:
    """Computes the obstruction of straight legs by ellipsoids, from 0 (free) to 1 (intersected).

    A leg is a straight path segment between two points. Its obstruction is 1 if it intersects an
    obstacle, and 0 if it does not intersect the obstacle grown by the clearance. In between, the
    obstruction is 1 - g: g is the minimum distance of the leg from the obstacle's center, in
    coordinates in which the grown obstacle is the unit ball.

    Args:
        p_WA: (I, 3) starts of the legs in the world frame [m].
        p_WB: (J, 3) ends of the legs in the world frame [m]; each start is combined with each end.
        ellipsoids: ellipsoids of M obstacles.
        counts: (M,) whether an obstacle is considered.
        clearance: distance by which the obstacles are grown [m].

    Returns:
        (I, J) maximum over the obstacles of the obstruction of each leg.
    """
    centers, R_WO = ellipsoids.p_WO[counts, None], ellipsoids.R_WO[counts]
    ends = [(p - centers) @ R_WO for p in (p_WA, p_WB)]
    axes = ellipsoids.semi_axes[counts, None]
    min_norms: FloatArray = np.zeros((2, len(p_WA), len(p_WB)))
    for row, growth in enumerate((clearance, 0.0)):
        a, b = (p / (axes + growth) for p in ends)
        aa, bb = (a * a).sum(axis=2)[:, :, None], (b * b).sum(axis=2)[:, None]
        ab = a @ b.transpose(0, 2, 1)
        squared = aa + bb - 2.0 * ab
        share = np.clip((aa - ab) / np.maximum(squared, 1e-300), 0.0, 1.0)
        g = np.sqrt(np.maximum(aa + share * (2.0 * (ab - aa) + share * squared), 0.0))
        min_norms[row] = g.min(axis=0, initial=1.0)
    return np.where(min_norms[1] < 1.0, 1.0, 1.0 - min_norms[0])
