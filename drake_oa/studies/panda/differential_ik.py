"""Drake's differential inverse kinematics for a scenario: collision model, program, controller.

At each step of `DifferentialInverseKinematicsSystem` a quadratic program finds the joint
velocity that brings the tool nearest to the asked pose, subject to joint velocity limits
and, for every pair (robot link, thing) with padded distance phi = d - p below the influence
distance, to

    phi + (dphi/dq) v dt >= s,

so that a pair keeps s + p. The safety distance s is the smaller of what tool and arm keep, and
the padding p is what a pair keeps besides. Between d = 0 and d = p the gradient of Drake 1.51
has the wrong sign (RobotLocomotion/drake#25016), and the program would drive such a pair
further in: with s > 0 this region lies s inside of what is kept.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from pydrake.multibody.inverse_kinematics import DifferentialInverseKinematicsSystem
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, RigidBody
from pydrake.planning import (
    DofMask,
    JointLimits,
    RobotDiagramBuilder,
    SceneGraphCollisionChecker,
)
from pydrake.systems.controllers import InverseDynamicsController

from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import BoolArray, FloatArray
from drake_oa.diagrams.policy import make_dmp
from drake_oa.policy.dmp import trajectory
from drake_oa.robot.config import Robot
from drake_oa.robot.grasped_object import part_carried, tool_links
from drake_oa.robot.plant import TOOL_FRAME
from drake_oa.scenario.obstacles import OBSTACLE_PREFIX
from drake_oa.scenario.scenario import Scenario
from drake_oa.world.world_model import add_world

_EDGE_STEP = 0.1
"""The collision checker wants a step for checks of edges, which are not used here [rad]."""
_FINGER_PULL = 0.01
"""How far the posture's fingers are from those of the robot [m]: see `posture`."""


@dataclass(frozen=True)
class PeerParameters:
    """What may be chosen about the method.

    Attributes:
        tool_distance: what the tool keeps from obstacles [m].
        arm_distance: what the other links keep from obstacles, and every link from
            the rest of the world [m].
        self_distance: what links keep from one another [m]. Not 0, where the gradient's sign
            changes; links of the UR5 that cannot come apart are 13 mm from one another.
        influence: pairs further apart than their distance and this are left out [m].
        horizon: dt of the collision constraint [s]: a link may use up the distance that
            is left to it within this time, and no faster. With the policy's step of 8 ms
            for it, the program was left without a solution in 8 of 9 scenes; with 0.3 s
            in 1.
        gain: share of the pose error that the asked velocity makes up in a step.
        speed_share: largest asked tool velocity along an axis, as a multiple of the
            planned motion's greatest speed.
        angular_limit: largest asked tool rate about an axis [rad/s].
        posture_gain: pull to the posture of the start in the null space [1/s].
        weight: of the tool's velocity error against the posture's.
        kp: stiffness of the joint controller [1/s^2].
        kd: its damping [1/s].
    """

    tool_distance: float = 0.03
    arm_distance: float = 0.02
    self_distance: float = 0.005
    influence: float = 0.2
    horizon: float = 0.3
    gain: float = 0.2
    speed_share: float = 1.2
    angular_limit: float = 2.5
    posture_gain: float = 1.0
    weight: float = 100.0
    kp: float = 2500.0
    kd: float = 100.0

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not math.isfinite(value) or value < 0.0:
                raise ValueError(
                    f"PeerParameters.{item.name} is {value}; it must be finite and not negative"
                )
            if value == 0.0 and item.name in ("horizon", "gain"):
                raise ValueError(f"PeerParameters.{item.name} is 0; it must be positive")

    @property
    def safety_distance(self) -> float:
        """The distance that tool and arm both keep from obstacles [m]."""
        return min(self.tool_distance, self.arm_distance)


def look_ahead(period: float, parameters: PeerParameters) -> float:
    """How far ahead the plan is asked for, so that the robot is on it in time [s].

    Making up the share g of an error at each step h, the command follows a steady motion
    h (1 / g - 1) late at the end of the step; it is given at its beginning and is held, so
    that it is half a step early there.
    """
    return period * (1.0 / parameters.gain - 0.5)


