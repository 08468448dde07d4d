"""What the layers think, drawn into Drake's Meshcat beside the robot."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import Capsule, Cylinder, Meshcat, MeshcatCone, Rgba, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import BodyIndex
from pydrake.perception import BaseField, Fields, PointCloud
from pydrake.systems.framework import Context, EventStatus, InputPort, LeafSystem, State
from pydrake.systems.sensors import CameraInfo

from drake_oa.common.messages import (
    EllipsoidSet,
    FloatArray,
    Frozen,
    PolicyState,
    Route,
    TablePlane,
)
from drake_oa.common.ports import read_value
from drake_oa.scenario.scenario import LAYERS
from drake_oa.viewing import drawing
from drake_oa.viewing.camera_inset import CameraInset
from drake_oa.viewing.drawing import Color, TriangleMesh

_ROOT = "/drake_oa"
_RING = {"inner_radius": 0.17, "band": 0.022, "gap": 0.005}
_SHORTEST_SEGMENT = 2e-3
_FRUSTUM_DEPTH = 1.1
"""How much of a camera's range is drawn [m]: a frustum of full depth hides more than it shows."""
_COST_CHANGE = 0.1
_AT_ORIGIN = RigidTransform()


_EYE_F, _LOOKED_AT_F = (2.45, -1.75, 1.30), (0.43, 0.0, 0.33)
"""Where the viewer's camera stands, and the point it looks at [m]."""


def _floor_frame(X_WB: RigidTransform, floor: float) -> RigidTransform:
    """The frame F below or above the base, of its heading."""
    (x, y, _), ahead = X_WB.translation(), X_WB.rotation().col(0)
    R_WF = RotationMatrix.MakeZRotation(math.atan2(ahead[1], ahead[0]))
    return RigidTransform(R_WF, [x, y, floor])


def camera_inset(meshcat: Meshcat, X_WB: RigidTransform, floor: float) -> CameraInset:
    """A picture of what cameras see, for the view of `dress_scene` with the same arguments."""
    X_WF = _floor_frame(X_WB, floor)
    return CameraInset(meshcat, X_WF @ np.array(_EYE_F), X_WF @ np.array(_LOOKED_AT_F))


def dress_scene(
    meshcat: Meshcat,
    X_WB: RigidTransform = _AT_ORIGIN,
    floor: float = 0.0,
    *,
    p_FC: tuple[float, float, float] = _EYE_F,
    p_FT: tuple[float, float, float] = _LOOKED_AT_F,
    fov: float = 32.0,
) -> None:
    """Makes the view fit to be shown: background, lights, shadows, camera.

    Hides grid, axes and what Drake's visualizer draws of collision geometry, inertia
    and contact forces (all still in the scene tree). Call it once, before or after
    the visualizers are added; whoever looks may change all of it in the browser.

    Args:
        meshcat: the viewer.
        X_WB: pose of the robot's base.
        floor: height of the frame F below or above it, which has its heading [m].
        p_FC: where the viewer's camera stands, in F [m].
        p_FT: the point it looks at, in F [m].
        fov: its vertical field of view [deg].
    """
    X_WF = _floor_frame(X_WB, floor)
    meshcat.SetProperty("/Background", "top_color", [0.80, 0.86, 0.92])
    meshcat.SetProperty("/Background", "bottom_color", [0.98, 0.98, 0.97])
    for path in ("/Grid", "/Axes", "/drake/proximity", "/drake/inertia", "/drake/contact_forces"):
        meshcat.SetProperty(path, "visible", False)
    meshcat.SetProperty("/Lights/SpotLight", "visible", True)
    spot = "/Lights/SpotLight/<object>"
    meshcat.SetProperty(spot, "position", [1.0, -1.2, 2.6])
    meshcat.SetTransform("/Lights/SpotLight", X_WF)
    meshcat.SetProperty(spot, "castShadow", True)
    meshcat.SetProperty(spot, "intensity", 13.0)
    meshcat.SetProperty("/Lights/AmbientLight/<object>", "intensity", 1.25)
    for name in ("PointLightNegativeX", "PointLightPositiveX", "FillLight"):
        meshcat.SetProperty(f"/Lights/{name}/<object>", "intensity", 0.6)
    meshcat.SetCamera(Meshcat.PerspectiveCamera(fov=fov, aspect=1.6, near=0.01, far=100.0))
    meshcat.SetCameraPose(X_WF @ np.array(p_FC), X_WF @ np.array(p_FT))


