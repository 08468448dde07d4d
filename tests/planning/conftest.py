"""Fixture with the arm of the planning tests, computed once per session."""

import pytest

from drake_oa.robot.config import Robot
from tests.planning.arms import ArmAlone, make_arm


@pytest.fixture(scope="session")
def panda_arm() -> ArmAlone:
    """Panda arm; shared by all tests, not to be modified."""
    return make_arm(Robot())
