"""Configuration of the robot: a scenario's field `robot`."""

import math
from typing import Annotated

from pydantic import AfterValidator, Field, ValidationInfo
from pydantic.dataclasses import dataclass

from drake_oa.common.config import BLOCK, Angles, Tagged, Vector3, length
from drake_oa.geometry.shapes import Box, Cylinder, Sphere

_Speed = Annotated[float, Field(gt=0.0, le=100.0)]


def _check_stable(ki: float, info: ValidationInfo) -> float:
    """Checks an integral gain; the control error e obeys de'/dt + kd e' + kp e + ki int e = 0."""
    bound = info.data.get("kp_position", math.inf) * info.data.get("kd_position", math.inf)
    if ki > 0.0 and ki >= bound:
        raise ValueError(f"{ki:g} must be below kp_position times kd_position, {bound:g}")
    return ki


@dataclass(config=BLOCK)
class Gains:
    """Gains of the inverse-dynamics controllers.

    JointInverseDynamics uses `kp_position`, `kd_position` and `ki_position` for each joint, and
    `kd_stop`; CartesianInverseDynamics uses all.

    Stiffness and damping multiply accelerations, so the error of a free tool obeys
    e'' + kd e' + kp e = 0 for any inertia of the arm; the defaults are critically damped.
    """

    kp_position: float = Field(default=400.0, ge=0.0, le=1e5)
    """Proportional gain of the tool position [1/s^2]. Raising it tracks more stiffly."""
    kd_position: float = Field(default=40.0, ge=0.0, le=1e4)
    """Derivative gain of the tool position [1/s]. Raising it damps more."""
    ki_position: Annotated[float, AfterValidator(_check_stable)] = Field(
        default=1000.0, ge=0.0, le=1e6
    )
    """Integral gain of the tool position, less than kp kd [1/s^3]; 0: none. Raising it removes
    steady errors sooner and oscillates more."""
    kp_orientation: float = Field(default=400.0, ge=0.0, le=1e5)
    """Proportional gain of the tool orientation [1/s^2]. Raising it tracks more stiffly."""
    kd_orientation: float = Field(default=40.0, ge=0.0, le=1e4)
    """Derivative gain of the tool orientation [1/s]. Raising it damps more."""
    kp_posture: float = Field(default=25.0, ge=0.0, le=1e5)
    """Proportional gain of the posture in the null space of the task [1/s^2]. Raising it tracks the
    posture more stiffly."""
    kd_posture: float = Field(default=10.0, ge=0.0, le=1e4)
    """Derivative gain of the posture in the null space of the task [1/s]. Raising it damps more."""
    max_effective_mass: float = Field(default=100.0, gt=0.0, le=1e12)
    """Effective mass above which the inverse is damped, near singularities [kg]. Raising it tracks
    exactly closer to singularities."""
    rotation_length: float = Field(default=0.25, gt=0.0, le=10.0)
    """Length that converts angles to distances when directions of the task are compared [m].
    Raising it gives rotations more weight."""
    kd_stop: float = Field(default=10.0, gt=0.0, le=1e4)
    """Joint damping while the control law cannot be evaluated [1/s]. Raising it stops sooner."""


@dataclass(config=BLOCK)
class BasePose:
    """Pose X_WB of the base link in the world."""

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
    """Distance by which spheres of the links exceed the links' surface, approximately [m]. Raising
    it needs fewer spheres and less time, and makes the arm thicker."""
    max_tool_protrusion: float = Field(default=0.004, gt=0.0, le=0.1)
    """The distance `protrusion` for the tool and the grasped object [m]. Raising it needs fewer
    spheres and makes the tool thicker."""
    max_fixed_protrusion: float = Field(default=0.02, gt=0.0, le=0.1)
    """The distance `protrusion` for bodies that no joint moves [m]. Raising it needs fewer spheres
    and makes those bodies thicker."""


@dataclass(config=BLOCK)
class Robot:
    """A serial arm of revolute joints that carries the tool. The defaults are the Panda's."""

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
    """Positions of the arm's joints, which are the first of the model: initial guess of the inverse
    kinematics and posture of the null space [rad]."""
    joint_speed: list[_Speed] | None = None
    """Maximum speed of each joint of the arm where it is below that of the model or the model has
    none [rad/s]; null: that of the model. Raising it moves faster."""
    finger_opening: float = Field(default=0.005, ge=0.0, le=0.04)
    """Opening of each finger [m]. At a joint limit the simulation is slower."""
    carried: list[Annotated[Box | Cylinder | Sphere, Tagged()]] = Field(default_factory=list)
    """Shapes of the grasped object, which is part of the tool, in the frame of the hand link H."""
    carried_mass: float = Field(default=0.5, gt=0.0, le=20.0)
    """Mass of the grasped object, distributed by volume [kg]. Raising it needs more torque."""
    spheres: SphereParameters = Field(default_factory=SphereParameters)
    """Spheres that cover the robot for clearance computations."""
    gains: Gains = Field(default_factory=Gains)
    """Gains of the controller."""