def posture(robot: Robot, q_start: FloatArray) -> FloatArray:
    """(n,) posture that the null space is pulled to: the start, fingers out of place.

    The fingers do not follow: their velocity is limited to zero. That limit is so always
    active, and OSQP refines (and says nothing about) a solution only where a constraint is.
    """
    q = np.array(q_start, dtype=float)
    q[len(robot.q_seed) :] += _FINGER_PULL
    return q


def joint_limits(plant: MultibodyPlant, robot: Robot) -> JointLimits:
    """The plant's own limits, and no velocity for the joints of the hand."""
    limits = JointLimits(plant)
    own = robot_dofs(plant)
    arm = np.arange(own.sum()) < len(robot.q_seed)
    return JointLimits(
        limits.position_lower()[own],
        limits.position_upper()[own],
        np.where(arm, limits.velocity_lower()[own], 0.0),
        np.where(arm, limits.velocity_upper()[own], 0.0),
        limits.acceleration_lower()[own],
        limits.acceleration_upper()[own],
    )


def robot_dofs(plant: MultibodyPlant) -> BoolArray:
    """(nq,) which positions are the robot's."""
    robot = plant.GetFrameByName(TOOL_FRAME).model_instance()
    marked = np.zeros(plant.num_positions())
    plant.SetPositionsInArray(robot, np.ones(plant.num_positions(robot)), marked)
    return marked > 0.0


def make_collision_checker(
    scenario: Scenario, parameters: PeerParameters
) -> SceneGraphCollisionChecker:
    """The collision model of a scenario's world, the same as the station's.

    Links that no joint moves are left out: no velocity changes what they keep.

    Raises:
        ScenarioError: if something can move besides the robot and the obstacles that the
            scenario drives, of which the method is told where they are.
    """
    builder = RobotDiagramBuilder(time_step=0.0)
    plant = builder.plant()
    instance = add_world(plant, scenario)
    plant.Finalize()
    part_carried(plant, builder.scene_graph(), scenario.robot)
    driven = sum(plant.num_positions(other) for other in _driven_instances(plant, scenario))
    if plant.num_positions() != plant.num_positions(instance) + driven:
        raise ScenarioError(
            "directives: something besides the robot and the obstacles that are driven can move; "
            "differential inverse kinematics needs to know where everything is"
        )
    checker = SceneGraphCollisionChecker(
        model=builder.Build(), robot_model_instances=[instance], edge_step_size=_EDGE_STEP
    )
    _pad(checker, instance, scenario, parameters)
    return checker


def _pad(
    checker: SceneGraphCollisionChecker,
    instance: ModelInstanceIndex,
    scenario: Scenario,
    parameters: PeerParameters,
) -> None:
    plant = checker.plant()
    of_tool = tool_links(scenario.robot) if scenario.robot else []
    safety = parameters.safety_distance
    checker.SetPaddingAllRobotEnvironmentPairs(parameters.arm_distance - safety)
    checker.SetPaddingAllRobotRobotPairs(parameters.self_distance - safety)
    for link in map(plant.get_body, plant.GetBodyIndices(instance)):
        if plant.IsAnchored(link):
            checker.SetCollisionFilteredWithAllBodies(link.index())
            continue
        if link.name() in of_tool:
            for thing in _obstacle_bodies(plant):
                checker.SetPaddingBetween(
                    link.index(), thing.index(), parameters.tool_distance - safety
                )


def _driven_instances(plant: MultibodyPlant, scenario: Scenario) -> list[ModelInstanceIndex]:
    return [
        plant.GetModelInstanceByName(f"{OBSTACLE_PREFIX}_{obstacle.name}")
        for obstacle in scenario.obstacles
        if obstacle.driven
    ]


