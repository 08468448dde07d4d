"""The arm that is kept safe; its spheres cost a second."""

import pytest

from drake_oa.robot.config import Robot, SphereParameters
from drake_oa.safety.joint_motions import GuardedArm, make_guarded_arm
from tests.planning.arms import ArmAlone, arm_alone

COARSE = SphereParameters(overshoot=0.015, tool_overshoot=0.012, fixed_overshoot=0.03)


@pytest.fixture(scope="session")
def panda() -> ArmAlone:
    """The Panda, coarsely; not to be changed."""
    return arm_alone(Robot(spheres=COARSE))


@pytest.fixture(scope="session")
def guarded(panda: ArmAlone) -> GuardedArm:
    """The same as safety takes it."""
    return make_guarded_arm(panda.robot, panda.chain, panda.covered)
