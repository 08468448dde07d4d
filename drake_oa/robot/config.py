"""Configuration block of the robot: a scenario's field `robot`."""

import math
from typing import Annotated

from pydantic import AfterValidator, Field, ValidationInfo
from pydantic.dataclasses import dataclass

from drake_oa.common.config import BLOCK, Angles, Tagged, Vector3, length
from drake_oa.geometry.shapes import Box, Cylinder, Sphere

_Speed = Annotated[float, Field(gt=0.0, le=100.0)]
"""Type of a maximum joint speed [rad/s]."""


def _check_stable(ki: float, info: ValidationInfo) -> float:
    """Checks an integral gain for a stable error e, with e'' + kd e' + kp e + ki int e dt = 0."""
    bound = info.data.get("kp_position", math.inf) * info.data.get("kd_position", math.inf)
    if ki > 0.0 and ki >= bound:
        raise ValueError(f"{ki:g} must be below kp_position times kd_position, {bound:g}")
    return ki


@dataclass(config=BLOCK)
class Gains:
    """Gains of the inverse-dynamics controllers.

    JointInverseDynamics uses `kp_position`, `kd_position` and `ki_position` for each joint, and
    `kd_stop`. CartesianInverseDynamics uses all gains.

    The gains scale accelerations: without contact, the error obeys e'' + kd e' + kp e = 0 for any
    inertia of the arm. The defaults are critically damped.
    """

    kp_position: float = Field(default=400.0, ge=0.0, le=1e5)
    """Proportional gain of the tool position [1/s^2]. Raising it reduces the tracking error."""
    kd_position: float = Field(default=40.0, ge=0.0, le=1e4)
    """Derivative gain of the tool position [1/s]. Raising it increases the damping."""
    ki_position: Annotated[float, AfterValidator(_check_stable)] = Field(
        default=1000.0, ge=0.0, le=1e6
    )
    """Integral gain of the tool position, below kp_position kd_position [1/s^3]; 0: no integral
    action. Raising it removes steady-state errors sooner, with more oscillation."""
    kp_orientation: float = Field(default=400.0, ge=0.0, le=1e5)
    """Proportional gain of the tool orientation [1/s^2]. Raising it reduces the tracking error."""
    kd_orientation: float = Field(default=40.0, ge=0.0, le=1e4)
    """Derivative gain of the tool orientation [1/s]. Raising it increases the damping."""
    kp_posture: float = Field(default=25.0, ge=0.0, le=1e5)
    """Proportional gain of the nominal posture in the null space of the task [1/s^2]. Raising it
    reduces the error of the posture."""
    kd_posture: float = Field(default=10.0, ge=0.0, le=1e4)
    """Derivative gain of the nominal posture in the null space of the task [1/s]. Raising it
    increases the damping."""
    max_effective_mass: float = Field(default=100.0, gt=0.0, le=1e12)
    """Effective mass of the tool above which the inverse of the Jacobian is damped, near
    singularities [kg]. Raising it tracks exactly closer to singularities, with faster joints."""
    rotation_length: float = Field(default=0.25, gt=0.0, le=10.0)
    """Length that converts angles to distances in comparisons of task directions [m]. Raising it
    gives rotations more weight."""
    kd_stop: float = Field(default=10.0, gt=0.0, le=1e4)
    """Joint damping while the control law cannot be evaluated [1/s]. Raising it stops the arm
    sooner."""


@dataclass(config=BLOCK)
class BasePose:
    """Pose X_WB of the robot's base link B in the world."""

    translation: Annotated[list[Annotated[float, Field(ge=-20.0, le=20.0)]], length(3)] = Field(
        default=[0.0, 0.0, 0.0]
    )
    """Position of the base link in the world [m]. Raising it moves the robot along the axis."""
    rpy: Angles = Field(default=[0.0, 0.0, 0.0])
    """Roll, pitch and yaw of the base link in the world [rad]."""


@dataclass(config=BLOCK)
class SphereParameters:
    """Accuracy of the spheres that cover the robot."""

    protrusion: float = Field(default=0.003, gt=0.0, le=0.1)
    """Approximate distance by which the spheres of a link protrude from its surface [m]. Raising it
    gives fewer spheres and less computation, but a thicker arm."""
    max_tool_protrusion: float = Field(default=0.004, gt=0.0, le=0.1)
    """Approximate distance by which spheres protrude from the tool and the grasped object [m].
    Raising it gives fewer spheres and a thicker tool."""
    max_fixed_protrusion: float = Field(default=0.02, gt=0.0, le=0.1)
    """Approximate distance by which spheres protrude from bodies that no joint moves [m]. Raising
    it gives fewer spheres and thicker bodies."""


@dataclass(config=BLOCK)
class Robot:
    """Serial arm of revolute joints with a tool. The defaults are those of the Panda."""

    model: str = "package://drake_oa/panda/panda_arm_hand.urdf"
    """Model of the robot: a package:// URL, or a file relative to the scenario. Drake's Panda is
    package://drake_models/franka_description/urdf/panda_arm_hand.urdf"""
    base_link: str = "panda_link0"
    """Name of the link that is welded to the world."""
    X_WB: BasePose = Field(default_factory=BasePose)
    """Pose of the base link B in the world."""
    hand_link: str = "panda_hand"
    """Name of the hand link H."""
    p_HE: Vector3 = Field(default=[0.0, 0.0, 0.1034])
    """Position of the tool point E in the frame of the hand link H [m]. Raising its z makes the
    tool longer."""
    tool_links: list[str] = Field(default=["panda_hand", "panda_leftfinger", "panda_rightfinger"])
    """Names of the bodies of the tool, which dilate the obstacles."""
    rpy_WE: Angles = Field(default=[math.pi, 0.0, math.pi / 2.0])
    """Roll, pitch and yaw of the tool frame E in the world unless the task changes them [rad]. The
    default points the tool down and opens the fingers along the world's x axis, so that the hand is
    narrow along the motion."""
    q_seed: list[float] = Field(default=[-0.7401, 0.1857, 0.0143, -1.9017, -0.003, 2.0874, 0.0608])
    """Configuration of the arm: seed of the inverse kinematics, and nominal posture in the null
    space [rad]. The arm's joints are the first joints of the model."""
    joint_speed: list[_Speed] | None = None
    """Maximum speed of each joint of the arm, in addition to the model's limits [rad/s]; null: the
    limits of the model. Raising it allows faster motions."""
    finger_opening: float = Field(default=0.005, ge=0.0, le=0.04)
    """Opening of each finger [m]. Raising it widens the hand. At a joint limit, 0 or the maximum,
    the simulation is slower."""
    carried: list[Annotated[Box | Cylinder | Sphere, Tagged()]] = Field(default_factory=list)
    """Shapes of the grasped object in the frame of the hand link H; the object is part of the tool.
    """
    carried_mass: float = Field(default=0.5, gt=0.0, le=20.0)
    """Mass of the grasped object, distributed by volume [kg]. Raising it increases the torques."""
    spheres: SphereParameters = Field(default_factory=SphereParameters)
    """Spheres that cover the robot for clearance computations."""
    gains: Gains = Field(default_factory=Gains)
    """Gains of the inverse-dynamics controller."""
