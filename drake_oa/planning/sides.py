"""On which sides of the baseline motions are proposed, and what that costs.

What leads the search ranks the sides; cost rings of one's own (`drake_oa.route.cost_rings`), as the
paper's route selection has them, count besides: a side's price is `ring_price` times the sum of its
rings, in baselines, and a ring of 1 forbids it. A path in the joints, which is looked for where no
side will do, passes on none and asks no ring; where every side is forbidden none is looked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from drake_oa.common.messages import EllipsoidSet, FloatArray, Route
from drake_oa.policy.coupling import ALPHA, NORMAL
from drake_oa.policy.rollout import Scene
from drake_oa.regulation.proposal_network import N_SIDES
from drake_oa.regulation.proposals import ANGLE, NO_PRICE, Proposer
from drake_oa.route.cost_rings import FORBIDDEN, Ring, ring_scene


@dataclass(frozen=True)
class Sides:
    """What proposes motions, and rings that count in the choice of a side.

    Attributes:
        proposer: what leads the search.
        rings: costs of sides, by name.
        ring_price: of a ring just below 1, in baselines.
    """

    proposer: Proposer
    rings: Mapping[str, Ring] = field(default_factory=dict)
    ring_price: float = 0.5

    def weighed(self, scene: Scene, seen: EllipsoidSet, duration: float, clearance: float) -> Route:
        """The sides of one scene with their costs: the proposer's, and the rings'.

        Args:
            scene: the motion, alone.
            seen: its obstacles; without any there are no sides.
            duration: T [s].
            clearance: asked [m].
        """
        if not len(seen):
            return Route()
        costs = self.proposer.weigh(scene, duration)
        p_WS, p_WG, R_WL = scene.p_WS, scene.p_WG, scene.R_WL
        around = ring_scene(
            p_WS,
            p_WG,
            R_WL,
            seen,
            None,
            asked_clearance=clearance,
            n_directions=max((cost.shape[1] for cost in costs.values()), default=N_SIDES),
        )
        # One motion passes all of them on one side.
        given = {name: ring(around).max(axis=0)[None] for name, ring in self.rings.items()}
        blocked = bool(given) and bool(_forbidden(list(given.values())).all())
        return Route(
            direction_W=around.directions_W,
            angles=around.angles,
            costs=costs | given,
            p_WS=p_WS,
            p_WG=p_WG,
            R_WL=R_WL,
            blocked=blocked,
            note=f"every side is forbidden by the rings {', '.join(given)}" if blocked else "",
        )

    def price(self, route: Route) -> FloatArray:
        """(K,) what sides cost by the rings that are given, in baselines; inf: forbidden."""
        given = [route.costs[name] for name in self.rings if name in route.costs]
        if not given:
            return NO_PRICE
        total = self.ring_price * np.sum(given, axis=0)[0]
        return np.where(_forbidden(given), np.inf, total)


def _forbidden(rings: list[FloatArray]) -> FloatArray:
    """(K,) whether one of the rings (1, K) forbids a side."""
    return np.max(rings, axis=0)[0] >= FORBIDDEN


def taken(route: Route, term: FloatArray, genes: FloatArray, seen: EllipsoidSet) -> Route:
    """With the side that a motion takes, at the obstacle that is nearest to its term's point."""
    if not len(seen) or not len(route.angles):
        return route
    row = np.linalg.norm(seen.p_WO - term[:3], axis=1).argmin()
    count = len(route.angles)
    side = int(np.rint(genes[ANGLE] * count / (2.0 * np.pi))) % count
    return replace(
        route,
        ids=seen.ids[[row]],
        index=np.array([side]),
        direction_W=route.direction_W[[side]],
        normal_W=term[None, NORMAL : NORMAL + 3],
        # The unmodulated motion takes none.
        remaining_clearance=np.array([float(term[ALPHA] > 0.0)]),
    )
