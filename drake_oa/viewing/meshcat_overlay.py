"""System that draws intermediate results of the layers in Drake's viewer Meshcat."""

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
"""Path in Meshcat's scene tree below which all objects of the overlay are drawn."""
PERIOD = 1.0 / 15.0
"""Simulated time between two frames of the overlay, the objects that are drawn in Meshcat [s]."""
_FRAMES_VISIBLE = 3
"""Number of frames of the overlay for which a drawn point cloud or cost ring is visible, before the
next one replaces it."""
_CLOUD_SPACING = 0.02
"""Edge length of the voxels with which a point cloud is thinned before it is drawn, one point per
voxel [m]."""
_SLOT_COUNT = 8
"""Number of obstacles for which Meshcat's scene tree has objects. An obstacle uses the slot whose
number is its ID modulo this number."""
_SHORTEST_SEGMENT = 2e-3
"""Minimum length of each drawn segment of the executed path [m]. No segment is drawn while the tool
point is within this distance of the end of the last segment."""


class MeshcatOverlay(LeafSystem):
    """System that draws the point cloud, ellipsoids, cost rings and paths of a run in Meshcat.

    .. pydrake_system::

      name: MeshcatOverlay
      input_ports:
      - ellipsoids_W (optional)
      - policy_state
      - route (optional)
      - cloud (optional)
      - body_poses (optional)

    - ellipsoids_W (optional): abstract `EllipsoidSet`, the ellipsoids around the obstacles dilated
      by the tool, in the world frame. Not connected: no ellipsoids are drawn.
    - policy_state: abstract `PolicyState` of the movement primitive.
    - route (optional): abstract `Route`, the selected side of each obstacle, with the costs of all
      sides. Not connected: no cost rings are drawn.
    - cloud (optional): `pydrake.perception.PointCloud` in the world frame [m]. Not connected: no
      cloud is drawn.
    - body_poses (optional): list of `RigidTransform` with the poses of the plant's bodies in the
      world. They give the tool point, whose path is the executed path. Not connected: the tool
      point is p_WE in `policy_state`.

    Ellipsoids are rose, the nominal path is blue, and the executed path is red. A cost ring
    displays the costs of passing an obstacle in each direction around the baseline, the line from
    start to goal. The rings of an obstacle are centered at the point of the baseline closest to the
    obstacle, in the order of `Route.costs` from the inside out. Green is cost 0, yellow is 0.5, red
    is 1. A magenta line points in the selected direction. Rings and line are drawn only for
    obstacles with heading guidance, the coupling term that turns the motion to the selected side:
    `Route.remaining_clearance` is positive, or empty.

    The objects are under "/drake_oa" in the scene tree, in the folders "perception", "descriptor",
    "decision" and "motion". A recording of Meshcat stores transforms and properties, but no
    objects. Therefore each new shape (cloud, rings, segment of the executed path) is a new object,
    which is hidden in frames of other times. The discrete state stores the time of the first frame
    and the end point of the executed path.
    """

    def __init__(
        self,
        meshcat: Meshcat,
        *,
        nominal_W: FloatArray | None = None,
        body_index: BodyIndex | None = None,
        p_BE: Sequence[float] = (0.0, 0.0, 0.0),
        show: Sequence[str] = LAYERS,
    ) -> None:
        """Declares the ports, state and events of the system; the initialization event draws the
        first frame.

        Args:
            meshcat: Meshcat instance.
            nominal_W: (T, 3) points of the nominal path in the world [m]; None: the straight line
                from start to goal.
            body_index: index of the tool's body B in the plant; None: the tool point E is at p_WE
                of `policy_state`.
            p_BE: (3,) position of the tool point E in the frame of body B [m].
            show: folders of objects that are visible at first, out of "perception" (point cloud),
                "descriptor" (ellipsoids), "decision" (cost rings and selected directions) and
                "motion" (paths); the user can change them in the browser.
        """
        super().__init__()
        self._show = tuple(show)
        self._meshcat = meshcat
        self._nominal_W = nominal_W
        self._body_index = body_index
        self._p_BE = np.array(p_BE, dtype=float)
        self._ellipsoids = AbstractInput(self, "ellipsoids_W", EllipsoidSet)
        self._policy = AbstractInput(self, "policy_state", PolicyState)
        self._route = AbstractInput(self, "route", Route)
        self._cloud = AbstractInput(self, "cloud", PointCloud)
        self._bodies = self.DeclareAbstractInputPort("body_poses", Value[list[RigidTransform]]())
        self.DeclareDiscreteState(4)
        self.DeclareInitializationDiscreteUpdateEvent(self._initialize)
        self.DeclareInitializationPublishEvent(self._draw_start)
        # The initialization draws the frame at the start.
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, PERIOD, self._advance)
        self.DeclarePeriodicPublishEvent(PERIOD, PERIOD, self._draw_frame)

    def _tool_point(self, context: Context) -> FloatArray:
        """Returns the position (3,) of the tool point E in the world [m], from the body poses if
        connected, otherwise from the policy state.
        """
        if self._body_index is None or not self._bodies.HasValue(context):
            return self._policy.read(context).p_WE
        X_WB: RigidTransform = self._bodies.Eval(context)[int(self._body_index)]
        return np.asarray(X_WB @ self._p_BE)

    def _executed(self, context: Context) -> tuple[FloatArray, FloatArray]:
        """Returns the start (3,) and end (3,) of the next segment of the executed path in the world
        [m].

        Both points are equal while the segment is too short to be drawn. At each time, Drake
        performs the publish event, which draws the segment, before the update event, which stores
        its end. Both events therefore use the same segment.
        """
        before: FloatArray = context.get_discrete_state_vector().value()[1:]
        now = self._tool_point(context)
        return before, now if np.linalg.norm(now - before) > _SHORTEST_SEGMENT else before

    def _initialize(self, context: Context, state: DiscreteValues) -> None:
        """Stores the time of the first frame and the start point of the executed path in the
        discrete state, at the initialization.
        """
        state.set_value([context.get_time(), *self._tool_point(context)])

    def _advance(self, context: Context, state: DiscreteValues) -> None:
        """Stores the new end point of the drawn executed path in the discrete state, at each
        periodic update.
        """
        start = context.get_discrete_state_vector()[0]
        state.set_value([start, *self._executed(context)[1]])

    # Drawing -----------------------------------------------------------------------

    def _segment(
        self, path: str, p_from: FloatArray, p_to: FloatArray, radius: float, color: Color
    ) -> None:
        """Draws a line segment between two different points as a capsule.

        A line object of Meshcat would have a width of only one pixel.

        Args:
            path: path of the object in Meshcat's scene tree.
            p_from: (3,) start of the segment, in the frame of the object [m].
            p_to: (3,) end of the segment, in the frame of the object [m].
            radius: radius of the capsule [m].
            color: color of the capsule.
        """
        way = p_to - p_from
        capsule = Capsule(radius, float(np.linalg.norm(way)))
        self._meshcat.SetObject(path, capsule, Rgba(*color))
        R = RotationMatrix.MakeFromOneVector(way, 2)
        self._meshcat.SetTransform(path, RigidTransform(R, 0.5 * (p_from + p_to)))

    def _show_path(self, path: str, visible: bool, time: float) -> None:
        """Shows or hides all objects below a path of Meshcat's scene tree.

        The live view changes at once. In a recording the change applies from a simulated time on.

        Args:
            path: path in the scene tree.
            visible: whether the objects are visible.
            time: simulated time of the change in the recording [s].
        """
        self._meshcat.SetProperty(path, "visible", visible, time)

    def _appear(self, path: str, context: Context) -> None:
        """Shows the objects below a path of Meshcat's scene tree from the time of a Context on, and
        hides them in earlier frames of a recording.
        """
        time, start = context.get_time(), context.get_discrete_state_vector()[0]
        if time > start:
            self._show_path(path, False, start)
        self._show_path(path, True, time)

    def _draw_start(self, context: Context) -> None:
        """Draws the objects whose shapes are constant during the run (nominal path, start, goal,
        tool point, lines of selected directions, and ellipsoids as unit spheres, which are scaled
        in each frame), and then the first frame.
        """
        meshcat = self._meshcat
        for layer in LAYERS:
            meshcat.Delete(f"{_ROOT}/{layer}")
            meshcat.SetProperty(f"{_ROOT}/{layer}", "visible", layer in self._show)
        # Beyond the outermost of three rings.
        length = drawing.INNER_RADIUS + 3 * (drawing.BAND + drawing.GAP) + 0.08
        for slot in range(_SLOT_COUNT):
            body = f"{_ROOT}/descriptor/{slot}/ellipsoid/shape"
            meshcat.SetObject(body, Sphere(1.0), Rgba(*drawing.ELLIPSOID, 0.32))
            # Objects inside or behind the ellipsoid remain visible.
            meshcat.SetProperty(f"{body}/<object>", "material.depthWrite", False)
            line = f"{_ROOT}/decision/{slot}/direction/line"
            self._segment(line, np.zeros(3), np.array([length, 0.0, 0.0]), 0.0055, drawing.SELECTED)
        policy = self._policy.read(context)
        path = np.stack([policy.p_WS, policy.p_WG]) if self._nominal_W is None else self._nominal_W
        for row, (p_from, p_to) in enumerate(pairwise(path)):
            if (p_to != p_from).any():
                name = f"{_ROOT}/motion/nominal/path/{row}"
                self._segment(name, p_from, p_to, 0.005, drawing.NOMINAL)
        for name, p_WQ in (("start", policy.p_WS), ("goal", policy.p_WG)):
            ball = f"{_ROOT}/motion/nominal/{name}"
            meshcat.SetObject(ball, Sphere(0.014), Rgba(*drawing.NOMINAL))
            meshcat.SetTransform(ball, RigidTransform(p_WQ))
        meshcat.SetObject(f"{_ROOT}/motion/tool_point", Sphere(0.013), Rgba(*drawing.EXECUTED))
        self._draw_frame(context)

    def _draw_frame(self, context: Context) -> None:
        """Draws ellipsoids, selected directions, the tool point and the newest segment of the
        executed path at the time of a Context; every few frames also cost rings and point cloud.
        """
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
        if frame % _FRAMES_VISIBLE == 0 and self._cloud.port.HasValue(context):
            clouds = f"{_ROOT}/perception/cloud"
            self._show_path(f"{clouds}/{frame - _FRAMES_VISIBLE}", False, time)
            thinned = self._cloud.read(context).VoxelizedDownSample(_CLOUD_SPACING)
            self._meshcat.SetObject(f"{clouds}/{frame}", thinned, 0.011, Rgba(*drawing.CLOUD))
            self._appear(f"{clouds}/{frame}", context)

    def _draw_obstacles(self, context: Context, frame: int) -> None:
        """Draws the ellipsoids, selected directions and cost rings (costs of passing on each side)
        of all obstacles, in the obstacles' slots (numbered folders) of the scene tree.

        Args:
            context: Context of this system.
            frame: number of the frame, from 0.
        """
        time, meshcat = context.get_time(), self._meshcat
        ellipsoids = self._ellipsoids.read_or_empty(context)
        route = self._route.read_or_empty(context)
        policy = self._policy.read(context)
        ids, remaining_clearance = ellipsoids.ids.tolist(), route.remaining_clearance
        # Rings of obstacles without coupling would occlude the rings of others.
        sides = {
            name % _SLOT_COUNT: row
            for row, name in enumerate(route.ids.tolist())
            if name in ids and (not len(remaining_clearance) or remaining_clearance[row] > 0.0)
        }
        rows = {name % _SLOT_COUNT: row for row, name in enumerate(ids)}
        # Projections of the obstacles onto the baseline, where sides are decided.
        baseline, length = policy.R_WL[:, 0], float(np.linalg.norm(policy.p_WG - policy.p_WS))
        along = np.clip((ellipsoids.p_WO - policy.p_WS) @ baseline, 0.0, length)
        p_WB = policy.p_WS + along[:, None] * baseline
        for slot in range(_SLOT_COUNT):
            body, decision = f"{_ROOT}/descriptor/{slot}", f"{_ROOT}/decision/{slot}"
            self._show_path(body, slot in rows, time)
            self._show_path(decision, slot in sides, time)
            if slot in rows:
                row = rows[slot]
                X_WO = _pose(ellipsoids.R_WO[row], ellipsoids.p_WO[row])
                meshcat.SetTransform(f"{body}/ellipsoid", X_WO, time)
                # A recording holds the scale only on a child of the path with the pose.
                scale = ellipsoids.semi_axes[row].tolist()
                meshcat.SetProperty(f"{body}/ellipsoid/shape", "scale", scale, time)
            if slot in sides:
                row, p_WD = sides[slot], p_WB[rows[slot]]
                R_WA = RotationMatrix.MakeFromOneVector(route.direction_W[row], 0)
                meshcat.SetTransform(f"{decision}/direction", RigidTransform(R_WA, p_WD), time)
                meshcat.SetTransform(f"{decision}/rings", _pose(policy.R_WL, p_WD), time)
            if frame % _FRAMES_VISIBLE == 0:
                self._show_path(f"{decision}/rings/{frame - _FRAMES_VISIBLE}", False, time)
                if slot in sides and route.costs:
                    costs = {name: values[sides[slot]] for name, values in route.costs.items()}
                    # The legend reads the names of the rings from the path.
                    bands = f"{decision}/rings/{frame}/{', '.join(costs)}"
                    mesh = drawing.ring_mesh(costs, route.angles)
                    meshcat.SetTriangleColorMesh(bands, *mesh)
                    self._appear(f"{decision}/rings/{frame}", context)


def _pose(R: FloatArray, p: FloatArray) -> RigidTransform:
    """Returns the pose with a rotation matrix R (3, 3), which is projected to SO(3) to correct
    rounding errors, and a position p (3,) [m].
    """
    return RigidTransform(RotationMatrix.ProjectToRotationMatrix(R), p)
