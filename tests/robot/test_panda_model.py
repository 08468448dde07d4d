"""The Panda: kinematics and dynamics against reference figures, geometry against itself."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pydrake.geometry import (
    Box,
    Capsule,
    QueryObject,
    ReadObjToTriangleSurfaceMesh,
    SceneGraph,
    Sphere,
)
from pydrake.multibody.parsing import LoadModelDirectives, Parser, ProcessModelDirectives
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable, SpatialInertia
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

import drake_oa.models

MODELS = Path(next(iter(drake_oa.models.__path__)))
ARM = [f"panda_link{i}" for i in range(8)]
FINGERS = ["panda_leftfinger", "panda_rightfinger"]
SHELLS = [*ARM, "panda_hand", *FINGERS]
JOINTS = [f"panda_joint{i}" for i in range(1, 8)]
FINGER_JOINTS = ["panda_finger_joint1", "panda_finger_joint2"]

Q_READY = np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4, 0.02, 0.02])
Q_START = np.array([-0.7401, 0.1857, 0.0143, -1.9017, -0.003, 2.0874, 0.0608, 0.02, 0.02])

# One configuration of the reference data, so that this file stands alone.
Q_INLINE = np.array(
    [
        *(-2.278021790232, 0.044562928076, 2.174636532604, -0.574698766625),
        *(-1.830045079451, 3.643801767441, 2.735717302179, 0.034029441248, 0.019465078851),
    ]
)
X_TCP_INLINE = np.array(
    [
        [-0.749911523883, 0.267268452313, 0.605144842782, 0.330873633762],
        [-0.023155344355, -0.924798469272, 0.379752052345, 0.110106835876],
        [0.661132767585, 0.270768103053, 0.699705722425, 1.124626968379],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
J_TCP_JOINT4_INLINE = np.array(
    [
        *(-0.102670224006, -0.994039290858, -0.036670333152),
        *(-0.466285778702, 0.039190076571, 0.2431717593),
    ]
)
# Of the identified model's closed form: arm without hand, without reflected inertia.
M_DIAGONAL_INLINE = np.array(
    [
        *(0.264994764874, 2.674182838075, 0.278099053812, 0.623762549752),
        *(0.022334337438, 0.022939213326, 0.001272243011),
    ]
)
G_INLINE = np.array(
    [
        *(0.0, 6.684629366622, 0.422926083944, 5.608463238797),
        *(0.850395121282, -1.428552664138, -0.013710402742),
    ]
)


class Robot:
    """The Panda alone in a diagram with its context."""

    def __init__(self) -> None:
        builder = DiagramBuilder()
        self.plant: MultibodyPlant
        self.scene_graph: SceneGraph
        self.plant, self.scene_graph = AddMultibodyPlantSceneGraph(builder, 1e-3)
        parser = Parser(self.plant)
        parser.package_map().AddPackageXml(str(MODELS / "package.xml"))
        directives = LoadModelDirectives(str(MODELS / "scenes" / "panda.dmd.yaml"))
        ProcessModelDirectives(directives, parser)
        self.plant.Finalize()
        self.diagram: Diagram = builder.Build()
        self.root = self.diagram.CreateDefaultContext()

    @property
    def context(self) -> Context:
        return self.plant.GetMyContextFromRoot(self.root)

    def colliding_links(self, q: np.ndarray) -> set[frozenset[str]]:
        self.plant.SetPositions(self.context, q)
        query: QueryObject = self.plant.get_geometry_query_input_port().Eval(self.context)
        inspector = query.inspector()

        def link(geometry_id) -> str:
            return self.plant.GetBodyFromFrameId(inspector.GetFrameId(geometry_id)).name()

        pairs = query.ComputePointPairPenetration()
        return {frozenset((link(pair.id_A), link(pair.id_B))) for pair in pairs}

    def distance_to_collision_geometry(self, links: list[str], p_BQ: np.ndarray) -> np.ndarray:
        """Signed distance of points (N, 3), in the first link's frame, to the links' collision
        shapes. The links after the first are welded to it.
        """
        inspector = self.scene_graph.model_inspector()
        first = self.plant.GetFrameByName(links[0])
        best = np.full(len(p_BQ), np.inf)
        for name in links:
            X_BL = self.plant.GetFrameByName(name).CalcPose(self.context, first)
            for geometry_id in self.plant.GetCollisionGeometriesForBody(
                self.plant.GetBodyByName(name)
            ):
                X_BG = X_BL @ inspector.GetPoseInFrame(geometry_id)
                p_GQ = X_BG.inverse().multiply(p_BQ.T).T
                shape = inspector.GetShape(geometry_id)
                best = np.minimum(best, _distance(shape, p_GQ))
        return best


def _distance(shape, p: np.ndarray) -> np.ndarray:
    if isinstance(shape, Box):
        excess = np.abs(p) - shape.size() / 2
        outside = np.linalg.norm(np.maximum(excess, 0.0), axis=1)
        return outside + np.minimum(excess.max(axis=1), 0.0)
    if isinstance(shape, Capsule):
        half = shape.length() / 2
        axis_point = np.clip(p[:, 2], -half, half)[:, None] * np.array([0.0, 0.0, 1.0])
        return np.linalg.norm(p - axis_point, axis=1) - shape.radius()
    assert isinstance(shape, Sphere), f"collision geometry is a {type(shape).__name__}"
    return np.linalg.norm(p, axis=1) - shape.radius()


def _visual_points(link: str, kind: str = "") -> np.ndarray:
    """Vertices, edge points and centroids (N, 3) of a link's visual mesh, in the link's frame."""
    file = MODELS / "panda" / "meshes" / f"{link.removeprefix('panda_')}{kind}.obj"
    mesh = ReadObjToTriangleSurfaceMesh(str(file))
    vertices = np.asarray(mesh.vertices())
    corners = vertices[[[t.vertex(i) for i in range(3)] for t in mesh.triangles()]]
    return np.vstack([vertices, corners.mean(axis=1), corners[:, :2].mean(axis=1)])


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot()


@pytest.fixture
def bare_arm() -> Robot:
    """The identified links alone: no hand, no reflected inertia."""
    robot = Robot()
    for name in ["panda_hand", *FINGERS]:
        body = robot.plant.GetBodyByName(name)
        body.SetSpatialInertiaInBodyFrame(robot.context, SpatialInertia.Zero())
    for joint in JOINTS:
        actuator = robot.plant.GetJointActuatorByName(joint.replace("joint", "motor"))
        actuator.SetRotorInertia(robot.context, 0.0)
    return robot


def _pose(robot: Robot, q: np.ndarray, frame: str) -> np.ndarray:
    robot.plant.SetPositions(robot.context, q)
    return robot.plant.GetFrameByName(frame).CalcPoseInWorld(robot.context).GetAsMatrix4()


def _jacobian(robot: Robot, q: np.ndarray, frame: str) -> np.ndarray:
    robot.plant.SetPositions(robot.context, q)
    world = robot.plant.world_frame()
    return robot.plant.CalcJacobianSpatialVelocity(
        robot.context,
        JacobianWrtVariable.kV,
        robot.plant.GetFrameByName(frame),
        np.zeros(3),
        world,
        world,
    )


def _arm_dynamics(robot: Robot, q_arm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mass matrix (7, 7) and the torque (7,) that holds the arm against gravity."""
    robot.plant.SetPositions(robot.context, np.r_[q_arm, 0.0, 0.0])
    M = robot.plant.CalcMassMatrix(robot.context)[:7, :7]
    return M, -robot.plant.CalcGravityGeneralizedForces(robot.context)[:7]


