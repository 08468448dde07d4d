"""What the shipped chain does when it is rolled out where it was not trained."""

from pathlib import Path

import pytest

from drake_oa.policy.config import Policy
from drake_oa.regulation.regressor import load_chain
from drake_oa.training.validation import validate

SHIPPED = Path(__file__).resolve().parents[2] / "models" / "weights" / "regressor_chain.safetensors"


def test_the_shipped_chain_keeps_clearances_and_arrives():
    chain = load_chain(SHIPPED)
    explored = chain.metadata["exploration"]
    outcome = validate(
        chain,
        scenes=600,
        alpha_x=explored["alpha_x"],
        end=explored["end"],
        fade=explored["fade"],
        seed=5,
    )
    assert outcome.contacts == 0
    assert outcome.kept >= 0.99
    assert outcome.excess_least > -0.01
    assert outcome.arrived >= 0.99
    assert outcome.goal_error_largest < 2e-3


def test_the_spring_it_was_trained_for_is_the_scenarios():
    chain = load_chain(SHIPPED)
    explored = chain.metadata["exploration"]
    policy = Policy()
    assert explored["alpha_x"] == pytest.approx(policy.alpha_x)
    assert explored["fade"] == pytest.approx(policy.fade)
