"""Tests of `DmpIntegrator` without a diagram."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator

from drake_oa.common.messages import CouplingParameters, FloatArray
from drake_oa.policy.dmp import imitate, minimum_jerk
from drake_oa.policy.dmp_integrator import DmpIntegrator
from tests.builders import balls, read

START, GOAL = np.array([0.0, 0.0, 0.3]), np.array([1.0, 0.0, 0.3])
STRONG = CouplingParameters(*np.array([[100.0], [0.9], [5.0]]), np.ones(1, dtype=bool))
BALL = balls((0.5, 0.02, 0.3), radius=0.05, stamp=np.inf)


@pytest.fixture
def system() -> DmpIntegrator:
    return DmpIntegrator(imitate(*minimum_jerk(START, GOAL, duration=1.0)), START)


def simulator(system: DmpIntegrator, goal: FloatArray = GOAL, **inputs: object) -> Simulator:
    """Returns a simulator of the system with values at its input ports."""
    result = Simulator(system)
    context = result.get_mutable_context()
    system.GetInputPort("goal").FixValue(context, goal)
    for name, value in inputs.items():
        system.GetInputPort(name).FixValue(context, Value(value))
    return result


def test_the_coupling_term_steers_around_the_obstacle(system: DmpIntegrator) -> None:
    run = simulator(system, ellipsoids_W=BALL, coupling_parameters=STRONG)
    positions = []
    for time in np.arange(0.05, 1.2, 0.05):
        run.AdvanceTo(time)
        positions.append(read(system, run.get_context(), "desired_position"))
    assert np.min(positions, axis=0)[1] < -0.05
    np.testing.assert_allclose(positions[-1], GOAL, atol=1e-2)
    # A changed input acts from the next step.
    port = system.GetInputPort("coupling_parameters")
    port.FixValue(run.get_mutable_context(), Value(replace(STRONG, alpha=np.array([-1.0]))))
    with pytest.raises(ValueError, match="alpha, psi, kappa must be"):
        run.AdvanceTo(1.2)


def test_a_goal_at_the_start_is_refused(system: DmpIntegrator) -> None:
    with pytest.raises(ValueError, match="start and goal must be finite and apart"):
        simulator(system, START).Initialize()
