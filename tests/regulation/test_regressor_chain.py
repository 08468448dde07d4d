"""The system that regulates the coupling terms."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import Value

from drake_oa.common.messages import PolicyState
from drake_oa.policy.dmp import local_frame
from drake_oa.regulation.regressor import TARGETS, ChainWeights, Network, section_extents
from drake_oa.regulation.regressor_chain import RegressorChain, way_past
from tests.builders import balls


def weights():
    rng = np.random.default_rng(0)
    networks = {}
    for i, name in enumerate(TARGETS):
        sizes = [3 + i, 8, 1]
        networks[name] = Network(
            tuple(rng.standard_normal((sizes[k + 1], sizes[k])) for k in range(2)),
            tuple(rng.standard_normal(sizes[k + 1]) for k in range(2)),
            np.zeros(3 + i),
            np.ones(3 + i),
            0.0,
            1.0,
        )
    return ChainWeights(networks, np.full(3, 0.02), np.full(3, 0.9), np.ones(3), frozenset(TARGETS))


def ellipsoids(m):
    centers = np.tile([0.5, 0.0, 0.1], (m, 1)) + 0.05 * np.arange(m)[:, None]
    return balls(*centers, radius=[0.1, 0.15, 0.2])


def policy(p_WG=(0.8, 0.0, 0.0)):
    start, goal = np.zeros(3), np.array(p_WG)
    return PolicyState(
        p_WE=np.array([0.1, 0.0, 0.0]),
        z_W=np.array([0.5, 0.1, 0.0]),
        p_WS=start,
        p_WG=goal,
        R_WL=local_frame(start, goal) if goal.any() else np.eye(3),
    )


def evaluate(system, ellipsoids_W, policy_state):
    context = system.CreateDefaultContext()
    system.GetInputPort("ellipsoids_W").FixValue(context, Value(ellipsoids_W))
    system.GetInputPort("policy_state").FixValue(context, Value(policy_state))
    return system.GetOutputPort("coupling_parameters").Eval(context)


def test_output_is_the_pure_functions_answer():
    obstacles, state = ellipsoids(3), policy()
    found = evaluate(RegressorChain(weights(), 0.1), obstacles, state)
    extents = section_extents(state.p_WE, state.z_W, state.R_WL, obstacles)
    expected = weights().parameters(extents, 0.1, 0.8)
    np.testing.assert_array_equal(found.as_array(), expected.as_array())
    assert found.in_range.all()


def test_the_original_term_comes_at_its_published_gains():
    found = evaluate(RegressorChain(weights(), 0.1, original=5.0), ellipsoids(2), policy())
    assert found.original
    np.testing.assert_allclose(found.as_array(), [[5000.0, np.pi / 20.0, 0.0]] * 2)


def test_the_duration_is_that_of_the_way_past_the_sections():
    # 0.1 m beside the baseline, 0.15 m wide: the way leads 0.05 m past the other side.
    one = replace(ellipsoids(1), p_WO=np.array([[0.4, 0.1, 0.0]]))
    way = 2.0 * np.hypot(0.4, 0.05)
    assert way_past(policy(), one, 0.1) == pytest.approx(way)
    scaled = RegressorChain(weights(), 0.1, scaling="sections")
    assert evaluate(scaled, one, policy()).tau == pytest.approx(way / 0.8)
    unscaled = RegressorChain(weights(), 0.1, scaling="none")
    assert evaluate(unscaled, one, policy()).tau == 1.0
    # Of 0: what the route is long counts.
    assert evaluate(RegressorChain(weights(), 0.1), one, policy()).tau == 0.0


def test_the_way_past_what_is_straight_ahead_goes_over_it():
    ahead = replace(ellipsoids(1), p_WO=np.array([[0.4, 0.0, 0.0]]))
    assert way_past(policy(), ahead, 0.1) == pytest.approx(2.0 * np.hypot(0.4, 0.2))
    for place in ([0.4, 0.3, 0.0], [-0.1, 0.0, 0.0], [0.9, 0.0, 0.0]):
        aside = replace(ellipsoids(1), p_WO=np.array([place]))
        assert way_past(policy(), aside, 0.1) == pytest.approx(0.8)


def test_without_a_motion_nothing_is_coupled():
    found = evaluate(RegressorChain(weights(), 0.1), ellipsoids(2), policy((0.0, 0.0, 0.0)))
    assert found.alpha.tolist() == [0.0, 0.0]
    assert not found.in_range.any()
    assert np.isfinite(found.as_array()).all()
