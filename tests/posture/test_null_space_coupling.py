"""The links' coupling law: orthogonal, bounded, and out of the tool's way."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pydrake.common.value import Value
from pydrake.math import RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.analysis import Simulator

from drake_oa.common.config import check_values
from drake_oa.common.messages import ObstacleClouds
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.diagrams.control import make_controller
from drake_oa.diagrams.posture import make_null_space_coupling
from drake_oa.geometry.points import ObstaclePoints
from drake_oa.policy.coupling import dead_zone_free_rate
from drake_oa.posture import null_space_coupling as kernels
from drake_oa.posture.null_space_coupling import (
    NullSpaceCoupling,
    NullSpaceCouplingParameters,
    null_space_acceleration,
    null_space_basis,
    reach,
    section_acceleration,
    thinned_points,
)
from drake_oa.robot.arm import ArmModel
from drake_oa.robot.arm_kernels import jacobian
from drake_oa.robot.config import Robot
from drake_oa.robot.plant import RobotPlant, make_robot_plant
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.task_joints import start_positions
from tests.builders import arm_of

LAW = NullSpaceCouplingParameters(alpha=30.0, psi=0.8, kappa=20.0)
STEP = 0.008
TRUTH = "perception=!GroundTruth {}"
vectors = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array)


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario(
        "shelf_elbow", [TRUTH, "regulation=!Paper {}", "robot.null_space_coupling={}"]
    )


@pytest.fixture(scope="module")
def panda(scenario: Scenario) -> RobotPlant:
    return make_robot_plant(scenario.robot)


@pytest.fixture(scope="module")
def arm(panda: RobotPlant) -> ArmModel:
    return arm_of(panda, RotationMatrix(), without=Robot().tool_links)


def unit(v: np.ndarray) -> np.ndarray:
    assume(np.linalg.norm(v) > 0.1)
    return v / np.linalg.norm(v)


def elbow(arm: ArmModel) -> np.ndarray:
    """Where the fourth joint is."""
    return arm.poses(arm.posture)[3, :3, 3]


def post(p_WQ: Sequence[float], v_WO: Sequence[float] = (0.0, 0.0, 0.0)) -> ObstaclePoints:
    cloud = np.asarray(p_WQ) + 0.03 * np.array([[0, 0, z] for z in range(-3, 4)], dtype=float)
    clouds = ObstacleClouds(
        stamp=0.0, clouds_W=(cloud,), ids=np.arange(1), v_WO=np.array([v_WO], dtype=float)
    )
    return thinned_points(clouds)


@given(vectors, vectors, st.floats(0.0, 0.5))
def test_it_turns_the_velocity_away_and_does_not_push_it(
    v: np.ndarray, to: np.ndarray, distance: float
) -> None:
    u = unit(to)
    a = section_acceleration(v, u, distance, LAW, STEP)
    assert abs(a @ v) <= 1e-9 * (1.0 + np.linalg.norm(a))
    assert a @ u <= 1e-9
    if v @ u <= 0.0:
        assert not a.any()


@given(vectors, vectors, st.floats(0.0, 0.5))
def test_its_rate_is_the_papers(v: np.ndarray, to: np.ndarray, distance: float) -> None:
    u, e = unit(to), unit(v)
    theta = math.acos(min(max(float(e @ u), -1.0), 1.0))
    assume(0.01 < theta < 1.36)
    # In a short step nothing limits it, and it does not fade yet.
    rate = np.linalg.norm(section_acceleration(v, u, distance, LAW, 1e-6)) / np.linalg.norm(v)
    expected = dead_zone_free_rate(theta, distance, LAW.alpha, LAW.psi, LAW.kappa)
    assert rate == pytest.approx(float(expected), rel=1e-3)


@given(vectors, vectors, vectors, st.floats(-3.0, 3.0))
def test_a_turned_frame_turns_it(
    v: np.ndarray, to: np.ndarray, axis: np.ndarray, angle: float
) -> None:
    u = unit(to)
    assume(np.linalg.norm(np.cross(unit(v), u)) > 1e-3)
    n = unit(axis)
    K = np.array([[0, -n[2], n[1]], [n[2], 0, -n[0]], [-n[1], n[0], 0]])
    R = np.eye(3) + math.sin(angle) * K + (1.0 - math.cos(angle)) * K @ K
    expected = R @ section_acceleration(v, u, 0.1, LAW, STEP)
    found = section_acceleration(R @ v, R @ u, 0.1, LAW, STEP)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_nothing_at_rest_far_away_or_without_strength() -> None:
    u, v = np.array([1.0, 0.0, 0.0]), np.array([0.2, 0.1, 0.0])
    assert section_acceleration(v, u, 0.1, LAW, STEP).any()
    assert not section_acceleration(np.zeros(3), u, 0.1, LAW, STEP).any()
    assert not section_acceleration(v, u, reach(LAW), LAW, STEP).any()
    none = NullSpaceCouplingParameters(alpha=0.0, psi=1.0, kappa=1.0)
    assert not section_acceleration(v, u, 0.1, none, STEP).any()


def test_a_heading_straight_at_it_turns_the_fastest() -> None:
    u = np.array([1.0, 0.0, 0.0])
    a = section_acceleration(0.3 * u, u, 0.0, LAW, 1e-6)
    assert np.linalg.norm(a) == pytest.approx(LAW.alpha * 0.3, rel=1e-3)


def test_the_section_is_the_nearest_and_its_jacobian_drakes(
    panda: RobotPlant, arm: ArmModel
) -> None:
    plant = panda.plant
    context = plant.CreateDefaultContext()
    q = arm.posture
    plant.SetPositions(context, np.append(q, [0.01, 0.01]))
    X_WB, seen = arm.poses(q), post(elbow(arm) + [0.0, 0.25, 0.0])
    p, u, J = np.empty(3), np.empty(3), np.empty((3, 7))
    distance, body = kernels.nearest_section(X_WB, arm.shapes, seen.blocks, 0.0, 0, 1.0, p, u)
    assert np.linalg.norm(u) == pytest.approx(1.0)
    assert np.abs(seen.points - (p + distance * u)).sum(axis=1).min() < 1e-9
    kernels.point_jacobian(X_WB, body, p, J)
    frame = plant.GetBodyByName(f"panda_link{body + 1}").body_frame()
    p_BS = plant.CalcPointsPositions(context, plant.world_frame(), p, frame)
    world = plant.world_frame()
    expected = plant.CalcJacobianTranslationalVelocity(
        context, JacobianWrtVariable.kV, frame, p_BS, world, world
    )
    np.testing.assert_allclose(J, expected[:, :7], atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(st.tuples(*[st.floats(-0.5, 0.5)] * 7).map(np.array), vectors)
def test_none_of_it_moves_the_tool_and_it_is_bounded(
    arm: ArmModel, v: np.ndarray, v_WO: np.ndarray
) -> None:
    law = NullSpaceCouplingParameters(alpha=300.0, psi=1.5, kappa=5.0, most=7.0)
    around = post(elbow(arm) + [0.0, 0.2, 0.0], v_WO)
    a = null_space_acceleration(arm, around, arm.posture, v, law, time=0.0, step=STEP)
    J = np.empty((6, 7))
    jacobian(arm.poses(arm.posture), J)
    np.testing.assert_allclose(J @ a, 0.0, atol=1e-9)
    assert np.linalg.norm(a) <= 7.0 + 1e-9


def test_what_comes_at_a_still_elbow_moves_it(arm: ArmModel) -> None:
    still = np.zeros(7)
    around = post(elbow(arm) + [0.05, 0.2, 0.0], (0.0, -0.4, 0.0))
    a = null_space_acceleration(arm, around, arm.posture, still, LAW, time=0.0, step=STEP)
    assert np.linalg.norm(a) > 0.01
    rests = post(elbow(arm) + [0.05, 0.2, 0.0])
    a = null_space_acceleration(arm, rests, arm.posture, still, LAW, time=0.0, step=STEP)
    assert not a.any()


def test_without_obstacles_there_is_none(arm: ArmModel) -> None:
    none = ObstaclePoints()
    a = null_space_acceleration(arm, none, arm.posture, np.ones(7), LAW, time=0.0, step=STEP)
    assert not a.any()


def test_the_basis_of_a_null_space() -> None:
    J = np.random.default_rng(0).normal(size=(6, 7))
    Z = null_space_basis(J)
    assert Z.shape == (7, 1)
    np.testing.assert_allclose(J @ Z, 0.0, atol=1e-12)
    J[5] = J[4]
    assert null_space_basis(J).shape == (7, 2)
    assert null_space_basis(np.eye(6)).shape == (6, 0)


@pytest.mark.parametrize("name", ["alpha", "psi", "kappa", "most"])
@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_bad_parameters_are_refused(name: str, value: float) -> None:
    given = {"alpha": 1.0, "psi": 1.0, "kappa": 1.0, "most": 1.0, name: value}
    with pytest.raises(ValueError, match=name):
        check_values(NullSpaceCouplingParameters(**given), "null_space_coupling")


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
