"""Baseline method that follows the nominal motion by Drake's differential inverse kinematics with
collision constraints.

    goal -> dmp_integrator [-> orientation_integrator] -> commanded_joints
    commanded_joints -> differential_ik -> commanded_joints -> controller -> plant

The baseline takes the place of the layer `safety`, the systems that turn the desired tool motion
into joint commands, in a diagram without perception (`drake_oa.diagrams.avoidance`). It knows the
obstacles exactly. At each step of `DifferentialInverseKinematicsSystem` a quadratic program
computes the joint velocity v, at the commanded positions, that moves the tool best toward the
desired pose. The program is subject to joint velocity limits, and to a minimum clearance of every
pair of a robot link and an object, or of two links.

The minimum clearance of a pair is the sum of two parameters of Drake: the safety distance s, which
is common to all pairs, and the padding p of the pair. Here s is the smaller of the minimum
clearances of tool and other links; p is the rest. A pair with distance d has the padded distance
phi = d - p. If phi is below s + 0.2 m (`INFLUENCE`), the pair has the collision constraint

    phi + (dphi/dq) v dt >= s,    dt = 0.3 s (`HORIZON`).

Between d = 0 and d = p the gradient of Drake 1.51 has the wrong sign (RobotLocomotion/drake#25016),
which would increase a penetration. If s > 0, a pair is in this region only if its distance is more
than s below its minimum clearance.
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import sys
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.inverse_kinematics import DifferentialInverseKinematicsSystem
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import MultibodyPlant
from pydrake.planning import DofMask, JointLimits, RobotDiagramBuilder, SceneGraphCollisionChecker
from pydrake.systems.framework import BasicVector, BusValue, Context, DiscreteValues, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import FloatArray
from drake_oa.common.signal_builder import SignalBuilder
from drake_oa.diagrams.avoidance import Layers, without_avoidance
from drake_oa.diagrams.control import add_control
from drake_oa.diagrams.motion import make_dmp
from drake_oa.diagrams.station import StationModel
from drake_oa.policy.dmp import trajectory
from drake_oa.robot.grasped_object import exclude_grasp_contacts, tool_links
from drake_oa.robot.plant import TOOL_FRAME, make_robot_plant
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.report import achievable_clearance_of
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.world.obstacles import obstacle_instances
from drake_oa.world.world_model import add_world

_EDGE_STEP = 0.1
"""Step of Drake's collision checker for edges in joint space, a required argument without effect
here [rad]."""
SELF_DISTANCE = 0.005
"""Minimum distance between links of the robot in the differential IK baseline [m].

It is above 0, where the gradient of Drake's distances changes its sign. It is below 13 mm, the
distance between links of the UR5 that cannot move apart."""
INFLUENCE = 0.2
"""Excess of the distance between link and object over the minimum clearance of this pair, above
which the differential IK baseline ignores the pair [m]."""
HORIZON = 0.3
"""Time dt in the collision constraint of the differential IK baseline [s]. The joint velocity must
not reduce a distance below the minimum clearance within this time.