def test_names_are_those_of_drakes_own_panda(robot: Robot) -> None:
    plant = robot.plant
    panda = plant.GetModelInstanceByName("panda")
    links = {plant.get_body(i).name() for i in plant.GetBodyIndices(panda)}
    assert links == {*SHELLS, "panda_link8", "panda_hand_tcp"}
    moving = [
        plant.get_joint(i).name()
        for i in plant.GetJointIndices(panda)
        if plant.get_joint(i).num_positions() > 0
    ]
    assert moving == [*JOINTS, *FINGER_JOINTS]
    assert plant.num_positions(panda) == plant.num_actuated_dofs(panda) == 9
    for name in ["panda_joint8", "panda_hand_joint"]:
        assert plant.HasJointNamed(name, panda)


def test_positions_and_actuators_are_in_the_order_of_the_joints(robot: Robot) -> None:
    plant = robot.plant
    for index, name in enumerate([*JOINTS, *FINGER_JOINTS]):
        joint = plant.GetJointByName(name)
        assert joint.position_start() == joint.velocity_start() == index
    actuated = [plant.get_joint_actuator(i).joint().name() for i in plant.GetJointActuatorIndices()]
    assert actuated == [*JOINTS, *FINGER_JOINTS]


def test_limits_are_frankas(robot: Robot) -> None:
    plant = robot.plant
    q_min = [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973, 0.0, 0.0]
    q_max = [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973, 0.04, 0.04]
    np.testing.assert_array_equal(plant.GetPositionLowerLimits(), q_min)
    np.testing.assert_array_equal(plant.GetPositionUpperLimits(), q_max)
    v_max = [2.175] * 4 + [2.61] * 3 + [0.2] * 2
    np.testing.assert_array_equal(plant.GetVelocityUpperLimits(), v_max)
    np.testing.assert_array_equal(plant.GetVelocityLowerLimits(), np.negative(v_max))
    a_max = [15, 7.5, 10, 12.5, 15, 20, 20]
    np.testing.assert_array_equal(plant.GetAccelerationUpperLimits()[:7], a_max)
    np.testing.assert_array_equal(
        plant.GetEffortUpperLimits(), [87, 87, 87, 87, 12, 12, 12, 20, 20]
    )


