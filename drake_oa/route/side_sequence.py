"""The sides of several obstacles, chosen together.

Where obstacles stand one after another the best side of one depends on that of the next:
the way from one passing point to another has a length, may run through a third obstacle, and
may leave what the arm reaches. With the groups of obstacles (`overlap_groups`)
in their order along the baseline and omega_i the direction of group i, what is least is

    sum_i eta_i(omega_i) + N (l(omega_1, ..., omega_N) - l_min) / (l_max - l_min)
          + 2 sum over the legs of their obstruction,

eta_i being the rings of the group but the length ring, and l the length of the way start,
passing points in their order, goal, with l_min and l_max its bounds. With one obstacle
nothing else obstructs a leg, and this is min_omega of section IV-D of the paper. Each term looks at
neighbours only, so that the least of all K^N combinations takes N K^2 steps (Viterbi).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from drake_oa.common.kernel_arrays import kernel_arrays
from drake_oa.common.messages import EllipsoidSet, FloatArray, IntArray
from drake_oa.route import side_sequence_kernels as kernels
from drake_oa.route.cost_rings import Margin

_OBSTRUCTED = 2.0
"""Cost of a leg through an obstacle. Where the length outweighs it the way is cut short, and
the coupling's bends add up near the obstacle; a larger one changes little
(docs/design.md)."""
_SAMPLES = 6
"""Points of a leg that must be in reach: the middles of its equal parts."""


def overlap_groups(ellipsoids: EllipsoidSet, clearance: float) -> IntArray:
    """Numbers the groups of obstacles that leave no way between them, (M,).

    Two obstacles belong together when their gap along the line of centres is less
    than two clearances; groups are the connected components.
    """
    count = len(ellipsoids)
    gap = ellipsoids.p_WO[:, None, :] - ellipsoids.p_WO[None, :, :]
    distance = np.linalg.norm(gap, axis=2)
    unit = np.divide(
        gap, distance[:, :, None], out=np.zeros_like(gap), where=distance[:, :, None] > 0.0
    )
    in_axes = np.einsum("iab,ija->ijb", ellipsoids.R_WO, unit)
    reach = np.linalg.norm(in_axes * ellipsoids.semi_axes[:, None, :], axis=2)
    linked = distance < reach + reach.T + 2.0 * clearance
    label = np.arange(count)
    for _ in range(count):
        spread = np.where(linked, label[None, :], count).min(axis=1, initial=count)
        if np.array_equal(spread, label):
            break
        label = spread
    return label


def along_baseline(ellipsoids: EllipsoidSet, groups: IntArray, baseline: FloatArray) -> IntArray:
    """The numbers of the groups in the order in which a motion along (3,) meets them."""
    numbers = np.unique(groups)
    place = ellipsoids.p_WO @ baseline
    return numbers[np.argsort([place[groups == g].mean() for g in numbers], kind="stable")]


@dataclass(frozen=True, eq=False)
class Chain:
    """Costs of N stages with K choices each, of which neighbours see each other.

    Attributes:
        choice: (N, K) of a choice.
        pair: (N - 1, K, K) of a choice at a stage and at the next.
    """

    choice: FloatArray
    pair: FloatArray

    def least(self) -> tuple[IntArray, float]:
        """The choices of least total, of equal ones the first, and that total."""
        count = len(self.choice)
        onward = np.array(self.choice)
        after = np.zeros(self.choice.shape, dtype=np.int64)
        for i in range(count - 2, -1, -1):
            total = self.pair[i] + onward[i + 1]
            after[i] = total.argmin(axis=1)
            onward[i] += total.min(axis=1)
        index = np.empty(count, dtype=np.int64)
        index[0] = onward[0].argmin()
        for i in range(1, count):
            index[i] = after[i - 1, index[i - 1]]
        return index, float(onward[0].min())

    def total(self, index: IntArray) -> float:
        """Of given choices."""
        rows = np.arange(len(index))
        return float(
            self.choice[rows, index].sum() + self.pair[rows[:-1], index[:-1], index[1:]].sum()
        )


@dataclass(frozen=True, eq=False)
class Legs:
    """The ways between start, passing points and goal of N groups.

    Attributes:
        order: (N,) numbers of the groups along the baseline.
        p_WP: (N, K, 3) the passing points of the groups [m].
        length: lengths of the legs [m]: from the start and to the goal in `choice`.
        obstruction: in [0, 1] a leg, how much obstacles are in its way.
        beyond: 1 where a leg between two groups is out of reach; 0 in `choice`, whose legs
            the rings look at.
    """

    order: IntArray
    p_WP: FloatArray
    length: Chain
    obstruction: Chain
    beyond: Chain


def legs_between(
    p_WS: FloatArray,
    p_WG: FloatArray,
    p_WP: FloatArray,
    detour: FloatArray,
    ellipsoids: EllipsoidSet,
    groups: IntArray,
    clearance: float,
    margins: Mapping[str, Margin] | None = None,
) -> Legs:
    """Looks at every leg.

    A group is passed over the passing point of its member that stands out farthest. The
    legs from the start and to the goal pass their own group, whatever its side, by the
    coupling's bend: it is not in their way.

    Args:
        p_WS, p_WG: (3,) start and goal [m].
        p_WP: (M, K, 3) passing points [m].
        detour: (M, K) their distance from the baseline [m].
        ellipsoids: the M obstacles.
        groups: (M,) the groups' numbers.
        clearance: asked clearance [m].
        margins: name -> signed margin [m] of points (..., 3), negative out of reach.
    """
    baseline = p_WG - p_WS
    order = along_baseline(ellipsoids, groups, baseline)
    count, width = len(order), detour.shape[1]
    p = np.empty((count, width, 3))
    for i, group in enumerate(order):
        rows = np.flatnonzero(groups == group)
        p[i] = p_WP[rows[detour[rows].argmax(axis=0)], np.arange(width)]
    shapes = kernel_arrays(ellipsoids.p_WO, ellipsoids.R_WO, ellipsoids.semi_axes)

    def blocked(a: FloatArray, b: FloatArray, own: int | None) -> FloatArray:
        counts = groups != own if own is not None else np.ones(len(groups), dtype=bool)
        out = np.empty((len(a), len(b)))
        kernels.obstruction(*kernel_arrays(a, b), *shapes, counts, clearance, out)
        return out

    length = Chain(np.zeros((count, width)), np.linalg.norm(p[1:, None] - p[:-1, :, None], axis=3))
    in_way = Chain(np.zeros((count, width)), np.zeros((count - 1, width, width)))
    beyond = Chain(np.zeros((count, width)), np.zeros((count - 1, width, width)))
    length.choice[0] += np.linalg.norm(p[0] - p_WS, axis=1)
    length.choice[-1] += np.linalg.norm(p_WG - p[-1], axis=1)
    in_way.choice[0] += blocked(p_WS[None], p[0], int(order[0]))[0]
    in_way.choice[-1] += blocked(p[-1], p_WG[None], int(order[-1]))[:, 0]
    share = ((np.arange(_SAMPLES) + 0.5) / _SAMPLES)[:, None, None, None]
    for i in range(count - 1):
        in_way.pair[i] = blocked(p[i], p[i + 1], None)
        if margins:
            on_leg = p[i][:, None] + share * (p[i + 1] - p[i][:, None])
            for margin in margins.values():
                beyond.pair[i] += (margin(on_leg) < 0.0).any(axis=0)
    np.minimum(beyond.pair, 1.0, out=beyond.pair)
    return Legs(order, p, length, in_way, beyond)


def sequence_costs(legs: Legs, rings: FloatArray, shut: FloatArray, least_spread: float) -> Chain:
    """What a sequence of sides costs.

    Args:
        legs: see `legs_between`.
        rings: (N, K) sum of the rings of each group but the length ring, in `legs.order`.
        shut: (N, K) 1 where a ring forbids the direction: it, and a leg out of reach, costs
            more than all else together.
        least_spread: of lengths, below which they count as near to each other [m]; inf:
            lengths do not count.
    """
    longest = -Chain(-legs.length.choice, -legs.length.pair).least()[1]
    shortest = legs.length.least()[1]
    count = len(rings)
    scale = count / max(longest - shortest, count * least_spread)
    all_else = float(rings.max(axis=1).sum()) + count + _OBSTRUCTED * (count + 1)
    # Of the length only what is over the shortest counts.
    choice = rings + scale * legs.length.choice + _OBSTRUCTED * legs.obstruction.choice
    choice[0] -= scale * shortest
    return Chain(
        choice + (all_else + 1.0) * shut,
        scale * legs.length.pair
        + _OBSTRUCTED * legs.obstruction.pair
        + (all_else + 1.0) * legs.beyond.pair,
    )
