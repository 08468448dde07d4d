"""Intermediate results of the layers, drawn into Drake's Meshcat beside the robot."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import Capsule, Meshcat, Rgba, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import BodyIndex
from pydrake.perception import PointCloud
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from drake_oa.common.messages import EllipsoidSet, FloatArray, PolicyState, Route
from drake_oa.common.ports import AbstractInput
from drake_oa.scenario.scenario import LAYERS
from drake_oa.viewing import drawing
from drake_oa.viewing.drawing import Color

_ROOT = "/drake_oa"
PERIOD = 1.0 / 15.0
"""Time between frames [s]."""
_LASTING = 3
"""Number of frames that a cloud, and the rings of an obstacle, are shown."""
_CLOUD_SPACING = 0.02
"""Edge of the voxels of which one point each is drawn [m]."""
_PLACES = 8
"""Number of places of drawn obstacles; that of an obstacle is the remainder of its ID."""
_SHORTEST_SEGMENT = 2e-3
"""Minimum length of a drawn segment of the executed path [m]."""


class MeshcatOverlay(LeafSystem):
    """Draws cloud, ellipsoids, cost rings and paths into Meshcat.

    .. pydrake_system::

      name: MeshcatOverlay
      input_ports:
      - ellipsoids_W (optional)
      - policy_state
      - route (optional)
      - cloud (optional)
      - body_poses (optional)

    - ellipsoids_W (optional): abstract `EllipsoidSet`, the dilated obstacles in the
      world frame.
    - policy_state: abstract `PolicyState` of the movement primitive.
    - route (optional): abstract `Route`, the chosen sides and their cost rings.
    - cloud (optional): `pydrake.perception.PointCloud` in the world frame [m].
    - body_poses (optional): the plant's list of `RigidTransform`; without it the
      executed path is that of the policy's p_WE.

    Rose: the ellipsoids. Blue: the planned path. Red: the executed one. Around the point of the
    baseline where an obstacle's side is decided: the cost rings from inside to outside in the order
    of `Route.costs`, green where a direction costs nothing, yellow at 0.5, red where it costs 1;
    the magenta line is the chosen one. Rings are shown of obstacles that bend the motion only.

    Everything is under "/drake_oa" in the scene tree, a folder for each of `LAYERS`, and is
    recorded when Meshcat records: a recording holds transforms and properties but no objects,
    so whatever changes its shape (cloud, rings, executed path) is one object for some frames,
    visible only then. The system writes to Meshcat and reads nothing from it; its discrete state
    holds the time of the first frame and the end of the executed path.
    """

    def __init__(
        self,
        meshcat: Meshcat,
        *,
        planned_W: FloatArray | None = None,
        body_index: BodyIndex | None = None,
        p_BE: Sequence[float] = (0.0, 0.0, 0.0),
        show: Sequence[str] = LAYERS,
    ) -> None:
        """Declares the ports; draws nothing yet.

        Args:
            meshcat: the viewer.
            planned_W: (T, 3) points of the pre-planned path [m]; None: the straight
                line from start to goal.
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
        self._ellipsoids = AbstractInput(self, "ellipsoids_W", EllipsoidSet)
        self._policy = AbstractInput(self, "policy_state", PolicyState)
        self._route = AbstractInput(self, "route", Route)
        self._cloud = AbstractInput(self, "cloud", PointCloud)
        self._bodies = self.DeclareAbstractInputPort("body_poses", Value[list[RigidTransform]]())
        self.DeclareDiscreteState(4)
        self.DeclareInitializationDiscreteUpdateEvent(self._begin)
        self.DeclareInitializationPublishEvent(self._draw_start)
        # The frame at the start is the initialization's.
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, PERIOD, self._advance)
        self.DeclarePeriodicPublishEvent(PERIOD, PERIOD, self._draw_frame)

    def _tool_point(self, context: Context) -> FloatArray:
        if self._body_index is None or not self._bodies.HasValue(context):
            return self._policy.read(context).p_WE
        X_WB: RigidTransform = self._bodies.Eval(context)[int(self._body_index)]
        return np.asarray(X_WB @ self._p_BE)

    def _executed(self, context: Context) -> tuple[FloatArray, FloatArray]:
        """Returns the ends (3,) of the newest segment of the executed path; equal: it is short.

        Drake publishes at an instant before it updates at that instant: both find the same.
        """
        before: FloatArray = context.get_discrete_state_vector().value()[1:]
        now = self._tool_point(context)
        return before, now if np.linalg.norm(now - before) > _SHORTEST_SEGMENT else before

    def _begin(self, context: Context, state: DiscreteValues) -> None:
        state.set_value([context.get_time(), *self._tool_point(context)])

    def _advance(self, context: Context, state: DiscreteValues) -> None:
        start = context.get_discrete_state_vector()[0]
        state.set_value([start, *self._executed(context)[1]])

    # Drawing -----------------------------------------------------------------------

    def _segment(
        self, path: str, p_from: FloatArray, p_to: FloatArray, radius: float, color: Color
    ) -> None:
        """Sets a round segment between two points that differ [m].

        WebGL draws a line one pixel wide only.
        """
        way = p_to - p_from
        capsule = Capsule(radius, float(np.linalg.norm(way)))
        self._meshcat.SetObject(path, capsule, Rgba(*color))
        R = RotationMatrix.MakeFromOneVector(way, 2)
        self._meshcat.SetTransform(path, RigidTransform(R, 0.5 * (p_from + p_to)))

    def _show_path(self, path: str, visible: bool, time: float) -> None:
        """Shows or hides a path from a time on."""
        self._meshcat.SetProperty(path, "visible", visible, time)

    def _appear(self, path: str, context: Context) -> None:
        """Shows a path from now on, in the recording not before."""
        time, start = context.get_time(), context.get_discrete_state_vector()[0]
        if time > start:
            self._show_path(path, False, start)
        self._show_path(path, True, time)

    def _draw_start(self, context: Context) -> None:
        """Draws the objects that only move, and the first frame."""
        meshcat = self._meshcat
        for layer in LAYERS:
            meshcat.Delete(f"{_ROOT}/{layer}")
            meshcat.SetProperty(f"{_ROOT}/{layer}", "visible", layer in self._show)
        length = drawing.ring_radius(3) + 0.08
        for place in range(_PLACES):
            body = f"{_ROOT}/descriptor/{place}/ellipsoid/shape"
            meshcat.SetObject(body, Sphere(1.0), Rgba(*drawing.ELLIPSOID, 0.32))
            # What is inside or behind it stays visible.
            meshcat.SetProperty(f"{body}/<object>", "material.depthWrite", False)
            line = f"{_ROOT}/decision/{place}/direction/line"
            self._segment(line, np.zeros(3), np.array([length, 0.0, 0.0]), 0.0055, drawing.CHOSEN)
        policy = self._policy.read(context)
        path = np.stack([policy.p_WS, policy.p_WG]) if self._planned_W is None else self._planned_W
        for row, (p_from, p_to) in enumerate(pairwise(path)):
            if (p_to != p_from).any():
                name = f"{_ROOT}/motion/planned/path/{row}"
                self._segment(name, p_from, p_to, 0.005, drawing.PLANNED)
        for name, p_WQ in (("start", policy.p_WS), ("goal", policy.p_WG)):
            ball = f"{_ROOT}/motion/planned/{name}"
            meshcat.SetObject(ball, Sphere(0.014), Rgba(*drawing.PLANNED))
            meshcat.SetTransform(ball, RigidTransform(p_WQ))
        meshcat.SetObject(f"{_ROOT}/motion/tool_point", Sphere(0.013), Rgba(*drawing.EXECUTED))
        self._draw_frame(context)

    def _draw_frame(self, context: Context) -> None:
        time, start = context.get_time(), context.get_discrete_state_vector()[0]
        frame = round((time - start) / PERIOD)
        self._draw_obstacles(context, frame)
        X_WE = RigidTransform(self._tool_point(context))
        self._meshcat.SetTransform(f"{_ROOT}/motion/tool_point", X_WE, time)
        p_from, p_to = self._executed(context)
        if (p_from != p_to).any():
            path = f"{_ROOT}/motion/executed/{frame}"
            self._segment(path, p_from, p_to, 0.0055, drawing.EXECUTED)
            self._appear(path, context)
        if frame % _LASTING == 0 and self._cloud.port.HasValue(context):
            clouds = f"{_ROOT}/perception/cloud"
            self._show_path(f"{clouds}/{frame - _LASTING}", False, time)
            thinned = self._cloud.read(context).VoxelizedDownSample(_CLOUD_SPACING)
            self._meshcat.SetObject(f"{clouds}/{frame}", thinned, 0.011, Rgba(*drawing.CLOUD))
            self._appear(f"{clouds}/{frame}", context)

    def _draw_obstacles(self, context: Context, frame: int) -> None:
        time, meshcat = context.get_time(), self._meshcat
        ellipsoids = self._ellipsoids.read_or_empty(context)
        route = self._route.read_or_empty(context)
        policy = self._policy.read(context)
        ids, left = ellipsoids.ids.tolist(), route.remaining_clearance
        # Rings of obstacles that need no coupling would only hide the others'.
        sides = {
            name % _PLACES: row
            for row, name in enumerate(route.ids.tolist())
            if name in ids and (not len(left) or left[row] > 0.0)
        }
        rows = {name % _PLACES: row for row, name in enumerate(ids)}
        # Points of the baseline where sides are decided.
        baseline, length = policy.R_WL[:, 0], float(np.linalg.norm(policy.p_WG - policy.p_WS))
        along = np.clip((ellipsoids.p_WO - policy.p_WS) @ baseline, 0.0, length)
        p_WB = policy.p_WS + along[:, None] * baseline
        for place in range(_PLACES):
            body, decided = f"{_ROOT}/descriptor/{place}", f"{_ROOT}/decision/{place}"
            self._show_path(body, place in rows, time)
            self._show_path(decided, place in sides, time)
            if place in rows:
                row = rows[place]
                X_WO = _pose(ellipsoids.R_WO[row], ellipsoids.p_WO[row])
                meshcat.SetTransform(f"{body}/ellipsoid", X_WO, time)
                # A recording keeps the scale of a child of the posed path.
                scale = ellipsoids.semi_axes[row].tolist()
                meshcat.SetProperty(f"{body}/ellipsoid/shape", "scale", scale, time)
            if place in sides:
                row, p_WD = sides[place], p_WB[rows[place]]
                R_WA = RotationMatrix.MakeFromOneVector(route.direction_W[row], 0)
                meshcat.SetTransform(f"{decided}/direction", RigidTransform(R_WA, p_WD), time)
                meshcat.SetTransform(f"{decided}/rings", _pose(policy.R_WL, p_WD), time)
            if frame % _LASTING == 0:
                self._show_path(f"{decided}/rings/{frame - _LASTING}", False, time)
                if place in sides and route.costs:
                    costs = {name: values[sides[place]] for name, values in route.costs.items()}
                    # The legend reads the rings' names from the path.
                    bands = f"{decided}/rings/{frame}/{', '.join(costs)}"
                    mesh = drawing.ring_mesh(costs, route.angles)
                    meshcat.SetTriangleColorMesh(bands, *mesh)
                    self._appear(f"{decided}/rings/{frame}", context)


def _pose(R: FloatArray, p: FloatArray) -> RigidTransform:
    return RigidTransform(RotationMatrix.ProjectToRotationMatrix(R), p)
