"""System that outputs the true collision geometry of simulated bodies as a collision scene."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import QueryObject, SceneGraphInspector
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context, LeafSystem, State

from drake_oa.common.messages import OUT_OF_WORLD
from drake_oa.common.ports import AbstractInput, valid_period
from drake_oa.geometry.collision_scene import ENVIRONMENT, CollisionScene, read_geometry

_AT_REST = 1e-3
"""Speed below which a simulated body counts as at rest [m/s].

Resting bodies jitter in simulated contact, and would otherwise be treated as moving obstacles."""


class GroundTruthScene(LeafSystem):
    """System that outputs the collision geometry of simulated bodies at their true poses.

    It replaces `PerceivedScene`, which uses perceived obstacles, in scenarios with
    `perception: !GroundTruth`.

    .. pydrake_system::

      name: GroundTruthScene
      input_ports:
      - query_object
      output_ports:
      - collision_scene_W

    - query_object: `QueryObject` of the scene graph with the bodies.
    - collision_scene_W: abstract `CollisionScene` in the world frame: collision geometries of the
      bodies. The velocity of a geometry is the mean velocity of its body's origin since the
      previous update; speeds below 1 mm/s are set to 0. Bodies with a world coordinate of magnitude
      above 25 m (`messages.OUT_OF_WORLD`) count as absent and are omitted.

    The scene is updated at initialization and then every `period`.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        inspector: SceneGraphInspector,
        bodies: Sequence[BodyIndex],
        *,
        names: Mapping[BodyIndex, int],
        period: float = 1.0 / 15.0,
    ) -> None:
        """Reads the collision geometry of the bodies and declares the ports.

        Args:
            plant: finalized plant with the bodies.
            inspector: inspector of the plant's scene graph.
            bodies: indices of the bodies; bodies without collision geometry have no effect.
            names: track ID of the obstacle to which a body belongs, by the index of the body. A
                body without an entry belongs to the environment (a table, for example).
            period: time between updates [s].

        Raises:
            ValueError: for an unsupported shape, named in the message, or a period that is not
                positive and finite.
        """
        super().__init__()
        self._bodies = []
        for index in bodies:
            body = plant.get_body(index)
            name = names.get(index, ENVIRONMENT)
            label = f"obstacle {name}" if name >= 0 else body.scoped_name().get_full()
            geometry_ids = plant.GetCollisionGeometriesForBody(body)
            geometries = [read_geometry(inspector, geometry_id) for geometry_id in geometry_ids]
            of_body = [replace(geometry, name=name, label=label) for geometry in geometries]
            self._bodies.append((plant.GetBodyFrameIdOrThrow(index), of_body))
        period = valid_period(period)
        self._query = AbstractInput(self, "query_object", QueryObject)
        self._origins = self.DeclareDiscreteState(3 * len(self._bodies))
        self._scene = self.DeclareAbstractState(Value(CollisionScene()))
        self.DeclareStateOutputPort("collision_scene_W", self._scene)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._update)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, period, self._update)

    def _update(self, context: Context, state: State) -> None:
        query = self._query.read(context)
        time = context.get_time()
        previous: CollisionScene = context.get_abstract_state(self._scene).get_value()
        previous_origins = context.get_discrete_state(self._origins).value().reshape(-1, 3)
        dt = time - previous.stamp
        origins, geometries = np.array(previous_origins), []
        for row, (frame, of_body) in enumerate(self._bodies):
            X_WB = query.GetPoseInWorld(frame).GetAsMatrix4()
            origins[row] = X_WB[:3, 3]
            if np.abs(origins[row]).max() > OUT_OF_WORLD:
                continue
            velocity = np.zeros(3)
            has_appeared = np.abs(previous_origins[row]).max() > OUT_OF_WORLD
            if 0.0 < dt < math.inf and not has_appeared:
                velocity = (origins[row] - previous_origins[row]) / dt
            if np.linalg.norm(velocity) < _AT_REST:
                velocity = np.zeros(3)
            geometries += [
                replace(geometry, X_WO=X_WB @ geometry.X_WO, v_WO=velocity, stamp=time)
                for geometry in of_body
            ]
        scene = CollisionScene.of(time, geometries)
        state.get_mutable_discrete_state(self._origins).SetFromVector(origins.ravel())
        state.get_mutable_abstract_state(self._scene).set_value(scene)
