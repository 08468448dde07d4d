"""Contacts, clearances and path length of a logged motion, evaluated on the true geometry of its
scenario.

For a robot, SceneGraph's distance and penetration queries compute contacts and clearances at every
logged instant. They are independent of the collision model with which the motion was planned.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from pydrake.geometry import GeometryId, PenetrationAsPointPair, QueryObject, SceneGraphInspector
from pydrake.multibody.tree import BodyIndex, RigidBody
from pydrake.systems.framework import Context, DiagramBuilder

from drake_oa.common.messages import OUT_OF_WORLD, EllipsoidSet, FloatArray
from drake_oa.geometry.collision_scene import CollisionGeometries, geometries_of, read_geometry
from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.robot.grasped_object import tool_links
from drake_oa.robot.plant import TOOL_FRAME
from drake_oa.scenario.loading import scenario_text
from drake_oa.scenario.obstacles import OBSTACLE_PREFIX
from drake_oa.scenario.scenario import Scenario
from drake_oa.world.station import make_station


@dataclass(frozen=True, eq=False)
class MotionMetrics:
    """Contacts of a robot's motion over T instants, and its clearances: distances to the nearest
    obstacle.

    Attributes:
        contacts: names "link - object" of all pairs that are in contact at any instant, in the
            order of their first contacts.
        initial_contacts: pairs of `contacts` that are in contact at the first instant.
        new_contacts: pairs of `contacts` that begin a contact after the first instant, in the order
            of these beginnings. A pair that is in contact at the first instant, separates and
            touches again is in `initial_contacts` and in `new_contacts`.
        self_contacts: names "link - link" of all pairs of the robot's links that are in contact at
            any instant, in the order of their first contacts.
        contact_depth: maximum penetration [m] of each pair of `contacts` and `self_contacts`, by
            the name of the pair.
        tool_clearance: (T,) distance of the tool (hand, fingers and grasped object) to the nearest
            obstacle [m]; like the other clearances negative in penetration, inf without obstacles.
        resting_clearance: (T,) distance of the tool to the nearest obstacle that never moves [m].
        robot_clearance: (T,) distance of the whole robot to the nearest obstacle [m].
        p_WE: (T, 3) positions of the tool point E in the world [m].
    """

    contacts: tuple[str, ...]
    initial_contacts: tuple[str, ...]
    new_contacts: tuple[str, ...]
    self_contacts: tuple[str, ...]
    contact_depth: dict[str, float]
    tool_clearance: FloatArray
    resting_clearance: FloatArray
    robot_clearance: FloatArray
    p_WE: FloatArray


MIN_PENETRATION = 1e-9
"""Penetration depth below which two shapes do not count as in contact [m].

