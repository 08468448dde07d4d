"""Model of the Panda: digest of the validated files, and the manufacturer's limits."""

from hashlib import sha256
from pathlib import Path

import numpy as np

import drake_oa.models
from drake_oa.robot.plant import RobotPlant

MODELS = Path(next(iter(drake_oa.models.__path__)))
FILES = ["panda/panda_arm_hand.urdf", "scenes/panda.dmd.yaml"]
CHECKED = "7b28c98a691b08f1b3c53f40b4bf5aec08a4f1fe9e5707d4d2ec20db519c2d80"
"""Digest of the validated files: collision shapes enclose the meshes to 1 mm (coarse ones to 5 mm),
and the dynamics are within 5.4 % and 0.2 N m of the identified ones."""


def test_files_equal_the_validated_ones() -> None:
    meshes = sorted((MODELS / "panda" / "meshes").glob("*.obj"))
    files = [*(MODELS / name for name in FILES), *meshes]
    assert sha256(b"".join(file.read_bytes() for file in files)).hexdigest() == CHECKED


def test_limits_and_reflected_inertia_equal_the_manufacturers(panda: RobotPlant) -> None:
    plant = panda.plant
    joints = [f"panda_joint{i}" for i in range(1, 8)]
    actuators = [plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices()]
    assert [one.joint().name() for one in actuators[:7]] == joints
    q_max = [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973, 0.04, 0.04]
    np.testing.assert_array_equal(plant.GetPositionUpperLimits(), q_max)
    v_max = [2.175] * 4 + [2.61] * 3 + [0.2] * 2
    np.testing.assert_array_equal(plant.GetVelocityUpperLimits(), v_max)
    a_max = [15, 7.5, 10, 12.5, 15, 20, 20]
    np.testing.assert_array_equal(plant.GetAccelerationUpperLimits()[:7], a_max)
    np.testing.assert_array_equal(plant.GetEffortUpperLimits()[:7], [87] * 4 + [12] * 3)
    reflected = [a.default_gear_ratio() ** 2 * a.default_rotor_inertia() for a in actuators[:7]]
    fr3 = [0.605721456] * 2 + [0.462474144] * 2 + [0.205544064] * 3
    np.testing.assert_allclose(reflected, fr3, rtol=1e-12)
