"""The choice of the sides on which obstacles are passed, by their cost rings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from drake_oa.common.messages import BoolArray, FloatArray, IntArray
from drake_oa.route.cost_rings import FORBIDDEN, JOINT_LIMITS, LEAST_SPREAD, Margin, Ring, RingScene
from drake_oa.route.side_sequence import (
    Chain,
    along_baseline,
    legs_between,
    overlap_groups,
    sequence_costs,
)

Followed = Callable[[FloatArray], int]
"""(P, 3) corners of a way [m] -> the first that the arm does not get to, P where it gets to all."""


@dataclass(frozen=True, eq=False)
class Selection:
    """The chosen side of each obstacle.

    Attributes:
        index: (M,) chosen column of the rings.
        groups: (M,) numbers of the groups, see `overlap_groups`.
        costs: name -> (M, K) each ring.
        blocked: (M,) whether every direction is forbidden by some ring, or every way on to
            the next obstacle.
    """

    index: IntArray
    groups: IntArray
    costs: dict[str, FloatArray]
    blocked: BoolArray


def select_directions(
    scene: RingScene,
    rings: Mapping[str, Ring],
    *,
    previous: IntArray | None = None,
    hysteresis: float = 0.2,
    margins: Mapping[str, Margin] | None = None,
    followed: Followed | None = None,
    together: bool = True,
) -> Selection:
    """Chooses omega_d: the direction of least total cost for each obstacle.

    Obstacles with no way between them (`overlap_groups`) are passed on one side:
    the mean of their costs decides, and what one of them forbids is forbidden to
    all. Equal costs are decided by the lowest angle, so the answer is definite. The sides
    of several groups are chosen together, see `drake_oa.route.side_sequence`. A way that the arm
    cannot follow costs the side at which it ends 1 on the ring of the joint limits, and the
    choice is made again.

    Args:
        scene: the scene.
        rings: the rings by name.
        previous: (M,) the columns chosen before, -1 where there was none. A group
            keeps its side while that is allowed and dearer than the best one by
            less than `hysteresis`.
        hysteresis: in units of cost.
        margins: name -> signed margin [m] of points (..., 3), negative where a leg from
            one obstacle to the next must not lead.
        followed: how far the arm follows a way; None: it is not asked.
        together: whether the sides of several groups are chosen together; each by itself
            otherwise.
    """
    count, width = scene.detour.shape
    costs = {name: np.asarray(ring(scene), dtype=float) for name, ring in rings.items()}
    for name, cost in costs.items():
        if cost.shape != (count, width):
            raise ValueError(
                f"ring '{name}' returned shape {cost.shape}; it must be ({count}, {width}), "
                "obstacles by directions"
            )
    groups = overlap_groups(scene.ellipsoids, scene.clearance)
    choose = partial(_choose, scene, groups, previous, hysteresis, margins, together)
    selection = choose(costs)
    if followed is None or not count:
        return selection
    order = along_baseline(scene.ellipsoids, groups, scene.p_WG - scene.p_WS)
    # Each time one side more is forbidden, until a group has none left.
    while not selection.blocked.any():
        rows = [np.flatnonzero(groups == group) for group in order]
        sides = [selection.index[members[0]] for members in rows]
        peaks = [
            scene.p_WP[members[scene.detour[members, side].argmax()], side]
            for members, side in zip(rows, sides, strict=True)
        ]
        way = np.array([scene.p_WS, *peaks, scene.p_WG])
        corner = followed(way)
        if corner >= len(way):
            break
        stuck = min(max(corner - 1, 0), len(rows) - 1)
        strained = costs.get(JOINT_LIMITS, np.zeros((count, width))).copy()
        strained[rows[stuck], sides[stuck]] = FORBIDDEN
        costs = costs | {JOINT_LIMITS: strained}
        selection = choose(costs)
    return selection


def _choose(
    scene: RingScene,
    groups: IntArray,
    previous: IntArray | None,
    hysteresis: float,
    margins: Mapping[str, Margin] | None,
    together: bool,
    costs: dict[str, FloatArray],
) -> Selection:
    count, width = scene.detour.shape
    blocked = np.zeros(count, dtype=bool)
    forbidden = np.zeros((count, width), dtype=bool)
    for name, cost in costs.items():
        if name != "length":
            forbidden |= cost >= FORBIDDEN
    numbers = np.unique(groups)
    rows_of = {int(group): np.flatnonzero(groups == group) for group in numbers}
    shut = {group: np.asarray(forbidden[rows].any(axis=0)) for group, rows in rows_of.items()}
    for group, rows in rows_of.items():
        blocked[rows] = bool(shut[group].all())
    kept = {group: _kept(previous, rows) for group, rows in rows_of.items()}
    if together and len(numbers) > 1:
        chosen = _sequence(scene, costs, groups, rows_of, shut, kept, hysteresis, margins)
        for a, b in chosen.beyond:
            blocked[rows_of[a]] = blocked[rows_of[b]] = True
        best = chosen.index
    else:
        total = sum(costs.values(), np.zeros((count, width)))
        best = {
            # A forbidden direction never beats an allowed one, whatever the sum of the others.
            group: _cheapest(
                total[rows].mean(axis=0) + np.where(shut[group], float(len(costs)), 0.0),
                kept[group],
                hysteresis,
            )
            for group, rows in rows_of.items()
        }
    index = np.zeros(count, dtype=np.int64)
    for group, rows in rows_of.items():
        index[rows] = best[group]
    return Selection(index, groups, costs, blocked)


def _kept(previous: IntArray | None, rows: IntArray) -> int:
    """The side that a group had, or -1."""
    if previous is None:
        return -1
    known = previous[rows][previous[rows] >= 0]
    return int(known[0]) if known.size else -1


def _cheapest(cost: FloatArray, kept: int, hysteresis: float) -> int:
    best = int(np.argmin(cost))
    return kept if kept >= 0 and cost[kept] < cost[best] + hysteresis else best


@dataclass(frozen=True, eq=False)
class _Chosen:
    """Column of each group, and the pairs of groups with no way from one to the next."""

    index: dict[int, int]
    beyond: list[tuple[int, int]]


def _sequence(
    scene: RingScene,
    costs: Mapping[str, FloatArray],
    groups: IntArray,
    rows_of: Mapping[int, IntArray],
    shut: Mapping[int, BoolArray],
    kept: Mapping[int, int],
    hysteresis: float,
    margins: Mapping[str, Margin] | None,
) -> _Chosen:
    """The sides of several groups, chosen together."""
    legs = legs_between(
        scene.p_WS,
        scene.p_WG,
        scene.p_WP,
        scene.detour,
        scene.ellipsoids,
        groups,
        scene.clearance,
        margins,
    )
    order = legs.order.tolist()
    rest = sum(
        (cost for name, cost in costs.items() if name != "length"), np.zeros(scene.detour.shape)
    )
    baseline = float(np.linalg.norm(scene.p_WG - scene.p_WS))
    chain = sequence_costs(
        legs,
        np.array([rest[rows_of[group]].mean(axis=0) for group in order]),
        np.array([shut[group] for group in order], dtype=float),
        LEAST_SPREAD * baseline if "length" in costs else np.inf,
    )
    dear = np.array(chain.choice)
    for i, group in enumerate(order):
        if kept[group] >= 0 and not shut[group][kept[group]]:
            # A side is left where that takes more than the hysteresis off the whole.
            dear[i, kept[group]] -= hysteresis
    index, _ = Chain(dear, chain.pair).least()
    pairs = [(order[i], order[i + 1]) for i in range(len(order) - 1)]
    beyond = [
        pair for i, pair in enumerate(pairs) if legs.beyond.pair[i, index[i], index[i + 1]] > 0.0
    ]
    return _Chosen(dict(zip(order, index.tolist(), strict=True)), beyond)
