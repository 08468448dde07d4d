"""Route selection by heuristic cost rings.

For each obstacle a circle of directions omega in the YZ-plane of the policy's
local frame L is weighed by several rings, and the direction of least total cost
is the side on which the obstacle is passed (Pairet et al. 2019, section IV-D, eq. 12):

    min_omega  eta_table(omega) + eta_length(omega) + eta_limits(omega)

eta_limits is the sum of two rings that are nowhere both 1: what is out of reach, and what
is reached only near a joint's limit, both by inverse kinematics along the way. A ring is a
function from a `RingScene` to an (M, K) array of costs in [0, 1]; passing more of them to
`select_directions` adds them to the sum.

The choice of the sides on which obstacles are passed, by their cost rings.

Where obstacles stand one after another the best side of one depends on that of the next:
the way from one passing point to another has a length, may run through a third obstacle, and
may leave what the arm reaches. With the groups of obstacles (`overlap_groups`)
in their order along the baseline and omega_i the direction of group i, what is least is

    sum_i eta_i(omega_i) + N (l(omega_1, ..., omega_N) - l_min) / max(l_max - l_min, 0.1 N L)
          + 2 sum over the legs of their obstruction,

eta_i being the rings of the group but the length ring, and l the length of the way start,
passing points in their order, goal, with l_min and l_max its bounds, and L the baseline. With one
obstacle nothing else obstructs a leg, and this is eq. 12 of the paper. Each term looks at
neighbors only, so that the least of all K^N combinations takes N K^2 steps (Viterbi).
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
"""Cost at which a ring forbids a direction."""
JOINT_MARGIN = 0.1
"""Distance that the joints keep from their limits where there is room [rad]."""
_HYSTERESIS = 0.2
"""Cost that another choice must save for a group to leave its side."""
LEAST_SPREAD = 0.1
"""Spread of path lengths, in baselines, below which they count as near to each other."""


@dataclass(frozen=True, eq=False)
class RingScene:
    """What a ring may look at: M obstacles, K directions.

    Attributes:
        p_WS: (3,) start [m].
        p_WG: (3,) goal [m].
        ellipsoids: the M obstacles, dilated by the tool.
        table: the supporting plane, or None.
        angles: (K,) angles on the local YZ circle [rad].
        directions_W: (K, 3) the directions omega as unit vectors.
        p_WP: (M, K, 3) passing points: where a motion that leaves the baseline
            along omega has the requested clearance to the obstacle [m].
        detour: (M, K) distance of the passing point from the baseline [m].
        requested_clearance: the requested clearance Delta [m].
        joint_margin: (M, K) the least distance of the arm's joints to their limits on the way
            over the passing point [rad]; -inf where the arm cannot follow it, inf: not known.
        straight_margin: the same on the baseline [rad].
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
JointMargins = Callable[[FloatArray], FloatArray]
"""(N, P, 3) corners of N ways [m] -> (N, P) the least distance of the arm's joints to their limits
on the leg to each corner [rad]; -inf from the first corner that the arm does not reach."""


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
    """Lays the circle of directions round the baseline.

    The passing point of obstacle i along omega is

        p_P = b + omega max(0, h_i(omega) + Delta - omega . (b - c_i)),

    with b the point of the baseline nearest to the center c_i and h_i the support
    function of the ellipsoid about its center: the plane through p_P with normal
    omega is Delta away from the obstacle.

    Args:
        p_WS: (3,) start [m].
        p_WG: (3,) goal [m].
        R_WL: (3, 3) local frame, x from start to goal.
        ellipsoids: the obstacles.
        table: the supporting plane, or None.
        requested_clearance: requested clearance Delta [m].
        n_directions: K, how many directions.
        joint_margins: of the arm; None: not known.
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
        ways = np.stack(np.broadcast_arrays(p_WS, p_WP, p_WG), axis=2).reshape(-1, 3, 3)
        margin = joint_margins(ways).min(axis=1).reshape(detour.shape)
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
    """eta_length: path start - passing point - goal, scaled to [0, 1] over the ring.

    Lengths that differ by less than a tenth of the baseline count as near to each
    other: else an obstacle right on the baseline, whose sides are about as long, would
    change its side, against all hysteresis, with every millimeter it moves.
    """
    length = np.linalg.norm(scene.p_WP - scene.p_WS, axis=2)
    length = length + np.linalg.norm(scene.p_WG - scene.p_WP, axis=2)
    if not length.size:
        return length
    low, high = length.min(axis=1, keepdims=True), length.max(axis=1, keepdims=True)
    least = LEAST_SPREAD * float(np.linalg.norm(scene.p_WG - scene.p_WS))
    return np.asarray((length - low) / np.maximum(high - low, least))


def table_ring(scene: RingScene, *, height: float) -> FloatArray:
    """eta_table: 1 where the passing point is lower than `height` above the table.

    Args:
        scene: the scene.
        height: least height of E above the table [m]: how far the tool reaches
            below E, and a margin.
    """
    if scene.table is None:
        return np.zeros(scene.detour.shape)
    return (scene.table.height(scene.p_WP) < height).astype(float)


def reach_ring(scene: RingScene) -> FloatArray:
    """1 where the arm cannot follow the way over the passing point."""
    return np.isneginf(scene.joint_margin).astype(float)


def joint_limits_ring(scene: RingScene) -> FloatArray:
    """1 where the arm follows the way, but comes nearer to a joint's limit than it must.

    That is nearer than `JOINT_MARGIN`, and than on the baseline.
    """
    is_near = scene.joint_margin < min(JOINT_MARGIN, scene.straight_margin)
    return (is_near & ~np.isneginf(scene.joint_margin)).astype(float)


_SAMPLES = 41
"""Places on the baseline at which an obstacle's distance is looked at."""


