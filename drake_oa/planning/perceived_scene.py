"""System that represents perceived obstacles as collision geometry: one distance field each.

A distance field is a grid of signed distances to the cloud of an obstacle. Its computation requires
some milliseconds, and a changed field triggers another motion search. The noise of the camera
changes the points of an obstacle in every frame. A field is therefore reused, and moved to the
expected position of its obstacle, as long as it explains the new cloud:

- Each new point is inside the surface of the moved field, or outside by at most one voxel (cell of
  the grid). A voxel is at least three standard deviations of a camera's noise at 1 m.
- All but 5 % of the points from which the field was computed have a new point within 1.5 voxels
  along each axis.
- The occluded part is unchanged: same view direction, same table, same maximum depth.
- With several cameras, at most 5 % of the field's inner nodes, which are more than one voxel below
  its surface, are observed as free.

The approximation is conservative: small parts that are no longer occupied may remain occupied.
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

from drake_oa.common.messages import BoolArray, FloatArray, Frozen, ObstacleClouds, TablePlane
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

_MAX_MOVING_DEPTH = 0.15
"""Maximum assumed depth of obstacles along the view, for filling their occluded side [m].

It applies to obstacles that move or have moved. For others, the maximum is the visible depth (the
horizontal extent of the observed points along the view), limited to the range from 0.08 m
(`DEEPEST`) to this value."""
_MAX_MISSING_FRACTION = 0.05
"""Maximum fraction of a distance field that may contradict a new observation if it is reused [-].

It limits two fractions separately: that of the field's points without a newly observed point
nearby, and that of the field's inner nodes that an image observes as free."""
_MAX_CHECKED_POINTS = 500
"""Approximate maximum number of a distance field's points that are compared with a new cloud."""
_MAX_VIEW_CHANGE = 0.1
"""Maximum change of a component of the unit vector from camera to obstacle for which the distance
field of the obstacle is reused."""
_DEPTH_MARGIN = 0.01
"""Distance by which a free point must lie in front of the surface that an image measures [m]."""
_MAX_INSIDE_NODES = 400
"""Number of a distance field's inner nodes above which only every k-th is compared with images, so
that fewer than twice this number are compared.

An inner node that an image observes as free contradicts the field."""
_MAX_MAGNITUDE = 1e3
"""Magnitude of a coordinate [m] or a velocity component [m/s] above which an observation is
ignored."""

_NOT_FINITE = "obstacles_W is not finite"
"""Note of the collision scene after an observation with NaN, infinite or too large values."""
_NO_VIEWPOINTS = np.zeros((0, 3))
"""(0, 3) empty array of camera positions, with which no occluded space is filled."""


@dataclass(frozen=True, eq=False)
class PerceivedField(Frozen):
    """Distance field of one obstacle, and the observation from which the field was computed.

    Attributes:
        geometry: collision geometry of the field, with its current pose and velocity.
        grid: signed distances to the obstacle's cloud at the nodes of a grid.
        points: (N, 3) observed points from which the field was computed, in the world frame [m].
        view_W: (n, 3) unit directions from each camera to the obstacle in the world frame.
        max_depth: maximum assumed depth of the obstacle along the view, for filling its occluded
            side [m]. If the observed points extend farther along the view, their extent, up to
            0.15 m (`_MAX_MOVING_DEPTH`), is used instead.
        inside: (K, 3) sample of the grid nodes inside the obstacle, used to detect space that has
            become free [m]. They are more than a voxel (cell of the grid) below the surface, and no
            image observed them as free when the field was computed. Positions are in the frame O of
            the grid (axes of the world, origin at the first node). (0, 3) with one camera.
    """

    geometry: CollisionGeometry
    grid: DistanceField
    points: FloatArray
    view_W: FloatArray
    max_depth: float
    inside: FloatArray


@dataclass(frozen=True, eq=False)
class PerceivedSceneState(Frozen):
    """Collision scene of one observation, with the data that the next update requires.

    Attributes:
        scene: collision geometries of the obstacles and of the table.
        fields: distance fields of the obstacles in `scene`.
        table: support plane of the obstacles in `scene`; None: no plane.
        moved_ids: track IDs of obstacles that move or have moved.
    """

    scene: CollisionScene = field(default_factory=CollisionScene)
    fields: tuple[PerceivedField, ...] = ()
    table: TablePlane | None = None
    moved_ids: frozenset[int] = frozenset()


