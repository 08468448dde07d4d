"""A push from outside, alone and on a body."""

import numpy as np
import pytest
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import BodyIndex, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drake_oa.scenario.faults import Push
from drake_oa.world.push import ExternalPush

PUSH = Push(start=1.0, duration=0.2, force=[1.0, -2.0, 3.0], torque=[0.1, 0.2, 0.3])


@pytest.mark.parametrize(
    ("time", "share"), [(0.0, 0.0), (0.99, 0.0), (1.0, 1.0), (1.19, 1.0), (1.2, 0.0), (9.0, 0.0)]
)
def test_it_acts_while_it_lasts(time: float, share: float) -> None:
    system = ExternalPush([(PUSH, BodyIndex(3))])
    context = system.CreateDefaultContext()
    context.SetTime(time)
    (applied,) = system.get_output_port().Eval(context)
    assert applied.body_index == BodyIndex(3)
    np.testing.assert_array_equal(applied.F_Bq_W.translational(), share * np.array(PUSH.force))
    np.testing.assert_array_equal(applied.F_Bq_W.rotational(), share * np.array(PUSH.torque))


def test_two_pushes_are_two_forces() -> None:
    system = ExternalPush([(PUSH, BodyIndex(3)), (Push(start=5.0), BodyIndex(4))])
    context = system.CreateDefaultContext()
    context.SetTime(5.1)
    forces = [item.F_Bq_W.translational()[1] for item in system.get_output_port().Eval(context)]
    assert forces == [0.0, 20.0]


def test_a_free_body_gets_its_momentum() -> None:
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, time_step=0.002)
    body = plant.AddRigidBody("body", SpatialInertia.SolidSphereWithMass(2.0, 0.1))
    plant.set_gravity_enabled(body.model_instance(), False)
    plant.Finalize()
    push = builder.AddSystem(ExternalPush([(PUSH, body.index())]))
    builder.Connect(push.get_output_port(), plant.get_applied_spatial_force_input_port())
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(1.5)
    context = plant.GetMyContextFromRoot(simulator.get_context())
    v = plant.EvalBodySpatialVelocityInWorld(context, body).translational()
    # Force times duration over mass.
    np.testing.assert_allclose(v, np.array(PUSH.force) * 0.2 / 2.0, rtol=0.02)


def test_there_is_a_push() -> None:
    with pytest.raises(ValueError, match="pushes is empty"):
        ExternalPush([])
