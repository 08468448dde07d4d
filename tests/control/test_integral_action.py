"""A lasting disturbance is taken away; force is not gathered."""

import numpy as np
import pytest
from pydrake.systems.framework import BasicVector

from drake_oa.common.config import ScenarioError
from drake_oa.control.cartesian_inverse_dynamics import (
    LARGEST_ACCELERATION,
    LARGEST_ERROR,
    IntegralAction,
)
from drake_oa.diagrams.control import make_integral_action
from drake_oa.scenario.loading import load_scenario

PERIOD = 0.008
KP, KD, KI = 400.0, 40.0, 1000.0


def simulate(disturbance: np.ndarray, steps: int) -> np.ndarray:
    """Errors (steps, 3) of a point under the law e'' = -kp e - kd e' - added + disturbance."""
    system = IntegralAction(KI, period=PERIOD)
    context = system.CreateDefaultContext()
    system.GetInputPort("desired_acceleration").FixValue(context, np.zeros(3))
    measured = system.GetInputPort("tracking_error").FixValue(context, np.zeros(3))
    e, v = np.zeros(3), np.zeros(3)
    errors = []
    for _ in range(steps):
        added = system.get_output_port().Eval(context)
        for _ in range(8):
            v = v + PERIOD / 8.0 * (disturbance - KP * e - KD * v - added)
            e = e + PERIOD / 8.0 * v
        measured.GetMutableData().set_value(BasicVector(e))
        context.SetDiscreteState(system.EvalUniquePeriodicDiscreteUpdate(context).value())
        errors.append(e)
    return np.array(errors)


def test_without_it_a_disturbance_leaves_an_error_and_with_it_none() -> None:
    disturbance = np.array([0.6, -0.3, 0.9])
    errors = np.abs(simulate(disturbance, 400))
    assert errors.max() > 0.5 * 0.9 / KP
    assert errors[-1].max() < 1e-5
    assert errors.max() < 1.05 * 0.9 / KP


@pytest.mark.parametrize(
    ("error", "added"),
    [
        (0.9 * LARGEST_ERROR, LARGEST_ACCELERATION),
        (1.1 * LARGEST_ERROR, 0.0),
        (np.inf, 0.0),
        (np.nan, 0.0),
    ],
)
def test_a_tool_that_is_held_back_does_not_gather_force(error: float, added: float) -> None:
    system = IntegralAction(KI, period=PERIOD)
    context = system.CreateDefaultContext()
    system.GetInputPort("desired_acceleration").FixValue(context, [1.0, 2.0, 3.0])
    system.GetInputPort("tracking_error").FixValue(context, [error, 0.0, 0.0])
    for _ in range(1000):
        context.SetDiscreteState(system.EvalUniquePeriodicDiscreteUpdate(context).value())
    np.testing.assert_allclose(system.get_output_port().Eval(context), [1.0 + added, 2.0, 3.0])


def test_the_gain_must_be_positive() -> None:
    with pytest.raises(ValueError, match="gain must be positive"):
        IntegralAction(0.0, period=PERIOD)


def test_an_unstable_gain_is_refused() -> None:
    scenario = load_scenario("tabletop_box", ["robot.gains.ki_position=16000"])
    with pytest.raises(ScenarioError, match=r"ki_position: 16000 must be below .* 16000"):
        make_integral_action(scenario)
    assert make_integral_action(load_scenario("free_space")) is None