def update_scene(
    previous: PerceivedSceneState,
    obstacles: ObstacleClouds,
    viewpoints_W: FloatArray = _NO_VIEWPOINTS,
    views: Sequence[View] = (),
) -> PerceivedSceneState:
    """Updates the collision scene of perceived obstacles with a new observation.

    An observation is ignored if a coordinate or velocity is NaN or above 1000 m or m/s
    (`_MAX_MAGNITUDE`), or if it is older than the previous one. Geometries and stamp then remain:
    the age of the scene increases, and moving geometries continue at constant velocity.

    Args:
        previous: state after the previous observation.
        obstacles: new observation; without a support plane, the previous plane remains.
        viewpoints_W: (n, 3) positions of the cameras in the world frame [m]; (0, 3): occluded space
            is not filled.
        views: depth images of several cameras; space that any image observes as free is not filled.

    Returns:
        State after the new observation.
    """
    inputs = [*obstacles.clouds_W, obstacles.v_WO, viewpoints_W]
    # A comparison with NaN is false, so that NaN is rejected too.
    if not all(np.abs(part).max(initial=0.0) <= _MAX_MAGNITUDE for part in inputs):
        return replace(previous, scene=replace(previous.scene, note=_NOT_FINITE))
    if obstacles.stamp < previous.scene.stamp or obstacles.stamp == -math.inf:
        return replace(previous, scene=replace(previous.scene, note=obstacles.note))
    table = select_output_table(previous.table, obstacles.table) or previous.table
    previous_fields = {field.geometry.name: field for field in previous.fields}
    elapsed = max(0.0, obstacles.stamp - previous.scene.stamp)
    moved_ids, fields = set(), []
    rows = zip(obstacles.ids.tolist(), obstacles.clouds_W, obstacles.v_WO, strict=True)
    for name, cloud, v_WO in rows:
        if v_WO.any() or name in previous.moved_ids:
            moved_ids.add(name)
        if not len(cloud):
            continue
        max_depth, previous_field = (
            _MAX_MOVING_DEPTH if name in moved_ids else DEEPEST,
            previous_fields.get(name),
        )
        reused_field = None
        if (
            previous_field is not None
            and table is previous.table
            and previous_field.max_depth == max_depth
        ):
            reused_field = _reuse_field(previous_field, cloud, elapsed * v_WO, viewpoints_W, views)
        current_field = reused_field or _create_field(
            name, cloud, viewpoints_W, max_depth, table, views
        )
        geometry = replace(current_field.geometry, v_WO=np.array(v_WO), stamp=obstacles.stamp)
        fields.append(replace(current_field, geometry=geometry))
    geometries = [field.geometry for field in fields] + _table_geometries(table)
    scene = CollisionScene.of(obstacles.stamp, geometries, obstacles.note)
    return PerceivedSceneState(scene, tuple(fields), table, frozenset(moved_ids))


def _table_geometries(table: TablePlane | None) -> list[CollisionGeometry]:
    """Returns a list with the half-space below a support plane; an empty list without a plane."""
    return [] if table is None else [table_geometry(table)]