def test_reflected_inertia_is_that_of_the_fr3(robot: Robot) -> None:
    expected = [0.605721456] * 2 + [0.462474144] * 2 + [0.205544064] * 3
    actuators = [robot.plant.get_joint_actuator(i) for i in robot.plant.GetJointActuatorIndices()]
    reflected = [a.default_gear_ratio() ** 2 * a.default_rotor_inertia() for a in actuators]
    np.testing.assert_allclose(reflected[:7], expected, rtol=1e-12)
    assert reflected[7:] == [0.0, 0.0]


def test_inertias_are_physically_valid(robot: Robot) -> None:
    for name in SHELLS:
        inertia = robot.plant.GetBodyByName(name).CalcSpatialInertiaInBodyFrame(robot.context)
        assert inertia.IsPhysicallyValid(), name


def test_tool_pose_and_jacobian_equal_the_inline_reference(robot: Robot) -> None:
    X_WE = _pose(robot, Q_INLINE, "panda_hand_tcp")
    np.testing.assert_allclose(X_WE, X_TCP_INLINE, atol=1e-9)
    J = _jacobian(robot, Q_INLINE, "panda_hand_tcp")
    np.testing.assert_allclose(J[:, 3], J_TCP_JOINT4_INLINE, atol=1e-9)
    np.testing.assert_array_equal(J[:, 7:], 0.0)


def test_bare_arm_dynamics_are_near_the_inline_closed_form(bare_arm: Robot) -> None:
    M, tau = _arm_dynamics(bare_arm, Q_INLINE[:7])
    np.testing.assert_allclose(np.diag(M), M_DIAGONAL_INLINE, atol=0.05)
    np.testing.assert_allclose(tau, G_INLINE, atol=0.2)


def test_kinematics_equal_the_reference_data(
    robot: Robot, reference: Callable[[str], Path]
) -> None:
    data = np.load(reference("panda_reference.npz"))
    frames = {"X_link8": "panda_link8", "X_hand": "panda_hand", "X_tcp": "panda_hand_tcp"}
    q = data["q"]
    for key, frame in frames.items():
        poses = np.array([_pose(robot, q_i, frame) for q_i in q])
        np.testing.assert_allclose(poses, data[key], atol=1e-9)
    J = np.array([_jacobian(robot, q_i, "panda_hand_tcp") for q_i in q])
    np.testing.assert_allclose(J, data["J_tcp"], atol=1e-9)


def test_dynamics_agree_with_the_identified_closed_form(
    bare_arm: Robot, reference: Callable[[str], Path]
) -> None:
    data = np.load(reference("panda_gaz_closed_form.npz"))
    pairs = [_arm_dynamics(bare_arm, q) for q in data["q"]]
    M, tau = (np.array(values) for values in zip(*pairs, strict=True))
    error = np.linalg.norm(M - data["M"], axis=(1, 2)) / np.linalg.norm(data["M"], axis=(1, 2))
    assert error.mean() < 0.023
    assert error.max() < 0.054
    assert np.abs(tau - data["G"]).max() < 0.2


def test_gravity_with_hand_is_within_two_newton_metres_of_drakes_panda(
    robot: Robot, reference: Callable[[str], Path]
) -> None:
    data = np.load(reference("panda_reference.npz"))
    tau = np.array([_arm_dynamics(robot, q[:7])[1] for q in data["q"]])
    assert np.abs(tau + data["tau_g7_fingers_closed"]).max() < 2.5


@pytest.mark.parametrize(("kind", "tolerance"), [("", 1e-3), ("_coarse", 5e-3)])
@pytest.mark.parametrize("link", SHELLS)
def test_collision_geometry_encloses_the_visual(
    robot: Robot, link: str, kind: str, tolerance: float
) -> None:
    distance = robot.distance_to_collision_geometry([link], _visual_points(link, kind))
    assert distance.max() < tolerance


@pytest.mark.parametrize("q", [Q_READY, Q_START], ids=["ready", "start"])
@pytest.mark.parametrize("opening", [0.0, 0.02, 0.04])
def test_no_self_collision_at_rest_poses(robot: Robot, q: np.ndarray, opening: float) -> None:
    assert robot.colliding_links(np.r_[q[:7], opening, opening]) == set()


def test_real_self_collisions_are_reported(robot: Robot) -> None:
    hand_into_base = np.r_[0.0, 1.6, 0.0, -3.0, 0.0, 1.6, 0.785, 0.02, 0.02]
    pairs = robot.colliding_links(hand_into_base)
    assert any("panda_link0" in pair for pair in pairs)
    folded = np.r_[0.0, 0.0, 0.0, -1.6, 0.0, -0.0175, 0.785, 0.02, 0.02]
    assert frozenset(("panda_hand", "panda_link5")) in robot.colliding_links(folded)
