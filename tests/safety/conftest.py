"""Fixture with the arm of the safety tests, computed once per session."""

import pytest

from drake_oa.robot.config import Robot, SphereParameters
from tests.planning.arms import ArmAlone, make_arm

COARSE = SphereParameters(protrusion=0.015, max_tool_protrusion=0.012, max_fixed_protrusion=0.03)


@pytest.fixture(scope="session")
def panda() -> ArmAlone:
    """Panda arm with coarse spheres; shared by all tests, not to be modified."""
    return make_arm(Robot(spheres=COARSE))
