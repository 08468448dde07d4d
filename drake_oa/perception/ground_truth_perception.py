"""Perception that outputs the exact obstacles of the simulated world, in place of cameras."""

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
"""Approximate number of points that are sampled on each collision geometry of an obstacle."""
_MIN_SPEED = 1e-3
"""Speed below which an obstacle counts as resting [m/s]; contact makes resting obstacles
vibrate."""


class GroundTruthPerception(LeafSystem):
    """System that outputs points on the surfaces of obstacles at their exact poses in SceneGraph.

    .. pydrake_system::

      name: GroundTruthPerception
      input_ports:
      - query_object
      output_ports:
      - obstacles_W
      - cloud

    Port `query_object`: QueryObject of the scene graph that contains the obstacles.

    Port `obstacles_W`: ObstacleClouds in the world frame [m]: points on the whole surface of each
    model instance, including occluded parts. The track ID is the index of the model instance in the
    constructor's list. Obstacles at a world coordinate of more than 25 m
    (`messages.OUT_OF_WORLD`) are omitted.

    Port `cloud`: PointCloud of all these points in the world frame [m].

    The poses are read at initialization and then every `period`. The velocity of an obstacle is the
    displacement of the centroid of its points since the previous reading, over the period. It is
    exactly zero below 1 mm/s, and at the first reading that contains the obstacle.
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
        """Samples the surfaces of the obstacles, and declares ports, state and events.

        Args:
            plant: finalized plant that contains the obstacles.
            inspector: inspector of the scene graph in which the plant is registered.
            obstacles: model instance of each obstacle.
            table: support plane in the output; None: no table.
            period: time between updates [s].

        Raises:
            ValueError: for an obstacle without collision geometry or with an unbounded shape, or
                for a period that is not positive.
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
        """Reads the poses of the obstacles from SceneGraph, and stores their clouds and velocities
        in the state.
        """
        query = self._query_port.read(context)
        time, before = context.get_time(), self._state.read(context).obstacles
        dt = time - before.stamp
        earlier = dict(zip(before.ids.tolist(), before.clouds_W, strict=True))
        clouds, ids, velocities = [], [], []
        for track_id, parts in enumerate(self._samples):
            points = []
            for frame, p_BQ in parts:
                X_WB = query.GetPoseInWorld(frame).GetAsMatrix4()
                points.append(p_BQ @ X_WB[:3, :3].T + X_WB[:3, 3])
            cloud = np.concatenate(points)
            if np.abs(cloud[0]).max() > OUT_OF_WORLD:
                continue
            shift = (cloud - earlier.get(track_id, cloud)).mean(axis=0)
            is_moving = dt > 0.0 and np.linalg.norm(shift) >= _MIN_SPEED * dt
            velocities.append(shift / dt if is_moving else np.zeros(3))
            cloud.flags.writeable = False
            clouds.append(cloud)
            ids.append(track_id)
        obstacles = ObstacleClouds(
            time,
            tuple(clouds),
            np.array(ids, dtype=np.int64),
            self._table,
            v_WO=np.reshape(velocities, (-1, 3)),
        )
        cloud_W = np.concatenate([np.zeros((0, 3)), *clouds])
        self._state.write(state, TrackerState(obstacles, cloud_W=cloud_W))


def _body_fixed_samples(
    plant: MultibodyPlant, inspector: SceneGraphInspector, instance: ModelInstanceIndex
) -> tuple[tuple[FrameId, FloatArray], ...]:
    """Samples points on the surfaces of the collision geometries of a model instance.

    Returns:
        For each body with collision geometry, its frame and the points (N, 3) in that frame [m].

    Raises:
        ValueError: if no body has collision geometry.
    """
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
            "ground-truth perception requires at least one"
        )
    return tuple(parts)
