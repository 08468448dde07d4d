"""Faults of a scenario: its blocks, and the systems that bring them into a diagram."""

from typing import Any

import numpy as np
import pytest
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.analysis import Simulator
from pydrake.systems.sensors import CameraInfo

from drake_oa.scenario.faults import CameraDropout, Push, TorqueSaturation
from drake_oa.world.faults import CameraFaults, ExternalPush, WeakActuators
from tests.builders import depth_image

PERIOD = 0.1
CAMERA = CameraInfo(8, 6, np.deg2rad(60.0))


def arrivals(*faults: CameraDropout, end: float = 1.05) -> np.ndarray:
    """Rows (stamp, depth, position) at each frame of a camera that shows the time."""
    system = CameraFaults(faults, CAMERA, num_states=2, period=PERIOD)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    rows = []
    for t in np.arange(0.0, end, PERIOD):
        image = depth_image(np.full((6, 8), t))
        system.GetInputPort("depth_image").FixValue(context, image)
        system.GetInputPort("robot_state").FixValue(context, [t, 0.0])
        if t == 0.0:
            simulator.Initialize()
        else:
            simulator.AdvanceTo(t)
            simulator.AdvancePendingEvents()
        depth: Any = system.GetOutputPort("depth_image").Eval(context)
        stamp, x = (
            system.GetOutputPort(name).Eval(context) for name in ("image_stamp", "robot_state")
        )
        rows.append((stamp[0], depth.data[3, 4, 0], x[0]))
    return np.array(rows)


@pytest.mark.parametrize(
    ("faults", "frames"),
    [
        ([CameraDropout(0.3, 0.2), CameraDropout(0.5, 0.2)], [0, 1, 2, 2, 2, 2, 2, 7, 8, 9, 10]),
        ([CameraDropout(0.31, 0.05)], [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10]),
    ],
)
def test_image_stamp_and_robot_state_are_those_of_the_last_frame(
    faults: list[CameraDropout], frames: list[int]
) -> None:
    expected = np.array(frames) * PERIOD
    np.testing.assert_allclose(arrivals(*faults), np.tile(expected[:, None], 3), atol=1e-6)


def test_a_camera_that_is_dead_from_the_start_shows_nothing() -> None:
    stamp, depth, _ = arrivals(CameraDropout(0.0, 0.25))[:3].T
    assert (stamp == -np.inf).all()
    assert np.isnan(depth).all()


PUSH = Push(start=1.0, duration=0.2, force=[1.0, -2.0, 3.0], torque=[0.1, 0.2, 0.3])


@pytest.mark.parametrize(("time", "share"), [(0.99, 0.0), (1.0, 1.0), (1.19, 1.0), (1.2, 0.0)])
def test_a_push_acts_while_it_lasts(time: float, share: float) -> None:
    system = ExternalPush([(PUSH, BodyIndex(3)), (Push(start=5.0), BodyIndex(4))])
    context = system.CreateDefaultContext()
    context.SetTime(time)
    applied, other = system.get_output_port().Eval(context)
    assert applied.body_index == BodyIndex(3)
    np.testing.assert_array_equal(applied.F_Bq_W.translational(), share * np.array(PUSH.force))
    np.testing.assert_array_equal(applied.F_Bq_W.rotational(), share * np.array(PUSH.torque))
    assert not other.F_Bq_W.translational().any()


LIMITS = np.array([87.0, 12.0, 20.0])
ASKED = np.array([50.0, -11.0, 3.0])


@pytest.mark.parametrize(
    ("time", "given"),
    [(0.9, ASKED), (1.0, [43.5, -6.0, 3.0]), (1.6, [26.1, -3.6, 3.0]), (2.5, ASKED)],
)
def test_torques_are_cut_off_while_the_fault_lasts(time: float, given: np.ndarray) -> None:
    faults = [TorqueSaturation(1.0, 1.0, 0.5), TorqueSaturation(1.5, 1.0, 0.3)]
    system = WeakActuators(faults, LIMITS)
    context = system.CreateDefaultContext()
    system.get_input_port().FixValue(context, ASKED)
    context.SetTime(time)
    np.testing.assert_allclose(system.get_output_port().Eval(context), given)
