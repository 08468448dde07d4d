"""Arms as planning takes them; their spheres cost a second."""

import pytest

from drake_oa.robot.config import Robot
from tests.diagrams.six_arm import six_robot
from tests.planning.arms import ArmAlone, arm_alone


@pytest.fixture(scope="session")
def panda_arm() -> ArmAlone:
    """The Panda; not to be changed."""
    return arm_alone(Robot())


@pytest.fixture(scope="session")
def six_arm(tmp_path_factory: pytest.TempPathFactory) -> ArmAlone:
    """An arm of six joints without fingers; not to be changed."""
    return arm_alone(six_robot(tmp_path_factory.mktemp("six")))


@pytest.fixture(params=["panda_arm", "six_arm"])
def arm(request: pytest.FixtureRequest) -> ArmAlone:
    """Each of the two."""
    return request.getfixturevalue(request.param)
