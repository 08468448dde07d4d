"""Collisions, clearance, convergence and path length of a finished motion.

They are computed from what was logged, at every logged instant, by SceneGraph's
own distance and contact queries: nothing that steered the motion judges it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from pydrake.geometry import GeometryId, HalfSpace, QueryObject, SceneGraphInspector
from pydrake.multibody.tree import ModelInstanceIndex, RigidBody
from pydrake.systems.framework import Context, DiagramBuilder

from drake_oa.common.messages import OUT_OF_WORLD, EllipsoidSet, FloatArray
from drake_oa.geometry.collision_shapes import outline_corners
from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.robot.grasped_object import tool_links
from drake_oa.robot.plant import TOOL_FRAME
from drake_oa.scenario.scenario import Scenario
from drake_oa.world.station import make_station


@dataclass(frozen=True, eq=False)
class MotionMetrics:
    """What a motion kept and what it touched.

    Attributes:
        contacts: "link - object" of every pair that touched, each once, in order of
            first contact.
        initial_contacts: those of them that touched at the first instant: the motion
            started in them.
        made_contacts: those of them that came to touch after it, in order: the motion
            made them. A pair that parted and met again is in both.
        self_contacts: "link - link" of the robot's own that touched, in order.
        contact_depth: pair of `contacts` or `self_contacts` -> its greatest penetration [m].
        tool_clearance: (T,) distance of the tool to the nearest obstacle [m];
            negative inside, inf while there is no obstacle.
        resting_clearance: (T,) the same to those obstacles that never move.
        robot_clearance: (T,) the same for the whole robot.
        p_WE: (T, 3) the tool point [m].
    """

    contacts: tuple[str, ...]
    initial_contacts: tuple[str, ...]
    made_contacts: tuple[str, ...]
    self_contacts: tuple[str, ...]
    contact_depth: dict[str, float]
    tool_clearance: FloatArray
    resting_clearance: FloatArray
    robot_clearance: FloatArray
    p_WE: FloatArray


Touching = Sequence[tuple[str, float]]
"""Pairs in contact at one instant and their penetrations [m]."""


class _ContactRecord:
    """Tells contacts that a motion started in from those it made."""

    def __init__(self) -> None:
        self.depth: dict[str, float] = {}
        self.own_depth: dict[str, float] = {}
        self.initial: tuple[str, ...] = ()
        self.made: dict[str, None] = {}
        self._before: set[str] | None = None

    def add(self, touching: Touching, own: Touching = ()) -> None:
        """Adds the pairs in contact at the next instant and their penetrations [m]."""
        for known, pairs in ((self.depth, touching), (self.own_depth, own)):
            for pair, depth in pairs:
                known[pair] = max(known.get(pair, 0.0), depth)
        present = dict.fromkeys(pair for pair, _ in touching)
        if self._before is None:
            self.initial = tuple(present)
        else:
            self.made |= {pair: None for pair in present if pair not in self._before}
        self._before = set(present)


def path_length(path: FloatArray) -> float:
    """Length of a polyline (T, D) [m]."""
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def free_point_metrics(p_WE: FloatArray, ellipsoids: EllipsoidSet) -> MotionMetrics:
    """Metrics of a free point among ellipsoids; p_WE is (T, 3) [m]."""
    if len(ellipsoids) == 0:
        clearance = np.full((len(p_WE), 0), np.inf)
    else:
        clearance = signed_distance(
            p_WE[:, None, :], ellipsoids.p_WO, ellipsoids.R_WO, ellipsoids.semi_axes
        )
    nearest = clearance.min(axis=1, initial=np.inf)
    resting = clearance[:, ~ellipsoids.v_WO.any(axis=1)].min(axis=1, initial=np.inf)
    names = np.array([f"tool point - ellipsoid {i}" for i in ellipsoids.ids], dtype=str)
    record = _ContactRecord()
    for row in clearance:
        record.add([(str(names[i]), float(-row[i])) for i in np.flatnonzero(row <= 0.0)])
    return _metrics(record, np.stack([nearest, nearest, resting]), p_WE)


def _metrics(record: _ContactRecord, clearance: FloatArray, p_WE: FloatArray) -> MotionMetrics:
    """From the (3, T) clearances of robot, tool, and tool to what rests."""
    robot, tool, resting = clearance
    return MotionMetrics(
        contacts=tuple(record.depth),
        initial_contacts=record.initial,
        made_contacts=tuple(record.made),
        self_contacts=tuple(record.own_depth),
        contact_depth=record.depth | record.own_depth,
        tool_clearance=tool,
        resting_clearance=resting,
        robot_clearance=robot,
        p_WE=p_WE,
    )


class Nearest(NamedTuple):
    """The two nearest points of a robot and an obstacle, in the world, and how far apart [m]."""

    distance: float
    p_WA: FloatArray
    p_WB: FloatArray


class RobotJudge:
    """Asks SceneGraph about one configuration of a scenario's robot after another."""

    def __init__(self, scenario: Scenario) -> None:
        """Builds the station, which takes most of the time that a few configurations take.

        Args:
            scenario: with a robot; it says what stands in the world.

        Raises:
            ScenarioError: if the station cannot be built.
        """
        builder = DiagramBuilder()
        self._station = make_station(builder, scenario, render=False)
        diagram = builder.Build()
        self._diagram = diagram  # Owns plant and scene graph.
        self._plant = self._station.plant
        root = diagram.CreateDefaultContext()
        self._root = root
        self._plant_context = self._plant.GetMyMutableContextFromRoot(root)
        self._q_world = self._plant.GetPositions(self._plant_context)
        graph = self._station.scene_graph
        self._graph_context = graph.GetMyContextFromRoot(root)
        self._query_port = graph.get_query_output_port()
        self._tool_frame = self._plant.GetFrameByName(TOOL_FRAME)
        self._body = {}
        for instance in map(ModelInstanceIndex, range(self._plant.num_model_instances())):
            for index in self._plant.GetBodyIndices(instance):
                body = self._plant.get_body(index)
                for geometry in self._plant.GetCollisionGeometriesForBody(body):
                    self._body[geometry] = body
        robot = [g for g in self._body if self._is_robot(g)]
        obstacles = [
            g for g, b in self._body.items() if b.model_instance() in self._station.obstacles
        ]
        inspector = graph.model_inspector()
        self._robot_balls = _Balls(inspector, robot, self._body)
        self._obstacle_balls = _Balls(inspector, obstacles, self._body)
        of_tool = tool_links(scenario.robot) if scenario.robot else []
        self._tool = np.array([self._body[g].name() in of_tool for g in robot], bool)
        # What is driven hangs on slides.
        self._rests = np.array(
            [self._plant.num_positions(self._body[g].model_instance()) == 0 for g in obstacles],
            bool,
        )

    def _is_robot(self, geometry: GeometryId) -> bool:
        return self._body[geometry].model_instance() == self._station.robot

    def metrics(self, q: FloatArray, q_world: FloatArray | None = None) -> MotionMetrics:
        """Metrics of a motion.

        Args:
            q: (T, nq) positions of the robot, in the plant's order.
            q_world: (T, n) all positions of the station's plant, for a world in which more
                than the robot moves; None or (T, 0): the rest stays where the scenario puts it.

        Returns:
            Clearances to the obstacles; contacts with obstacles and with anything else
            that is not the robot, the table for one, and of the robot with itself, but for
            links that a joint connects.

        Raises:
            ValueError: if q_world is not of this station.
        """
        if q_world is None or q_world.shape[1] == 0:
            q_world = np.broadcast_to(self._q_world, (len(q), len(self._q_world)))
        elif q_world.shape != (len(q), len(self._q_world)):
            raise ValueError(
                f"q_world: shape {q_world.shape} must be ({len(q)}, {len(self._q_world)}): an "
                "instant a row, a position of the scenario's world a column"
            )
        record = _ContactRecord()
        clearance, p_WE = np.empty((3, len(q))), np.empty((len(q), 3))
        for row, positions in enumerate(q):
            self._plant.SetPositions(self._plant_context, q_world[row])
            self._plant.SetPositions(self._plant_context, self._station.robot, positions)
            query = self._query_port.Eval(self._graph_context)
            record.add(*self._contacts(query))
            clearance[:, row] = self._clearances(query)
            p_WE[row] = self._tool_frame.CalcPoseInWorld(self._plant_context).translation()
        return _metrics(record, clearance, p_WE)

    def nearest(self, q: FloatArray, q_world: FloatArray) -> Nearest | None:
        """The robot's and an obstacle's nearest points; None while there is no obstacle.

        Args:
            q: (nq,) positions of the robot, in the plant's order.
            q_world: (n,) all positions of the station's plant.
        """
        self._plant.SetPositions(self._plant_context, q_world)
        self._plant.SetPositions(self._plant_context, self._station.robot, q)
        query = self._query_port.Eval(self._graph_context)
        ours, others = self._robot_balls, self._obstacle_balls
        bound = self._bounds()
        found, least = None, OUT_OF_WORLD
        for pair in np.argsort(bound, axis=None):
            i, j = divmod(int(pair), len(others.radius))
            if bound[i, j] >= least:
                break
            hit = query.ComputeSignedDistancePairClosestPoints(
                ours.geometries[i], others.geometries[j]
            )
            if hit.distance < least:
                found, least = hit, hit.distance
        if found is None:
            return None
        p_WA = query.GetPoseInWorld(found.id_A) @ found.p_ACa
        return Nearest(found.distance, p_WA, query.GetPoseInWorld(found.id_B) @ found.p_BCb)

    def _contacts(self, query: QueryObject) -> tuple[Touching, Touching]:
        """Contacts "link - object" of the robot, and "link - link" of the robot with itself."""
        found: list[tuple[str, float]] = []
        own: list[tuple[str, float]] = []
        for hit in query.ComputePointPairPenetration():
            a, b = hit.id_A, hit.id_B
            if self._is_robot(a) != self._is_robot(b):
                link, thing = (a, b) if self._is_robot(a) else (b, a)
                model = self._plant.GetModelInstanceName(self._body[thing].model_instance())
                found.append((f"{self._body[link].name()} - {model}", hit.depth))
            elif self._is_robot(a):
                pair = " - ".join(sorted((self._body[a].name(), self._body[b].name())))
                own.append((pair, hit.depth))
        return found, own

    def _bounds(self) -> FloatArray:
        """(M, N) that no geometry of the robot and of the obstacles is nearer than [m]."""
        ours, others = self._robot_balls, self._obstacle_balls
        apart = ours.centers(self._plant_context)[:, None] - others.centers(self._plant_context)
        # No pair is nearer than the balls round both.
        bound: FloatArray = np.linalg.norm(apart, axis=2) - ours.radius[:, None] - others.radius
        return bound

    def _clearances(self, query: QueryObject) -> FloatArray:
        """(3,) least distance to the obstacles that are there [m].

        Of the robot, of the tool, and of the tool to what never moves.
        """
        ours, others = self._robot_balls, self._obstacle_balls
        bound = self._bounds()
        least = np.full(3, np.inf)
        sought = np.array([True, self._tool.any(), bool(self._tool.any() and self._rests.any())])
        for pair in np.argsort(bound, axis=None):
            i, j = divmod(int(pair), len(others.radius))
            if bound[i, j] >= min(least[sought].max(), OUT_OF_WORLD):
                break
            counts = np.array([True, self._tool[i], self._tool[i] and self._rests[j]])
            counts &= bound[i, j] < least
            if not counts.any():
                continue
            hit = query.ComputeSignedDistancePairClosestPoints(
                ours.geometries[i], others.geometries[j]
            )
            least[counts] = np.minimum(least[counts], hit.distance)
        return least


