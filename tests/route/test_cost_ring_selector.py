"""Tests of `CostRingSelector` without a diagram."""

import logging

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from drake_oa.common.messages import EllipsoidSet, FloatArray, PolicyState, Route, TablePlane
from drake_oa.route.cost_ring_selector import CostRingSelector
from drake_oa.route.cost_rings import RingScene
from tests.builders import balls, fix

START, GOAL = np.array([0.0, 0.0, 0.3]), np.array([1.0, 0.0, 0.3])
POLICY = PolicyState(p_WE=START, p_WS=START, p_WG=GOAL)


def prepared(system: CostRingSelector, ellipsoids: EllipsoidSet, **inputs: object) -> Simulator:
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    fix(system, context, goal=GOAL, ellipsoids_W=ellipsoids, policy_state=POLICY, **inputs)
    simulator.Initialize()
    return simulator


def route_of(system: CostRingSelector, context: Context) -> Route:
    return system.GetOutputPort("route").Eval(context)


def decided(system: CostRingSelector, ellipsoids: EllipsoidSet, **inputs: object) -> Route:
    return route_of(system, prepared(system, ellipsoids, **inputs).get_context())


def test_the_shorter_side_is_selected() -> None:
    route = decided(CostRingSelector(0.15), balls((0.5, 0.05, 0.3)))
    np.testing.assert_allclose(route.direction_W[0], [0.0, -1.0, 0.0], atol=1e-12)
    assert set(route.costs) == {"table", "length"}
    assert route.costs["length"].shape == (1, 36)
    assert route.path_length > 1.0
    assert route.note == ""


def test_the_decision_is_the_route_and_does_not_follow_the_motion() -> None:
    system = CostRingSelector(0.15)
    simulator = prepared(system, balls((0.4, 0.02, 0.3), (0.6, 0.02, 0.3)))
    context = simulator.get_mutable_context()
    decision = system.GetOutputPort("decision").Eval(context)
    np.testing.assert_array_equal(decision.direction_W, route_of(system, context).direction_W)
    fix(system, context, policy_state=PolicyState(p_WE=START + 0.1, p_WS=START, p_WG=GOAL))
    assert system.GetOutputPort("decision").Eval(context) is decision


def test_a_user_supplied_ring_affects_the_selection() -> None:
    def only_up(scene: RingScene) -> FloatArray:
        up = scene.directions_W[:, 2] > 0.999
        return np.broadcast_to(~up, scene.detour.shape).astype(float)

    system = CostRingSelector(0.15, extra_rings={"only_up": only_up})
    route = decided(system, balls((0.5, 0.05, 0.3)))
    np.testing.assert_allclose(route.direction_W[0], [0.0, 0.0, 1.0], atol=1e-12)
    assert "only_up" in route.costs


def test_workspace_and_joint_limits_are_separate_rings() -> None:
    def margins(paths: FloatArray) -> FloatArray:
        y = paths[..., 1]
        return np.where(y > -0.3, y + 0.15, -np.inf)

    system = CostRingSelector(0.15, joint_margins=margins)
    route = decided(system, balls((0.5, 0.05, 0.3)))
    assert route.direction_W[0, 1] > -0.5
    unreachable = route.costs["workspace"][0] >= 1.0
    near_limit = route.costs["joint_limits"][0] >= 1.0
    assert near_limit.any()
    assert not (unreachable & near_limit).any()
    # If the baseline is as close to a joint limit, no direction is forbidden for it.
    near_limit_everywhere = CostRingSelector(
        0.15, joint_margins=lambda paths: np.minimum(margins(paths), 0.05)
    )
    assert not decided(near_limit_everywhere, balls((0.5, -0.05, 0.3))).note


def test_the_table_port_replaces_the_perceived_table() -> None:
    # Without a table the path below the obstacle is shorter than the path above it.
    high = balls((0.5, 0.0, 0.35), table=TablePlane(offset=-1.0))
    system = CostRingSelector(0.15)
    assert decided(system, high).direction_W[0, 2] == pytest.approx(-1.0)
    route = decided(system, high, table=TablePlane(offset=0.2))
    assert route.direction_W[0, 2] > -0.5
    assert route.costs["table"].any()


def test_hysteresis_keeps_the_side_of_a_drifting_obstacle() -> None:
    system = CostRingSelector(0.15, period=0.1)
    simulator = prepared(system, balls((0.5, 0.02, 0.3)))
    first = route_of(system, simulator.get_context()).direction_W
    assert first[0, 1] < -0.9
    fix(system, simulator.get_mutable_context(), ellipsoids_W=balls((0.5, -0.01, 0.3)))
    simulator.AdvanceTo(0.25)
    np.testing.assert_array_equal(route_of(system, simulator.get_context()).direction_W, first)
    # Without hysteresis the other side is selected; with a larger drift also with hysteresis.
    assert decided(system, balls((0.5, -0.01, 0.3))).direction_W[0, 1] > 0.9
    fix(system, simulator.get_mutable_context(), ellipsoids_W=balls((0.5, -0.09, 0.3)))
    simulator.AdvanceTo(0.45)
    assert route_of(system, simulator.get_context()).direction_W[0, 1] > 0.9


def test_a_new_obstacle_triggers_a_decision_at_once() -> None:
    system = CostRingSelector(0.15, period=10.0)
    simulator = prepared(system, balls((0.3, 0.05, 0.3)))
    simulator.AdvanceTo(0.01)
    two = balls((0.3, 0.05, 0.3), (0.7, -0.05, 0.3), ids=[0, 4])
    fix(system, simulator.get_mutable_context(), ellipsoids_W=two)
    route = route_of(system, simulator.get_context())
    assert route.ids.tolist() == [0, 4]
    assert len(route.direction_W) == len(route.remaining_clearance) == 2
    fix(system, simulator.get_mutable_context(), ellipsoids_W=balls())
    assert len(route_of(system, simulator.get_context()).ids) == 0


def test_a_blocked_route_is_noted_and_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    system = CostRingSelector(0.15, joint_margins=lambda p: np.full(p.shape[:-1], -np.inf))
    with caplog.at_level(logging.INFO, "drake_oa"):
        simulator = prepared(system, balls((0.5, 0.0, 0.3), ids=[3]))
        simulator.AdvanceTo(0.3)
    route = route_of(system, simulator.get_context())
    assert route.note == "every side of obstacle 3 is forbidden"
    assert len(caplog.records) == 1
    assert route.note in caplog.text


def test_the_error_of_a_wrong_shape_names_the_ring() -> None:
    system = CostRingSelector(0.15, extra_rings={"flat": lambda scene: np.zeros(3)})
    with pytest.raises(ValueError, match="'flat'"):
        prepared(system, balls((0.5, 0.0, 0.3)))
