"""Search for the motion of a point among ellipsoids: the synthetic suites, and training.

The obstacles are ellipsoids dilated by the tool (`drake_oa.descriptor`), so that the tool is the
point E, and no inverse kinematics is needed.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pydrake.geometry as drake

from drake_oa.common.messages import EllipsoidSet, FloatArray
from drake_oa.common.thinking import count
from drake_oa.geometry.solids import Solids, least_distances, solid_of, solids_of
from drake_oa.planning.search import BAD, PRICE, Search
from drake_oa.policy.rollout import Scene, ToolRollouts

_TOUCH = 50.0
"""Additional cost of contact."""


def ellipsoid_solids(ellipsoids: EllipsoidSet) -> Solids:
    """Returns ellipsoids as solids, at time 0 where they are now."""
    rows = []
    for row in range(len(ellipsoids)):
        X_WO = np.eye(4)
        X_WO[:3, :3], X_WO[:3, 3] = ellipsoids.R_WO[row], ellipsoids.p_WO[row]
        solid = solid_of(drake.Ellipsoid(*ellipsoids.semi_axes[row]))
        rows.append(replace(solid, X_WO=X_WO, v_WO=ellipsoids.v_WO[row]))
    return solids_of(rows)


def path_distances(
    solids: Solids, path: FloatArray, seconds: FloatArray, most: float = np.inf
) -> FloatArray:
    """Returns the least distances (N, K) of paths to solids that move [m].

    Args:
        solids: K solids.
        path: (N, T, 3) points at equal intervals from time 0 on [m]; NaN after the end.
        seconds: (N,) the intervals [s].
        most: distance above which none is computed [m].
    """
    t = np.arange(path.shape[1]) * seconds[:, None]
    least = np.empty((len(path), len(solids.ball)))
    for k, ball in enumerate(solids.ball):
        one = solids.chosen(np.arange(len(solids.ball)) == k)
        points = (path - t[..., None] * ball[4:7]).reshape(-1, 3)
        d = least_distances(one, points, 0.0, most, -np.inf)
        least[:, k] = d.reshape(t.shape).min(axis=1)
    return least


class PointSearch(Search):
    """Search for the motion of a point among the ellipsoids of its scene.

    A motion is feasible if it keeps from each obstacle the requested clearance, or its distance at
    the beginning, or the goal's distance at the end if that is less.
    """

    def __init__(self, scene: Scene, **more: Any) -> None:
        """Stores the problem; arguments as of `Search`."""
        super().__init__(scene, **more)
        self.solids = ellipsoid_solids(scene.ellipsoids)
        start = path_distances(self.solids, scene.p_WE[None, None], np.zeros(1))
        self.limit = np.minimum(scene.clearance, start[0])

    def margins(self, genes: FloatArray, tool: ToolRollouts) -> tuple[FloatArray, FloatArray]:
        """Returns the least excess over the feasible clearance, and the clearance, (n,) each [m].

        Args:
            genes: (n, 7) candidates.
            tool: their paths.
        """
        step = self.seconds(genes) * tool.ds
        # Beyond the requested clearance no distance matters.
        most = float(self.scene.clearance.max(initial=0.0)) + self.parameters.slack
        least = path_distances(self.solids, tool.path, step, most)
        goal = np.full((len(genes), 2, 3), np.inf)
        goal[:, 1] = self.scene.p_WG
        at_goal = path_distances(self.solids, goal, step * tool.steps)
        count(steps=int(tool.steps.sum()) * len(self.scene.ellipsoids))
        margin = least - np.minimum(self.limit, at_goal)
        return margin.min(axis=1, initial=np.inf), least.min(axis=1, initial=np.inf)

    def world_cost(
        self, genes: FloatArray, tool: ToolRollouts, cost: FloatArray, worst: float
    ) -> FloatArray:
        """Returns the costs of the point's clearance; see `Search`."""
        margin, least = self.margins(genes, tool)
        short = np.maximum(-margin - self.parameters.slack, 0.0)
        bad = PRICE * short / self.scene.baseline + _TOUCH * ((short > 0.0) & (least <= 0.0))
        return np.asarray(np.where(bad > 0.0, BAD + bad, 0.0))