class _Balls:
    """Balls round geometries, fixed to their bodies."""

    def __init__(
        self,
        inspector: SceneGraphInspector,
        geometries: list[GeometryId],
        body: dict[GeometryId, RigidBody],
    ) -> None:
        self.geometries = geometries
        bodies = list({body[g].index(): body[g] for g in geometries}.values())
        self._bodies = bodies
        self._row = np.array([bodies.index(body[g]) for g in geometries], dtype=int)
        self._p_BC, self.radius = np.zeros((len(geometries), 3)), np.zeros(len(geometries))
        for row, geometry in enumerate(geometries):
            if isinstance(inspector.GetShape(geometry), HalfSpace):
                self.radius[row] = np.inf
                continue
            corners = outline_corners(inspector, geometry)
            middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
            self._p_BC[row] = middle
            self.radius[row] = np.linalg.norm(corners - middle, axis=1).max()

    def centers(self, context: Context) -> FloatArray:
        """(N, 3) in the world, in the order of the geometries [m]."""
        X_WB = np.array(
            [body.EvalPoseInWorld(context).GetAsMatrix34() for body in self._bodies]
        ).reshape(-1, 3, 4)[self._row]
        return np.asarray(np.einsum("nij,nj->ni", X_WB[:, :, :3], self._p_BC) + X_WB[:, :, 3])


def robot_metrics(
    scenario: Scenario, q: FloatArray, q_world: FloatArray | None = None
) -> MotionMetrics:
    """`RobotJudge.metrics` of one motion in a scenario."""
    return RobotJudge(scenario).metrics(q, q_world)
