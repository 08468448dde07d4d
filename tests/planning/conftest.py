"""The arm as planning takes it; its spheres cost a second."""

import pytest

from drake_oa.robot.config import Robot
from tests.planning.arms import ArmAlone, arm_alone


@pytest.fixture(scope="session")
def panda_arm() -> ArmAlone:
    """The Panda; not to be changed."""
    return arm_alone(Robot())
