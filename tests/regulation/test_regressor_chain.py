"""The system that regulates the coupling terms."""

import numpy as np
import pytest
from pydrake.common.value import Value

from drake_oa.common.messages import EllipsoidSet, PolicyState, Route
from drake_oa.policy.dmp import local_frame
from drake_oa.regulation.regressor import TARGETS, ChainWeights, Network, section_extents
from drake_oa.regulation.regressor_chain import RegressorChain


def weights():
    rng = np.random.default_rng(0)
    networks = {}
    for i, name in enumerate(TARGETS):
        sizes = [4 + i, 8, 1]
        networks[name] = Network(
            tuple(rng.standard_normal((sizes[k + 1], sizes[k])) for k in range(2)),
            tuple(rng.standard_normal(sizes[k + 1]) for k in range(2)),
            np.zeros(4 + i),
            np.ones(4 + i),
            0.0,
            1.0,
        )
    return ChainWeights(networks, np.full(4, 0.02), np.full(4, 0.9), np.ones(4), frozenset(TARGETS))


def ellipsoids(m):
    return EllipsoidSet(
        stamp=0.0,
        p_WO=np.tile([0.5, 0.0, 0.1], (m, 1)) + 0.05 * np.arange(m)[:, None],
        R_WO=np.tile(np.eye(3), (m, 1, 1)),
        semi_axes=np.tile([0.1, 0.15, 0.2], (m, 1)),
        v_WO=np.zeros((m, 3)),
        ids=np.arange(m),
    )


def policy(p_WG=(0.8, 0.0, 0.0)):
    start, goal = np.zeros(3), np.array(p_WG)
    return PolicyState(
        p_WE=np.array([0.1, 0.0, 0.0]),
        z_W=np.array([0.5, 0.1, 0.0]),
        p_WS=start,
        p_WG=goal,
        R_WL=local_frame(start, goal) if goal.any() else np.eye(3),
    )


def evaluate(system, ellipsoids_W, policy_state, route=None):
    context = system.CreateDefaultContext()
    if route is not None:
        system.GetInputPort("route").FixValue(context, Value(route))
    system.GetInputPort("ellipsoids_W").FixValue(context, Value(ellipsoids_W))
    system.GetInputPort("policy_state").FixValue(context, Value(policy_state))
    return system.GetOutputPort("coupling_parameters").Eval(context)


def test_output_is_the_pure_functions_answer():
    obstacles, state = ellipsoids(3), policy()
    found = evaluate(RegressorChain(weights(), 0.1), obstacles, state)
    extents = section_extents(
        state.p_WE, state.z_W, state.R_WL, obstacles.p_WO, obstacles.R_WO, obstacles.semi_axes
    )
    expected = weights().parameters(extents, 0.1, 0.8, obstacles.p_WO[:, 0])
    np.testing.assert_array_equal(found.as_array(), expected.as_array())
    assert found.in_range.all()


def test_with_a_route_its_half_ellipses_are_regulated():
    route = Route(
        center_W=np.array([[0.4, 0.0, 0.0], [0.5, 0.0, 0.0]]),
        extents=np.array([[0.1, 0.2], [0.1, 0.1]]),
        remaining_clearance=np.array([0.1, 0.0]),
        weight=np.array([0.5, 1.0]),
        p_WG=np.array([0.8, 0.0, 0.0]),
    )
    found = evaluate(RegressorChain(weights(), 0.1), ellipsoids(2), policy(), route)
    expected = weights().parameters(
        route.extents, route.remaining_clearance, 0.8, route.center_W[:, 0]
    )
    assert found.alpha[0] == pytest.approx(0.5 * expected.alpha[0])
    assert found.alpha[1] == 0.0
    np.testing.assert_array_equal(found.center_W, route.center_W)


def test_a_route_for_other_obstacles_is_refused():
    with pytest.raises(ValueError, match="route has 0 rows; there are 2 ellipsoids"):
        evaluate(RegressorChain(weights(), 0.1), ellipsoids(2), policy(), Route())


def test_no_obstacles_give_no_rows():
    assert len(evaluate(RegressorChain(weights(), 0.1), EllipsoidSet(), policy())) == 0


def test_without_a_motion_nothing_is_coupled():
    found = evaluate(RegressorChain(weights(), 0.1), ellipsoids(2), policy((0.0, 0.0, 0.0)))
    assert found.alpha.tolist() == [0.0, 0.0]
    assert not found.in_range.any()
    assert np.isfinite(found.as_array()).all()


def test_output_follows_its_inputs_and_is_cached_between():
    system = RegressorChain(weights(), 0.1)
    context = system.CreateDefaultContext()
    system.GetInputPort("policy_state").FixValue(context, Value(policy()))
    system.GetInputPort("ellipsoids_W").FixValue(context, Value(ellipsoids(1)))
    port = system.GetOutputPort("coupling_parameters")
    first = port.Eval(context)
    assert port.Eval(context) is first
    system.GetInputPort("ellipsoids_W").FixValue(context, Value(ellipsoids(2)))
    assert len(port.Eval(context)) == 2


def test_a_foreign_value_on_a_port_is_named():
    system = RegressorChain(weights(), 0.1)
    system.set_name("chain")
    with pytest.raises(TypeError, match="chain: input port 'ellipsoids_W' holds a PolicyState"):
        evaluate(system, PolicyState(), policy())


@pytest.mark.parametrize("clearance", [0.0, -0.1, np.nan, np.inf])
def test_a_clearance_that_is_no_positive_length_is_refused(clearance):
    with pytest.raises(ValueError, match="clearance must be finite and positive"):
        RegressorChain(weights(), clearance)


def test_weights_of_another_type_are_refused():
    with pytest.raises(TypeError, match=r"ChainWeights .* not str"):
        RegressorChain("weights.npz", 0.1)