With the policy's step of 8 ms the quadratic program was infeasible in 8 of 9 scenes; with 0.3 s it
was in 1 of 9."""
GAIN = 0.2
"""Fraction of the tool's pose error that the desired tool velocity of the differential IK baseline
corrects in one period of the policy [-]."""
SPEED_FACTOR = 1.2
"""Maximum desired tool velocity along an axis in the differential IK baseline, as a multiple of the
maximum speed of the nominal motion, without avoidance [-]."""
ANGULAR_LIMIT = 2.5
"""Maximum desired angular velocity of the tool about an axis in the differential IK baseline
[rad/s]."""
WEIGHT = 100.0
"""Weight of the tool's velocity error in the differential IK baseline, relative to the weight of
the cost that attracts the arm to its nominal posture [-]."""
KP = 2500.0
"""Stiffness of the joint controller that tracks the commands of the differential IK baseline
[1/s^2]."""
KD = 100.0
"""Damping of the joint controller that tracks the commands of the differential IK baseline [1/s].
"""


ARM_DISTANCE = 0.02
"""Upper bound of the minimum clearance in the differential IK baseline between obstacles and links
other than the tool, and between the environment and all links [m]."""
METHOD = "DifferentialInverseKinematics"
"""Name of the differential IK baseline in the field `inference` of a log."""


def make_collision_checker(
    scenario: Scenario,
    *,
    tool_padding: float,
    link_padding: float,
    world_padding: float = 0.0,
    self_padding: float = 0.0,
) -> SceneGraphCollisionChecker:
    """Makes Drake's collision checker of a scenario's world, with one padding for each kind of
    pairs of bodies.

    A padding is subtracted from the distance of a pair. The world contains the same robot,
    obstacles and environment (table, for example) as the simulated station. Fixed links are left
    out, since no joint velocity changes their distances.

    Args:
        scenario: scenario with a robot.
        tool_padding: padding between tool and obstacles [m].
        link_padding: padding between the other links and obstacles [m].
        world_padding: padding between the robot and the environment [m].
        self_padding: padding between links of the robot [m].
    """
    builder = RobotDiagramBuilder(time_step=0.0)
    plant = builder.plant()
    instance = add_world(plant, scenario)
    plant.Finalize()
    exclude_grasp_contacts(plant, builder.scene_graph(), scenario.robot)
    obstacles = obstacle_instances(plant)
    checker = SceneGraphCollisionChecker(
        model=builder.Build(), robot_model_instances=[instance], edge_step_size=_EDGE_STEP
    )
    plant, of_tool = checker.plant(), tool_links(robot_of(scenario))
    checker.SetPaddingAllRobotEnvironmentPairs(world_padding)
    checker.SetPaddingAllRobotRobotPairs(self_padding)
    for link in map(plant.get_body, plant.GetBodyIndices(instance)):
        if plant.IsAnchored(link):
            checker.SetCollisionFilteredWithAllBodies(link.index())
            continue
        padding = tool_padding if link.name() in of_tool else link_padding
        for obstacle in obstacles:
            for index in plant.GetBodyIndices(obstacle):
                checker.SetPaddingBetween(link.index(), index, padding)
    return checker


def make_differential_ik(
    scenario: Scenario, checker: SceneGraphCollisionChecker, safety: float
) -> DifferentialInverseKinematicsSystem:
    """Makes Drake's differential IK system with cost, limits and collision constraints, to be
    evaluated every `scenario.policy.period`.

    Args:
        scenario: scenario with a robot.
        checker: collision checker with paddings.
        safety: safety distance s, added to the padding of every pair [m].
    """
    System, plant = DifferentialInverseKinematicsSystem, checker.plant()
    dmp = make_dmp(scenario)
    planned = trajectory(dmp, scenario.task.start, scenario.task.goal)
    speed = SPEED_FACTOR * float(np.linalg.norm(planned.z, axis=1).max()) / dmp.duration
    active = DofMask.MakeFromModel(plant, plant.GetFrameByName(TOOL_FRAME).model_instance())
    cost, limits = System.LeastSquaresCost, System.JointVelocityLimitConstraint
    centering, collision = System.JointCenteringCost, System.CollisionConstraint
    distances = collision.Config(safety_distance=safety, influence_distance=safety + INFLUENCE)
    recipe = System.Recipe()
    recipe.AddIngredient(cost(cost.Config(cartesian_qp_weight=WEIGHT)))
    recipe.AddIngredient(centering(centering.Config()))
    recipe.AddIngredient(limits(limits.Config(), JointLimits(plant, active)))
    recipe.AddIngredient(collision(distances))
    return System(
        recipe=recipe,
        task_frame=plant.world_frame().scoped_name().get_full(),
        collision_checker=checker,
        active_dof=active,
        time_step=HORIZON,
        # The system's velocity is K_VX (X - X_now) / time_step; its real step is the policy's.
        K_VX=GAIN * HORIZON / scenario.policy.period,
        Vd_TG_limit=SpatialVelocity(w=np.full(3, ANGULAR_LIMIT), v=np.full(3, speed)),
    )


class CommandedJoints(LeafSystem):
    """Integrator of the joint velocity from Drake's differential IK system, and source of that
    system's inputs.

    .. pydrake_system::

      name: CommandedJoints
      input_ports:
      - joint_velocity
      - desired_position
      - desired_velocity
      - desired_orientation (optional)
      - desired_angular_velocity (optional)
      - desired_posture (optional)
      - plant_state
      output_ports:
      - desired_joint_state
      - desired_cartesian_poses
      - position
      - nominal_posture

    - joint_velocity: (n,) velocity of the robot's n joints, fingers included, computed by the
      differential IK system [rad/s, m/s].
    - desired_position: (3,) tool position p_WE of the nominal motion [m].
    - desired_velocity: (3,) tool velocity v_WE of the nominal motion [m/s].
    - desired_orientation (optional): (4,) quaternion w, x, y, z of R_WE. Not connected: the
      orientation is `rpy_WE` of the scenario's robot.
    - desired_angular_velocity (optional): (3,) angular velocity w_WE of the tool [rad/s], connected
      whenever desired_orientation is.
    - desired_posture (optional): (2m,) nominal posture of the arm's m joints and its derivative
      [rad, rad/s]. Not connected: the posture is that of the start.
    - plant_state: state of the station's plant, from which the obstacles' positions are read.
    - desired_joint_state: (2m,) commanded positions [rad] and velocities [rad/s] of the arm.
    - desired_cartesian_poses: abstract `BusValue` with the desired pose X_WE of the tool frame,
      extrapolated by a time look_ahead that compensates the lag of the command: p_WE + look_ahead
      v_WE, and exp(look_ahead w_WE) R_WE.
    - position: positions of the whole plant, with the robot at its commanded positions [rad, m].
    - nominal_posture: positions of the whole plant, with the robot in its nominal posture [rad, m].

    The discrete state is the commanded positions q and velocities v. Each period h of the policy, v
    becomes the input joint_velocity and q becomes q + h v.
    """

    def __init__(self, scenario: Scenario, plant: MultibodyPlant, q_start: FloatArray) -> None:
        """Declares ports, discrete state and periodic update of the system.

        Args:
            scenario: scenario with a robot.
            plant: plant of the collision checker, with the same positions as the station's plant.
            q_start: (n,) positions of the robot at the start, fingers included [rad, m].
        """
        super().__init__()
        robot, self._q_start, n = robot_of(scenario), np.array(q_start), len(q_start)
        self._R_WE = RollPitchYaw(robot.rpy_WE).ToRotationMatrix().matrix()
        # Correcting the fraction g of an error at each step h, the command lags a steady motion by
        # h (1 / g - 1) at the end of the step. The velocity is applied from the step's beginning,
        # half a step early on average.
        self._period = scenario.policy.period
        self._look_ahead = self._period * (1.0 / GAIN - 0.5)
        self._plant, self._arm = plant, len(robot.q_seed)
        tool_frame = plant.GetFrameByName(TOOL_FRAME)
        self._robot, self._tool = tool_frame.model_instance(), tool_frame.scoped_name().get_full()
        sizes = {
            "joint_velocity": n,
            "desired_position": 3,
            "desired_velocity": 3,
            "desired_orientation": 4,
            "desired_angular_velocity": 3,
            "desired_posture": 2 * self._arm,
            "plant_state": plant.num_multibody_states(),
        }
        self._inputs = {name: self.DeclareVectorInputPort(name, sizes[name]) for name in sizes}
        # No feedthrough of the velocity, as the program computes it from these outputs.
        prerequisites = {
            port.ticket() for name, port in self._inputs.items() if name != "joint_velocity"
        }
        prerequisites.add(self.xd_ticket())
        self.DeclareDiscreteState(np.append(q_start, np.zeros(n)))
        self.DeclarePeriodicDiscreteUpdateEvent(self._period, 0.0, self._advance)
        for name, size, calc, tickets in (
            ("desired_joint_state", 2 * self._arm, self._calc_state, {self.xd_ticket()}),
            ("position", plant.num_positions(), self._calc_position, prerequisites),
            ("nominal_posture", plant.num_positions(), self._calc_posture, prerequisites),
        ):
            self.DeclareVectorOutputPort(name, size, calc, tickets)
        self.DeclareAbstractOutputPort(
            "desired_cartesian_poses", lambda: Value(BusValue()), self._calc_poses, prerequisites
        )

    def _advance(self, context: Context, values: DiscreteValues) -> None:
        q, _ = np.split(context.get_discrete_state_vector().value(), 2)
        v = self._inputs["joint_velocity"].Eval(context)
        values.set_value(np.append(q + self._period * v, v))

    def _calc_state(self, context: Context, output: BasicVector) -> None:
        parts = np.split(context.get_discrete_state_vector().value(), 2)
        output.SetFromVector(np.concatenate([part[: self._arm] for part in parts]))

    def _calc_poses(self, context: Context, output: AbstractValue) -> None:
        R_WE = self._R_WE
        if self._inputs["desired_orientation"].HasValue(context):
            turning = self._inputs["desired_angular_velocity"].Eval(context)
            quaternion = self._inputs["desired_orientation"].Eval(context)
            ahead = Rotation.from_rotvec(self._look_ahead * turning)
            R_WE = (ahead * Rotation.from_quat(quaternion, scalar_first=True)).as_matrix()
        v_WE = self._inputs["desired_velocity"].Eval(context)
        p_WE = self._inputs["desired_position"].Eval(context) + self._look_ahead * v_WE
        poses = BusValue()
        poses.Set(self._tool, Value(RigidTransform(RotationMatrix(R_WE), p_WE)))
        output.set_value(poses)

    def _calc_position(self, context: Context, output: BasicVector) -> None:
        q_robot, _ = np.split(context.get_discrete_state_vector().value(), 2)
        self._set_positions(context, q_robot, output)

    def _calc_posture(self, context: Context, output: BasicVector) -> None:
        q_robot = self._q_start.copy()
        if self._inputs["desired_posture"].HasValue(context):
            desired = self._inputs["desired_posture"].Eval(context)
            q_robot[: self._arm] = desired[: self._arm]
        self._set_positions(context, q_robot, output)

    def _set_positions(self, context: Context, q_robot: FloatArray, output: BasicVector) -> None:
        """Sets an output to the positions of the whole plant, with those of the robot replaced by
        q_robot.

        Args:
            context: context of the system.
            q_robot: (n,) positions of the robot [rad, m].
            output: value of the output port.
        """
        q = self._inputs["plant_state"].Eval(context)[: self._plant.num_positions()].copy()
        self._plant.SetPositionsInArray(self._robot, q_robot, q)
        output.set_value(q)


@contextlib.contextmanager
def _without_solver_messages() -> Iterator[None]:
    """Suppresses messages of Drake and the solver OSQP, about infeasible steps and inactive
    constraints, within a `with` block.
    """
    logger = logging.getLogger("drake")
    level, out = logger.level, os.dup(1)
    logger.setLevel(logging.ERROR)
    sys.stdout.flush()
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 1)
    try:
        yield
    finally:
        # C code buffers its output separately; flush it before stdout is restored.
        ctypes.CDLL(None).fflush(None)
        os.dup2(out, 1)
        os.close(out)
        logger.setLevel(level)


def simulate_differential_ik(scenario: Scenario, duration: float | None = None) -> MotionLog:
    """Simulates a motion with the differential IK baseline until it terminates and the world is at
    rest.

    The desired tool pose follows the nominal motion and then stays at the goal. While the quadratic
    program is infeasible the commanded joint positions are held.

    The minimum clearance of the tool is the achievable clearance: the requested one, limited by the
    clearances at start and goal. The minimum clearance of other links is the requested one, at most
    2 cm (`ARM_DISTANCE`).

    Args:
        scenario: scenario with a robot; its perception and inference are not used.
        duration: time limit [s]; None: six times the demonstrated duration after the last move of
            the goal, as in `simulate`.

    Returns:
        The log, without observations; its `inference` is `METHOD`.

    Raises:
        ScenarioError: if the scenario has no robot, or its start or goal is out of reach.
        MotionInterruptedError: if the simulation raised an exception or was interrupted; it has the
            log until then, and the cause.
    """
    robot = robot_of(scenario)
    # A minimum clearance above that of the start would make the first step infeasible.
    tool, arm = achievable_clearance_of(scenario), min(ARM_DISTANCE, scenario.task.clearance)
    safety = min(tool, arm)
    gains = replace(robot.gains, kp_position=KP, kd_position=KD, ki_position=0.0)
    stiff = replace(scenario, robot=replace(robot, gains=gains))

    def add_program(
        signals: SignalBuilder, scenario: Scenario, station: StationModel | None
    ) -> None:
        if station is None:
            return
        checker = make_collision_checker(
            scenario,
            tool_padding=tool - safety,
            link_padding=arm - safety,
            world_padding=arm - safety,
            self_padding=SELF_DISTANCE - safety,
        )
        signals.add("commanded_joints", CommandedJoints(scenario, checker.plant(), station.q_start))
        steady = ConstantVectorSource(np.zeros(len(robot.q_seed)))
        signals.add("steady", steady, outputs={"y0": "desired_joint_acceleration"})
        program = make_differential_ik(scenario, checker, safety)
        signals.add("differential_ik", program, outputs={"commanded_velocity": "joint_velocity"})

    layers = replace(
        without_avoidance(Layers()),
        safety=add_program,
        control=lambda signals, _, station: add_control(signals, stiff, station),
    )
    with _without_solver_messages():
        log = replace(simulate(scenario, duration=duration, layers=layers), inference=METHOD)
    if not len(log.desired_orientation):
        return log
    poses = make_robot_plant(robot).tool_poses(log.q)
    actual = Rotation.from_matrix([X_WE.rotation().matrix() for X_WE in poses])
    desired = Rotation.from_quat(log.desired_orientation, scalar_first=True)
    return replace(log, orientation_error=(desired * actual.inv()).as_rotvec())
