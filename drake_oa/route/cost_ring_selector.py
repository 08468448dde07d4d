"""System of the route layer: selects the passing side of each obstacle by cost rings."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from functools import partial

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, LeafSystem, State

from drake_oa.common.messages import (
    PART_ID_STRIDE,
    EllipsoidSet,
    FloatArray,
    PolicyState,
    Route,
    TablePlane,
)
from drake_oa.common.ports import DECISION_OFFSET, AbstractInput, positive, valid_period
from drake_oa.policy.dmp import local_frame
from drake_oa.route.cost_rings import (
    FORBIDDEN,
    JointMargins,
    Ring,
    joint_limits_ring,
    length_ring,
    path_length,
    reach_ring,
    remaining_clearance,
    ring_scene,
    select_directions,
    table_ring,
)

_logger = logging.getLogger("drake_oa")


class CostRingSelector(LeafSystem):
    """Selector of the side on which each obstacle is passed, by costs of directions (cost rings).

    A side is a direction orthogonal to the baseline, the line from start to goal.

    .. pydrake_system::

      name: CostRingSelector
      input_ports:
      - ellipsoids_W
      - policy_state
      - goal
      - table (optional)
      output_ports:
      - route
      - decision

    - ellipsoids_W: abstract `EllipsoidSet`, the obstacles dilated by the tool in the world frame.
    - policy_state: abstract `PolicyState` of the movement primitive.
    - goal: (3,) goal of the motion in the world frame [m].
    - table (optional): abstract `TablePlane`, the support plane. Not connected: the support plane
      that `ellipsoids_W` contains.
    - route: abstract `Route`: for each obstacle the selected direction omega_d, the normal of the
      plane in which the obstacle is passed, and the clearance at which heading guidance leads the
      motion past it; the cost rings; and the costs of the sides by user-supplied rings. Empty
      before the first motion. The output changes with decisions, not with each step of the movement
      primitive; `DmpIntegrator` computes the guidance headings.
    - decision: abstract `Route`, equal to `route`. A diagram can connect one of these ports to the
      policy and the other to a viewer, under different signal names.

    The sides of all obstacles are selected together (`drake_oa.route.cost_rings`). If all
    directions of an obstacle are forbidden, `Route.blocked` is set, and `Route.note` names the
    obstacle. The movement primitive then holds the motion until a direction is allowed.

    `Route.side_cost` contains, for each side, the cost of passing all obstacles on this side. For
    each user-supplied ring, the largest cost of the side among the obstacles counts. The side cost
    is `ring_weight` times the sum of these largest costs, and infinite if one of them is 1.

    The sides are selected at initialization, once per `period`, and at once if the set of obstacles
    changes; hysteresis prevents frequent changes. The periodic update has a small offset, so that
    an observation at the same time is considered. The last decision is abstract state.
    """

    def __init__(
        self,
        requested_clearance: float,
        *,
        period: float = 1.0 / 15.0,
        table_height: float = 0.05,
        joint_margins: JointMargins | None = None,
        extra_rings: Mapping[str, Ring] | None = None,
        ring_weight: float = 0.5,
    ) -> None:
        """Declares the ports.

        Args:
            requested_clearance: requested clearance Delta between tool and obstacles [m].
            period: time between decisions [s].
            table_height: minimum height of the tool point above the table [m].
            joint_margins: function (`JointMargins`) that computes the minimum distance of the
                joints from their limits [rad] along paths of the tool point; None: the rings
                "workspace" (reach of the arm) and "joint_limits" are omitted.
            extra_rings: user-supplied cost rings by name, functions that map a `RingScene` of M
                obstacles and K directions to costs (M, K) in [0, 1]; 1 forbids a direction.
            ring_weight: cost of a side that a user-supplied ring rates just below 1, as additional
                path length over the distance from start to goal [-].

        Raises:
            ValueError: if requested clearance or period are not finite and positive.
        """
        super().__init__()
        period = valid_period(period)
        self._requested_clearance = positive(requested_clearance, "requested_clearance [m]")
        self._rings: dict[str, Ring] = {
            "table": partial(table_ring, height=table_height),
            "length": length_ring,
        }
        self._joint_margins = joint_margins
        if joint_margins is not None:
            self._rings |= {"workspace": reach_ring, "joint_limits": joint_limits_ring}
        self._extra, self._ring_weight = dict(extra_rings or {}), ring_weight
        self._rings |= self._extra

        self._ellipsoids = AbstractInput(self, "ellipsoids_W", EllipsoidSet)
        self._policy = AbstractInput(self, "policy_state", PolicyState)
        self._goal = self.DeclareVectorInputPort("goal", 3)
        self._table = AbstractInput(self, "table", TablePlane)
        self._decided = self.DeclareAbstractState(Value(Route()))
        for name in ("route", "decision"):
            self.DeclareAbstractOutputPort(
                name,
                lambda: Value(Route()),
                lambda context, output: output.set_value(self._current(context)),
                # Not the goal port: Drake marks a constant source as changed at each time step.
                prerequisites_of_calc={
                    self._ellipsoids.ticket(),
                    self._table.ticket(),
                    self.abstract_state_ticket(self._decided),
                },
            )
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, DECISION_OFFSET, self._decide)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._decide)

    def _weigh(self, context: Context, p_WS: FloatArray, p_WG: FloatArray) -> Route:
        """Selects the passing sides of all obstacles for a motion, by the cost rings.

        Args:
            context: context of the system, from which obstacles and table are read.
            p_WS: (3,) start of the motion in the world frame [m].
            p_WG: (3,) goal of the motion in the world frame [m].

        Returns:
            Route with the selected sides.
        """
        ellipsoids = self._ellipsoids.read(context)
        R_WL = local_frame(p_WS, p_WG)
        table = self._table.find(context) or ellipsoids.table
        scene = ring_scene(
            p_WS,
            p_WG,
            R_WL,
            ellipsoids,
            table,
            requested_clearance=self._requested_clearance,
            joint_margins=self._joint_margins,
        )
        last_route: Route = context.get_abstract_state(self._decided).get_value()
        sides = dict(zip(last_route.ids.tolist(), last_route.index.tolist(), strict=True))
        previous = np.array([sides.get(i, -1) for i in ellipsoids.ids.tolist()], dtype=np.int64)
        index, costs, blocked = select_directions(scene, self._rings, previous=previous)
        names = ", ".join(map(str, np.unique(ellipsoids.ids[blocked] % PART_ID_STRIDE)))
        direction_W = scene.directions_W[index]
        return Route(
            direction_W=direction_W,
            # A positive rotation about the normal turns the baseline toward the side.
            normal_W=np.cross(R_WL[:, 0], direction_W),
            remaining_clearance=remaining_clearance(scene),
            index=index,
            angles=scene.angles,
            costs=costs,
            path_length=path_length(scene, index),
            p_WS=p_WS,
            p_WG=p_WG,
            R_WL=R_WL,
            ids=ellipsoids.ids,
            blocked=bool(blocked.any()),
            note=f"every side of obstacle {names} is forbidden" if names else "",
            side_cost=self._side_cost(costs),
        )

    def _decide(self, context: Context, state: State) -> None:
        before: Route = context.get_abstract_state(self._decided).get_value()
        policy, goal = self._policy.read(context), self._goal.Eval(context)
        if not math.isfinite(goal.sum()):
            return
        route = self._weigh(context, policy.p_WS, goal)
        if route.blocked and route.note != before.note:
            _logger.info("t=%.3f s: %s", context.get_time(), route.note)
        state.get_mutable_abstract_state(self._decided).set_value(route)

    def _current(self, context: Context) -> Route:
        """Returns the route of the last decision, or a new one if the set of obstacles has changed.

        A route contains the selected side of each obstacle. Before the first decision, the route is
        computed for the current start and goal, or is empty if start and goal coincide.
        """
        ellipsoids = self._ellipsoids.read(context)
        decided: Route = context.get_abstract_state(self._decided).get_value()
        if decided.baseline == 0.0:
            policy = self._policy.read(context)
            goal = self._goal.Eval(context)
            ready = 0.0 < math.dist(policy.p_WS, goal) < math.inf
            return self._weigh(context, policy.p_WS, goal) if ready else decided
        if np.array_equal(decided.ids, ellipsoids.ids):
            return decided
        return self._weigh(context, decided.p_WS, decided.p_WG)

    def _side_cost(self, costs: Mapping[str, FloatArray]) -> FloatArray:
        """Computes the cost of passing all obstacles on the same side, by user-supplied cost rings.

        Args:
            costs: costs (M, K) of M obstacles and K sides by the name of the ring.

        Returns:
            (K,) costs as additional path length over the distance from start to goal, inf for a
            forbidden side; (1,) zeros without user-supplied rings or obstacles.
        """
        costs = {name: cost for name, cost in costs.items() if name in self._extra and len(cost)}
        if not costs:
            return np.zeros(1)
        rings = np.array([cost.max(axis=0) for cost in costs.values()])
        forbidden = (rings >= FORBIDDEN).any(axis=0)
        return np.where(forbidden, np.inf, self._ring_weight * rings.sum(axis=0))
