"""Configuration block of the robot, which is the field `robot` of a scenario."""

import math
from typing import Annotated

from pydantic import AfterValidator, Field, ValidationInfo
from pydantic.dataclasses import dataclass

from drake_oa.common.config import BLOCK, Angles, Tagged, Vector3, length
from drake_oa.geometry.shapes import Box, Cylinder, Sphere

_Speed = Annotated[float, Field(gt=0.0, le=100.0)]
"""Type of the maximum speed of a revolute joint, above 0 and at most 100 [rad/s]."""


def _check_stable(ki: float, info: ValidationInfo) -> float:
    """Checks that the integral gain of a controller is 0 or below the product of kp_position and
    kd_position, so that the tracking error decays.

    The error e obeys e'' + kd e' + kp e + ki int e dt = 0, with the position gains kp and kd.

    Args:
        ki: integral gain [1/s^3].
        info: values of the preceding fields of `Gains`, already validated.

    Returns:
        The integral gain, unchanged.

    Raises:
        ValueError: if the error would not decay.
    """
    bound = info.data.get("kp_position", math.inf) * info.data.get("kd_position", math.inf)
    if ki > 0.0 and ki >= bound:
        raise ValueError(f"{ki:g} must be below kp_position times kd_position, {bound:g}")
    return ki


@dataclass(config=BLOCK)
class Gains:
    """Gains of the inverse-dynamics controllers, which track the desired motion of the arm.

    JointInverseDynamics, the default controller, uses `kp_position`, `kd_position` and
    `ki_position` for each joint, and `kd_stop`. CartesianInverseDynamics, which tracks the pose of
    the tool, uses all gains.

    The gains scale accelerations: without contact, the tracking error e obeys e'' + kd e' + kp e =
    0 for any inertia of the arm. The defaults are critically damped.
    """

    kp_position: float = Field(default=400.0, ge=0.0, le=1e5)
    """Proportional gain of the position error: of each joint in JointInverseDynamics, of the tool
    in CartesianInverseDynamics [1/s^2]. Raising it reduces the tracking error."""
    kd_position: float = Field(default=40.0, ge=0.0, le=1e4)
    """Derivative gain of the position error: of each joint in JointInverseDynamics, of the tool in
    CartesianInverseDynamics [1/s]. Raising it increases the damping."""
    ki_position: Annotated[float, AfterValidator(_check_stable)] = Field(
        default=1000.0, ge=0.0, le=1e6
    )
    """Integral gain of the position error: of each joint in JointInverseDynamics, of the tool in
    CartesianInverseDynamics [1/s^3]. It must be 0 (no integral action) or below kp_position times
    kd_position. Raising it removes steady-state errors sooner, with more oscillation."""
    kp_orientation: float = Field(default=400.0, ge=0.0, le=1e5)
    """Proportional gain of the tool's orientation error [1/s^2]. Raising it reduces the tracking
    error."""
    kd_orientation: float = Field(default=40.0, ge=0.0, le=1e4)
    """Derivative gain of the tool's orientation error [1/s]. Raising it increases the damping."""
    kp_posture: float = Field(default=25.0, ge=0.0, le=1e5)
    """Proportional gain of the error from the nominal posture, in the null space of the tool's
    motion [1/s^2]. Raising it reduces this error."""
    kd_posture: float = Field(default=10.0, ge=0.0, le=1e4)
    """Derivative gain of the error from the nominal posture, in the null space of the tool's motion
    [1/s]. Raising it increases the damping."""
    max_effective_mass: float = Field(default=100.0, gt=0.0, le=1e12)
    """Limit of the tool's effective mass [kg]. In a direction of larger effective mass, the force
    that accelerates the tool is damped. The effective mass grows near singularities. Raising the
    limit gives exact tracking closer to singularities, with faster joints."""
    rotation_length: float = Field(default=0.25, gt=0.0, le=10.0)
    """Length that converts rotations of the tool to distances, so that `max_effective_mass` applies
    to rotations, too [m]. Raising it gives exact tracking of rotations closer to singularities."""
    kd_stop: float = Field(default=10.0, gt=0.0, le=1e4)
    """Damping of each joint that brakes the arm while an input of the controller is not finite, so
    that the control law gives no finite torques [1/s]. Raising it stops the arm sooner."""