@dataclass(frozen=True)
class _RingOnShow:
    """One obstacle's rings as last drawn: in which frame, and in which before that."""

    name: int = -1
    costs: Mapping[str, FloatArray] = field(default_factory=dict)
    frame: int = -1
    before: int = -1


@dataclass(frozen=True, eq=False)
class _Shown(Frozen):
    """What is on show: the run-time data of the overlay, kept in the Context.

    Attributes:
        start: time of the first frame [s].
        frame: number of this frame.
        slots: obstacle in each place of the pool, -1 where there is none.
        p_from, p_to: (3,) newest segment of the executed path [m].
        grew: whether that segment belongs to this frame.
        rings: the rings in each place.
    """

    start: float = 0.0
    frame: int = 0
    slots: tuple[int, ...] = ()
    p_from: FloatArray = field(default_factory=lambda: np.zeros(3))
    p_to: FloatArray = field(default_factory=lambda: np.zeros(3))
    grew: bool = False
    rings: tuple[_RingOnShow, ...] = ()


class SeenRange(NamedTuple):
    """What a depth camera sees: by its intrinsics, and nearest and farthest depth [m]."""

    camera: CameraInfo
    near: float = 0.8
    far: float = 3.5


class MeshcatOverlay(LeafSystem):
    """Draws frustum, cloud, ellipsoids, sections, cost rings and paths into Meshcat.

    .. pydrake_system::

      name: MeshcatOverlay
      input_ports:
      - ellipsoids_W (optional)
      - policy_state
      - route (optional)
      - cloud (optional)
      - camera_pose (optional)
      - body_poses (optional)

    - ellipsoids_W (optional): abstract `EllipsoidSet`, the dilated obstacles in the
      world frame.
    - policy_state: abstract `PolicyState` of the movement primitive.
    - route (optional): abstract `Route`, the chosen sides and their cost rings.
    - cloud (optional): `pydrake.perception.PointCloud` in the world frame [m].
    - camera_pose (optional): `RigidTransform` X_WC, C being x right, y down, z forward; of
      several `cameras` a port each, named by them.
    - body_poses (optional): the plant's list of `RigidTransform`; without it the
      executed path is that of the policy's p_WE.

    Rose: the ellipsoids. Dark red on them: their sections by the P-plane. Blue: the
    planned path. Red: the executed one. Round the point of the baseline where an
    obstacle's side is decided: the cost rings from inside to outside in the order of
    `Route.costs`, green where a direction costs nothing, yellow at 0.5, red where it costs 1;
    the magenta arrow is the chosen one. Rings are shown of obstacles that bend the motion only.

    Everything is under "/drake_oa" in the scene tree, a folder for each of `LAYERS`, and is
    recorded when Meshcat records: a recording holds transforms and properties but no objects,
    so whatever changes its shape (cloud, rings, executed path) is one object a frame, shown
    from then on or in its interval only. The system writes to Meshcat and reads nothing from
    it; what it has drawn is abstract state.
    """

    def __init__(
        self,
        meshcat: Meshcat,
        *,
        period: float = 1.0 / 15.0,
        planned_W: FloatArray | None = None,
        cameras: Mapping[str, SeenRange] | None = None,
        body_index: BodyIndex | None = None,
        p_BE: FloatArray | tuple[float, float, float] = (0.0, 0.0, 0.0),
        max_obstacles: int = 8,
        cloud_period: float = 0.2,
        max_points: int = 1500,
        point_spacing: float = 0.015,
        record_clouds: bool = True,
        show: Sequence[str] = LAYERS,
    ) -> None:
        """Declares the ports; draws nothing yet.

        Args:
            meshcat: the viewer.
            period: time between frames [s].
            planned_W: (T, 3) points of the pre-planned path [m]; None: the straight
                line from start to goal.
            cameras: port -> what the camera sees whose pose it takes; its frustum is drawn if
                the port is connected. None: a port camera_pose, and no frustum.
            body_index: body B of the plant that carries E; None: policy_state.p_WE.
            p_BE: (3,) the tool point E in B [m].
            max_obstacles: how many obstacles are drawn at most.
            cloud_period: time between two clouds [s], rounded to frames.
            max_points: points of a cloud that are drawn at most.
            point_spacing: least distance of these, roughly [m].
            record_clouds: keep each cloud as an object of its own for a recording;
                False replaces the one there is, for viewers that run for hours.
            show: the `LAYERS` that are visible at first; whoever looks may change that.

        Raises:
            ValueError: if an argument is out of its range.
        """
        super().__init__()
        for name, value in (("period", period), ("cloud_period", cloud_period)):
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be positive [s], not {value}")
        if max_obstacles < 1:
            raise ValueError(f"max_obstacles must be at least 1, not {max_obstacles}")
        unknown = [layer for layer in show if layer not in LAYERS]
        if unknown:
            raise ValueError(f"show: {unknown[0]!r} is not one of {', '.join(LAYERS)}")
        self._show = tuple(show)
        self._meshcat = meshcat
        self._period = period
        self._planned_W = None if planned_W is None else np.array(planned_W, dtype=float)
        if self._planned_W is not None and (
            self._planned_W.ndim != 2 or self._planned_W.shape[1] != 3 or len(self._planned_W) < 2
        ):
            raise ValueError(f"planned_W must be (T, 3), T > 1, not {self._planned_W.shape}")
        self._edges_C = [
            drawing.frustum_edges(
                (seen.camera.focal_x(), seen.camera.focal_y()),
                (seen.camera.center_x(), seen.camera.center_y()),
                (seen.camera.width(), seen.camera.height()),
                (seen.near, min(seen.far, max(_FRUSTUM_DEPTH, 1.1 * seen.near))),
            )
            for seen in (cameras or {}).values()
        ]
        self._body_index = body_index
        self._p_BE = np.array(p_BE, dtype=float)
        self._max_obstacles = max_obstacles
        self._cloud_every = max(1, round(cloud_period / period))
        self._max_points = max_points
        self._point_spacing = point_spacing
        self._record_clouds = record_clouds
        self._declare(tuple(cameras or ("camera_pose",)))

    def _declare(self, poses: Sequence[str]) -> None:
        self._ellipsoids = self.DeclareAbstractInputPort("ellipsoids_W", Value(EllipsoidSet()))
        self._policy = self.DeclareAbstractInputPort("policy_state", Value(PolicyState()))
        self._route = self.DeclareAbstractInputPort("route", Value(Route()))
        self._cloud = self.DeclareAbstractInputPort("cloud", Value(PointCloud(0)))
        self._cameras = [
            self.DeclareAbstractInputPort(name, Value(RigidTransform())) for name in poses
        ]
        self._bodies = self.DeclareAbstractInputPort("body_poses", Value[list[RigidTransform]]())
        self._shown = self.DeclareAbstractState(Value(_Shown()))
        self.DeclareInitializationUnrestrictedUpdateEvent(self._begin)
        self.DeclareInitializationPublishEvent(self._draw_start)
        # The frame at the start is the initialization's.
        self.DeclarePeriodicUnrestrictedUpdateEvent(self._period, self._period, self._advance)
        self.DeclarePeriodicPublishEvent(self._period, self._period, self._draw)

    def _seeing(self, context: Context) -> Iterator[tuple[str, FloatArray, InputPort]]:
        """Path, frustum and port of each camera whose pose is connected."""
        for number, edges_C in enumerate(self._edges_C):
            port = self._cameras[number]
            if port.HasValue(context):
                yield _camera_path(number), edges_C, port

    # What is to be shown -----------------------------------------------------------

    def _read_ellipsoids(self, context: Context) -> EllipsoidSet:
        if not self._ellipsoids.HasValue(context):
            return EllipsoidSet()
        return read_value(self, self._ellipsoids, context, EllipsoidSet)

    def _read_route(self, context: Context) -> Route:
        if not self._route.HasValue(context):
            return Route()
        return read_value(self, self._route, context, Route)

    def _tool_point(self, context: Context) -> FloatArray:
        if self._body_index is None or not self._bodies.HasValue(context):
            return read_value(self, self._policy, context, PolicyState).p_WE
        X_WB: RigidTransform = self._bodies.Eval(context)[int(self._body_index)]
        return np.asarray(X_WB @ self._p_BE)

    def _begin(self, context: Context, state: State) -> EventStatus:
        p_WE = self._tool_point(context)
        shown = _Shown(
            start=context.get_time(),
            slots=(-1,) * self._max_obstacles,
            p_from=p_WE,
            p_to=p_WE,
            rings=(_RingOnShow(),) * self._max_obstacles,
        )
        self._set_shown(state, self._with_obstacles(context, shown))
        return EventStatus.Succeeded()

    def _advance(self, context: Context, state: State) -> EventStatus:
        self._set_shown(state, self._following(context))
        return EventStatus.Succeeded()

    def _following(self, context: Context) -> _Shown:
        """What is on show in this frame, from what was on show in the last one.

        Drake publishes at an instant before it updates at that instant: both the
        drawing and the update ask for this, and find the same.
        """
        before: _Shown = context.get_abstract_state(self._shown).get_value()
        p_WE = self._tool_point(context)
        grew = float(np.linalg.norm(p_WE - before.p_to)) > _SHORTEST_SEGMENT
        shown = replace(
            before,
            frame=before.frame + 1,
            grew=grew,
            p_from=before.p_to if grew else before.p_from,
            p_to=p_WE if grew else before.p_to,
        )
        return self._with_obstacles(context, shown)

    def _set_shown(self, state: State, shown: _Shown) -> None:
        state.get_mutable_abstract_state(self._shown).set_value(shown)

    def _with_obstacles(self, context: Context, shown: _Shown) -> _Shown:
        """Places the obstacles, and renews the rings whose costs have changed visibly."""
        ellipsoids = self._read_ellipsoids(context)
        route = self._read_route(context)
        slots = drawing.assign_slots(shown.slots, ellipsoids.ids)
        row_of = {name: row for row, name in enumerate(route.ids.tolist())}
        rings = []
        for name, ring in zip(slots, shown.rings, strict=True):
            row = row_of.get(name, -1)
            if row >= 0:
                costs = {key: np.array(values[row]) for key, values in route.costs.items()}
                if name != ring.name or not _look_alike(costs, ring.costs):
                    ring = _RingOnShow(name, costs, shown.frame, ring.frame)
            rings.append(ring)
        return replace(shown, slots=slots, rings=tuple(rings))

    # Drawing -----------------------------------------------------------------------

    def _mesh(self, path: str, mesh: TriangleMesh, color: Color, opacity: float = 1.0) -> None:
        """Sets a smoothly shaded mesh."""
        self._meshcat.SetTriangleMesh(path, mesh.vertices, mesh.faces, Rgba(*color, opacity))
        self._meshcat.SetProperty(f"{path}/<object>", "material.flatShading", False)
        self._meshcat.SetProperty(f"{path}/<object>", "castShadow", False)

    def _arrow(self, path: str, length: float, radius: float, color: Color) -> None:
        """Sets an arrow from the path's origin along its x axis [m]."""
        head = 7.0 * radius
        for name, shape, turn, x in (
            ("shaft", Cylinder(radius, length - head), 0.5 * np.pi, 0.5 * (length - head)),
            # Its apex is its origin, from where it opens along z.
            ("head", MeshcatCone(head, 2.4 * radius, 2.4 * radius), -0.5 * np.pi, length),
        ):
            X = RigidTransform(RotationMatrix.MakeYRotation(turn), [x, 0.0, 0.0])
            self._meshcat.SetObject(f"{path}/{name}", shape, Rgba(*color))
            self._meshcat.SetTransform(f"{path}/{name}", X)

    def _set(self, path: str, name: str, value: Any, time: float) -> None:
        self._meshcat.SetProperty(path, name, value, time)

    def _appear(self, path: str, shown: _Shown, time: float) -> None:
        """Shows a path from now on, in the recording not before."""
        if time > shown.start:
            self._set(path, "visible", False, shown.start)
        self._set(path, "visible", True, time)

    def _draw_start(self, context: Context) -> EventStatus:
        """The objects that only move, and the first frame."""
        meshcat = self._meshcat
        for layer in LAYERS:
            meshcat.Delete(f"{_ROOT}/{layer}")
            meshcat.SetProperty(f"{_ROOT}/{layer}", "visible", layer in self._show)
        circle = drawing.tube(drawing.unit_circle(), 0.014, closed=True)
        radius = drawing.ring_radius(3, **_RING)
        for slot in range(self._max_obstacles):
            path = f"{_ROOT}/descriptor/{slot}"
            body = f"{path}/ellipsoid/shape"
            self._mesh(body, drawing.unit_sphere(), drawing.ELLIPSOID, 0.32)
            # What is inside or behind it stays visible.
            meshcat.SetProperty(f"{body}/<object>", "material.depthWrite", False)
            self._mesh(f"{path}/section/shape", circle, drawing.SECTION)
            self._arrow(f"{_ROOT}/decision/{slot}/direction", radius + 0.08, 0.0055, drawing.CHOSEN)
        self._draw_planned(read_value(self, self._policy, context, PolicyState))
        for path, edges_C, _ in self._seeing(context):
            start, end = edges_C[:, 0].T, edges_C[:, 1].T
            meshcat.SetLineSegments(f"{path}/frustum", start, end, 1.0, Rgba(*drawing.FRUSTUM))
        meshcat.SetObject(f"{_ROOT}/motion/tool_point", Sphere(0.013), Rgba(*drawing.EXECUTED))
        self._draw_frame(context, context.get_abstract_state(self._shown).get_value())
        return EventStatus.Succeeded()

    def _draw_planned(self, policy: PolicyState) -> None:
        path = np.stack([policy.p_WS, policy.p_WG]) if self._planned_W is None else self._planned_W
        if float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()) > 0.0:
            self._mesh(f"{_ROOT}/motion/planned/path", drawing.tube(path, 0.005), drawing.PLANNED)
        for name, p_WQ in (("start", policy.p_WS), ("goal", policy.p_WG)):
            ball = f"{_ROOT}/motion/planned/{name}"
            self._meshcat.SetObject(ball, Sphere(0.014), Rgba(*drawing.PLANNED))
            self._meshcat.SetTransform(ball, RigidTransform(p_WQ))

    def _draw(self, context: Context) -> EventStatus:
        self._draw_frame(context, self._following(context))
        return EventStatus.Succeeded()

    def _draw_frame(self, context: Context, shown: _Shown) -> None:
        time = context.get_time()
        self._draw_obstacles(context, shown, time)
        self._draw_executed(self._tool_point(context), shown, time)
        for path, _, port in self._seeing(context):
            self._meshcat.SetTransform(path, port.Eval(context), time)
        if shown.frame % self._cloud_every == 0 and self._cloud.HasValue(context):
            table = self._read_ellipsoids(context).table
            self._draw_cloud(self._cloud.Eval(context), table, shown, time)

    def _draw_obstacles(self, context: Context, shown: _Shown, time: float) -> None:
        ellipsoids = self._read_ellipsoids(context)
        route = self._read_route(context)
        policy = read_value(self, self._policy, context, PolicyState)
        row_of = {name: row for row, name in enumerate(ellipsoids.ids.tolist())}
        # Rings of obstacles that need no coupling would only hide the others'.
        bends = (
            route.remaining_clearance > 0.0
            if len(route.remaining_clearance)
            else np.ones(len(route.ids), bool)
        )
        ring_row = {name: row for row, name in enumerate(route.ids.tolist()) if bends[row]}
        normals = np.tile(policy.R_WL[:, 1], (len(ellipsoids), 1))
        if len(route.normal_W) and np.array_equal(route.ids, ellipsoids.ids):
            normals = route.normal_W
        normals = drawing.plane_normals(policy.p_WE, policy.z_W, ellipsoids.p_WO, normals)
        sections = drawing.section_transform(
            ellipsoids.p_WO, ellipsoids.R_WO, ellipsoids.semi_axes, normals
        )
        p_WB = drawing.baseline_points(policy.p_WS, policy.p_WG, policy.R_WL, ellipsoids.p_WO)
        for slot, name in enumerate(shown.slots):
            path, decided = f"{_ROOT}/descriptor/{slot}", f"{_ROOT}/decision/{slot}"
            row = row_of.get(name, -1)
            self._set(path, "visible", row >= 0, time)
            self._set(decided, "visible", row >= 0, time)
            if row < 0:
                continue
            X_WO = _pose(ellipsoids.R_WO[row], ellipsoids.p_WO[row])
            self._place(f"{path}/ellipsoid", X_WO, ellipsoids.semi_axes[row], time)
            R, p, scale = drawing.split_transform(sections[row])
            self._place(f"{path}/section", _pose(R, p), scale, time)
            side = ring_row.get(name, -1)
            self._set(f"{decided}/direction", "visible", side >= 0, time)
            self._set(f"{decided}/rings", "visible", side >= 0, time)
            if side >= 0:
                R_WA = drawing.orthonormal_frame(route.direction_W[side])
                self._meshcat.SetTransform(f"{decided}/direction", _pose(R_WA, p_WB[row]), time)
                X_WL = _pose(policy.R_WL, p_WB[row])
                self._meshcat.SetTransform(f"{decided}/rings", X_WL, time)
                self._draw_ring(f"{decided}/rings", shown.rings[slot], route.angles, shown, time)

    def _place(self, path: str, X: RigidTransform, scale: FloatArray, time: float) -> None:
        """Poses a path and stretches its child `shape`: a recording keeps both."""
        self._meshcat.SetTransform(path, X, time)
        self._set(f"{path}/shape", "scale", scale.tolist(), time)

    def _draw_ring(
        self, path: str, ring: _RingOnShow, angles: FloatArray, shown: _Shown, time: float
    ) -> None:
        if ring.frame != shown.frame:
            return
        mesh = drawing.ring_mesh(ring.costs, angles, **_RING)
        if ring.before >= 0:
            self._set(f"{path}/{ring.before}", "visible", False, time)
        if mesh.vertices.size and mesh.colors is not None:
            name = f"{path}/{ring.frame}"
            # The legend reads the rings' names from the path.
            bands = f"{name}/{', '.join(ring.costs)}"
            self._meshcat.SetTriangleColorMesh(bands, mesh.vertices, mesh.faces, mesh.colors)
            self._meshcat.SetProperty(f"{bands}/<object>", "castShadow", False)
            self._appear(name, shown, time)

    def _draw_executed(self, p_WE: FloatArray, shown: _Shown, time: float) -> None:
        self._meshcat.SetTransform(f"{_ROOT}/motion/tool_point", RigidTransform(p_WE), time)
        if not shown.grew:
            return
        way = shown.p_to - shown.p_from
        path = f"{_ROOT}/motion/executed/{shown.frame}"
        R = RotationMatrix.MakeFromOneVector(way, 2)
        self._meshcat.SetObject(
            path, Capsule(0.0055, float(np.linalg.norm(way))), Rgba(*drawing.EXECUTED)
        )
        self._meshcat.SetTransform(path, RigidTransform(R, 0.5 * (shown.p_from + shown.p_to)))
        self._appear(path, shown, time)

    def _draw_cloud(
        self, cloud: PointCloud, table: TablePlane | None, shown: _Shown, time: float
    ) -> None:
        path = f"{_ROOT}/perception/cloud/{shown.frame if self._record_clouds else 'now'}"
        if self._record_clouds and shown.frame > 0:
            previous = f"{_ROOT}/perception/cloud/{shown.frame - self._cloud_every}"
            self._set(previous, "visible", False, time)
        thin = self._thinned(cloud, table)
        self._meshcat.SetObject(path, thin, 0.011, Rgba(*drawing.CLOUD))
        self._appear(path, shown, time)

    def _thinned(self, cloud: PointCloud, table: TablePlane | None) -> PointCloud:
        """Most of the points for what stands on the table, the rest for the table."""
        # An image holds far more points than are drawn: look at some of them only.
        looked_at = np.arange(0, cloud.size(), max(1, cloud.size() // 40_000))
        xyzs = np.asarray(cloud.xyzs()[:, looked_at], dtype=float)
        finite = np.flatnonzero(np.isfinite(xyzs).all(axis=0))
        stands = (table or TablePlane()).height(xyzs[:, finite].T) > 0.01
        rows = []
        for part, share, spacing in ((stands, 0.7, 1.0), (~stands, 0.3, 2.5)):
            of_part = finite[part]
            chosen = drawing.thin_points(
                xyzs[:, of_part].T,
                most=max(1, round(share * self._max_points)),
                spacing=spacing * self._point_spacing,
            )
            rows.append(of_part[chosen])
        index = np.concatenate(rows)
        colored = cloud.has_rgbs()
        kinds = BaseField.kXYZs | BaseField.kRGBs if colored else BaseField.kXYZs
        thin = PointCloud(index.size, Fields(kinds))
        thin.mutable_xyzs()[:] = xyzs[:, index]
        if colored:
            thin.mutable_rgbs()[:] = cloud.rgbs()[:, looked_at[index]]
        return thin


def _camera_path(number: int) -> str:
    return f"{_ROOT}/perception/camera" + (f"_{number + 1}" if number else "")


def _pose(R: FloatArray, p: FloatArray) -> RigidTransform:
    return RigidTransform(RotationMatrix.ProjectToRotationMatrix(R), p)


def _look_alike(costs: Mapping[str, FloatArray], drawn: Mapping[str, FloatArray]) -> bool:
    """Whether two sets of rings differ too little to be drawn again."""
    return list(costs) == list(drawn) and all(
        costs[name].shape == drawn[name].shape
        and bool(np.all(np.abs(costs[name] - drawn[name]) <= _COST_CHANGE))
        for name in costs
    )