def position_orders(plant: MultibodyPlant, scenario: Scenario) -> dict[str, FloatArray]:
    """Model instance -> (nq, n) matrix that takes its positions to their places in the plant's.

    Of the robot, the first, and of the obstacles that the scenario drives.
    """
    robot = plant.GetFrameByName(TOOL_FRAME).model_instance()
    orders = {}
    for instance in (robot, *_driven_instances(plant, scenario)):
        columns = np.zeros((plant.num_positions(), plant.num_positions(instance)))
        for row, unit in enumerate(np.eye(columns.shape[1])):
            q = np.zeros(plant.num_positions())
            plant.SetPositionsInArray(instance, unit, q)
            columns[:, row] = q
        orders[plant.GetModelInstanceName(instance)] = columns
    return orders


def of_state(order: FloatArray) -> FloatArray:
    """(nq, 2 n) matrix that takes a state, positions and as many velocities, to (nq, n) order."""
    return np.hstack([order, np.zeros_like(order)])


def _obstacle_bodies(plant: MultibodyPlant) -> list[RigidBody]:
    """Bodies of the model instances that are obstacles by name."""
    return [
        plant.get_body(index)
        for instance in map(ModelInstanceIndex, range(plant.num_model_instances()))
        if plant.GetModelInstanceName(instance).startswith(OBSTACLE_PREFIX)
        for index in plant.GetBodyIndices(instance)
    ]


def tool_frame_name(plant: MultibodyPlant) -> str:
    """Scoped name of the tool point's frame E."""
    return str(plant.GetFrameByName(TOOL_FRAME).scoped_name().get_full())


def make_differential_ik(
    scenario: Scenario, checker: SceneGraphCollisionChecker, parameters: PeerParameters
) -> DifferentialInverseKinematicsSystem:
    """The system with its program; it is to be asked every `scenario.policy.period`.

    Raises:
        ScenarioError: if the scenario has no robot.
    """
    if scenario.robot is None:
        raise ScenarioError("robot: differential inverse kinematics needs one; it is null")
    System, plant = DifferentialInverseKinematicsSystem, checker.plant()
    tracking = System.LeastSquaresCost.Config(cartesian_qp_weight=parameters.weight)
    centering = System.JointCenteringCost.Config(posture_gain=parameters.posture_gain)
    collision = System.CollisionConstraint.Config(
        safety_distance=parameters.safety_distance,
        influence_distance=parameters.safety_distance + parameters.influence,
    )
    recipe = System.Recipe()
    recipe.AddIngredient(System.LeastSquaresCost(tracking))
    recipe.AddIngredient(System.JointCenteringCost(centering))
    recipe.AddIngredient(
        System.JointVelocityLimitConstraint(
            System.JointVelocityLimitConstraint.Config(), joint_limits(plant, scenario.robot)
        )
    )
    recipe.AddIngredient(System.CollisionConstraint(collision))
    return System(
        recipe=recipe,
        task_frame=plant.world_frame().scoped_name().get_full(),
        collision_checker=checker,
        active_dof=DofMask([bool(own) for own in robot_dofs(plant)]),
        time_step=parameters.horizon,
        # The system asks for gain (X - X_now) / time_step; the step is the policy's.
        K_VX=parameters.gain * parameters.horizon / scenario.policy.period,
        Vd_TG_limit=SpatialVelocity(
            w=np.full(3, parameters.angular_limit),
            v=np.full(3, parameters.speed_share * _planned_speed(scenario)),
        ),
    )


def _planned_speed(scenario: Scenario) -> float:
    """Greatest speed of the planned motion [m/s]."""
    dmp = make_dmp(scenario)
    planned = trajectory(dmp, scenario.task.start, scenario.task.goal)
    return float(np.linalg.norm(planned.z, axis=1).max()) / dmp.duration


def make_joint_controller(
    plant: MultibodyPlant, parameters: PeerParameters
) -> InverseDynamicsController:
    """Drake's inverse dynamics controller over all joints of a plant."""
    n = plant.num_positions()
    return InverseDynamicsController(
        plant,
        kp=np.full(n, parameters.kp),
        ki=np.zeros(n),
        kd=np.full(n, parameters.kd),
        has_reference_acceleration=False,
    )
