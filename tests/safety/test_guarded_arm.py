"""How the arm's joints move with its tool."""

import numpy as np
import pytest
from pydrake.multibody.tree import JacobianWrtVariable

from drake_oa.safety.guarded_arm import GuardedArm, full_speed_rates, tool_jacobian
from tests.planning.arms import ArmAlone

V_WE = np.array([0.0, 0.4, 0.0])


@pytest.mark.parametrize("seed", range(5))
def test_the_jacobian_is_that_of_the_plant(panda: ArmAlone, guarded: GuardedArm, seed: int) -> None:
    random = np.random.default_rng(seed)
    plant, q = panda.robot.plant, panda.q_full.copy()
    q[:7] = panda.random_q(random)
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    tool, world = panda.robot.tool_frame, plant.world_frame()
    J = plant.CalcJacobianSpatialVelocity(
        context, JacobianWrtVariable.kV, tool, np.zeros(3), world, world
    )[:, :7]
    x = np.concatenate([q, random.normal(size=9)])
    positions, velocities = guarded.split(x)
    np.testing.assert_array_equal(positions, q[:7])
    np.testing.assert_array_equal(velocities, x[9:16])
    np.testing.assert_allclose(tool_jacobian(guarded.chain, positions), J, atol=1e-9)


def test_at_full_speed_the_tool_goes_as_the_policy_wants(
    panda: ArmAlone, guarded: GuardedArm
) -> None:
    J, v = tool_jacobian(guarded.chain, panda.q), np.random.default_rng(0).normal(size=7) * 0.2
    found = full_speed_rates(J, v, V_WE, 1e-9)
    np.testing.assert_allclose(J @ found, [0.0, 0.0, 0.0, *V_WE], atol=1e-6)
    # And in the null space as it does.
    free = np.linalg.svd(J)[2][6:]
    np.testing.assert_allclose(free @ found, free @ v, atol=1e-9)
