"""The `robot` block of a scenario: model, tool, gains and posture."""

import dataclasses as dc
import math
from itertools import pairwise

from drake_oa.common.config import ScenarioError, roll_pitch_yaw
from drake_oa.common.config import count as _count
from drake_oa.common.config import number as _number
from drake_oa.common.config import vector as _vector
from drake_oa.geometry.shapes import Box, Cylinder, Sphere

_FASTEST = 100.0
"""Of a joint's greatest speeds the greatest that is meant [rad/s]."""


@dc.dataclass
class Gains:
    """Gains of the operational-space law.

    Stiffness and damping act on accelerations, so the error of a free tool obeys
    e'' + kd e' + kp e = 0 whatever the arm's inertia; the defaults are critically damped.
    """

    # Position [1/s^2] and [1/s].
    kp_position: float = _number(400.0, "1/s^2", 0.0, 1e5)
    kd_position: float = _number(40.0, "1/s", 0.0, 1e4)
    # Of the position error's integral, below kp kd; 0: none [1/s^3].
    ki_position: float = _number(1000.0, "1/s^3", 0.0, 1e6)
    # Orientation.
    kp_orientation: float = _number(400.0, "1/s^2", 0.0, 1e5)
    kd_orientation: float = _number(40.0, "1/s", 0.0, 1e4)
    # Posture, in the null space of the task.
    kp_posture: float = _number(25.0, "1/s^2", 0.0, 1e5)
    kd_posture: float = _number(10.0, "1/s", 0.0, 1e4)
    # Away from a joint limit nearer than the margin, in the null space; 0: none.
    kp_limit: float = _number(100.0, "1/s^2", 0.0, 1e5)
    limit_margin: float = _number(0.1, "rad", 0.0, math.pi)
    # Heaviest direction of the task that is still driven exactly; beyond it the arm is near
    # singular and the inverse damped.
    max_effective_mass: float = _number(100.0, "kg", 0.0, 1e12, open_low=True)
    # Length by which angles are weighed against distances when directions are compared.
    rotation_length: float = _number(0.25, "m", 0.0, 10.0, open_low=True)
    # Damping of all joints when the law cannot be followed.
    kd_stop: float = _number(10.0, "1/s", 0.0, 1e4, open_low=True)


@dc.dataclass
class BasePose:
    """Where the base link stands in the world, X_WB."""

    translation: list[float] = _vector([0.0, 0.0, 0.0], "m", within=20.0)
    # Roll, pitch, yaw.
    rpy: list[float] = roll_pitch_yaw([0.0, 0.0, 0.0])


def _of(*values: float) -> list[float]:
    return dc.field(default_factory=lambda: list(values), metadata={"unit": "m"})


