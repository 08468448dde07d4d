"""Motions that imitate a demonstration of their own."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder

from drake_oa.common.messages import CouplingParameters, EllipsoidSet, FloatArray
from drake_oa.policy.config import Policy
from drake_oa.policy.dmp import (
    Demonstration,
    imitate,
    imitate_orientation,
    minimum_jerk,
    minimum_jerk_orientation,
    minimum_jerk_share,
    rotation_matrix,
)
from drake_oa.policy.dmp_integrator import DmpIntegrator
from drake_oa.policy.orientation_integrator import OrientationIntegrator
from tests.builders import read

START, GOAL = np.array([0.3, -0.4, 0.3]), np.array([0.3, 0.4, 0.3])
R_WS = RollPitchYaw(np.pi, 0.0, 0.0).ToRotationMatrix().matrix()


def arc(turned: float = np.pi / 3.0) -> Demonstration:
    """A half circle above the line in two seconds, and a turn [rad]."""
    t = np.linspace(0.0, 2.0, 201)
    angle = np.pi * minimum_jerk_share(t / 2.0)
    center = 0.5 * (START + GOAL)
    path = center + 0.4 * np.column_stack([0.0 * t, -np.cos(angle), np.sin(angle)])
    turns = [RollPitchYaw(0.0, 0.0, turned * a / np.pi).ToRotationMatrix() for a in angle]
    R = R_WS @ np.array([turn.matrix() for turn in turns])
    return Demonstration(imitate(path, t), imitate_orientation(R, t), R[0], R[-1], t / 2.0)


def simulator(shown: Demonstration, *, anew: bool) -> tuple[Simulator, Diagram]:
    builder = DiagramBuilder()
    straight = imitate(*minimum_jerk(START, GOAL, duration=1.0))
    config = Policy(period=0.008)
    policy = builder.AddNamedSystem("policy", DmpIntegrator(straight, START, config=config))
    turning = builder.AddNamedSystem(
        "turning",
        OrientationIntegrator(minimum_jerk_orientation(), R_WS, R_WS, period=config.period),
    )
    builder.Connect(policy.GetOutputPort("policy_state"), turning.GetInputPort("policy_state"))
    diagram = builder.Build()
    run = Simulator(diagram)
    context = policy.GetMyMutableContextFromRoot(run.get_mutable_context())
    policy.GetInputPort("goal").FixValue(context, GOAL)
    policy.GetInputPort("ellipsoids_W").FixValue(context, Value(EllipsoidSet(stamp=np.inf)))
    policy.GetInputPort("coupling_parameters").FixValue(
        context, Value(CouplingParameters(anew=anew, verified=True))
    )
    for system in (policy, turning):
        context = system.GetMyMutableContextFromRoot(run.get_mutable_context())
        system.GetInputPort("demonstration").FixValue(context, Value(shown))
    return run, diagram


def follow(run: Simulator, diagram: Diagram, end: float) -> tuple[FloatArray, FloatArray]:
    """(T, 3) positions and the last orientation."""
    policy, turning = (diagram.GetSubsystemByName(name) for name in ("policy", "turning"))
    places = []
    for time in np.arange(0.05, end, 0.05):
        run.AdvanceTo(float(time))
        context = policy.GetMyContextFromRoot(run.get_context())
        places.append(read(policy, context, "desired_position"))
    context = turning.GetMyContextFromRoot(run.get_context())
    return np.array(places), rotation_matrix(read(turning, context, "desired_orientation"))


@pytest.mark.parametrize("turned", [np.pi / 3.0, 7.0])
def test_a_motion_that_begins_anew_imitates_what_is_shown(turned: float) -> None:
    # 7 rad are 400 degrees.
    run, diagram = simulator(arc(turned), anew=True)
    places, R_WE = follow(run, diagram, 3.5)
    radius = np.linalg.norm(places - 0.5 * (START + GOAL), axis=1)
    np.testing.assert_allclose(radius, 0.4, atol=5e-3)
    assert places[:, 2].max() > 0.69
    np.testing.assert_allclose(places[-1], GOAL, atol=1e-3)
    np.testing.assert_allclose(R_WE, arc(turned).R_WG, atol=5e-3)


def test_without_beginning_anew_it_goes_on_as_it_was() -> None:
    places, _ = follow(*simulator(arc(), anew=False), 1.5)
    np.testing.assert_allclose(places[:, 2], START[2], atol=1e-6)
