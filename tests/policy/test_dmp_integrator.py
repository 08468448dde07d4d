"""The action layer alone."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator

from drake_oa.common.messages import (
    CouplingParameters,
    EllipsoidSet,
    FloatArray,
    PolicyState,
    Route,
)
from drake_oa.policy.config import Policy
from drake_oa.policy.dmp import imitate, minimum_jerk
from drake_oa.policy.dmp_integrator import DmpIntegrator
from tests.builders import balls, read

START, GOAL = np.array([0.0, 0.0, 0.3]), np.array([1.0, 0.0, 0.3])


def make_system() -> DmpIntegrator:
    return DmpIntegrator(imitate(*minimum_jerk(START, GOAL, duration=1.0)), START)


def ellipsoids(count: int = 1) -> EllipsoidSet:
    return balls(*[(0.5, 0.02, 0.3)] * count, radius=0.05, stamp=np.inf)


def simulator(system: DmpIntegrator, goal: FloatArray = GOAL, **inputs: object) -> Simulator:
    found = Simulator(system)
    context = found.get_mutable_context()
    system.GetInputPort("goal").FixValue(context, goal)
    for name, value in inputs.items():
        system.GetInputPort(name).FixValue(context, Value(value))
    return found


def test_without_obstacles_it_is_the_planned_motion() -> None:
    system = make_system()
    run = simulator(system)
    run.AdvanceTo(0.5)
    context = run.get_context()
    np.testing.assert_allclose(
        read(system, context, "desired_position"), [0.5, 0.0, 0.3], atol=1e-3
    )
    # Minimum jerk: 1.875 m/s half way.
    np.testing.assert_allclose(read(system, context, "desired_velocity"), [1.875, 0, 0], atol=1e-2)
    run.AdvanceTo(1.05)
    np.testing.assert_allclose(read(system, context, "desired_position"), GOAL, atol=1e-3)
    assert read(system, context, "phase")[0] == pytest.approx(0.01**1.045, rel=0.03)


def test_it_starts_at_rest_at_the_start() -> None:
    system = make_system()
    context = system.CreateDefaultContext()
    np.testing.assert_array_equal(read(system, context, "desired_position"), START)
    assert not read(system, context, "desired_velocity").any()
    assert not read(system, context, "desired_acceleration").any()


def test_the_desired_motion_is_smooth_between_steps() -> None:
    system = make_system()
    run = simulator(system)
    places = []
    for time in np.arange(0.4, 0.45, 0.001):
        run.AdvanceTo(time)
        places.append(read(system, run.get_context(), "desired_position")[0])
    advance = np.diff(places)
    assert advance.min() > 0.0015
    assert np.abs(np.diff(advance)).max() < 2e-5


def test_the_coupling_bends_it_round_the_obstacle() -> None:
    system = make_system()
    strong = CouplingParameters(
        np.array([100.0]), np.array([0.9]), np.array([5.0]), np.ones(1, dtype=bool)
    )
    run = simulator(system, ellipsoids_W=ellipsoids(), coupling_parameters=strong)
    places = []
    for time in np.arange(0.05, 1.2, 0.05):
        run.AdvanceTo(time)
        places.append(read(system, run.get_context(), "desired_position"))
    assert np.min(places, axis=0)[1] < -0.05
    np.testing.assert_allclose(places[-1], GOAL, atol=1e-2)


def test_the_decision_is_led_by_from_where_the_motion_is() -> None:
    parameters = CouplingParameters(
        np.array([300.0]), np.array([0.7]), np.array([5.0]), np.ones(1, dtype=bool)
    )
    # The obstacle's centre lies to the left: by itself the motion would pass on the right.
    left = Route(
        direction_W=np.array([[0.0, 1.0, 0.0]]),
        normal_W=np.array([[0.0, 0.0, 1.0]]),
        remaining_clearance=np.array([0.1]),
        path_length=1.0,
    )
    sides = []
    for clearance in (0.0, 0.1):
        system = make_system()
        run = simulator(
            system,
            ellipsoids_W=ellipsoids(),
            coupling_parameters=parameters,
            route=replace(left, remaining_clearance=np.array([clearance])),
        )
        run.AdvanceTo(0.1)
        sides.append(read(system, run.get_context(), "desired_position")[1])
    assert sides[0] < 0.0
    assert sides[1] > sides[0]


def test_a_change_on_a_port_counts_from_the_next_step() -> None:
    strong = CouplingParameters(
        np.array([100.0]), np.array([0.9]), np.array([5.0]), np.ones(1, dtype=bool)
    )
    system = make_system()
    run = simulator(system, ellipsoids_W=ellipsoids(), coupling_parameters=strong)
    run.AdvanceTo(0.2)
    port = system.GetInputPort("coupling_parameters")
    port.FixValue(run.get_mutable_context(), Value(replace(strong, alpha=np.array([-1.0]))))
    with pytest.raises(ValueError, match="alpha, psi, kappa must be"):
        run.AdvanceTo(0.21)


def test_all_run_time_data_is_in_the_context() -> None:
    system = make_system()
    run = simulator(system)
    run.AdvanceTo(0.3)
    other = Simulator(system, run.get_context().Clone())
    # Another simulator goes on with the motion: it does not begin it anew.
    other.Initialize()
    assert read(system, other.get_context(), "desired_position")[0] > 0.1
    run.AdvanceTo(0.8)
    other.AdvanceTo(0.8)
    for port in ("desired_position", "desired_velocity", "desired_acceleration", "phase"):
        np.testing.assert_array_equal(
            read(system, run.get_context(), port), read(system, other.get_context(), port)
        )
    run.reset_context(system.CreateDefaultContext())
    np.testing.assert_array_equal(read(system, run.get_context(), "desired_position"), START)


def test_it_holds_without_observation_and_says_so(caplog: pytest.LogCaptureFixture) -> None:
    system = make_system()
    run = simulator(system, ellipsoids_W=EllipsoidSet())
    with caplog.at_level(logging.WARNING, "drake_oa"):
        run.AdvanceTo(0.6)
    np.testing.assert_allclose(read(system, run.get_context(), "desired_velocity"), 0.0)
    assert [r.getMessage() for r in caplog.records] == ["t=0.000 s: held: no observation yet"]
    # Once seen it goes on.
    system.GetInputPort("ellipsoids_W").FixValue(
        run.get_mutable_context(), Value(ellipsoids(count=0))
    )
    caplog.clear()
    with caplog.at_level(logging.WARNING, "drake_oa"):
        run.AdvanceTo(2.0)
    assert [r.getMessage().split(": ")[1] for r in caplog.records] == ["running again"]
    np.testing.assert_allclose(read(system, run.get_context(), "desired_position"), GOAL, atol=1e-3)


@pytest.mark.parametrize("port", ["ellipsoids_W", "coupling_parameters", "route"])
def test_a_wrong_type_on_a_port_is_refused_by_its_name(port: str) -> None:
    inputs: dict[str, object] = {"ellipsoids_W": ellipsoids()}
    inputs[port] = PolicyState()
    run = simulator(make_system(), **inputs)
    with pytest.raises(TypeError, match=rf"'{port}' holds a PolicyState; it must be a "):
        run.AdvanceTo(0.01)


def test_a_goal_at_the_start_is_refused() -> None:
    with pytest.raises(ValueError, match="start and goal must be finite and apart"):
        simulator(make_system(), START).Initialize()


@pytest.mark.parametrize("goal", [np.nan, np.inf])
def test_a_goal_that_is_not_finite_is_refused(goal: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        simulator(make_system(), np.array([goal, 0.0, 0.3])).Initialize()


@pytest.mark.parametrize(
    ("start", "period", "said"),
    [
        (np.array([0.0, np.nan, 0.0]), 0.005, "start must be 3 finite numbers"),
        (np.zeros(2), 0.005, "start must be 3 finite numbers"),
        (START, 0.0, "policy.period: 0.0 is outside"),
        (START, np.nan, "policy.period: must be a finite number"),
    ],
)
def test_bad_construction_is_refused(start: FloatArray, period: float, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        DmpIntegrator(imitate(*minimum_jerk(START, GOAL)), start, config=Policy(period=period))


def test_a_speed_scale_slows_holds_and_lets_go_on(caplog: pytest.LogCaptureFixture) -> None:
    system = make_system()
    run = simulator(system)
    port = system.GetInputPort("speed_scale")
    port.FixValue(run.get_mutable_context(), np.array([0.5]))
    run.AdvanceTo(1.0)
    slow = read(system, run.get_context(), "desired_position")
    # Half the way in the whole duration, less what the ramp took in advance.
    assert 0.4 < slow[0] < 0.8
    with caplog.at_level(logging.WARNING, "drake_oa"):
        port.FixValue(run.get_mutable_context(), np.array([0.0]))
        run.AdvanceTo(2.0)
        policy = system.GetOutputPort("policy_state").Eval(run.get_context())
        assert (policy.speed, policy.note) == (0.0, "speed_scale is 0")
        port.FixValue(run.get_mutable_context(), np.array([1.0]))
        run.AdvanceTo(4.0)
    # Who scales it says so.
    assert caplog.messages == []
    np.testing.assert_allclose(read(system, run.get_context(), "desired_position"), GOAL, atol=1e-3)


def test_an_evasion_displaces_the_held_motion() -> None:
    system = make_system()
    run = simulator(system)
    context = run.get_mutable_context()
    system.GetInputPort("speed_scale").FixValue(context, np.array([0.0]))
    run.AdvanceTo(0.5)
    before = read(system, context, "desired_position")
    system.GetInputPort("evasion").FixValue(context, np.array([0.0, 0.2, 0.0]))
    run.AdvanceTo(1.0)
    moved = read(system, context, "desired_position") - before
    np.testing.assert_allclose(moved, [0.0, 0.1, 0.0], atol=2e-3)
    np.testing.assert_allclose(read(system, context, "desired_velocity"), [0.0, 0.2, 0.0])
