"""The links' coupling as a system, and on the controller's port."""

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator

from drake_oa.common.messages import ObstacleClouds
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.diagrams.control import make_controller
from drake_oa.diagrams.posture import make_null_space_coupling
from drake_oa.posture.null_space_coupling_system import NullSpaceCoupling
from drake_oa.robot.plant import RobotPlant, make_robot_plant
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.task_joints import start_positions

TRUTH = "perception=!GroundTruth {}"


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario("shelf_elbow", [TRUTH, "robot.posture={plan: false, coupling: {}}"])


@pytest.fixture(scope="module")
def panda(scenario: Scenario) -> RobotPlant:
    return make_robot_plant(scenario.robot)


@pytest.fixture(scope="module")
def q_start(panda: RobotPlant, scenario: Scenario) -> np.ndarray:
    return start_positions(panda, scenario)


@pytest.fixture(scope="module")
def coupling(panda: RobotPlant, scenario: Scenario, q_start: np.ndarray) -> NullSpaceCoupling:
    found = make_null_space_coupling(scenario, panda, q_start)
    assert found is not None
    return found


def beside_the_elbow(plant: MultibodyPlant, q: np.ndarray) -> ObstacleClouds:
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    p_WJ = plant.GetFrameByName("panda_link4").CalcPoseInWorld(context).translation()
    cloud = p_WJ + np.array([[0.05, 0.2, z] for z in (-0.03, 0.0, 0.03)])
    velocity = np.array([[0.0, -0.4, 0.0]])
    return ObstacleClouds(stamp=0.0, clouds_W=(cloud,), ids=np.arange(1), v_WO=velocity)


def simulated(coupling: NullSpaceCoupling, x: np.ndarray, seen: ObstacleClouds) -> Simulator:
    simulator = Simulator(coupling)
    context = simulator.get_mutable_context()
    coupling.GetInputPort("robot_state").FixValue(context, x)
    coupling.GetInputPort("obstacles_W").FixValue(context, Value(seen))
    simulator.Initialize()
    return simulator


def answer(coupling: NullSpaceCoupling, simulator: Simulator) -> np.ndarray:
    return np.array(coupling.get_output_port().Eval(simulator.get_context()))


def test_it_is_held_between_decisions(
    coupling: NullSpaceCoupling, panda: RobotPlant, q_start: np.ndarray
) -> None:
    simulator = simulated(
        coupling, np.append(q_start, np.zeros(9)), beside_the_elbow(panda.plant, q_start)
    )
    simulator.AdvanceTo(0.002)
    before = answer(coupling, simulator)
    assert before.any()
    coupling.GetInputPort("obstacles_W").FixValue(
        simulator.get_mutable_context(), Value(ObstacleClouds())
    )
    simulator.AdvanceTo(0.008)
    np.testing.assert_array_equal(answer(coupling, simulator), before)
    simulator.AdvanceTo(0.010)
    assert not answer(coupling, simulator).any()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_state_that_is_not_finite_gives_none(
    coupling: NullSpaceCoupling, panda: RobotPlant, q_start: np.ndarray, value: float
) -> None:
    x = np.append(q_start, np.full(9, value))
    simulator = simulated(coupling, x, beside_the_elbow(panda.plant, q_start))
    assert not answer(coupling, simulator).any()


def test_on_the_controllers_port_it_moves_the_elbow_and_not_the_tool(
    coupling: NullSpaceCoupling, panda: RobotPlant, scenario: Scenario, q_start: np.ndarray
) -> None:
    plant = panda.plant
    x = np.append(q_start, np.zeros(9))
    a_0 = answer(coupling, simulated(coupling, x, beside_the_elbow(plant, q_start)))
    controller = make_controller(scenario, panda, q_start)
    root = panda.diagram.CreateDefaultContext()
    model = plant.GetMyMutableContextFromRoot(root)
    plant.SetPositionsAndVelocities(model, x)
    context = controller.CreateDefaultContext()
    frame = panda.tool_frame
    controller.GetInputPort("robot_state").FixValue(context, x)
    p_WE = frame.CalcPoseInWorld(model).translation()
    desired = {"position": p_WE, "velocity": [0.1, 0.0, 0.0], "acceleration": [0.0] * 3}
    for name, value in desired.items():
        controller.GetInputPort(f"desired_{name}").FixValue(context, value)
    found = []
    for a in (np.zeros(7), a_0):
        controller.GetInputPort("null_space_acceleration").FixValue(context, a)
        tau = controller.GetOutputPort("actuation").Eval(context)
        plant.get_actuation_input_port().FixValue(model, tau)
        A = frame.CalcSpatialAccelerationInWorld(model).get_coeffs()
        found.append((A, plant.get_generalized_acceleration_output_port().Eval(model)[:7]))
    # The fingers, which the law takes as fixed to the hand, account for the rest.
    np.testing.assert_allclose(found[1][0], found[0][0], atol=0.02)
    assert np.abs(found[1][1] - found[0][1]).max() > 0.1


def test_it_is_there_where_the_scenario_asks_for_it(scenario: Scenario) -> None:
    diagram = build_avoidance(scenario)
    assert diagram.HasSubsystemNamed("null_space_coupling")
    assert not diagram.HasSubsystemNamed("posture_follower")
    plain = build_avoidance(load_scenario("shelf_elbow", [TRUTH]))
    assert not plain.HasSubsystemNamed("null_space_coupling")
    blind = build_avoidance(scenario, modulated=False)
    assert not blind.HasSubsystemNamed("null_space_coupling")


def test_a_state_too_short_for_the_arm_is_refused(coupling: NullSpaceCoupling) -> None:
    with pytest.raises(ValueError, match="num_states"):
        NullSpaceCoupling(coupling._arm, 12, coupling._parameters)
