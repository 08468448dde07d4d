"""Solids as perception sees them: a distance field an obstacle, made anew where it has to be.

A field costs some milliseconds, and with a new one every motion is searched again. Perception
hands on other points in each frame, if only by its noise. So a field is kept, moved with its
obstacle, as long as the new cloud says nothing that the field does not:

- no point is farther from it than a voxel: a point may be at least half a voxel from where it
  was, which is three deviations of a camera's noise at 1 m;
- of the points that it was made from, all but a few have a new one beside them;
- what is hidden of it is still the same: the view has hardly turned, the table is where it was,
  and it is as deep as before.

What errs then errs to the safe side: a little that is gone may count as there.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, LeafSystem, State
from scipy.ndimage import map_coordinates
from scipy.spatial import KDTree

from drake_oa.common.messages import (
    BoolArray,
    FloatArray,
    Frozen,
    ObstacleClouds,
    TablePlane,
)
from drake_oa.common.ports import DECISION_OFFSET, AbstractInput, valid_period
from drake_oa.geometry.collision_scene import (
    CollisionGeometry,
    CollisionScene,
    cloud_geometry,
    table_geometry,
)
from drake_oa.geometry.distance_field import DEEPEST, DistanceField, field_of
from drake_oa.geometry.pinhole import FREE, View, classify_points
from drake_oa.perception.depth_perception import FreeSpace
from drake_oa.perception.tracking import select_output_table
from drake_oa.perception.visibility import ImageRange, with_occluded_extents

_logger = logging.getLogger("drake_oa")

_DEEPEST_MOVED = 0.15
"""Depth of obstacles that move or have moved [m]: no link has to pass close behind them."""
_GONE, _CHECKED = 0.05, 500
"""Share of the points of a field that may have no new one beside them, and number of points that
are checked."""
_TURNED = 0.1
"""A view that has turned by more shows another side [rad]."""
_SEEN_FREE = 0.01
"""Distance of the depth behind a point above which an image sees through it [m]."""
_MOST_ASKED = 400
"""Nodes within a field of which is asked whether they are seen to be free."""
_FARTHEST = 1e3
"""Points and speeds beyond this are none [m, m/s]."""

_NOT_FINITE = "obstacles_W holds what is not finite"
_UNKNOWN = np.zeros((0, 3))


@dataclass(frozen=True, eq=False)
class PerceivedField(Frozen):
    """Field of one obstacle, and its source.

    Attributes:
        geometry: where it is now, and how fast.
        grid: its distances.
        made_of: (N, 3) points [m].
        view_W: (n, 3) unit directions in which it was seen, of each camera.
        deepest: what is hidden was taken to be at most so deep [m].
        inside: (K, 3) some nodes within it through which no image saw, in O [m]; none with one
            camera.
    """

    geometry: CollisionGeometry
    grid: DistanceField
    made_of: FloatArray
    view_W: FloatArray
    deepest: float
    inside: FloatArray


@dataclass(frozen=True, eq=False)
class PerceivedSceneState(Frozen):
    """Known world at one observation.

    Attributes:
        scene: its solids.
        fields: those of the obstacles, as in `scene`, but for the table.
        table: as in `scene`, or None.
        moved: names of obstacles that move or have moved.
    """

    scene: CollisionScene = field(default_factory=CollisionScene)
    fields: tuple[PerceivedField, ...] = ()
    table: TablePlane | None = None
    moved: frozenset[int] = frozenset()


def looked_at(
    before: PerceivedSceneState,
    obstacles: ObstacleClouds,
    viewpoints_W: FloatArray = _UNKNOWN,
    views: Sequence[View] = (),
) -> PerceivedSceneState:
    """The solids of a new observation.

    Args:
        before: of the observation before.
        obstacles: what is seen now. What is not finite, or older than what was seen before, makes
            it count as none: the solids and their stamp are left as they were, and so what moved
            goes on, and all of it ages. Where it has no table, the one before stays.
        viewpoints_W: (n, 3) from where, of each camera [m]; (0, 3): nothing that is hidden is
            filled.
        views: images of several cameras: what any of them sees through is not filled.
    """
    numbers = [*obstacles.clouds_W, obstacles.v_WO, viewpoints_W]
    # NaN is not below anything.
    if not all(np.abs(part).max(initial=0.0) <= _FARTHEST for part in numbers):
        return replace(before, scene=replace(before.scene, note=_NOT_FINITE))
    if obstacles.stamp < before.scene.stamp or obstacles.stamp == -math.inf:
        return replace(before, scene=replace(before.scene, note=obstacles.note))
    table = select_output_table(before.table, obstacles.table) or before.table
    known = {seen.geometry.name: seen for seen in before.fields}
    since = max(0.0, obstacles.stamp - before.scene.stamp)
    moved, fields = set(), []
    rows = zip(obstacles.ids.tolist(), obstacles.clouds_W, obstacles.v_WO, strict=True)
    for name, cloud, v_WO in rows:
        if v_WO.any() or name in before.moved:
            moved.add(name)
        if not len(cloud):
            continue
        deepest, last = _DEEPEST_MOVED if name in moved else DEEPEST, known.get(name)
        kept = None
        if last is not None and table is before.table and last.deepest == deepest:
            kept = _kept(last, cloud, since * v_WO, viewpoints_W, views)
        made = kept or _made(name, cloud, viewpoints_W, deepest, table, views)
        geometry = replace(made.geometry, v_WO=np.array(v_WO), stamp=obstacles.stamp)
        fields.append(replace(made, geometry=geometry))
    geometries = [seen.geometry for seen in fields] + _of_table(table)
    scene = CollisionScene.of(obstacles.stamp, geometries, obstacles.note)
    return PerceivedSceneState(scene, tuple(fields), table, frozenset(moved))


def _of_table(table: TablePlane | None) -> list[CollisionGeometry]:
    return [] if table is None else [table_geometry(table)]


def _made(
    name: int,
    cloud: FloatArray,
    viewpoints_W: FloatArray,
    deepest: float,
    table: TablePlane | None,
    views: Sequence[View],
) -> PerceivedField:
    """A new field of a cloud."""
    away = cloud[:, :2].mean(axis=0) - viewpoints_W[:, :2]
    away /= np.maximum(np.linalg.norm(away, axis=1), 1e-9)[:, None]
    # Horizontal depth along each view.
    seen = np.ptp(cloud[:, :2] @ away.T, axis=0).max(initial=deepest)
    grid = field_of(
        cloud,
        viewpoints_W=viewpoints_W,
        deepest=min(seen, _DEEPEST_MOVED),
        table=table,
        seen_free=partial(seen_free, views) if views else None,
    )
    geometry = cloud_geometry(grid, name=name, label=f"obstacle {name}")
    nodes = np.flatnonzero((grid.values < 0.0) & (len(viewpoints_W) > 1))
    nodes = nodes[:: max(1, len(nodes) // _MOST_ASKED)]
    inside = grid.voxel * np.array(np.unravel_index(nodes, grid.values.shape), dtype=float).T
    # Noise leaves some of its surface before what an image shows.
    inside = inside[~seen_free(views, grid.p_WO + inside)]
    return PerceivedField(geometry, grid, cloud, _view(geometry, viewpoints_W), deepest, inside)


def seen_free(views: Sequence[View], p_WQ: FloatArray) -> BoolArray:
    """Checks which points (N, 3) [m] any of the images sees through."""
    free = np.zeros(len(p_WQ), dtype=bool)
    for view in views:
        free |= classify_points(p_WQ, view, _SEEN_FREE)[0] == FREE
    return free


def _view(geometry: CollisionGeometry, viewpoints_W: FloatArray) -> FloatArray:
    """(n, 3) unit directions to a solid from where it is seen."""
    view = geometry.X_WO[:3, 3] + geometry.center - viewpoints_W
    return np.asarray(view / np.maximum(np.linalg.norm(view, axis=1), 1e-9)[:, None])


def _kept(
    kept: PerceivedField,
    cloud: FloatArray,
    expected: FloatArray,
    viewpoints_W: FloatArray,
    views: Sequence[View],
) -> PerceivedField | None:
    """The field, moved to where its obstacle is now; None: it is no more that of it.

    Args:
        kept: of the observation before.
        cloud: (M, 3) points of the obstacle [m].
        expected: (3,) how far it should have moved [m].
        viewpoints_W: (n, 3) from where it is seen [m].
        views: images that may see through what was taken to be within it.
    """
    grid, X_WO = kept.grid, np.array(kept.geometry.X_WO)
    X_WO[:3, 3] += expected
    moved = replace(kept, geometry=replace(kept.geometry, X_WO=X_WO))
    view = _view(moved.geometry, viewpoints_W)
    if len(view) != len(kept.view_W) or np.abs(view - kept.view_W).max(initial=0.0) > _TURNED:
        return None
    if views and np.sum(seen_free(views, X_WO[:3, 3] + kept.inside)) > _GONE * len(kept.inside):
        return None
    nodes = (cloud - X_WO[:3, 3]).T / grid.voxel
    if map_coordinates(grid.values, nodes, order=1, cval=_FARTHEST).max() > grid.voxel:
        return None
    was = kept.made_of[:: max(1, len(kept.made_of) // _CHECKED)] + X_WO[:3, 3] - grid.p_WO
    beside, _ = KDTree(cloud).query(was, p=math.inf, distance_upper_bound=1.5 * grid.voxel)
    return moved if np.isinf(beside).sum() <= _GONE * len(was) else None


class PerceivedScene(LeafSystem):
    """Makes solids of the clouds that perception sees.

    .. pydrake_system::

      name: PerceivedScene
      input_ports:
      - obstacles_W
      - camera_pose (optional)
      output_ports:
      - collision_scene_W

    Of several `cameras` the pose of each has a port, named by them, and there is one more:
    `free_space_W` (optional), abstract `FreeSpace`, the images of the observation: where any of
    them sees through what another one leaves open, nothing is filled. Those of another time do not
    count.

    - obstacles_W: abstract `ObstacleClouds` of any source.
    - camera_pose (optional): RigidTransform X_WC of the camera that sees them; without it nothing
      is said of their hidden sides.
    - collision_scene_W: abstract `CollisionScene`: a field an obstacle, with its velocity, what it hides of
      itself from all cameras filled (`drake_oa.geometry.distance_field.field_of`), and what is
      below the table, where it is known; what the image cuts off goes on beyond it
      (`drake_oa.perception.visibility.with_occluded_extents`). While all rests and nothing new is seen
      its arrays are the same.

    The state is read every `period`, between an observation and the decision that goes by it. An
    observation that is not finite changes nothing, and the log says so, as it does once of each
    obstacle that is too large for fine voxels.
    """

    def __init__(
        self,
        *,
        period: float = 1.0 / 15.0,
        cameras: Mapping[str, ImageRange] | None = None,
        table: TablePlane | None = None,
    ) -> None:
        """Declares the ports.

        Args:
            period: time between observations [s].
            cameras: port of a camera's pose -> its image; what that cuts off goes on beyond it.
                None: a port camera_pose, and no image is known.
            table: the supporting plane until one is seen; None: none.

        Raises:
            ValueError: if it is not positive and finite.
        """
        super().__init__()
        period = valid_period(period)
        self._images = list((cameras or {}).values())
        self._obstacles = AbstractInput(self, "obstacles_W", ObstacleClouds)
        self._poses = [
            AbstractInput(self, name, RigidTransform) for name in cameras or ("camera_pose",)
        ]
        self._views = None
        if len(self._poses) > 1:
            self._views = AbstractInput(self, "free_space_W", FreeSpace)
        before = PerceivedSceneState(CollisionScene.of(-math.inf, _of_table(table)), table=table)
        self._seen = self.DeclareAbstractState(Value(before))
        self.DeclareAbstractOutputPort(
            "collision_scene_W",
            lambda: Value(CollisionScene()),
            self._calc,
            {
                self.abstract_state_ticket(self._seen),
                self._obstacles.ticket(),
                *(port.ticket() for port in self._poses),
                *([] if self._views is None else [self._views.ticket()]),
            },
        )
        self.DeclareInitializationUnrestrictedUpdateEvent(self._update)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.5 * DECISION_OFFSET, self._update)

    def _read(self, context: Context) -> PerceivedSceneState:
        seen: PerceivedSceneState = context.get_abstract_state(self._seen).get_value()
        return seen

    def _calc(self, context: Context, output: AbstractValue) -> None:
        seen = self._read(context)
        if seen.scene.stamp == -math.inf:
            # What is seen at initialization is in the state only after the first steps of others.
            seen = self._looked_at(context, seen)
        output.set_value(seen.scene)

    def _update(self, context: Context, state: State) -> None:
        before = self._read(context)
        after = self._looked_at(context, before)
        if after.scene.note == _NOT_FINITE != before.scene.note:
            message = "t=%.3f s: %s; the solids seen before are kept"
            _logger.warning(message, context.get_time(), _NOT_FINITE)
        state.get_mutable_abstract_state(self._seen).set_value(after)

    def _looked_at(self, context: Context, before: PerceivedSceneState) -> PerceivedSceneState:
        obstacles = self._obstacles.read(context)
        read = [port.find(context) for port in self._poses]
        poses = [pose.GetAsMatrix4() for pose in read if pose is not None]
        views: list[View] = []
        if self._views is not None:
            seen = self._views.read_or_empty(context)
            # Of another time they show what moves elsewhere.
            if seen.stamp == obstacles.stamp:
                views = [view for view in seen.views if view is not None]
        if len(poses) == len(self._images):
            free = partial(seen_free, views) if views else None
            cameras = list(zip(poses, self._images, strict=True))
            obstacles = with_occluded_extents(obstacles, cameras, free)
        viewpoints_W = np.array([X_WC[:3, 3] for X_WC in poses]).reshape(-1, 3)
        return looked_at(before, obstacles, viewpoints_W, views)
