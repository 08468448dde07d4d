"""Arms as planning takes them; their spheres cost a second."""

import pytest

from drake_oa.robot.config import Robot
from tests.diagrams.six_arm import arm_text
from tests.planning.arms import ArmAlone, arm_alone


@pytest.fixture(scope="session")
def panda_arm() -> ArmAlone:
    """The Panda; not to be changed."""
    return arm_alone(Robot())


@pytest.fixture(scope="session")
def six_arm(tmp_path_factory: pytest.TempPathFactory) -> ArmAlone:
    """An arm of six joints without fingers; not to be changed."""
    file = tmp_path_factory.mktemp("six") / "six.urdf"
    file.write_text(arm_text())
    return arm_alone(
        Robot(
            model=str(file),
            base_link="foot",
            hand_link="wrist3",
            p_HE=[0.0, 0.0, 0.1],
            tool_links=["wrist3"],
            q_seed=[0.3, -1.5708, 1.5708, -1.5708, -1.5708, 0.0],
        )
    )


@pytest.fixture(params=["panda_arm", "six_arm"])
def arm(request: pytest.FixtureRequest) -> ArmAlone:
    """Each of the two."""
    return request.getfixturevalue(request.param)
