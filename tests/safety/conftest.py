"""The arm that is kept safe; its spheres cost a second."""

import pytest

from drake_oa.robot.config import Robot, SphereParameters
from tests.planning.arms import ArmAlone, arm_alone

COARSE = SphereParameters(protrusion=0.015, max_tool_protrusion=0.012, max_fixed_protrusion=0.03)


@pytest.fixture(scope="session")
def panda() -> ArmAlone:
    """The Panda, coarsely; not to be changed."""
    return arm_alone(Robot(spheres=COARSE))
