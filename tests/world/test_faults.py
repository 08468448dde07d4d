"""Systems of the scenario's faults: external pushes and torque saturation."""

import numpy as np
import pytest
from pydrake.multibody.tree import BodyIndex

from drake_oa.scenario.faults import Push, TorqueSaturation
from drake_oa.world.faults import ExternalPush, WeakActuators

PUSH = Push(start=1.0, duration=0.2, force=[1.0, -2.0, 3.0], torque=[0.1, 0.2, 0.3])


@pytest.mark.parametrize(("time", "share"), [(0.99, 0.0), (1.0, 1.0), (1.19, 1.0), (1.2, 0.0)])
def test_push_is_applied_during_its_duration_only(time: float, share: float) -> None:
    system = ExternalPush([(PUSH, BodyIndex(3)), (Push(start=5.0), BodyIndex(4))])
    context = system.CreateDefaultContext()
    context.SetTime(time)
    applied, other = system.get_output_port().Eval(context)
    assert applied.body_index == BodyIndex(3)
    np.testing.assert_array_equal(applied.F_Bq_W.translational(), share * np.array(PUSH.force))
    np.testing.assert_array_equal(applied.F_Bq_W.rotational(), share * np.array(PUSH.torque))
    assert not other.F_Bq_W.translational().any()


LIMITS = np.array([87.0, 12.0, 20.0])
COMMANDED = np.array([50.0, -11.0, 3.0])


@pytest.mark.parametrize(
    ("time", "given"),
    [(0.9, COMMANDED), (1.0, [43.5, -6.0, 3.0]), (1.6, [26.1, -3.6, 3.0]), (2.5, COMMANDED)],
)
def test_torques_are_limited_during_the_fault_only(time: float, given: np.ndarray) -> None:
    faults = [TorqueSaturation(1.0, 1.0, 0.5), TorqueSaturation(1.5, 1.0, 0.3)]
    system = WeakActuators(faults, LIMITS)
    context = system.CreateDefaultContext()
    system.get_input_port().FixValue(context, COMMANDED)
    context.SetTime(time)
    np.testing.assert_allclose(system.get_output_port().Eval(context), given)
