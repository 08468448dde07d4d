"""What the layers think, drawn into Drake's Meshcat beside the robot."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TypeVar

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import Capsule, Cylinder, Meshcat, Rgba, Shape, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import BodyIndex
from pydrake.perception import PointCloud
from pydrake.systems.framework import Context, InputPort, LeafSystem, State

from drake_oa.common.messages import EllipsoidSet, FloatArray, Frozen, PolicyState, Route, zeros
from drake_oa.common.ports import read_optional, read_value
from drake_oa.regulation.regressor import actuation_planes
from drake_oa.scenario.scenario import LAYERS
from drake_oa.viewing import drawing
from drake_oa.viewing.drawing import Color

_ROOT = "/drake_oa"
PERIOD = 1.0 / 15.0
"""Time between frames [s]."""
_CLOUD_FRAMES = 3
"""Frames from one cloud to the next."""
_CLOUD_SPACING = 0.02
"""Edge of the voxels of which one point each is drawn [m]."""
_PLACES = 8
"""Greatest number of obstacles that are drawn."""
_SHORTEST_SEGMENT = 2e-3
_COST_CHANGE = 0.1
T = TypeVar("T")


@dataclass(frozen=True)
class _Rings:
    """Rings of one obstacle as drawn last: its ID, their costs, and the frame."""

    name: int = -1
    costs: Mapping[str, FloatArray] = field(default_factory=dict)
    frame: int = -1


@dataclass(frozen=True, eq=False)
class _Shown(Frozen):
    """Contents of the picture: the run-time data of the overlay, kept in the Context.

    Attributes:
        start: time of the first frame [s].
        frame: number of this frame.
        slots: obstacle in each place of the pool, -1 where there is none.
        p_WE: (3,) end of the executed path [m].
        rings: the rings in each place.
    """

    start: float = 0.0
    frame: int = 0
    slots: tuple[int, ...] = (-1,) * _PLACES
    p_WE: FloatArray = zeros(3)
    rings: tuple[_Rings, ...] = (_Rings(),) * _PLACES


class MeshcatOverlay(LeafSystem):
    """Draws frustum, cloud, ellipsoids, sections, cost rings and paths into Meshcat.

    .. pydrake_system::

      name: MeshcatOverlay
      input_ports:
      - ellipsoids_W (optional)
      - policy_state
      - route (optional)
      - cloud (optional)
      - camera_pose (with frustums)
      - body_poses (optional)

    - ellipsoids_W (optional): abstract `EllipsoidSet`, the dilated obstacles in the
      world frame.
    - policy_state: abstract `PolicyState` of the movement primitive.
    - route (optional): abstract `Route`, the chosen sides and their cost rings.
    - cloud (optional): `pydrake.perception.PointCloud` in the world frame [m].
    - camera_pose (with frustums): `RigidTransform` X_WC, C being x right, y down, z forward; a port
      for each of the `frustums`, named by them.
    - body_poses (optional): the plant's list of `RigidTransform`; without it the
      executed path is that of the policy's p_WE.

    Rose: the ellipsoids. Dark red on them: their sections by the P-plane. Blue: the
    planned path. Red: the executed one. Round the point of the baseline where an
    obstacle's side is decided: the cost rings from inside to outside in the order of
    `Route.costs`, green where a direction costs nothing, yellow at 0.5, red where it costs 1;
    the magenta line is the chosen one. Rings are shown of obstacles that bend the motion only.

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
        planned_W: FloatArray | None = None,
        frustums: Mapping[str, FloatArray] | None = None,
        body_index: BodyIndex | None = None,
        p_BE: Sequence[float] = (0.0, 0.0, 0.0),
        show: Sequence[str] = LAYERS,
    ) -> None:
        """Declares the ports; draws nothing yet.

        Args:
            meshcat: the viewer.
            planned_W: (T, 3) points of the pre-planned path [m]; None: the straight
                line from start to goal.
            frustums: port of a camera's pose -> edges of its `drawing.frustum_edges`, drawn if
                the port is connected; None: there are no cameras.
            body_index: body B of the plant that carries E; None: policy_state.p_WE.
            p_BE: (3,) the tool point E in B [m].
            show: the `LAYERS` that are visible at first; whoever looks may change that.
        """
        super().__init__()
        self._show = tuple(show)
        self._meshcat = meshcat
        self._planned_W = planned_W
        self._body_index = body_index
        self._p_BE = np.array(p_BE, dtype=float)
        self._ellipsoids = self.DeclareAbstractInputPort("ellipsoids_W", Value(EllipsoidSet()))
        self._policy = self.DeclareAbstractInputPort("policy_state", Value(PolicyState()))
        self._route = self.DeclareAbstractInputPort("route", Value(Route()))
        self._cloud = self.DeclareAbstractInputPort("cloud", Value(PointCloud(0)))
        self._cameras = [
            (self.DeclareAbstractInputPort(name, Value(RigidTransform())), edges_C)
            for name, edges_C in (frustums or {}).items()
        ]
        self._bodies = self.DeclareAbstractInputPort("body_poses", Value[list[RigidTransform]]())
        self._shown = self.DeclareAbstractState(Value(_Shown()))
        self.DeclareInitializationUnrestrictedUpdateEvent(self._begin)
        self.DeclareInitializationPublishEvent(self._draw_start)
        # The frame at the start is the initialization's.
        self.DeclarePeriodicUnrestrictedUpdateEvent(PERIOD, PERIOD, self._advance)
        self.DeclarePeriodicPublishEvent(PERIOD, PERIOD, self._draw)

    def _connected_cameras(self, context: Context) -> Iterator[tuple[str, FloatArray, InputPort]]:
        """Lists path, frustum and port of each camera whose pose is connected."""
        for number, (port, edges_C) in enumerate(self._cameras, start=1):
            if port.HasValue(context):
                name = f"camera_{number}" if number > 1 else "camera"
                yield f"{_ROOT}/perception/{name}", edges_C, port

    # State -------------------------------------------------------------------------

    def _read(self, port: InputPort, context: Context, kind: type[T]) -> T:
        """Reads a port; an empty value where it is not connected."""
        found = read_optional(self, port, context, kind)
        return kind() if found is None else found

    def _tool_point(self, context: Context) -> FloatArray:
        if self._body_index is None or not self._bodies.HasValue(context):
            return read_value(self, self._policy, context, PolicyState).p_WE
        X_WB: RigidTransform = self._bodies.Eval(context)[int(self._body_index)]
        return np.asarray(X_WB @ self._p_BE)

    def _begin(self, context: Context, state: State) -> None:
        shown = _Shown(start=context.get_time(), p_WE=self._tool_point(context))
        state.get_mutable_abstract_state(self._shown).set_value(
            self._with_obstacles(context, shown)
        )

    def _advance(self, context: Context, state: State) -> None:
        _, shown = self._last_two(context)
        state.get_mutable_abstract_state(self._shown).set_value(shown)

    def _last_two(self, context: Context) -> tuple[_Shown, _Shown]:
        """Returns the contents of the last frame and of this one.

        Drake publishes at an instant before it updates at that instant: both the
        drawing and the update ask for this, and find the same.
        """
        before: _Shown = context.get_abstract_state(self._shown).get_value()
        p_WE = self._tool_point(context)
        if float(np.linalg.norm(p_WE - before.p_WE)) <= _SHORTEST_SEGMENT:
            p_WE = before.p_WE
        shown = replace(before, frame=before.frame + 1, p_WE=p_WE)
        return before, self._with_obstacles(context, shown)

    def _with_obstacles(self, context: Context, shown: _Shown) -> _Shown:
        """Places the obstacles, and renews the rings whose costs have changed visibly."""
        ellipsoids = self._read(self._ellipsoids, context, EllipsoidSet)
        route = self._read(self._route, context, Route)
        slots = drawing.assign_slots(shown.slots, ellipsoids.ids)
        row_of = {name: row for row, name in enumerate(route.ids.tolist())}
        rings = []
        for name, ring in zip(slots, shown.rings, strict=True):
            row = row_of.get(name, -1)
            if row >= 0:
                costs = {key: values[row] for key, values in route.costs.items()}
                if name != ring.name or not _look_alike(costs, ring.costs):
                    ring = _Rings(name, costs, shown.frame)
            rings.append(ring)
        return replace(shown, slots=slots, rings=tuple(rings))

    # Drawing -----------------------------------------------------------------------

    def _solid(self, path: str, shape: Shape, color: Color, opacity: float = 1.0) -> None:
        """Sets a shape without a shadow."""
        self._meshcat.SetObject(path, shape, Rgba(*color, opacity))
        self._meshcat.SetProperty(f"{path}/<object>", "castShadow", False)

    def _segment(
        self, path: str, p_from: FloatArray, p_to: FloatArray, radius: float, color: Color
    ) -> None:
        """Sets a round segment between two points that differ [m].

        WebGL draws a line one pixel wide only.
        """
        way = p_to - p_from
        self._solid(path, Capsule(radius, float(np.linalg.norm(way))), color)
        R = RotationMatrix.MakeFromOneVector(way, 2)
        self._meshcat.SetTransform(path, RigidTransform(R, 0.5 * (p_from + p_to)))

    def _show_path(self, path: str, visible: bool, time: float) -> None:
        """Shows or hides a path from a time on."""
        self._meshcat.SetProperty(path, "visible", visible, time)

    def _appear(self, path: str, shown: _Shown, time: float) -> None:
        """Shows a path from now on, in the recording not before."""
        if time > shown.start:
            self._show_path(path, False, shown.start)
        self._show_path(path, True, time)

    def _draw_start(self, context: Context) -> None:
        """The objects that only move, and the first frame."""
        meshcat = self._meshcat
        for layer in LAYERS:
            meshcat.Delete(f"{_ROOT}/{layer}")
            meshcat.SetProperty(f"{_ROOT}/{layer}", "visible", layer in self._show)
        length = drawing.ring_radius(3) + 0.08
        for slot in range(_PLACES):
            path = f"{_ROOT}/descriptor/{slot}"
            body = f"{path}/ellipsoid/shape"
            self._solid(body, Sphere(1.0), drawing.ELLIPSOID, 0.32)
            # What is inside or behind it stays visible.
            meshcat.SetProperty(f"{body}/<object>", "material.depthWrite", False)
            self._solid(f"{path}/section/shape", Cylinder(1.0, 0.02), drawing.SECTION, 0.6)
            line = f"{_ROOT}/decision/{slot}/direction/line"
            self._segment(line, np.zeros(3), np.array([length, 0.0, 0.0]), 0.0055, drawing.CHOSEN)
        self._draw_planned(read_value(self, self._policy, context, PolicyState))
        for path, edges_C, _ in self._connected_cameras(context):
            start, end = edges_C[:, 0].T, edges_C[:, 1].T
            meshcat.SetLineSegments(f"{path}/frustum", start, end, 1.0, Rgba(*drawing.FRUSTUM))
        meshcat.SetObject(f"{_ROOT}/motion/tool_point", Sphere(0.013), Rgba(*drawing.EXECUTED))
        shown: _Shown = context.get_abstract_state(self._shown).get_value()
        self._draw_frame(context, _Shown(p_WE=shown.p_WE), shown)

    def _draw_planned(self, policy: PolicyState) -> None:
        path = np.stack([policy.p_WS, policy.p_WG]) if self._planned_W is None else self._planned_W
        for row, (p_from, p_to) in enumerate(pairwise(path)):
            if (p_to != p_from).any():
                name = f"{_ROOT}/motion/planned/path/{row}"
                self._segment(name, p_from, p_to, 0.005, drawing.PLANNED)
        for name, p_WQ in (("start", policy.p_WS), ("goal", policy.p_WG)):
            ball = f"{_ROOT}/motion/planned/{name}"
            self._meshcat.SetObject(ball, Sphere(0.014), Rgba(*drawing.PLANNED))
            self._meshcat.SetTransform(ball, RigidTransform(p_WQ))

    def _draw(self, context: Context) -> None:
        self._draw_frame(context, *self._last_two(context))

    def _draw_frame(self, context: Context, before: _Shown, shown: _Shown) -> None:
        time = context.get_time()
        self._draw_obstacles(context, before, shown)
        X_WE = RigidTransform(self._tool_point(context))
        self._meshcat.SetTransform(f"{_ROOT}/motion/tool_point", X_WE, time)
        self._draw_executed(before.p_WE, shown, time)
        for path, _, port in self._connected_cameras(context):
            self._meshcat.SetTransform(path, port.Eval(context), time)
        if shown.frame % _CLOUD_FRAMES == 0 and self._cloud.HasValue(context):
            self._draw_cloud(self._cloud.Eval(context), shown, time)

    def _draw_obstacles(self, context: Context, before: _Shown, shown: _Shown) -> None:
        time = context.get_time()
        ellipsoids = self._read(self._ellipsoids, context, EllipsoidSet)
        route = self._read(self._route, context, Route)
        policy = read_value(self, self._policy, context, PolicyState)
        row_of = {name: row for row, name in enumerate(ellipsoids.ids.tolist())}
        left = route.remaining_clearance
        # Rings of obstacles that need no coupling would only hide the others'.
        ring_row = {
            name: row
            for row, name in enumerate(route.ids.tolist())
            if not len(left) or left[row] > 0.0
        }
        planes = actuation_planes(policy.p_WE, policy.z_W, policy.R_WL, ellipsoids.p_WO)
        R_WS, sections = drawing.section_frames(ellipsoids.R_WO, ellipsoids.semi_axes, planes)
        # Points of the baseline where sides are decided.
        baseline, length = policy.R_WL[:, 0], float(np.linalg.norm(policy.p_WG - policy.p_WS))
        along = np.clip((ellipsoids.p_WO - policy.p_WS) @ baseline, 0.0, length)
        p_WB = policy.p_WS + along[:, None] * baseline
        for slot, obstacle in enumerate(shown.slots):
            path, decided = f"{_ROOT}/descriptor/{slot}", f"{_ROOT}/decision/{slot}"
            row = row_of.get(obstacle, -1)
            self._show_path(path, row >= 0, time)
            self._show_path(decided, row >= 0, time)
            if row < 0:
                continue
            for name, R, scale in (
                ("ellipsoid", ellipsoids.R_WO[row], ellipsoids.semi_axes[row]),
                ("section", R_WS[row], sections[row]),
            ):
                self._meshcat.SetTransform(f"{path}/{name}", _pose(R, ellipsoids.p_WO[row]), time)
                # A recording keeps the scale of a child of the posed path.
                self._meshcat.SetProperty(f"{path}/{name}/shape", "scale", scale.tolist(), time)
            side = ring_row.get(obstacle, -1)
            self._show_path(f"{decided}/direction", side >= 0, time)
            self._show_path(f"{decided}/rings", side >= 0, time)
            if side >= 0:
                R_WA = RotationMatrix.MakeFromOneVector(route.direction_W[side], 0)
                X_WA = RigidTransform(R_WA, p_WB[row])
                self._meshcat.SetTransform(f"{decided}/direction", X_WA, time)
                X_WL = _pose(policy.R_WL, p_WB[row])
                self._meshcat.SetTransform(f"{decided}/rings", X_WL, time)
                ring = shown.rings[slot]
                if ring.frame == shown.frame:
                    last = before.rings[slot].frame
                    self._draw_rings(f"{decided}/rings", last, ring, route.angles, shown, time)

    def _draw_rings(
        self, path: str, last: int, rings: _Rings, angles: FloatArray, shown: _Shown, time: float
    ) -> None:
        if last >= 0:
            self._show_path(f"{path}/{last}", False, time)
        if rings.costs:
            name = f"{path}/{rings.frame}"
            # The legend reads the rings' names from the path.
            bands = f"{name}/{', '.join(rings.costs)}"
            self._meshcat.SetTriangleColorMesh(bands, *drawing.ring_mesh(rings.costs, angles))
            self._meshcat.SetProperty(f"{bands}/<object>", "castShadow", False)
            self._appear(name, shown, time)

    def _draw_executed(self, p_from: FloatArray, shown: _Shown, time: float) -> None:
        if (shown.p_WE != p_from).any():
            path = f"{_ROOT}/motion/executed/{shown.frame}"
            self._segment(path, p_from, shown.p_WE, 0.0055, drawing.EXECUTED)
            self._appear(path, shown, time)

    def _draw_cloud(self, cloud: PointCloud, shown: _Shown, time: float) -> None:
        clouds = f"{_ROOT}/perception/cloud"
        if shown.frame > 0:
            self._show_path(f"{clouds}/{shown.frame - _CLOUD_FRAMES}", False, time)
        path = f"{clouds}/{shown.frame}"
        thinned = cloud.VoxelizedDownSample(_CLOUD_SPACING)
        self._meshcat.SetObject(path, thinned, 0.011, Rgba(*drawing.CLOUD))
        self._appear(path, shown, time)


def _pose(R: FloatArray, p: FloatArray) -> RigidTransform:
    return RigidTransform(RotationMatrix.ProjectToRotationMatrix(R), p)


def _look_alike(costs: Mapping[str, FloatArray], drawn: Mapping[str, FloatArray]) -> bool:
    """Whether two sets of rings differ too little to be drawn again."""
    return list(costs) == list(drawn) and all(
        np.allclose(costs[name], drawn[name], rtol=0.0, atol=_COST_CHANGE) for name in costs
    )
