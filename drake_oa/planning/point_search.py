"""Search for the motion of a point among ellipsoids: the synthetic suites, and training.

The obstacles are ellipsoids dilated by the tool (`drake_oa.descriptor`), so that the tool is the
point E, and no inverse kinematics is needed.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from drake_oa.common.latency import count
from drake_oa.common.messages import FloatArray
from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.planning.search import CLEARANCE_WEIGHT, INFEASIBLE_PENALTY, Search
from drake_oa.policy.rollout import Scene, ToolRollouts

_TOUCH = 50.0
"""Additional cost of contact."""


class PointSearch(Search):
    """Search for the motion of a point among the ellipsoids of its scene.

    A motion is feasible if it keeps from each obstacle the requested clearance, or its distance at
    the beginning, or the goal's distance at the end if that is less.
    """

    def __init__(self, scene: Scene, **more: Any) -> None:
        """Stores the problem; arguments as of `Search`."""
        super().__init__(scene, **more)
        self.limit = np.minimum(scene.clearance, self._distances(scene.p_WE))

    def _distances(self, p_WQ: FloatArray) -> FloatArray:
        """Returns distances (..., K) of points (..., 1, 3) or (..., K, 3) to the ellipsoids [m]."""
        seen = self.scene.ellipsoids
        return signed_distance(p_WQ, seen.p_WO, seen.R_WO, seen.semi_axes)

    def world_cost(
        self, params: FloatArray, tool: ToolRollouts, cost: FloatArray, worst: float
    ) -> FloatArray:
        """Returns the costs of the point's clearance; see `Search`."""
        scene, slack, step = self.scene, self.parameters.slack, self.dmp.duration * tool.ds
        v_WO = scene.ellipsoids.v_WO
        t = step * np.arange(tool.path.shape[1])[:, None, None]
        # The paths are NaN after their end.
        d = np.fmin.reduce(self._distances(tool.path[:, :, None] - t * v_WO), axis=1)
        at_goal = self._distances(scene.p_WG - step * tool.steps[:, None, None] * v_WO)
        count(steps=int(tool.steps.sum()) * len(scene.ellipsoids))
        margin = (d - np.minimum(self.limit, at_goal)).min(axis=1, initial=np.inf)
        short = np.maximum(-margin - slack, 0.0)
        touches = (short > 0.0) & (d <= 0.0).any(axis=1)
        bad = CLEARANCE_WEIGHT * short / scene.baseline + _TOUCH * touches
        return np.asarray(np.where(bad > 0.0, INFEASIBLE_PENALTY + bad, 0.0))