def remaining_clearance(scene: RingScene) -> FloatArray:
    """(M,) clearance that the motion is to be led at, no more than start and goal leave [m].

    0 where the baseline keeps it already, or is nearest at one of its ends: no side helps there.
    """
    shapes = scene.ellipsoids
    share = np.linspace(0.0, 1.0, _SAMPLES)[:, None, None]
    place = scene.p_WS + share * (scene.p_WG - scene.p_WS)
    distance = signed_distance(place, shapes.p_WO, shapes.R_WO, shapes.semi_axes)
    achievable_clearance = np.minimum(scene.requested_clearance, distance[[0, -1]].min(axis=0))
    nearest = distance.argmin(axis=0)
    between = (nearest > 0) & (nearest < _SAMPLES - 1)
    return np.where(
        between & (distance.min(axis=0) < achievable_clearance), achievable_clearance, 0.0
    )


def path_length(scene: RingScene, index: IntArray) -> float:
    """length(pi-hat) of section IV-E: start, passing points in order, goal [m]."""
    rows = np.flatnonzero(scene.detour[np.arange(len(index)), index] > 0.0)
    points = scene.p_WP[rows, index[rows]]
    baseline = scene.p_WG - scene.p_WS
    points = points[np.argsort(points @ baseline, kind="stable")]
    way = np.concatenate([scene.p_WS[None], points, scene.p_WG[None]])
    return float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())


def select_directions(
    scene: RingScene,
    rings: Mapping[str, Ring],
    *,
    previous: IntArray | None = None,
) -> tuple[IntArray, dict[str, FloatArray], BoolArray]:
    """Chooses omega_d: the directions of least total cost.

    Obstacles with no way between them (`overlap_groups`) are passed on one side:
    the mean of their costs decides, and what one of them forbids is forbidden to
    all. Equal costs are decided by the lowest angle, so the answer is definite. The sides
    of several groups are chosen together.

    Args:
        scene: the scene.
        rings: the rings by name.
        previous: (M,) the columns chosen before, -1 where there was none. A group
            keeps its side while that is allowed and no other choice takes `_HYSTERESIS` off the
            total.

    Returns:
        (M,) chosen columns of the rings, the rings (M, K) by name, and (M,) whether some ring
        forbids every direction.

    Raises:
        ValueError: naming the ring, for costs of another shape.
    """
    count, width = scene.detour.shape
    costs = {name: np.asarray(ring(scene), dtype=float) for name, ring in rings.items()}
    for name, cost in costs.items():
        if cost.shape != (count, width):
            raise ValueError(
                f"ring '{name}' returned shape {cost.shape}; it must be ({count}, {width}), "
                "obstacles by directions"
            )
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
            # A side is left where that takes more than the hysteresis off the whole.
            choice[row, side] -= _HYSTERESIS * (not shut[row, side])
    for rows, side, is_shut in zip(groups, least_sequence(choice, pair)[0], shut, strict=True):
        index[rows], blocked[rows] = side, is_shut.all()
    return index, costs, blocked


_OBSTRUCTED = 2.0
"""Cost of a leg through an obstacle. Where the length outweighs it the way is cut short, and
the coupling's bends add up near the obstacle; a larger one changes little
(docs/decisions/0021-sides-chosen-together.md)."""


def support_of(ellipsoids: EllipsoidSet, directions: FloatArray) -> FloatArray:
    """Computes the support function of each of M ellipsoids about its center.

    Args:
        ellipsoids: M ellipsoids.
        directions: (M, J, 3) unit directions.

    Returns:
        (M, J) [m].
    """
    axes = ellipsoids.R_WO * ellipsoids.semi_axes[:, None]
    return np.asarray(np.linalg.norm(directions @ axes, axis=2))


