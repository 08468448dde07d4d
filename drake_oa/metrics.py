"""Collisions, clearance, convergence and path length of a finished motion.

They are computed from what was logged, at every logged instant, by SceneGraph's
own distance and contact queries: nothing that steered the motion judges it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.geometry import GeometryId, QueryObject
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import DiagramBuilder

from drake_oa.ellipsoid import signed_distance
from drake_oa.scenario import Scenario
from drake_oa.station import TOOL_FRAME, make_station
from drake_oa.values import EllipsoidSet, FloatArray


@dataclass(frozen=True, eq=False)
class MotionMetrics:
    """What a motion kept and what it touched.

    Attributes:
        contacts: "link - object" of every pair that touched, each once, in order of
            first contact.
        tool_clearance: (T,) distance of the tool to the nearest obstacle [m];
            negative inside, inf where there is no obstacle.
        robot_clearance: (T,) the same for the whole robot.
        p_WE: (T, 3) the tool point [m].
    """

    contacts: tuple[str, ...]
    tool_clearance: FloatArray
    robot_clearance: FloatArray
    p_WE: FloatArray


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
    touched = ellipsoids.ids[(clearance <= 0.0).any(axis=0)]
    return MotionMetrics(
        tuple(f"tool point - ellipsoid {i}" for i in touched), nearest, nearest, p_WE
    )


class _RobotJudge:
    """Asks SceneGraph about one configuration of the robot after another."""

    def __init__(self, scenario: Scenario) -> None:
        builder = DiagramBuilder()
        self._station = make_station(builder, scenario, render=False)
        diagram = builder.Build()
        self._diagram = diagram  # Owns plant and scene graph.
        self._plant = self._station.plant
        root = diagram.CreateDefaultContext()
        self._root = root
        self._plant_context = self._plant.GetMyMutableContextFromRoot(root)
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
        self._pairs = [(a, b) for a in robot for b in obstacles]
        tool_links = scenario.robot.tool_links if scenario.robot else []
        self._tool = np.array([self._body[a].name() in tool_links for a, _ in self._pairs], bool)

    def _is_robot(self, geometry: GeometryId) -> bool:
        return self._body[geometry].model_instance() == self._station.robot

    def set_positions(self, q: FloatArray) -> QueryObject:
        """Poses the robot; returns the query object."""
        self._plant.SetPositions(self._plant_context, self._station.robot, q)
        return self._query_port.Eval(self._graph_context)

    def tool_point(self) -> FloatArray:
        """p_WE of the pose set last."""
        return self._tool_frame.CalcPoseInWorld(self._plant_context).translation()

    def contacts(self, query: QueryObject) -> list[str]:
        """ "link - thing" of what touches the robot."""
        found = []
        for hit in query.ComputePointPairPenetration():
            a, b = hit.id_A, hit.id_B
            if self._is_robot(a) != self._is_robot(b):
                link, thing = (a, b) if self._is_robot(a) else (b, a)
                model = self._plant.GetModelInstanceName(self._body[thing].model_instance())
                found.append(f"{self._body[link].name()} - {model}")
        return found

    def clearances(self, query: QueryObject) -> tuple[float, float]:
        """Least distance of the tool, and of the robot, to the obstacles [m]."""
        if not self._pairs:
            return np.inf, np.inf
        distance = np.array(
            [query.ComputeSignedDistancePairClosestPoints(a, b).distance for a, b in self._pairs]
        )
        return float(distance[self._tool].min(initial=np.inf)), float(distance.min())


def robot_metrics(scenario: Scenario, q: FloatArray) -> MotionMetrics:
    """Metrics of the robot in its station.

    Args:
        scenario: with a robot; its directives say what stands in the world.
        q: (T, nq) positions of the robot, in the plant's order.

    Returns:
        Clearances to the obstacles; contacts with obstacles and with anything else
        that is not the robot, the table for one.

    Raises:
        ScenarioError: if the station cannot be built; for one, because an obstacle can
            move: it is judged where the directives put it.
    """
    judge = _RobotJudge(scenario)
    contacts: dict[str, None] = {}
    tool_clearance, robot_clearance = np.empty((2, len(q)))
    p_WE = np.empty((len(q), 3))
    for row, positions in enumerate(q):
        query = judge.set_positions(positions)
        contacts |= dict.fromkeys(judge.contacts(query))
        tool_clearance[row], robot_clearance[row] = judge.clearances(query)
        p_WE[row] = judge.tool_point()
    return MotionMetrics(tuple(contacts), tool_clearance, robot_clearance, p_WE)
