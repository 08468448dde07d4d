"""Obstacles as the simulated world knows them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydrake.geometry import FrameId, QueryObject, SceneGraphInspector
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import Context, LeafSystem, State

from drake_oa.common.messages import OUT_OF_WORLD, FloatArray, ObstacleClouds, TablePlane
from drake_oa.common.ports import AbstractInput, valid_period
from drake_oa.geometry.collision_scene import read_geometry, surface_points
from drake_oa.perception.depth_perception import PerceptionState
from drake_oa.perception.tracking import TrackerState

_SAMPLES = 300
"""Approximate number of points of each geometry."""
_AT_REST = 1e-3
"""A slower obstacle is taken to rest [m/s]: contact lets a standing one tremble."""


class GroundTruthPerception(LeafSystem):
    """Knows the obstacles' collision geometry and asks SceneGraph where it is.

    .. pydrake_system::

      name: GroundTruthPerception
      input_ports:
      - query_object
      output_ports:
      - obstacles_W
      - cloud

    Port `query_object`: QueryObject of the scene graph that holds the obstacles.

    Port `obstacles_W`: ObstacleClouds in the world frame [m]: points all over the
    surface of each model instance, hidden sides included; its id is the place of
    the instance in the constructor's list. What is farther from the world's origin than
    `messages.OUT_OF_WORLD` is absent, and left out.

    Port `cloud`: PointCloud of all those points, in the world frame [m].

    The poses are read at initialization and then every `period`. The velocity of an
    obstacle is how far the centroid of its points went since the last reading, and exactly
    zero below 1 mm/s and at the first reading in which it is there.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        inspector: SceneGraphInspector,
        obstacles: Sequence[ModelInstanceIndex],
        *,
        table: TablePlane | None = None,
        period: float = 1.0 / 15.0,
    ) -> None:
        """Samples the obstacles' surfaces, and declares ports, state and events.

        Args:
            plant: finalized plant that holds the obstacles.
            inspector: of its scene graph.
            obstacles: one model instance an obstacle.
            table: the supporting plane handed on; None for no table.
            period: time between updates [s].

        Raises:
            ValueError: for an obstacle without collision geometry, of an unbounded
                shape, or a period that is not positive.
        """
        super().__init__()
        self._table = table
        self._samples = tuple(
            _body_fixed_samples(plant, inspector, instance) for instance in obstacles
        )
        period = valid_period(period)
        self._query_port = AbstractInput(self, "query_object", QueryObject)
        self._state = PerceptionState(self)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._update)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, period, self._update)

    def _update(self, context: Context, state: State) -> None:
        query = self._query_port.read(context)
        time, before = context.get_time(), self._state.read(context).obstacles
        dt = time - before.stamp
        earlier = dict(zip(before.ids.tolist(), before.clouds_W, strict=True))
        clouds, ids, velocities = [], [], []
        for name, parts in enumerate(self._samples):
            placed = []
            for frame, p_BQ in parts:
                X_WB = query.GetPoseInWorld(frame).GetAsMatrix4()
                placed.append(p_BQ @ X_WB[:3, :3].T + X_WB[:3, 3])
            cloud = np.concatenate(placed)
            if np.abs(cloud[0]).max() > OUT_OF_WORLD:
                continue
            moved = (cloud - earlier.get(name, cloud)).mean(axis=0)
            is_moving = dt > 0.0 and np.linalg.norm(moved) >= _AT_REST * dt
            velocities.append(moved / dt if is_moving else np.zeros(3))
            cloud.flags.writeable = False
            clouds.append(cloud)
            ids.append(name)
        obstacles = ObstacleClouds(
            time,
            tuple(clouds),
            np.array(ids, dtype=np.int64),
            self._table,
            v_WO=np.reshape(velocities, (-1, 3)),
        )
        points = np.concatenate([np.zeros((0, 3)), *clouds])
        self._state.write(state, TrackerState(obstacles, cloud_W=points))


def _body_fixed_samples(
    plant: MultibodyPlant,
    inspector: SceneGraphInspector,
    instance: ModelInstanceIndex,
) -> tuple[tuple[FrameId, FloatArray], ...]:
    parts = []
    for index in plant.GetBodyIndices(instance):
        geometry_ids = plant.GetCollisionGeometriesForBody(plant.get_body(index))
        if geometry_ids:
            geometries = [read_geometry(inspector, geometry_id) for geometry_id in geometry_ids]
            points = [
                geometry.placed(surface_points(geometry, _SAMPLES)) for geometry in geometries
            ]
            frame = plant.GetBodyFrameIdOrThrow(index)
            parts.append((frame, np.concatenate(points)))
    if not parts:
        raise ValueError(
            f"obstacle '{plant.GetModelInstanceName(instance)}' has no collision geometry; "
            "ground truth needs at least one"
        )
    return tuple(parts)
