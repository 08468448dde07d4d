"""The action layer alone."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator

from drake_oa.common.messages import CouplingParameters, EllipsoidSet, FloatArray
from drake_oa.policy.dmp import imitate, minimum_jerk
from drake_oa.policy.dmp_integrator import DmpIntegrator
from tests.builders import balls, read

START, GOAL = np.array([0.0, 0.0, 0.3]), np.array([1.0, 0.0, 0.3])
STRONG = CouplingParameters(*np.array([[100.0], [0.9], [5.0]]), np.ones(1, dtype=bool))
SEEN = balls((0.5, 0.02, 0.3), radius=0.05, stamp=np.inf)


@pytest.fixture
def system() -> DmpIntegrator:
    return DmpIntegrator(imitate(*minimum_jerk(START, GOAL, duration=1.0)), START)


def simulator(system: DmpIntegrator, goal: FloatArray = GOAL, **inputs: object) -> Simulator:
    found = Simulator(system)
    context = found.get_mutable_context()
    system.GetInputPort("goal").FixValue(context, goal)
    for name, value in inputs.items():
        system.GetInputPort(name).FixValue(context, Value(value))
    return found


def test_without_obstacles_it_is_the_planned_motion(system: DmpIntegrator) -> None:
    run = simulator(system)
    context = run.get_context()
    np.testing.assert_array_equal(read(system, context, "desired_position"), START)
    run.AdvanceTo(0.5)
    place, velocity = (read(system, context, f"desired_{n}") for n in ("position", "velocity"))
    np.testing.assert_allclose(place, [0.5, 0.0, 0.3], atol=1e-3)
    # Minimum jerk: 1.875 m/s half way.
    np.testing.assert_allclose(velocity, [1.875, 0, 0], atol=1e-2)
    run.AdvanceTo(1.05)
    np.testing.assert_allclose(read(system, context, "desired_position"), GOAL, atol=1e-3)
    assert read(system, context, "phase")[0] == pytest.approx(0.01**1.045, rel=0.03)


def test_the_coupling_bends_it_around_the_obstacle(system: DmpIntegrator) -> None:
    run = simulator(system, ellipsoids_W=SEEN, coupling_parameters=STRONG)
    places = []
    for time in np.arange(0.05, 1.2, 0.05):
        run.AdvanceTo(time)
        places.append(read(system, run.get_context(), "desired_position"))
    assert np.min(places, axis=0)[1] < -0.05
    np.testing.assert_allclose(places[-1], GOAL, atol=1e-2)
    # A change on a port counts from the next step.
    port = system.GetInputPort("coupling_parameters")
    port.FixValue(run.get_mutable_context(), Value(replace(STRONG, alpha=np.array([-1.0]))))
    with pytest.raises(ValueError, match="alpha, psi, kappa must be"):
        run.AdvanceTo(1.2)


def test_it_holds_without_observation_and_logs_it(
    system: DmpIntegrator, caplog: pytest.LogCaptureFixture
) -> None:
    run = simulator(system, ellipsoids_W=EllipsoidSet())
    with caplog.at_level(logging.WARNING, "drake_oa"):
        run.AdvanceTo(0.6)
        np.testing.assert_allclose(read(system, run.get_context(), "desired_velocity"), 0.0)
        # Once seen it goes on.
        port = system.GetInputPort("ellipsoids_W")
        port.FixValue(run.get_mutable_context(), Value(EllipsoidSet(stamp=np.inf)))
        run.AdvanceTo(2.0)
    messages = [record.getMessage().split(": ", 1)[1] for record in caplog.records]
    assert messages == ["held: no observation yet", "running again"]
    np.testing.assert_allclose(read(system, run.get_context(), "desired_position"), GOAL, atol=1e-3)


def test_a_goal_at_the_start_is_refused(system: DmpIntegrator) -> None:
    with pytest.raises(ValueError, match="start and goal must be finite and apart"):
        simulator(system, START).Initialize()


def test_a_speed_scale_slows_holds_and_lets_go_on(
    system: DmpIntegrator, caplog: pytest.LogCaptureFixture
) -> None:
    run = simulator(system)
    port, context = system.GetInputPort("speed_scale"), run.get_mutable_context()
    with caplog.at_level(logging.WARNING, "drake_oa"):
        for until, scale in ((1.0, 0.5), (2.0, 0.0), (4.0, 1.0)):
            port.FixValue(context, np.array([scale]))
            run.AdvanceTo(until)
            policy = system.GetOutputPort("policy_state").Eval(context)
            if scale == 0.5:
                # Half the way in the whole duration, less what the ramp took in advance.
                assert 0.4 < policy.p_WE[0] < 0.8
            if scale == 0.0:
                assert (policy.speed, policy.note) == (0.0, "speed_scale is 0")
    # The system that scales it logs it.
    assert caplog.messages == []
    np.testing.assert_allclose(read(system, context, "desired_position"), GOAL, atol=1e-3)
