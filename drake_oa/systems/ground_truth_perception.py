"""Obstacles as the simulated world knows them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import FrameId, QueryObject, SceneGraphInspector
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import Context, LeafSystem, State

from drake_oa.collision_shapes import surface_points
from drake_oa.systems.perception_state import PerceptionState
from drake_oa.systems.ports import read_value, valid_period
from drake_oa.values import FloatArray, ObstacleClouds, TablePlane


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
    the instance in the constructor's list.

    Port `cloud`: PointCloud of all those points, in the world frame [m].

    The poses are read at initialization and then every `period`.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        inspector: SceneGraphInspector,
        obstacles: Sequence[ModelInstanceIndex],
        *,
        table: TablePlane | None = None,
        points_per_geometry: int = 300,
        period: float = 1.0 / 15.0,
    ) -> None:
        """Samples the obstacles' surfaces, and declares ports, state and events.

        Args:
            plant: finalized plant that holds the obstacles.
            inspector: of its scene graph.
            obstacles: one model instance an obstacle.
            table: the supporting plane handed on; None for no table.
            points_per_geometry: about how many points sample each geometry, >= 30.
            period: time between updates [s].

        Raises:
            ValueError: for an obstacle without collision geometry, of an unbounded
                shape, or a period that is not positive.
        """
        super().__init__()
        self._table = table
        self._samples = tuple(
            _body_fixed_samples(plant, inspector, instance, points_per_geometry)
            for instance in obstacles
        )
        period = valid_period(period)
        self._query_port = self.DeclareAbstractInputPort("query_object", Value(QueryObject()))
        self._state = PerceptionState.declare(self)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._update)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, period, self._update)

    def _update(self, context: Context, state: State) -> None:
        query = read_value(self, self._query_port, context, QueryObject)
        clouds = []
        for parts in self._samples:
            placed = []
            for frame, p_BQ in parts:
                X_WB = query.GetPoseInWorld(frame).GetAsMatrix4()
                placed.append(p_BQ @ X_WB[:3, :3].T + X_WB[:3, 3])
            clouds.append(np.concatenate(placed))
            clouds[-1].flags.writeable = False
        obstacles = ObstacleClouds(
            context.get_time(), tuple(clouds), np.arange(len(clouds)), self._table
        )
        self._state.write(state, obstacles, np.concatenate([np.zeros((0, 3)), *clouds]))


def _body_fixed_samples(
    plant: MultibodyPlant,
    inspector: SceneGraphInspector,
    instance: ModelInstanceIndex,
    count: int,
) -> tuple[tuple[FrameId, FloatArray], ...]:
    parts = []
    for index in plant.GetBodyIndices(instance):
        geometries = plant.GetCollisionGeometriesForBody(plant.get_body(index))
        if geometries:
            points = [surface_points(inspector, geometry, count) for geometry in geometries]
            frame = plant.GetBodyFrameIdOrThrow(index)
            parts.append((frame, np.concatenate(points)))
    if not parts:
        raise ValueError(
            f"obstacle '{plant.GetModelInstanceName(instance)}' has no collision geometry; "
            "ground truth needs at least one"
        )
    return tuple(parts)
