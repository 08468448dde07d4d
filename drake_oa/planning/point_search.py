"""Motion search for a point among ellipsoids, used to evaluate methods on scenes without a robot.

The obstacles are ellipsoids dilated by the tool (`drake_oa.descriptor`). The tool is thus
represented by its tool point, and no inverse kinematics is required.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from drake_oa.common.latency import count
from drake_oa.common.messages import FloatArray
from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.planning.search import CLEARANCE_WEIGHT, INFEASIBLE_PENALTY, Search
from drake_oa.policy.rollout import Scene, ToolRollouts

_COLLISION_PENALTY = 50.0
"""Cost of a candidate motion that touches an ellipsoid and has a clearance shortfall, added to the
cost of the shortfall [-]."""


class PointSearch(Search):
    """Evolution strategy that searches for the motion of a point among ellipsoids.

    The required clearance from an ellipsoid is the smallest of three values: the requested
    clearance; the distance of the ellipsoid from the current position of the point; and the
    distance of the ellipsoid from the goal at the time of arrival.
    """

    def __init__(self, scene: Scene, **more: Any) -> None:
        """Stores the scene, and computes the required clearance from each ellipsoid.

        Args:
            scene: initial state, goal, ellipsoids, and requested clearances.
            more: further arguments of `Search`: movement primitive, parameters, warm start.
        """
        super().__init__(scene, **more)
        self.max_required = np.minimum(scene.clearance, self._distances(scene.p_WE))

    def _distances(self, p_WQ: FloatArray) -> FloatArray:
        """Computes the signed distances of points to the K ellipsoids at their initial positions.

        Args:
            p_WQ: (..., K, 3) a point for each ellipsoid, or (..., 1, 3) the same point for all, in
                the world frame [m].

        Returns:
            (..., K) distances, negative inside an ellipsoid [m].
        """
        ellipsoids = self.scene.ellipsoids
        return signed_distance(p_WQ, ellipsoids.p_WO, ellipsoids.R_WO, ellipsoids.semi_axes)

    def clearance_cost(
        self, params: FloatArray, tool: ToolRollouts, cost: FloatArray, max_cost: float
    ) -> FloatArray:
        """Computes the costs (n,) of clearance shortfall and contact along n candidate paths [-].

        Moving ellipsoids keep their velocity.

        Args:
            params: (n, 6) candidate parameters; not used.
            tool: simulated motions of the tool point.
            cost: (n,) other costs of the candidates; not used.
            max_cost: cost at or above which a candidate is of no use; not used.
        """
        scene, slack, step = self.scene, self.parameters.slack, self.dmp.duration * tool.ds
        v_WO = scene.ellipsoids.v_WO
        t = step * np.arange(tool.path.shape[1])[:, None, None]
        # Paths are NaN after their end, which fmin ignores.
        d = np.fmin.reduce(self._distances(tool.path[:, :, None] - t * v_WO), axis=1)
        at_goal = self._distances(scene.p_WG - step * tool.steps[:, None, None] * v_WO)
        count(steps=int(tool.steps.sum()) * len(scene.ellipsoids))
        margin = (d - np.minimum(self.max_required, at_goal)).min(axis=1, initial=np.inf)
        shortfall = np.maximum(-margin - slack, 0.0)
        is_contact = (shortfall > 0.0) & (d <= 0.0).any(axis=1)
        violation = CLEARANCE_WEIGHT * shortfall / scene.baseline + _COLLISION_PENALTY * is_contact
        return np.asarray(np.where(violation > 0.0, INFEASIBLE_PENALTY + violation, 0.0))