def _create_field(
    name: int,
    cloud: FloatArray,
    viewpoints_W: FloatArray,
    max_depth: float,
    table: TablePlane | None,
    views: Sequence[View],
) -> PerceivedField:
    """Computes the distance field of an obstacle from its cloud, and fills the occluded side.

    Args:
        name: track ID of the obstacle.
        cloud: (N, 3) observed points in the world frame [m].
        viewpoints_W: (n, 3) positions of the cameras in the world frame [m].
        max_depth: maximum assumed depth of the obstacle along the view [m]. If the observed points
            extend farther along the view, their extent, up to 0.15 m (`_MAX_MOVING_DEPTH`), is used
            instead.
        table: support plane, below which nothing is filled; None: no plane.
        views: depth images of several cameras; space that any image observes as free is not filled.
    """
    direction = cloud[:, :2].mean(axis=0) - viewpoints_W[:, :2]
    direction /= np.maximum(np.linalg.norm(direction, axis=1), 1e-9)[:, None]
    # Horizontal depth along each view.
    visible_depth = np.ptp(cloud[:, :2] @ direction.T, axis=0).max(initial=max_depth)
    grid = field_of(
        cloud,
        viewpoints_W=viewpoints_W,
        deepest=min(visible_depth, _MAX_MOVING_DEPTH),
        table=table,
        seen_free=partial(seen_free, views) if views else None,
    )
    geometry = cloud_geometry(grid, name=name, label=f"obstacle {name}")
    # Noise, and errors of the velocity, move the surface by less than a voxel.
    nodes = np.flatnonzero((grid.values < -grid.voxel) & (len(viewpoints_W) > 1))
    nodes = nodes[:: max(1, len(nodes) // _MAX_INSIDE_NODES)]
    inside = grid.voxel * np.array(np.unravel_index(nodes, grid.values.shape), dtype=float).T
    # By noise, some nodes at the surface are in front of the measured depth: leave them out.
    inside = inside[~seen_free(views, grid.p_WO + inside)]
    return PerceivedField(
        geometry, grid, cloud, _view_directions(geometry, viewpoints_W), max_depth, inside
    )


def seen_free(views: Sequence[View], p_WQ: FloatArray) -> BoolArray:
    """Checks for each of N points whether any depth image observes the point as free.

    An image does so if the surfaces that it measures at and next to the point's pixel are more than
    1 cm (`_DEPTH_MARGIN`) behind the point (`drake_oa.geometry.pinhole.classify_points`).

    Args:
        views: depth images of all cameras.
        p_WQ: (N, 3) points in the world frame [m].

    Returns:
        (N,) True for a point observed as free.
    """
    free = np.zeros(len(p_WQ), dtype=bool)
    for view in views:
        free |= classify_points(p_WQ, view, _DEPTH_MARGIN)[0] == FREE
    return free


def _view_directions(geometry: CollisionGeometry, viewpoints_W: FloatArray) -> FloatArray:
    """Computes the unit directions (n, 3) from n cameras to the center of a collision geometry.

    The directions are in the world frame.

    Args:
        geometry: collision geometry of an obstacle.
        viewpoints_W: (n, 3) positions of the cameras in the world frame [m].
    """
    direction = geometry.X_WO[:3, 3] + geometry.center - viewpoints_W
    return np.asarray(direction / np.maximum(np.linalg.norm(direction, axis=1), 1e-9)[:, None])


def _reuse_field(
    previous: PerceivedField,
    cloud: FloatArray,
    expected: FloatArray,
    viewpoints_W: FloatArray,
    views: Sequence[View],
) -> PerceivedField | None:
    """Moves a distance field to its obstacle's expected position, if it explains the new cloud.

    The field explains the cloud if no component of a unit view direction has changed by more than
    0.1 (`_MAX_VIEW_CHANGE`); if no new point is outside the moved field by more than a voxel (cell
    of the grid); if at most 5 % of the field's points have no new point within 1.5 voxels; and if
    at most 5 % of the field's inner nodes are observed as free.

    Args:
        previous: distance field at the previous observation.
        cloud: (M, 3) newly observed points of the obstacle in the world frame [m].
        expected: (3,) expected displacement of the obstacle since the previous observation, in the
            world frame [m].
        viewpoints_W: (n, 3) positions of the cameras in the world frame [m].
        views: depth images of several cameras, which may observe the field's inner nodes as free.

    Returns:
        The moved field; None: the cloud requires a new field.
    """
    grid, X_WO = previous.grid, np.array(previous.geometry.X_WO)
    X_WO[:3, 3] += expected
    result = replace(previous, geometry=replace(previous.geometry, X_WO=X_WO))
    view = _view_directions(result.geometry, viewpoints_W)
    if (
        len(view) != len(previous.view_W)
        or np.abs(view - previous.view_W).max(initial=0.0) > _MAX_VIEW_CHANGE
    ):
        return None
    if views and np.sum(
        seen_free(views, X_WO[:3, 3] + previous.inside)
    ) > _MAX_MISSING_FRACTION * len(previous.inside):
        return None
    nodes = (cloud - X_WO[:3, 3]).T / grid.voxel
    if map_coordinates(grid.values, nodes, order=1, cval=_MAX_MAGNITUDE).max() > grid.voxel:
        return None
    expected_points = (
        previous.points[:: max(1, len(previous.points) // _MAX_CHECKED_POINTS)]
        + X_WO[:3, 3]
        - grid.p_WO
    )
    distances, _ = KDTree(cloud).query(
        expected_points, p=math.inf, distance_upper_bound=1.5 * grid.voxel
    )
    return (
        result
        if np.isinf(distances).sum() <= _MAX_MISSING_FRACTION * len(expected_points)
        else None
    )


class PerceivedScene(LeafSystem):
    """System that converts perceived obstacle clouds to collision geometry (distance fields).

    .. pydrake_system::

      name: PerceivedScene
      input_ports:
      - obstacles_W
      - camera_pose (optional)
      output_ports:
      - collision_scene_W

    With several cameras, the pose of each camera has its own input port, named by the argument
    `cameras`. A further input port, `free_space_W` (optional), abstract `FreeSpace`, then contains
    the depth images of the observation. Space that any of these images observes as free is not
    filled. Images with another stamp than the observation are ignored.

    - obstacles_W: abstract `ObstacleClouds`: point clouds, track IDs and velocities of the
      perceived obstacles, and the support plane if it was detected.
    - camera_pose (optional): RigidTransform X_WC of the camera. Not connected: the occluded part
      of obstacles is not filled.
    - collision_scene_W: abstract `CollisionScene`: one distance field per obstacle, with its
      velocity, and the half-space below the support plane, if the input or the constructor
      contains one.
      Space that an obstacle occludes from a camera is filled up to an assumed depth, unless an
      image observes it as free (`drake_oa.geometry.distance_field.field_of`). Obstacles truncated
      by the upper or lower border of an image, or by its minimum depth, are extended vertically by
      up to their visible height (`drake_oa.perception.visibility.with_occluded_extents`).

    The state is updated every `period`, after the observation of the same instant and before the
    decision that uses the output. An observation with NaN, infinite or too large values (above
    1000 m or m/s) is ignored, with a warning.
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
            cameras: `ImageRange` of each camera, the rows of its image [pixel] and its minimum
                depth [m], by the name of its pose port. Obstacles that are truncated at these
                limits are extended. None: one port camera_pose, and no obstacle is extended.
            table: support plane until one is observed; None: no plane.

        Raises:
            ValueError: if the period is not positive and finite.
        """
        super().__init__()
        period = valid_period(period)
        self._images = list((cameras or {}).values())
        self._obstacles = AbstractInput(self, "obstacles_W", ObstacleClouds)
        self._poses = [
            AbstractInput(self, name, RigidTransform) for name in cameras or ("camera_pose",)
        ]
        self._free_space = None
        if len(self._poses) > 1:
            self._free_space = AbstractInput(self, "free_space_W", FreeSpace)
        initial = PerceivedSceneState(
            CollisionScene.of(-math.inf, _table_geometries(table)), table=table
        )
        self._scene_state = self.DeclareAbstractState(Value(initial))
        self.DeclareAbstractOutputPort(
            "collision_scene_W",
            lambda: Value(CollisionScene()),
            self._calc,
            {
                self.abstract_state_ticket(self._scene_state),
                self._obstacles.ticket(),
                *(port.ticket() for port in self._poses),
                *([] if self._free_space is None else [self._free_space.ticket()]),
            },
        )
        self.DeclareInitializationUnrestrictedUpdateEvent(self._update)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.5 * DECISION_OFFSET, self._update)

    def _read(self, context: Context) -> PerceivedSceneState:
        scene_state: PerceivedSceneState = context.get_abstract_state(self._scene_state).get_value()
        return scene_state

    def _calc(self, context: Context, output: AbstractValue) -> None:
        scene_state = self._read(context)
        if scene_state.scene.stamp == -math.inf:
            # At initialization other systems read this output before the state is updated.
            scene_state = self._updated(context, scene_state)
        output.set_value(scene_state.scene)

    def _update(self, context: Context, state: State) -> None:
        previous = self._read(context)
        current = self._updated(context, previous)
        if current.scene.note == _NOT_FINITE != previous.scene.note:
            scene = "no" if previous.scene.stamp == -math.inf else "the previous"
            message = "t=%.3f s: %s; %s collision scene remains in use"
            _logger.warning(message, context.get_time(), _NOT_FINITE, scene)
        state.get_mutable_abstract_state(self._scene_state).set_value(current)

    def _updated(self, context: Context, previous: PerceivedSceneState) -> PerceivedSceneState:
        obstacles = self._obstacles.read(context)
        poses_or_none = [port.find(context) for port in self._poses]
        poses = [pose.GetAsMatrix4() for pose in poses_or_none if pose is not None]
        views: list[View] = []
        if self._free_space is not None:
            free_space = self._free_space.read_or_empty(context)
            # In images of another time, moving obstacles are at other positions.
            if free_space.stamp == obstacles.stamp:
                views = [view for view in free_space.views if view is not None]
        if len(poses) == len(self._images):
            is_free = partial(seen_free, views) if views else None
            cameras = list(zip(poses, self._images, strict=True))
            obstacles = with_occluded_extents(obstacles, cameras, is_free)
        viewpoints_W = np.array([X_WC[:3, 3] for X_WC in poses]).reshape(-1, 3)
        return update_scene(previous, obstacles, viewpoints_W, views)