The reason is rounding: shapes that only touch, such as a grasped object and the hand, may penetrate
by a rounding error.
"""
Contacts = dict[str, float]
"""Type of the contacts at one instant: maximum penetration [m] of each pair of bodies in contact,
by the name of the pair."""
Hits = dict[str, PenetrationAsPointPair]
"""Type of the penetrations at one instant: Drake's `PenetrationAsPointPair` of maximum depth for
each pair of bodies in contact, by the name of the pair."""


def path_length(path: FloatArray) -> float:
    """Computes the length [m] of a path (T, D), whose T points are joined by straight lines."""
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def free_point_metrics(p_WE: FloatArray, ellipsoids: EllipsoidSet) -> MotionMetrics:
    """Computes contacts and clearances of a point that moves among ellipsoids, for scenarios
    without a robot.

    The point counts as tool and as whole robot. It is in contact if it is inside an ellipsoid.

    Args:
        p_WE: (T, 3) positions of the point in the world [m].
        ellipsoids: obstacles; those with zero velocity are the resting ones.
    """
    shapes = ellipsoids.p_WO, ellipsoids.R_WO, ellipsoids.semi_axes
    clearance = signed_distance(p_WE[:, None], *shapes)
    nearest = clearance.min(axis=1, initial=np.inf)
    resting = clearance[:, ~ellipsoids.v_WO.any(axis=1)].min(axis=1, initial=np.inf)
    names = np.array([f"tool point - ellipsoid {i}" for i in ellipsoids.ids], dtype=str)
    contacts = [
        {str(names[i]): float(-row[i]) for i in np.flatnonzero(row <= 0.0)} for row in clearance
    ]
    return _metrics(contacts, [], np.stack([nearest, nearest, resting]), p_WE)


def _metrics(
    contacts: Sequence[Contacts],
    self_contacts: Sequence[Contacts],
    clearance: FloatArray,
    p_WE: FloatArray,
) -> MotionMetrics:
    """Creates the metrics of a motion from its contacts and clearances at each of T instants.

    Args:
        contacts: contacts of the robot with objects, one item for each instant.
        self_contacts: contacts between links of the robot, one item for each instant.
        clearance: (3, T) clearances [m]; the rows are those of the robot, of the tool, and of the
            tool to resting obstacles.
        p_WE: (T, 3) positions of the tool point in the world [m].
    """
    robot, tool, resting = clearance
    depth, self_depth = _max_penetrations(contacts), _max_penetrations(self_contacts)
    new = [pair for before, now in pairwise(contacts) for pair in now if pair not in before]
    return MotionMetrics(
        contacts=tuple(depth),
        initial_contacts=tuple(contacts[0]) if contacts else (),
        new_contacts=tuple(dict.fromkeys(new)),
        self_contacts=tuple(self_depth),
        contact_depth=depth | self_depth,
        tool_clearance=tool,
        resting_clearance=resting,
        robot_clearance=robot,
        p_WE=p_WE,
    )


def _max_penetrations(instants: Iterable[Contacts]) -> Contacts:
    """Returns the maximum penetration [m] of each pair of bodies over all instants, by the name of
    the pair.

    The pairs are in the order of their first contacts.

    Args:
        instants: contacts at each instant.
    """
    depths: Contacts = {}
    for contacts in instants:
        for pair, depth in contacts.items():
            depths[pair] = max(depths.get(pair, 0.0), depth)
    return depths


class ClearanceEvaluator:
    """Evaluator of a robot's clearances and contacts on the true geometry of a scenario, by queries
    to Drake's SceneGraph.
    """

    def __init__(self, scenario: Scenario) -> None:
        """Builds the plant and scene graph of a scenario, which costs as much time as many
        evaluations.

        Args:
            scenario: scenario with a robot and its world.

        Raises:
            ScenarioError: if the scenario's world cannot be built.
        """
        builder = DiagramBuilder()
        self._station = station = make_station(builder, scenario, render=False)
        self._diagram = builder.Build()  # Owns plant and scene graph.
        self._trajectories = deepcopy(scenario.obstacles)
        self._plant, graph = station.plant, station.scene_graph
        self._root = self._diagram.CreateDefaultContext()
        self._plant_context = self._plant.GetMyMutableContextFromRoot(self._root)
        self._q_world = self._plant.GetPositions(self._plant_context)
        self._graph_context = graph.GetMyContextFromRoot(self._root)
        self._query_port = graph.get_query_output_port()
        self._tool_frame = self._plant.GetFrameByName(TOOL_FRAME)
        self._body = {
            geometry_id: body
            for body in map(self._plant.get_body, map(BodyIndex, range(self._plant.num_bodies())))
            for geometry_id in self._plant.GetCollisionGeometriesForBody(body)
        }
        robot = {g: body for g, body in self._body.items() if self._is_robot(g)}
        obstacles = {g: b for g, b in self._body.items() if b.model_instance() in station.obstacles}
        inspector = graph.model_inspector()
        self._robot_balls = _Balls(inspector, robot)
        self._obstacle_balls = _Balls(inspector, obstacles)
        self._others = [
            (read_geometry(inspector, g), body) for g, body in self._body.items() if g not in robot
        ]
        of_tool = tool_links(scenario.robot) if scenario.robot else []
        self._tool = np.array([body.name() in of_tool for body in robot.values()], bool)
        # Moving obstacles have prismatic joints, resting ones have no positions.
        moving = [self._plant.num_positions(b.model_instance()) for b in obstacles.values()]
        self._rests = np.array(moving) == 0

    def _is_robot(self, geometry_id: GeometryId) -> bool:
        return self._body[geometry_id].model_instance() == self._station.robot

    def metrics(self, q: FloatArray, q_world: FloatArray | None = None) -> MotionMetrics:
        """Computes clearances and contacts of the robot at each instant of a motion.

        Args:
            q: (T, nq) positions of the robot, in the plant's order [rad, m].
            q_world: (T, n) all positions of the plant of robot and world [rad, m], for a world in
                which more than the robot moves; None or (T, 0): only the robot moves.

        Returns:
            Metrics. Clearances are distances to obstacles only. Contacts are those of the robot
            with any object, such as an obstacle or the table, and those between two links of the
            robot that no joint connects to each other.

        Raises:
            ValueError: if q_world does not have the shape (T, n).
        """
        if q_world is None or q_world.shape[1] == 0:
            q_world = np.broadcast_to(self._q_world, (len(q), len(self._q_world)))
        elif q_world.shape != (len(q), len(self._q_world)):
            raise ValueError(
                f"q_world: shape {q_world.shape} must be ({len(q)}, {len(self._q_world)}), "
                "instants x positions of the scenario's world"
            )
        contacts: list[Contacts] = []
        self_contacts: list[Contacts] = []
        clearance, p_WE = np.empty((3, len(q))), np.empty((len(q), 3))
        for row, positions in enumerate(q):
            query = self._query_at(positions, q_world[row])
            hits, self_hits = self._deepest_hits(query)
            contacts.append({pair: hit.depth for pair, hit in hits.items()})
            self_contacts.append({pair: hit.depth for pair, hit in self_hits.items()})
            clearance[:, row] = self._clearances(query)
            p_WE[row] = self._tool_frame.CalcPoseInWorld(self._plant_context).translation()
        return _metrics(contacts, self_contacts, clearance, p_WE)

    def _query_at(self, q: FloatArray, q_world: FloatArray) -> QueryObject:
        """Sets the positions of the world and of the robot, and returns SceneGraph's QueryObject.

        Args:
            q: (nq,) positions of the robot, which replace those in q_world [rad, m].
            q_world: (n,) all positions of the plant of robot and world [rad, m].
        """
        self._plant.SetPositions(self._plant_context, q_world)
        self._plant.SetPositions(self._plant_context, self._station.robot, q)
        return self._query_port.Eval(self._graph_context)

    def positions_at(self, time: float) -> FloatArray:
        """Computes all positions (n,) of the plant at a simulated time, with moving obstacles on
        their trajectories [rad, m].

        The robot and all other bodies are at their initial positions.

        Args:
            time: simulated time [s].
        """
        q_world = np.array(self._q_world)
        for obstacle in self._trajectories:
            if obstacle.is_driven:
                name = f"{OBSTACLE_PREFIX}_{obstacle.name}"
                instance = self._plant.GetModelInstanceByName(name)
                self._plant.SetPositionsInArray(instance, obstacle.offset_at(time), q_world)
        return q_world

    def geometries_at(self, time: float) -> CollisionGeometries:
        """Computes the collision geometries of all bodies except the robot's at a simulated time
        [s], with poses in the world.

        Moving obstacles are at the poses of their trajectories, but have zero velocities in the
        result.
        """
        self._plant.SetPositions(self._plant_context, self.positions_at(time))
        geometries = []
        for geometry, body in self._others:
            X_WB = body.EvalPoseInWorld(self._plant_context).GetAsMatrix4()
            geometries.append(replace(geometry, X_WO=X_WB @ geometry.X_WO))
        return geometries_of(geometries)

    def contact_speeds(
        self, q: FloatArray, v: FloatArray, q_world: FloatArray
    ) -> tuple[dict[str, float], float]:
        """Computes for each contact how fast the robot's link moves into the object, and computes
        the robot's kinetic energy.

        Args:
            q: (nq,) positions of the robot, in the plant's order [rad, m].
            v: (nv,) velocities of the robot [rad/s, m/s].
            q_world: (n,) all positions of the plant of robot and world [rad, m].

        Returns:
            Speeds [m/s] by the name "link - object" of the pair, and the kinetic energy [J]. A
            speed is the velocity of the link at the point of maximum penetration, along the contact
            normal, positive into the object.
        """
        hits, _ = self._deepest_hits(self._query_at(q, q_world))
        self._plant.SetVelocities(self._plant_context, self._station.robot, v)
        speeds = {}
        for pair, hit in hits.items():
            is_A = self._is_robot(hit.id_A)
            link = self._body[hit.id_A if is_A else hit.id_B]
            p_WC, sign = (hit.p_WCa, -1.0) if is_A else (hit.p_WCb, 1.0)
            offset = p_WC - link.EvalPoseInWorld(self._plant_context).translation()
            V_WC = link.EvalSpatialVelocityInWorld(self._plant_context).Shift(offset)
            speeds[pair] = sign * float(V_WC.translational() @ hit.nhat_BA_W)
        return speeds, float(self._plant.EvalKineticEnergy(self._plant_context))

    def _deepest_hits(self, query: QueryObject) -> tuple[Hits, Hits]:
        """Finds the penetration of maximum depth for each pair of bodies in contact.

        Penetrations below `MIN_PENETRATION` do not count as contact.

        Args:
            query: SceneGraph's QueryObject at the positions of interest.

        Returns:
            Penetrations by the name of the pair: for pairs "link - object", and for pairs
            "link - link" of the robot. The name of an object is that of its model instance.
        """
        hits: Hits = {}
        self_hits: Hits = {}
        for hit in query.ComputePointPairPenetration():
            if hit.depth < MIN_PENETRATION:
                continue
            first, second = sorted((hit.id_A, hit.id_B), key=self._is_robot, reverse=True)
            link, other = self._body[first], self._body[second]
            if self._is_robot(second):
                group, pair = self_hits, " - ".join(sorted((link.name(), other.name())))
            elif self._is_robot(first):
                model = self._plant.GetModelInstanceName(other.model_instance())
                group, pair = hits, f"{link.name()} - {model}"
            else:
                continue
            if pair not in group or hit.depth > group[pair].depth:
                group[pair] = hit
        return hits, self_hits

    def _clearances(self, query: QueryObject) -> FloatArray:
        """Computes the minimum distances (3,) to obstacles [m]: of the robot, of the tool, and of
        the tool to resting obstacles.

        Only pairs of collision geometries that can be nearest are evaluated: bounding balls give a
        lower bound for the distance of each pair. Pairs are evaluated in the order of these bounds,
        until no bound is below the largest of the three minima. A minimum is inf if no obstacle is
        within `OUT_OF_WORLD` (25 m).
        """
        robot, obstacles = self._robot_balls, self._obstacle_balls
        apart = robot.centers(self._plant_context)[:, None] - obstacles.centers(self._plant_context)
        bounds = np.linalg.norm(apart, axis=2) - robot.radius[:, None] - obstacles.radius
        order, minima = np.argsort(bounds, axis=None), np.full(3, OUT_OF_WORLD)
        for i, j in zip(*np.unravel_index(order, bounds.shape), strict=True):
            if bounds[i, j] >= minima.max():
                break
            counts = np.array([True, self._tool[i], self._tool[i] and self._rests[j]])
            if (minima[counts] > bounds[i, j]).any():
                geometry_ids = robot.geometry_ids[i], obstacles.geometry_ids[j]
                pair = query.ComputeSignedDistancePairClosestPoints(*geometry_ids)
                minima[counts] = np.minimum(minima[counts], pair.distance)
        return np.where(minima < OUT_OF_WORLD, minima, np.inf)


class _Balls:
    """Bounding balls of N collision geometries, fixed to the bodies of these geometries, for lower
    bounds of distances.

    Attributes:
        geometry_ids: IDs of the collision geometries.
        radius: (N,) radii of the balls [m]; inf for half spaces.
    """

    def __init__(
        self, inspector: SceneGraphInspector, bodies: Mapping[GeometryId, RigidBody]
    ) -> None:
        self.geometry_ids, self._bodies = list(bodies), list(bodies.values())
        ball = geometries_of([read_geometry(inspector, geometry_id) for geometry_id in bodies]).ball
        self._p_BC, self.radius = ball[:, :3], ball[:, 3]

    def centers(self, context: Context) -> FloatArray:
        """Returns the centers (N, 3) of the bounding balls in the world [m].

        Args:
            context: context of the plant.
        """
        X_WB = [body.EvalPoseInWorld(context).GetAsMatrix34() for body in self._bodies]
        poses = np.reshape(X_WB, (-1, 3, 4))
        return np.asarray(np.einsum("nij,nj->ni", poses[:, :, :3], self._p_BC) + poses[:, :, 3])


_EVALUATORS: dict[str, ClearanceEvaluator] = {}
"""Cache of the clearance evaluators of up to four scenarios, by the scenario's YAML text."""


def clearance_evaluator(scenario: Scenario) -> ClearanceEvaluator:
    """Returns the clearance evaluator of a scenario from a cache, so that equal scenarios share one
    evaluator.
    """
    text = scenario_text(scenario)
    if text not in _EVALUATORS:
        _EVALUATORS[text] = ClearanceEvaluator(scenario)
        for oldest in list(_EVALUATORS)[:-4]:
            del _EVALUATORS[oldest]
    return _EVALUATORS[text]


def robot_metrics(
    scenario: Scenario, q: FloatArray, q_world: FloatArray | None = None
) -> MotionMetrics:
    """Computes contacts and clearances of a robot's motion on the true geometry of a scenario.

    Clearances count obstacles only. Contacts count every object, such as obstacles and the table,
    and pairs of the robot's links.

    Args:
        scenario: scenario with a robot.
        q: (T, nq) positions of the robot, in the plant's order [rad, m].
        q_world: (T, n) all positions of the plant of robot and world [rad, m]; None or (T, 0): only
            the robot moves.
    """
    return clearance_evaluator(scenario).metrics(q, q_world)
