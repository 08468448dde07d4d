"""Tests of the system `RegressorChain`."""

import numpy as np
import pytest

from drake_oa.common.files import package_file
from drake_oa.common.messages import PolicyState
from drake_oa.inference.regressor import load_chain, section_extents
from drake_oa.inference.regressor_chain import RegressorChain
from tests.builders import balls, fix

WEIGHTS = load_chain(package_file("package://drake_oa/weights/paper_chain_running.safetensors"))
OBSTACLES = balls((0.5, 0.0, 0.1), (0.55, 0.05, 0.15), radius=[0.1, 0.15, 0.2])


def evaluate(policy: PolicyState):
    system = RegressorChain(WEIGHTS, 0.1)
    context = system.CreateDefaultContext()
    fix(system, context, ellipsoids_W=OBSTACLES, policy_state=policy)
    return system.GetOutputPort("coupling_parameters").Eval(context)


def test_the_output_equals_the_functions_result():
    state = PolicyState(z_W=np.array([0.5, 0.1, 0.0]), p_WG=np.array([0.8, 0.0, 0.0]))
    extents = section_extents(state.p_WE, state.z_W, state.R_WL, OBSTACLES)
    expected = WEIGHTS.parameters(extents, 0.1, 0.8)
    np.testing.assert_array_equal(evaluate(state).as_array(), expected.as_array())


def test_without_a_motion_the_strength_is_zero():
    output = evaluate(PolicyState())
    assert output.alpha.tolist() == [0.0, 0.0]
    assert not output.in_range.any()
    assert np.isfinite(output.as_array()).all()


def test_an_invalid_clearance_is_refused():
    with pytest.raises(ValueError, match=r"requested_clearance \[m\] must be positive and finite"):
        RegressorChain(WEIGHTS, np.nan)
