"""The robot on its table, asked about many obstacles and motions without building it anew."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydrake.geometry import (
    AddContactMaterial,
    GeometryId,
    GeometryInstance,
    ProximityProperties,
    QueryObject,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.framework import DiagramBuilder

from drake_oa.cartesian_kernels import rotation_vector
from drake_oa.dmp import minimum_jerk
from drake_oa.inverse_kinematics import solve_tool_pose
from drake_oa.obstacles import Obstacle, pose, shape_geometry
from drake_oa.scenario import Robot, Scenario, ScenarioError
from drake_oa.station import TOOL_FRAME, home_positions, make_robot_plant, make_station
from drake_oa.values import FloatArray

_STEPS = 60
"""Steps of a straight motion."""
_POSTURE_RATE = 0.2
"""Share of the way back to the posture that the null space goes in a step."""
_LIMIT_MARGIN = 0.03
"""Distance that a motion keeps to the joint limits [rad]."""
_ON_PATH = 1e-3
"""Largest distance from the asked pose, in position [m] and orientation [rad]."""


class PandaCell:
    """A scenario's robot and what stands there, with other obstacles put in at will."""

    def __init__(self, scenario: Scenario) -> None:
        """Builds the cell.

        Args:
            scenario: with a robot. Obstacles of its own are no obstacles here.

        Raises:
            ScenarioError: if it has no robot, or its world cannot be built.
        """
        if scenario.robot is None:
            raise ScenarioError("robot: this cell needs one; this scenario has null")
        self._robot: Robot = scenario.robot
        self._duration = scenario.task.duration
        self._robot_plant = make_robot_plant(self._robot)
        self._seed = home_positions(self._robot_plant, self._robot)
        self._R_WE = RollPitchYaw(self._robot.rpy_WE).ToRotationMatrix()
        builder = DiagramBuilder()
        self._station = make_station(builder, scenario, render=False)
        self._source = self._station.scene_graph.RegisterSource("obstacles")
        self._diagram = builder.Build()
        self._root = self._diagram.CreateDefaultContext()
        plant, graph = self._station.plant, self._station.scene_graph
        self._plant_context = plant.GetMyMutableContextFromRoot(self._root)
        self._graph_context = graph.GetMyMutableContextFromRoot(self._root)
        self._tool_frame = plant.GetFrameByName(TOOL_FRAME)
        self._arm = slice(0, len(self._robot.q_seed))
        self._links = {
            geometry: plant.get_body(index).name()
            for index in plant.GetBodyIndices(self._station.robot)
            for geometry in plant.GetCollisionGeometriesForBody(plant.get_body(index))
        }
        self._obstacles: dict[GeometryId, str] = {}

    def frame_pose(self, frame: str) -> RigidTransform:
        """Pose in the world of a frame that does not move, "model::frame"."""
        model, _, name = frame.partition("::")
        plant = self._station.plant
        instance = plant.GetModelInstanceByName(model)
        return plant.GetFrameByName(name, instance).CalcPoseInWorld(self._plant_context)

    def put(self, obstacles: Sequence[Obstacle]) -> None:
        """Replaces the obstacles that were put before."""
        graph = self._station.scene_graph
        for known in self._obstacles:
            graph.RemoveGeometry(self._graph_context, self._source, known)
        self._obstacles = {}
        for obstacle in obstacles:
            for row, shape in enumerate(obstacle.shapes):
                instance = GeometryInstance(
                    pose(obstacle) @ pose(shape), shape_geometry(shape), f"{obstacle.name}_{row}"
                )
                properties = ProximityProperties()
                AddContactMaterial(properties=properties)
                instance.set_proximity_properties(properties)
                added = graph.RegisterGeometry(
                    self._graph_context, self._source, graph.world_frame_id(), instance
                )
                self._obstacles[added] = obstacle.name

    def tool_down(self, p_WE: FloatArray) -> FloatArray:
        """(nq,) positions with the tool at a point, as a run starts there.

        Args:
            p_WE: (3,) the tool point in the world [m].

        Raises:
            ValueError: if it is out of reach.
        """
        return solve_tool_pose(
            self._robot_plant.plant,
            TOOL_FRAME,
            RigidTransform(self._R_WE, np.asarray(p_WE)),
            self._seed,
        )

    def straight_motion(self, start: FloatArray, goal: FloatArray) -> FloatArray | None:
        """The joints along the straight minimum-jerk motion of the tool.

        The Cartesian controller's motion without its dynamics: damped steps onto the path,
        the null space drawn back to the posture at the start.

        Args:
            start: (3,) where the tool point starts, in the world [m].
            goal: (3,) where it ends [m].

        Returns:
            (T, nq) positions; None where the arm cannot follow within its joint limits.
        """
        try:
            posture = self.tool_down(start)
        except ValueError:
            return None
        plant = self._station.plant
        lower = plant.GetPositionLowerLimits()[self._arm] + _LIMIT_MARGIN
        upper = plant.GetPositionUpperLimits()[self._arm] - _LIMIT_MARGIN
        path, _ = minimum_jerk(start, goal, duration=self._duration, samples=_STEPS + 1)
        q = posture.copy()
        motion = np.empty((len(path), len(q)))
        for row, p_WE in enumerate(path):
            q = self._follow(q, p_WE, posture)
            error = self._pose_error(q, p_WE)
            joints = q[self._arm]
            if np.abs(error).max() > _ON_PATH or (joints < lower).any() or (joints > upper).any():
                return None
            motion[row] = q
        return motion

    def _pose_error(self, q: FloatArray, p_WE: FloatArray) -> FloatArray:
        """(6,) rotation vector [rad] and translation [m] from the pose at q to the asked one."""
        plant = self._station.plant
        plant.SetPositions(self._plant_context, self._station.robot, q)
        X_WE = self._tool_frame.CalcPoseInWorld(self._plant_context)
        R_error = self._R_WE.matrix() @ X_WE.rotation().matrix().T
        return np.concatenate(
            [rotation_vector(np.ascontiguousarray(R_error)), p_WE - X_WE.translation()]
        )

    def _follow(self, q: FloatArray, p_WE: FloatArray, posture: FloatArray) -> FloatArray:
        plant, world = self._station.plant, self._station.plant.world_frame()
        q = q.copy()
        for rate in (_POSTURE_RATE, 0.0):
            error = self._pose_error(q, p_WE)
            J = plant.CalcJacobianSpatialVelocity(
                self._plant_context,
                JacobianWrtVariable.kQDot,
                self._tool_frame,
                np.zeros(3),
                world,
                world,
            )[:, self._arm]
            inverse = np.linalg.pinv(J, rcond=1e-4)
            back = rate * (posture - q)[self._arm]
            q[self._arm] += inverse @ error + back - inverse @ (J @ back)
        return q

    def _query(self, q: FloatArray) -> QueryObject:
        self._station.plant.SetPositions(self._plant_context, self._station.robot, q)
        port = self._station.scene_graph.get_query_output_port()
        return port.Eval(self._graph_context)

    def contacts(self, q: FloatArray) -> list[tuple[str, str, float]]:
        """(link, thing, depth [m]) of what the robot touches at (nq,) positions q.

        Things are named by what was put; "" is anything else.
        """
        found = []
        for hit in self._query(q).ComputePointPairPenetration():
            for link, thing in ((hit.id_A, hit.id_B), (hit.id_B, hit.id_A)):
                if link in self._links and thing not in self._links:
                    name = self._obstacles.get(thing, "")
                    found.append((self._links[link], name, float(hit.depth)))
        return found

    def clearance(self, q: FloatArray) -> float:
        """Least distance of the robot at (nq,) positions q to what was put [m]; inf for nothing."""
        query = self._query(q)
        return min(
            (
                query.ComputeSignedDistancePairClosestPoints(link, thing).distance
                for link in self._links
                for thing in self._obstacles
            ),
            default=np.inf,
        )
