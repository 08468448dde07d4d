"""The robot on its table, asked about many obstacles and motions without building it anew."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import cached_property

import numpy as np
from pydrake.geometry import (
    AddContactMaterial,
    GeometryId,
    GeometryInstance,
    ProximityProperties,
    QueryObject,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.tree import JacobianWrtVariable, Joint
from pydrake.systems.framework import DiagramBuilder

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.rotation import rotation_vector
from drake_oa.geometry.shapes import pose, shape_geometry
from drake_oa.policy.dmp import minimum_jerk
from drake_oa.robot.arm import solve_tool_pose
from drake_oa.robot.plant import TOOL_FRAME, RobotPlant, home_positions, make_robot_plant
from drake_oa.scenario.obstacles import Obstacle
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.world.station import make_station

_STEPS = 60
"""Steps of a straight motion."""
_POSTURE_RATE = 0.2
"""Share of the way back to the posture that the null space goes in a step."""
_LIMIT_MARGIN = 0.03
"""Distance that a motion keeps to the joint limits [rad]."""
_ON_PATH = 1e-3
"""Largest distance from the asked pose, in position [m] and orientation [rad]."""


def moving_joints(robot_plant: RobotPlant) -> list[Joint]:
    """Returns the joints of a robot that have positions, in the order of those."""
    plant, robot = robot_plant.plant, robot_plant.instance
    joints = [plant.get_joint(index) for index in plant.GetJointIndices(robot)]
    return sorted((j for j in joints if j.num_positions()), key=lambda j: j.position_start())


def pose_at(obstacle: Obstacle, time: float) -> RigidTransform:
    """Pose in the world of an obstacle, which may move, at a time [s]."""
    X_WO = pose(obstacle)
    if obstacle.driven:
        X_WO.set_translation(X_WO.translation() + obstacle.offset_at(time))
    return X_WO


class PlanningScene:
    """A scenario's robot and what stands there, with other obstacles put in at will."""

    def __init__(self, scenario: Scenario) -> None:
        """Builds the cell.

        Args:
            scenario: with a robot. Obstacles of its own are no obstacles here.

        Raises:
            ScenarioError: if it has no robot, or its world cannot be built.
        """
        self._robot = robot_of(scenario)
        self._duration = scenario.task.duration
        self._robot_plant = make_robot_plant(self._robot)
        self._seed = home_positions(self._robot)
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

    def put(self, obstacles: Sequence[Obstacle], time: float = 0.0) -> None:
        """Replaces the obstacles that were put before.

        Args:
            obstacles: what to put.
            time: those that move are put where they are then [s].
        """
        graph = self._station.scene_graph
        for known in self._obstacles:
            graph.RemoveGeometry(self._graph_context, self._source, known)
        self._obstacles = {}
        for obstacle in obstacles:
            X_WO = pose_at(obstacle, time)
            for row, shape in enumerate(obstacle.shapes):
                instance = GeometryInstance(
                    X_WO @ pose(shape), shape_geometry(shape), f"{obstacle.name}_{row}"
                )
                properties = ProximityProperties()
                AddContactMaterial(properties=properties)
                instance.set_proximity_properties(properties)
                added = graph.RegisterGeometry(
                    self._graph_context, self._source, graph.world_frame_id(), instance
                )
                self._obstacles[added] = obstacle.name

    def positions(self, joints: Sequence[float]) -> FloatArray:
        """(nq,) positions with the arm's joints as given (n,) [rad]."""
        q = self._seed.copy()
        q[self._arm] = joints
        return q

    def tool_down(
        self,
        p_WE: FloatArray,
        q_seed: FloatArray | None = None,
        R_WE: RotationMatrix | None = None,
    ) -> FloatArray:
        """(nq,) positions with the tool at a point, as a run starts there.

        Args:
            p_WE: (3,) the tool point in the world [m].
            q_seed: (nq,) positions to stay near; None: those of the robot's seed.
            R_WE: orientation of the tool; None: the robot's, which is down in random scenes.

        Raises:
            ValueError: if it is out of reach.
        """
        return solve_tool_pose(
            self._robot_plant.plant,
            TOOL_FRAME,
            RigidTransform(self._R_WE if R_WE is None else R_WE, np.asarray(p_WE)),
            self._seed if q_seed is None else q_seed,
        )

    def straight_motion(
        self, start: FloatArray, goal: FloatArray, swing: float = 0.0
    ) -> FloatArray | None:
        """The joints along the straight minimum-jerk motion of the tool.

        The Cartesian controller's motion without its dynamics: damped steps onto the path,
        the null space drawn back to the posture at the start.

        Args:
            start: (3,) where the tool point starts, in the world [m].
            goal: (3,) where it ends [m].
            swing: how far the arm goes along its null space on the way, and back [rad], in
                place of its posture: the elbow swings to a side, the tool does not.

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
        share = np.sin(np.pi * np.linspace(0.0, 1.0, len(path))) ** 2
        turn = np.diff(share, prepend=0.0)
        aside = np.eye(len(self._robot.q_seed))[0]
        motion = np.empty((len(path), len(q)))
        for row, p_WE in enumerate(path):
            if swing:
                aside = self._null_direction(q, aside)
                back = swing * turn[row] * aside
            else:
                back = _POSTURE_RATE * (posture - q)[self._arm]
            q = self._follow(q, p_WE, back)
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

    def _jacobian(self) -> FloatArray:
        """(6, n) of the tool by the arm's joints, at the positions set last."""
        plant, world = self._station.plant, self._station.plant.world_frame()
        J = plant.CalcJacobianSpatialVelocity(
            self._plant_context,
            JacobianWrtVariable.kQDot,
            self._tool_frame,
            np.zeros(3),
            world,
            world,
        )
        return np.asarray(J[:, self._arm])

    def _null_direction(self, q: FloatArray, like: FloatArray) -> FloatArray:
        """(n,) unit velocity of the arm that leaves the tool where it is.

        Of both that which has more of `like`, (n,).
        """
        self._station.plant.SetPositions(self._plant_context, self._station.robot, q)
        direction = np.linalg.svd(self._jacobian())[2][-1]
        return np.asarray(direction if direction @ like >= 0.0 else -direction)

    def _follow(self, q: FloatArray, p_WE: FloatArray, back: FloatArray) -> FloatArray:
        """Two steps onto the path; the first goes `back` (n,) in the null space besides."""
        q = q.copy()
        for aside in (back, np.zeros_like(back)):
            error = self._pose_error(q, p_WE)
            J = self._jacobian()
            inverse = np.linalg.pinv(J, rcond=1e-4)
            q[self._arm] += inverse @ error + aside - inverse @ (J @ aside)
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

    def nearby(self, q: FloatArray, limit: float) -> list[tuple[str, str, float]]:
        """(link, thing, distance [m]) of what was put and is nearer than `limit` [m].

        At (nq,) positions q; inside, the distance is negative. One for each pair of shapes.
        """
        return [
            (self._links[link], self._obstacles[thing], distance)
            for link, thing, distance in self._near_pairs(q, limit)
            if link in self._links and thing in self._obstacles
        ]

    def is_free(self, q: FloatArray, clearance: float) -> bool:
        """Whether the robot at (nq,) positions q keeps off everything.

        That is `clearance` [m] to what was put, its joint limits, and no contact with the
        table or of its own links.
        """
        joints = q[self._arm]
        lower, upper = self.arm_limits
        if (joints < lower).any() or (joints > upper).any():
            return False
        for link, thing, distance in self._near_pairs(q, clearance):
            put = link in self._obstacles or thing in self._obstacles
            if distance < (clearance if put else 0.0):
                return False
        return True

    def _near_pairs(
        self, q: FloatArray, limit: float
    ) -> list[tuple[GeometryId, GeometryId, float]]:
        """Pairs of which at least one is the robot's, that first."""
        found = []
        query = self._query(q)
        for pair in query.ComputeSignedDistancePairwiseClosestPoints(limit):
            a, b = pair.id_A, pair.id_B
            if a in self._links or b in self._links:
                found.append((*((a, b) if a in self._links else (b, a)), float(pair.distance)))
        return found

    def shape_centers(self, q: FloatArray, links: Collection[str] | None = None) -> FloatArray:
        """(K, 3) centres of the shapes of some links, or of all, in the world [m].

        At (nq,) positions q.
        """
        query = self._query(q)
        return np.array(
            [
                query.GetPoseInWorld(geometry).translation()
                for geometry, link in self._links.items()
                if links is None or link in links
            ]
        )

    @cached_property
    def arm_links(self) -> tuple[str, ...]:
        """Names of the links that the arm's joints move, in the joints' order."""
        moving = moving_joints(self._robot_plant)
        return tuple(joint.child_body().name() for joint in moving[self._arm])

    @property
    def arm_limits(self) -> tuple[FloatArray, FloatArray]:
        """(n,) lowest and (n,) highest positions of the arm [rad]."""
        plant = self._robot_plant.plant
        return plant.GetPositionLowerLimits()[self._arm], plant.GetPositionUpperLimits()[self._arm]

    @property
    def arm_speeds(self) -> FloatArray:
        """(n,) greatest speeds of the arm's joints [rad/s]."""
        return np.asarray(self._robot_plant.plant.GetVelocityUpperLimits()[self._arm])