def overlap_groups(ellipsoids: EllipsoidSet, requested_clearance: float) -> IntArray:
    """Numbers the groups of obstacles that leave no way between them, (M,).

    Two obstacles belong together when their gap along the line of centers is less
    than two clearances; groups are the connected components.
    """
    gap = ellipsoids.p_WO[:, None] - ellipsoids.p_WO
    distance = np.linalg.norm(gap, axis=2)
    reach = support_of(ellipsoids, gap / np.maximum(distance, 1e-300)[:, :, None])
    linked = distance < reach + reach.T + 2.0 * requested_clearance
    return np.asarray(connected_components(linked, directed=False)[1])


def groups_along_baseline(scene: RingScene) -> list[IntArray]:
    """Rows of each group of obstacles, in the order in which the motion meets the groups."""
    numbers = overlap_groups(scene.ellipsoids, scene.requested_clearance)
    groups = [np.flatnonzero(numbers == number) for number in np.unique(numbers)]
    place = scene.ellipsoids.p_WO @ (scene.p_WG - scene.p_WS)
    return sorted(groups, key=lambda rows: float(place[rows].mean()))


def least_sequence(choice: FloatArray, pair: FloatArray) -> tuple[IntArray, float]:
    """Finds the choices of least total cost (Viterbi), of equal ones the first, and that total.

    Args:
        choice: (N, K) costs of a choice at a stage.
        pair: (N - 1, K, K) costs of a choice at a stage and one at the next.
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
    """Computes the costs of sequences of sides of N groups, see `least_sequence`.

    A group is passed over the passing point of its member that stands out farthest. The
    legs from the start and to the goal pass their own group, whatever its side, by the
    coupling's bend: it is not in their way.

    Args:
        scene: the scene.
        groups: rows of the groups along the baseline.
        rings: (N, K) sum of the rings of each group but the length ring.
        shut: (N, K) where a ring forbids the direction: it costs more than all else together.
        counts_length: whether lengths count.
    """
    count, width = rings.shape
    farthest = [rows[scene.detour[rows].argmax(axis=0)] for rows in groups]
    p = np.stack([scene.p_WP[rows, np.arange(width)] for rows in farthest])
    stages = [scene.p_WS[None], *p, scene.p_WG[None]]
    counts = np.ones((count + 1, len(scene.detour)), dtype=bool)
    counts[0, groups[0]], counts[-1, groups[-1]] = False, False
    legs = list(pairwise(stages))
    length = [np.linalg.norm(b - a[:, None], axis=2) for a, b in legs]
    obstructed = [
        obstruction(a, b, scene.ellipsoids, seen, scene.requested_clearance)
        for (a, b), seen in zip(legs, counts, strict=True)
    ]

    def chain(legs: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Adds the legs at both ends to the costs of the choices."""
        choice = np.zeros((count, width))
        choice[0] += legs[0][0]
        choice[-1] += legs[-1][:, 0]
        return choice, np.array(legs[1:-1]).reshape(-1, width, width)

    lengths, between = chain(length)
    shortest = least_sequence(lengths, between)[1]
    longest = -least_sequence(-lengths, -between)[1]
    spread = LEAST_SPREAD * float(np.linalg.norm(scene.p_WG - scene.p_WS))
    scale = count / max(longest - shortest, count * spread) if counts_length else 0.0
    choice, pair = chain(obstructed)
    all_else = float(rings.max(axis=1).sum()) + count + _OBSTRUCTED * (count + 1)
    # Of the length only what is over the shortest counts.
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
    """Computes the obstruction of straight legs by ellipsoids.

    With g the least norm of a leg's points in the axes of an obstacle, scaled so that the obstacle
    grown by the clearance is the unit ball, it is 1 - g, at least 0; and 1 where the leg meets the
    obstacle itself.

    Args:
        p_WA: (I, 3) beginnings of the legs [m].
        p_WB: (J, 3) ends of the legs [m].
        ellipsoids: M obstacles.
        counts: (M,) the obstacles that are considered.
        clearance: growth of the obstacles [m].

    Returns:
        (I, J) the largest of all obstacles.
    """
    centers, R_WO = ellipsoids.p_WO[counts, None], ellipsoids.R_WO[counts]
    ends = [(p - centers) @ R_WO for p in (p_WA, p_WB)]
    axes = ellipsoids.semi_axes[counts, None]
    least: FloatArray = np.zeros((2, len(p_WA), len(p_WB)))
    for row, growth in enumerate((clearance, 0.0)):
        a, b = (p / (axes + growth) for p in ends)
        aa, bb = (a * a).sum(axis=2)[:, :, None], (b * b).sum(axis=2)[:, None]
        ab = a @ b.transpose(0, 2, 1)
        squared = aa + bb - 2.0 * ab
        share = np.clip((aa - ab) / np.maximum(squared, 1e-300), 0.0, 1.0)
        g = np.sqrt(np.maximum(aa + share * (2.0 * (ab - aa) + share * squared), 0.0))
        least[row] = g.min(axis=0, initial=1.0)
    return np.where(least[1] < 1.0, 1.0, 1.0 - least[0])