@dc.dataclass
class Annulus:
    """Where the tool point is in reach about the axis of an upright base, the tool pointing down.

    The default is that of the default arm. Outer: the extended arm. Inner: 4 cm or more outside
    where the folded arm (joints 3 and 5 at zero) meets a joint limit.
    """

    # Heights above the base, increasing, and the radii there; between them they are linear.
    height: list[float] = _of(-0.2, -0.1, 0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
    inner: list[float] = _of(0.30, 0.30, 0.30, 0.33, 0.32, 0.23, 0.15, 0.15, 0.15, 0.15, 0.15)
    outer: list[float] = _of(0.72, 0.76, 0.78, 0.80, 0.79, 0.78, 0.74, 0.68, 0.60, 0.50, 0.32)


@dc.dataclass
class SphereParameters:
    """How near the spheres that stand for the robot fit, and how pairs that may touch are found."""

    # How far the spheres of the arm's links stick out of them, about; those of the tool, and of
    # what it holds; and those of what no joint moves, that only the arm comes near to. Less takes
    # more of them, and time [m].
    overshoot: float = _number(0.003, "m", 0.0, 0.1, open_low=True)
    tool_overshoot: float = _number(0.004, "m", 0.0, 0.1, open_low=True)
    fixed_overshoot: float = _number(0.02, "m", 0.0, 0.1, open_low=True)
    # Random postures within the joints' limits in which pairs of bodies that may touch are found,
    # and their seed.
    postures: int = _count(2000, 1, 1_000_000)
    seed: int = _count(0, 0, 2**31)


@dc.dataclass
class Robot:
    """The arm that carries the tool: revolute joints in a row. The defaults are the Panda's."""

    # URL, or a file that is looked for beside the scenario. Drake's own Panda is
    # package://drake_models/franka_description/urdf/panda_arm_hand.urdf
    model: str = "package://drake_oa/panda/panda_arm_hand.urdf"
    # The base link is welded to the world in this pose.
    base_link: str = "panda_link0"
    X_WB: BasePose = dc.field(default_factory=BasePose)
    # The tool point E is p_HE in the frame of the hand link H.
    hand_link: str = "panda_hand"
    p_HE: list[float] = _vector([0.0, 0.0, 0.1034], "m")
    # Bodies that make up the tool: they dilate the obstacles.
    tool_links: list[str] = dc.field(
        default_factory=lambda: ["panda_hand", "panda_leftfinger", "panda_rightfinger"]
    )
    # Orientation of E, held throughout where the task does not turn it: roll,
    # pitch, yaw [rad]. Tool down, fingers opening along the world's x: the hand is narrow along
    # the motion.
    rpy_WE: list[float] = roll_pitch_yaw([math.pi, 0.0, math.pi / 2.0])
    # Seed of the inverse kinematics and posture of the null space, a number for each joint of the
    # arm: these are the first of the model's joints [rad].
    q_seed: list[float] = dc.field(
        default_factory=lambda: [-0.7401, 0.1857, 0.0143, -1.9017, -0.003, 2.0874, 0.0608],
        metadata={"unit": "rad"},
    )
    # Greatest speed of each joint of the arm, where it is less than the model's or the model has
    # none; null: the model's [rad/s].
    joint_speed: list[float] | None = dc.field(default=None, metadata={"unit": "rad/s"})
    # Opening of each finger [m]. At a joint's limit the plant's steps cost more.
    finger_opening: float = _number(0.005, "m", 0.0, 0.04)
    # What the hand holds, posed in the frame of the hand link H; part of the tool.
    carried: list[Box | Cylinder | Sphere] = dc.field(default_factory=list)
    # Mass of all of it, shared out by volume [kg].
    carried_mass: float = _number(0.5, "kg", 0.0, 20.0, open_low=True)
    # What stands for it where its distance to things is asked.
    spheres: SphereParameters = dc.field(default_factory=SphereParameters)
    gains: Gains = dc.field(default_factory=Gains)
    # Null, or the default left to another model or tool point: found from what the arm reaches.
    annulus: Annulus | None = dc.field(default_factory=Annulus)


def check_robot(robot: Robot) -> None:
    """What no single field can tell.

    Raises:
        ScenarioError: naming the field.
    """
    for row, speed in enumerate(robot.joint_speed or ()):
        if not 0.0 < speed <= _FASTEST:
            raise ScenarioError(
                f"robot.joint_speed[{row}]: {speed:g} is outside (0, {_FASTEST:g}] [rad/s]"
            )
    if robot.annulus is None:
        return
    height, inner, outer = (getattr(robot.annulus, name) for name in ("height", "inner", "outer"))
    if not 2 <= len(height) == len(inner) == len(outer):
        raise ScenarioError(
            "robot.annulus: height, inner and outer must have the same number of values, 2 or "
            f"more, not {len(height)}, {len(inner)} and {len(outer)}"
        )
    if any(high <= low for low, high in pairwise(height)):
        raise ScenarioError(f"robot.annulus.height: must increase [m], not {height}")
    for row, (least, most) in enumerate(zip(inner, outer, strict=True)):
        if not 0.0 <= least < most:
            raise ScenarioError(
                f"robot.annulus.inner[{row}]: {least:g} is outside [0, {most:g}), up to outer [m]"
            )
