"""Actuators whose limits shrink for a while."""

import numpy as np
import pytest

from drake_oa.scenario.faults import ModelError, TorqueSaturation
from drake_oa.world.weak_actuators import WeakActuators

LIMITS = np.array([87.0, 12.0, 20.0])
ASKED = np.array([50.0, -11.0, 3.0])


@pytest.mark.parametrize(
    ("time", "given"),
    [(0.9, ASKED), (1.0, [43.5, -6.0, 3.0]), (1.99, [43.5, -6.0, 3.0]), (2.0, ASKED)],
)
def test_torques_are_cut_off_while_the_fault_lasts(time: float, given: np.ndarray) -> None:
    system = WeakActuators([ModelError(), TorqueSaturation(1.0, 1.0, 0.5)], LIMITS)
    context = system.CreateDefaultContext()
    system.get_input_port().FixValue(context, ASKED)
    context.SetTime(time)
    np.testing.assert_array_equal(system.get_output_port().Eval(context), given)


def test_limits_must_be_positive() -> None:
    with pytest.raises(ValueError, match="effort_limits must be"):
        WeakActuators([], np.array([87.0, 0.0]))
