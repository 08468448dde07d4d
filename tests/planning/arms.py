"""Collision models of arms, and obstacles, for tests of planning and safety."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.collision_scene import CollisionGeometry, geometries_of, shape_geometries
from drake_oa.geometry.shapes import Box, Sphere
from drake_oa.planning.collision_model import ArmCollisionModel, ClearanceRequirements
from drake_oa.robot.arm import Chain, chain_poses, make_chain
from drake_oa.robot.config import Robot
from drake_oa.robot.grasped_object import tool_links
from drake_oa.robot.plant import RobotPlant, home_positions, make_robot_plant
from drake_oa.robot.spheres import ArmSpheres, make_arm_spheres


@dataclass(frozen=True, eq=False, repr=False)
class ArmAlone:
    """Arm with n joints in its home configuration: kinematics and sphere model."""

    config: Robot
    robot: RobotPlant
    arm_spheres: ArmSpheres
    chain: Chain
    q_full: FloatArray  # (nq,) [rad, m]

    def __repr__(self) -> str:
        return f"<arm of {len(self.q)} joints>"

    @property
    def q(self) -> FloatArray:
        """(n,) home configuration [rad]."""
        return self.q_full[self.chain.q_index]

    @property
    def X_WE(self) -> FloatArray:
        """(12,) tool pose in the home configuration: rotation, row by row, and position [m]."""
        return self.poses(self.q)[-1].copy()

    @property
    def protrusion(self) -> float:
        """Maximum protrusion of the spheres of moving bodies [m]."""
        arm_spheres = self.arm_spheres
        return float(arm_spheres.protrusion[arm_spheres.arrays.group_joint >= 0].max())

    def poses(self, q: FloatArray) -> FloatArray:
        """Computes link poses (n + 2, 12) by `chain_poses`."""
        X = np.empty((len(q) + 2, 12))
        chain_poses(np.array(q), self.chain.X_PJ, X)
        return X

    def centers(self, q: FloatArray) -> FloatArray:
        """Computes the world positions (S, 3) of the spheres [m]."""
        X, spheres = self.poses(q), self.arm_spheres.arrays
        R, p = X[spheres.joint + 1, :9].reshape(-1, 3, 3), X[spheres.joint + 1, 9:]
        return np.asarray(np.einsum("sij,sj->si", R, spheres.p_JS) + p)

    def model(
        self,
        geometries: Sequence[CollisionGeometry] = (),
        tool_clearance: float = 0.05,
        link_clearance: float = 0.03,
        self_clearance: float = 0.005,
        now: float = 0.0,
    ) -> ArmCollisionModel:
        """Builds a collision model with required clearances of tool and links [m]."""
        spheres = self.arm_spheres.arrays
        is_tool = spheres.of_tool[spheres.first[:-1]]
        table = np.tile(
            np.where(is_tool, tool_clearance, link_clearance)[:, None], (1, len(geometries))
        )
        table[spheres.group_joint < 0] = -np.inf
        required = ClearanceRequirements(table, self_clearance, is_tool)
        return ArmCollisionModel(
            self.chain, spheres, geometries_of(list(geometries)), required, now
        )

    def random_q(self, random: np.random.Generator) -> FloatArray:
        """Samples a configuration (n,) within the joint limits [rad]."""
        return random.uniform(self.chain.lower, self.chain.upper)


def make_arm(config: Robot) -> ArmAlone:
    """Builds the arm of a robot configuration."""
    robot = make_robot_plant(config)
    q = home_positions(config)
    spheres = make_arm_spheres(robot, q, tool_links(config), config.spheres)
    chain = make_chain(robot.plant, robot.tool_frame, q, spheres.arrays)
    return ArmAlone(config, robot, spheres, chain, q)


def box_at(size: Sequence[float], p_WO: Sequence[float], label: str = "box") -> CollisionGeometry:
    """Returns an axis-aligned box at rest, with its size and center in the world [m]."""
    X_WO = RigidTransform(list(p_WO)).GetAsMatrix4()
    return shape_geometries([Box(list(size))], X_WO, label=label)[0]


def random_boxes(
    random: np.random.Generator, count: int, moving: int = 0
) -> list[CollisionGeometry]:
    """Samples boxes and spheres around an arm's base, of which the first `moving` ones move."""
    geometries: list[CollisionGeometry] = []
    for k in range(count):
        size = random.uniform(0.05, 0.2, 3)
        shape = Box(size.tolist()) if random.random() < 0.5 else Sphere(0.5 * size[0])
        angle, X = random.uniform(-np.pi, np.pi), np.eye(4)
        X[:3, :3] = Rotation.from_rotvec(random.normal(size=3)).as_matrix()
        X[:2, 3] = random.uniform(0.35, 0.8) * np.array([np.cos(angle), np.sin(angle)])
        X[2, 3] = random.uniform(0.0, 0.9)
        v_WO = random.uniform(-0.2, 0.2, 3) * (k < moving)
        geometries += shape_geometries([shape], X, v_WO=v_WO)
    return geometries


def wall_with_gap(height: float = 0.5, gap: float = 0.35) -> list[CollisionGeometry]:
    """Returns a wall in the plane y = 0 with a gap through which the arm can reach [m]."""
    low = box_at([0.5, 0.04, height], [0.6, 0.0, 0.5 * height], "low wall")
    return [low, box_at([0.5, 0.04, 0.4], [0.6, 0.0, height + gap + 0.2], "high wall")]
