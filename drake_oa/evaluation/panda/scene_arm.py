"""Arm model of the random scenes, which computes straight tool motions and distances from links to
obstacles.

The model consists of the arm's joints and of spheres that enclose its links, as in motion planning
(`drake_oa.planning.collision_model`). The distance of a link's true shape to an obstacle is up to
4 mm larger than the distance of the link's spheres; at the base it is up to 2 cm larger.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pydrake.geometry as drake
from numpy.typing import ArrayLike
from pydrake.math import RollPitchYaw

from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import FloatArray
from drake_oa.diagrams.station import covered_arm
from drake_oa.evaluation.cameras import obstacle_geometries
from drake_oa.geometry.collision_scene import geometries_of, geometry_of
from drake_oa.planning.collision_model import (
    ArmCollisionModel,
    ClearanceRequirements,
    group_distances,
)
from drake_oa.planning.search import ToolPaths, roll_out_arm
from drake_oa.policy.dmp import minimum_jerk_profile
from drake_oa.robot.arm import inverse_kinematics, make_chain
from drake_oa.robot.plant import home_positions, make_robot_plant
from drake_oa.robot.spheres import sphere_centers
from drake_oa.scenario.end_poses import end_positions
from drake_oa.scenario.loading import load_scenario, parse_scenario
from drake_oa.scenario.obstacles import Obstacle
from drake_oa.scenario.scenario import Scenario, robot_of

DEFAULT_SCENARIO = "tabletop_box"
"""Name of the shipped scenario whose robot, camera and parameters most random scenes have."""
ELBOW_SCENARIO = "shelf_elbow"
"""Name of the shipped scenario whose camera the scenes of the kind `elbow` have, in which obstacles
block only the path of the elbow. This camera has a smaller downward tilt than in other scenes."""
_STATION_DIRECTIVES = """\
directives:
- add_directives: {file: package://drake_oa/scenes/table.dmd.yaml}
- add_directives: {file: package://drake_oa/scenes/camera_xtion.dmd.yaml}
"""
"""YAML of the model directives that add table and camera stand to a random scene."""
_STEPS = 60
"""Number of time steps into which a straight tool motion is divided to compute its joint motion."""
_LIMIT_MARGIN = 0.03
"""Minimum distance between the joints and their position limits on a straight tool motion [rad]."""
_MAX_ERROR = 1e-3
"""Maximum error of the tool pose up to which the arm counts as following a straight tool motion:
largest element of the position error [m] and of the rotation vector of the orientation error [rad].
"""


@lru_cache(maxsize=4)
def base_scenario(like: str = DEFAULT_SCENARIO) -> Scenario:
    """Loads a shipped scenario and removes everything but table and camera stand from its world.

    Args:
        like: name of the shipped scenario.
    """
    scenario = load_scenario(like)
    scenario.directives = parse_scenario(_STATION_DIRECTIVES).directives
    scenario.obstacles = []
    return scenario


class Motion(NamedTuple):
    """Nominal motion (without avoidance) of a random scene.

    Attributes:
        start: (3,) tool position at the start in the world [m].
        goal: (3,) tool position at the goal in the world [m].
        t: (T,) times from 0 at the start [s].
        q: (T, n) joint positions at these times [rad].
        ends: (3, n) first and last row of `q`, and the goal configuration that inverse kinematics
            selects for the scenario [rad].
        rpy_WE: roll, pitch and yaw of the tool in the world [rad]; None: the tool points down.
    """

    start: FloatArray
    goal: FloatArray
    t: FloatArray
    q: FloatArray
    ends: FloatArray
    rpy_WE: list[float] | None = None


class SceneArm:
    """Arm model of the random scenes, with joints and enclosing spheres of G links.

    The tool points down unless `straight_motion` receives another orientation.

    Attributes:
        tool: (G,) whether each link belongs to the tool.
        joint: (G,) index of the joint that moves each link; -1 for fixed links.
    """

    def __init__(self) -> None:
        """Makes the arm model of the robot in the default scenario."""
        robot = robot_of(base_scenario())
        robot_plant, q_home = make_robot_plant(robot), home_positions(robot)
        self._spheres = covered_arm(robot).arrays
        plant, tool_frame = robot_plant.plant, robot_plant.tool_frame
        self._chain = make_chain(plant, tool_frame, q_home, self._spheres)
        self._q_home = q_home[self._chain.q_index]
        self._R_WE = RollPitchYaw(robot.rpy_WE).ToRotationMatrix().matrix().ravel()
        self.joint = self._spheres.group_joint
        self.tool = self._spheres.of_tool[self._spheres.first[:-1]]

    def postures(self, p_WE: FloatArray) -> FloatArray:
        """Computes several configurations (m, n) of the arm [rad] with the tool pointing down at a
        position p_WE (3,) in the world [m].
        """
        return inverse_kinematics(self._chain, np.append(self._R_WE, p_WE), self._q_home)

    def straight_motion(
        self,
        start: FloatArray,
        goal: FloatArray,
        aside: FloatArray | None = None,
        rpy_WE: list[float] | None = None,
    ) -> Motion | None:
        """Computes the joint motion of the arm along a straight minimum-jerk tool path.

        Args:
            start: (3,) tool position at the start in the world [m].
            goal: (3,) tool position at the goal in the world [m].
            aside: (n,) posture that attracts the arm in the middle of the motion, in the null space
                of the tool pose [rad]; at start and goal the start configuration attracts the arm.
                None: the start configuration attracts the arm during the whole motion.
            rpy_WE: roll, pitch and yaw of the tool in the world [rad]; None: the tool points down.

        Returns:
            The motion; None if the arm cannot follow the line within its joint limits, or touches
            the table or itself.
        """
        scenario = base_scenario()
        task = replace(scenario.task, start=start.tolist(), goal=goal.tolist())
        R_WE = self._R_WE
        if rpy_WE is not None:
            task.rpy_start = task.rpy_goal = rpy_WE
            R_WE = RollPitchYaw(rpy_WE).ToRotationMatrix().matrix().ravel()
        try:
            q_ends = np.stack(end_positions(replace(scenario, task=task)))[:, self._chain.q_index]
        except ScenarioError:
            return None
        q_start, s = q_ends[0], np.linspace(0.0, 1.0, _STEPS + 1)
        offset = np.sin(np.pi * s[:, None]) ** 2 * (0.0 if aside is None else aside - q_start)
        paths = ToolPaths(
            s=s,
            p_WE=(start + minimum_jerk_profile(s)[:, None] * (goal - start))[None],
            R_WE=np.tile(R_WE, (1, len(s), 1)),
            posture=(q_start + offset)[None],
            seconds=task.duration,
        )
        off_table = np.where(self.joint < 0, -np.inf, 0.0)[:, None]
        requirements = ClearanceRequirements(off_table, 0.0, self.tool)
        table = geometries_of([geometry_of(drake.HalfSpace())])
        world = ArmCollisionModel(self._chain, self._spheres, table, requirements, 0.0)
        rollout = roll_out_arm(world, q_start, paths)
        q, margin = rollout.q[0], _LIMIT_MARGIN
        within = (q > self._chain.lower + margin) & (q < self._chain.upper - margin)
        if rollout.error[0] > _MAX_ERROR or not within.all() or rollout.min_margin[0] < 0.0:
            return None
        ends = np.vstack([q[[0, -1]], q_ends[1:]])
        return Motion(start, goal, task.duration * s, q, ends, rpy_WE)

    def distances(
        self, q: FloatArray, obstacles: Iterable[Obstacle], t: ArrayLike = 0.0
    ) -> FloatArray:
        """Computes distances (T, G, K) between the spheres that enclose the arm's G links and K
        shapes of obstacles at T times [m], negative in penetration.

        Args:
            q: (T, n) joint positions [rad], or (1, n) for all times.
            obstacles: resting or moving obstacles.
            t: (T,) times [s], or one time for all joint positions.
        """
        placed = [obstacle_geometries(obstacles, time) for time in np.atleast_1d(t)]
        count, arm = max(len(q), len(placed)), (self._chain, self._spheres)
        at_times = [
            group_distances(*arm, placed[row % len(placed)], q[None, row % len(q)], 0.0, np.inf)
            for row in range(count)
        ]
        return np.stack(at_times)

    def centers(self, q: FloatArray, joints: range) -> FloatArray:
        """Computes centers of the spheres around some of the arm's links along a joint motion.

        Args:
            q: (T, n) joint positions [rad].
            joints: indices of the joints that move the selected links.

        Returns:
            (N, 3) positions in the world [m].
        """
        is_selected = np.isin(self._spheres.joint, joints)
        p_WS = sphere_centers(self._chain, self._spheres, q)[:, is_selected]
        return np.asarray(p_WS.reshape(-1, 3))


@lru_cache(maxsize=1)
def scene_arm() -> SceneArm:
    """Returns the arm model of the random scenes, which is constructed once per process."""
    return SceneArm()