@dataclass(config=BLOCK)
class BasePose:
    """Configuration block of the pose X_WB of the robot's base link B in the world."""

    translation: Annotated[list[Annotated[float, Field(ge=-20.0, le=20.0)]], length(3)] = Field(
        default=[0.0, 0.0, 0.0]
    )
    """Position of the base link in the world [m]."""
    rpy: Angles = Field(default=[0.0, 0.0, 0.0])
    """Roll, pitch and yaw of the base link in the world [rad]."""


@dataclass(config=BLOCK)
class SphereParameters:
    """Configuration block of the spheres that cover the robot. They replace the robot's shapes when
    clearances are computed, and protrude from them.
    """

    protrusion: float = Field(default=0.003, gt=0.0, le=0.1)
    """Approximate distance by which the covering spheres of a link protrude from the link's surface
    [m]. Raising it gives fewer spheres and less computation, but a thicker arm."""
    max_tool_protrusion: float = Field(default=0.004, gt=0.0, le=0.1)
    """Approximate distance by which covering spheres protrude from the surfaces of the tool and the
    grasped object [m]. Raising it gives fewer spheres, but a thicker tool."""
    max_fixed_protrusion: float = Field(default=0.02, gt=0.0, le=0.1)
    """Approximate distance by which covering spheres protrude from the surfaces of bodies that no
    joint moves [m]. Raising it gives fewer spheres, but thicker bodies."""


@dataclass(config=BLOCK)
class Robot:
    """Configuration block of a robot: a serial arm of revolute joints with a tool. The defaults are
    those of the Panda.
    """

    model: str = "package://drake_oa/panda/panda_arm_hand.urdf"
    """Model file of the robot: a package:// URL, or a file name relative to the scenario's folder.
    The Panda that Drake provides is
    package://drake_models/franka_description/urdf/panda_arm_hand.urdf"""
    base_link: str = "panda_link0"
    """Name of the base link B in the model, which is welded to the world."""
    X_WB: BasePose = Field(default_factory=BasePose)
    """Pose of the base link B in the world."""
    hand_link: str = "panda_hand"
    """Name of the hand link H in the model, to which the tool point and the grasped object are
    fixed."""
    p_HE: Vector3 = Field(default=[0.0, 0.0, 0.1034])
    """Position of the tool point E in the frame of the hand link H [m]. For the Panda, a larger z
    moves the tool point farther from the hand."""
    tool_links: list[str] = Field(default=["panda_hand", "panda_leftfinger", "panda_rightfinger"])
    """Names of the links that form the tool. Obstacles are dilated by the extents of these links,
    so that the tool counts as a point."""
    rpy_WE: Angles = Field(default=[math.pi, 0.0, math.pi / 2.0])
    """Roll, pitch and yaw of the tool frame E in the world, unless the task gives other
    orientations [rad]. By default the tool points down, and the fingers open along the world's x
    axis, so that the hand is narrow along the world's y axis."""
    q_seed: list[float] = Field(default=[-0.7401, 0.1857, 0.0143, -1.9017, -0.003, 2.0874, 0.0608])
    """Configuration of the arm [rad], used as the initial guess of the inverse kinematics and as
    the nominal posture, which the arm approaches in the null space of the tool's motion. The joints
    of the arm are the first joints of the model."""
    joint_speed: list[_Speed] | None = None
    """Maximum speed of each joint of the arm, which may only reduce the limit of the model [rad/s];
    null: the limits of the model. Raising it allows faster motions."""
    finger_opening: float = Field(default=0.005, ge=0.0, le=0.04)
    """Position of each finger joint of the hand, at which the fingers are held [m]. Raising it
    widens the hand. At a limit of the finger joints (0 or 0.04 m for the Panda), the simulation is
    slower."""
    carried: list[Annotated[Box | Cylinder | Sphere, Tagged()]] = Field(default_factory=list)
    """Primitive shapes of an object that the robot has grasped, in the frame of the hand link H.
    The object counts as part of the tool; empty: no object."""
    carried_mass: float = Field(default=0.5, gt=0.0, le=20.0)
    """Mass of the grasped object, distributed over its shapes by volume [kg]. Raising it increases
    the joint torques."""
    spheres: SphereParameters = Field(default_factory=SphereParameters)
    """Accuracy of the spheres that cover the robot. They replace its shapes when clearances are
    computed."""
    gains: Gains = Field(default_factory=Gains)
    """Gains of the inverse-dynamics controller, which tracks the desired motion."""
