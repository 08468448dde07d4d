"""Drake's differential inverse kinematics on the simulated station, along the pre-planned motion.

    goal -> dmp_integrator [-> orientation_integrator] -> inputs -> differential_ik ->
    commanded_position (integral), commanded_velocity (held) -> commanded_state
    commanded_position, positions of the moving obstacles -> inputs

    commanded_state -> controller -> actuation -> effort_limits -> plant

The program starts from the commanded positions. At each step of
`DifferentialInverseKinematicsSystem` a quadratic program finds the joint velocity that brings the
tool nearest to the asked pose, subject to joint velocity limits and, for every pair (robot link,
thing) with padded distance phi = d - p below the influence distance, to

    phi + (dphi/dq) v dt >= s,

so that a pair keeps s + p. The safety distance s is the smaller of what tool and arm keep, and
the padding p is what a pair keeps besides. Between d = 0 and d = p the gradient of Drake 1.51
has the wrong sign (RobotLocomotion/drake#25016), and the program would drive such a pair
further in: with s > 0 this region lies s inside of what is kept.
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.inverse_kinematics import DifferentialInverseKinematicsSystem
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.planning import DofMask, JointLimits, RobotDiagramBuilder, SceneGraphCollisionChecker
from pydrake.systems.analysis import Simulator
from pydrake.systems.controllers import InverseDynamicsController
from pydrake.systems.framework import (
    BasicVector,
    BusValue,
    Context,
    Diagram,
    DiagramBuilder,
    LeafSystem,
)
from pydrake.systems.primitives import (
    DiscreteTimeIntegrator,
    MatrixGain,
    Multiplexer,
    Saturation,
    ZeroOrderHold,
)
from scipy.spatial.transform import Rotation

from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import FloatArray
from drake_oa.common.wires import Wires
from drake_oa.diagrams.faults import add_drivers
from drake_oa.diagrams.motion import (
    add_orientation,
    make_dmp,
    make_dmp_integrator,
    make_goal,
    make_orientation_integrator,
)
from drake_oa.diagrams.station import make_posture_guide
from drake_oa.policy.dmp import normalised_time, trajectory
from drake_oa.robot.grasped_object import part_carried, tool_links
from drake_oa.robot.plant import TOOL_FRAME, make_robot_plant
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.simulation import MotionWatcher, run_motion
from drake_oa.scenario.end_poses import start_positions
from drake_oa.scenario.obstacles import OBSTACLE_PREFIX
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.world.station import make_station
from drake_oa.world.world_model import add_world

_EDGE_STEP = 0.1
"""Step of the collision checker's checks of edges, which are not used here [rad]."""
SELF_DISTANCE = 0.005
"""Distance that links keep from one another [m]. Not 0, where the gradient's sign changes; links of
the UR5 that cannot come apart are 13 mm from one another."""
INFLUENCE = 0.2
"""Pairs whose distance exceeds the safety distance by more than this are left out [m]."""
HORIZON = 0.3
"""dt of the collision constraint [s]: a link may use up the distance that is left to it within this
time, and no faster. With the policy's step of 8 ms for it, the program was left without a solution
in 8 of 9 scenes; with 0.3 s in 1."""
GAIN = 0.2
"""Share of the pose error that the asked velocity makes up in a step."""
SPEED_SHARE = 1.2
"""Largest asked tool velocity along an axis, as a multiple of the planned motion's greatest
speed."""
ANGULAR_LIMIT = 2.5
"""Largest asked tool rate about an axis [rad/s]."""
WEIGHT = 100.0
"""Weight of the tool's velocity error against the posture's."""
KP, KD = 2500.0, 100.0
"""Stiffness [1/s^2] and damping [1/s] of the joint controller."""


@dataclass(frozen=True)
class KeptDistances:
    """Distances that the program keeps.

    Attributes:
        tool: of the tool from obstacles [m].
        arm: of the other links from obstacles, and of every link from the rest of the world [m].
    """

    tool: float = 0.03
    arm: float = 0.02

    @property
    def safety(self) -> float:
        """Distance that tool and arm both keep from obstacles [m]."""
        return min(self.tool, self.arm)


_DISTANCES = KeptDistances()
METHOD = "DifferentialInverseKinematics"
"""The log's `regulation`."""


def make_collision_checker(
    scenario: Scenario, *, tool: float, links: float, world: float, own: float
) -> SceneGraphCollisionChecker:
    """Makes the collision model of a scenario's world, the same as the station's.

    Links that no joint moves are left out: no velocity changes their distances.

    Args:
        scenario: with a robot.
        tool: padding of the tool and obstacles [m].
        links: padding of the other links and obstacles [m].
        world: padding of the robot and the rest of the world [m].
        own: padding of the links among each other [m].

    Raises:
        ScenarioError: if something can move besides the robot and the obstacles that the
            scenario drives.
    """
    builder = RobotDiagramBuilder(time_step=0.0)
    plant = builder.plant()
    instance = add_world(plant, scenario)
    plant.Finalize()
    part_carried(plant, builder.scene_graph(), scenario.robot)
    obstacles = [
        other
        for other in map(ModelInstanceIndex, range(plant.num_model_instances()))
        if plant.GetModelInstanceName(other).startswith(OBSTACLE_PREFIX)
    ]
    if plant.num_positions() != sum(map(plant.num_positions, [instance, *obstacles])):
        raise ScenarioError(
            "directives: something besides the robot and the obstacles that are driven can move; "
            "differential inverse kinematics needs to know where everything is"
        )
    checker = SceneGraphCollisionChecker(
        model=builder.Build(), robot_model_instances=[instance], edge_step_size=_EDGE_STEP
    )
    plant, of_tool = checker.plant(), tool_links(robot_of(scenario))
    checker.SetPaddingAllRobotEnvironmentPairs(world)
    checker.SetPaddingAllRobotRobotPairs(own)
    for link in map(plant.get_body, plant.GetBodyIndices(instance)):
        if plant.IsAnchored(link):
            checker.SetCollisionFilteredWithAllBodies(link.index())
            continue
        padding = tool if link.name() in of_tool else links
        for obstacle in obstacles:
            for index in plant.GetBodyIndices(obstacle):
                checker.SetPaddingBetween(link.index(), index, padding)
    return checker


def make_differential_ik(
    scenario: Scenario, checker: SceneGraphCollisionChecker, distances: KeptDistances
) -> DifferentialInverseKinematicsSystem:
    """Makes the system with its program, which runs every `scenario.policy.period`."""
    System, plant = DifferentialInverseKinematicsSystem, checker.plant()
    dmp = make_dmp(scenario)
    planned = trajectory(dmp, scenario.task.start, scenario.task.goal)
    greatest_speed = float(np.linalg.norm(planned.z, axis=1).max()) / dmp.duration
    active = DofMask.MakeFromModel(plant, plant.GetFrameByName(TOOL_FRAME).model_instance())
    recipe = System.Recipe()
    for ingredient in (
        System.LeastSquaresCost(System.LeastSquaresCost.Config(cartesian_qp_weight=WEIGHT)),
        System.JointCenteringCost(System.JointCenteringCost.Config()),
        System.JointVelocityLimitConstraint(
            System.JointVelocityLimitConstraint.Config(), JointLimits(plant, active)
        ),
        System.CollisionConstraint(
            System.CollisionConstraint.Config(
                safety_distance=distances.safety,
                influence_distance=distances.safety + INFLUENCE,
            )
        ),
    ):
        recipe.AddIngredient(ingredient)
    return System(
        recipe=recipe,
        task_frame=plant.world_frame().scoped_name().get_full(),
        collision_checker=checker,
        active_dof=active,
        time_step=HORIZON,
        # The system asks for gain (X - X_now) / time_step; the step is the policy's.
        K_VX=GAIN * HORIZON / scenario.policy.period,
        Vd_TG_limit=SpatialVelocity(
            w=np.full(3, ANGULAR_LIMIT),
            v=np.full(3, SPEED_SHARE * greatest_speed),
        ),
    )


class ProgramInputs(LeafSystem):
    """Inputs of the program from the planned motion, the commanded positions and the obstacles.

    .. pydrake_system::

      name: ProgramInputs
      input_ports:
      - desired_position
      - desired_velocity
      - desired_orientation (optional)
      - desired_angular_velocity (optional)
      - phase
      - commanded_position
      - plant_state
      output_ports:
      - desired_cartesian_poses
      - position
      - nominal_posture

    - desired_position: (3,) p_WE [m].
    - desired_velocity: (3,) v_WE [m/s].
    - desired_orientation (optional): (4,) quaternion w, x, y, z of R_WE. Without it the
      orientation is that of the robot's block.
    - desired_angular_velocity (optional): (3,) w_WE [rad/s].
    - phase: (1,) phase of the motion.
    - commanded_position: (n,) positions of the robot [rad, m].
    - plant_state: state of the station's plant, of which the obstacles' positions are used.
    - desired_cartesian_poses: abstract `BusValue` with the pose X_WE of the tool frame a moment
      later: p_WE + look_ahead v_WE, and exp(look_ahead w_WE) R_WE.
    - position: positions of the whole world [rad, m].
    - nominal_posture: positions of the robot at the start, in the world's; led to the joints at
      the goal where the task gives them [rad, m].

    There is no state.
    """

    def __init__(self, scenario: Scenario, plant: MultibodyPlant, q_start: FloatArray) -> None:
        """Declares the ports.

        Args:
            scenario: with a robot.
            plant: of the collision checker; its positions are those of the station's plant.
            q_start: (n,) all positions of the robot at the start.
        """
        super().__init__()
        robot, self._q_start = robot_of(scenario), np.array(q_start)
        self._R_WE = RollPitchYaw(robot.rpy_WE).ToRotationMatrix().matrix()
        # Making up the share g of an error at each step h, the command follows a steady motion
        # h (1 / g - 1) late at the end of the step; it is given at its beginning and is held, so
        # that it is half a step early there.
        self._look_ahead = scenario.policy.period * (1.0 / GAIN - 0.5)
        self._guide = make_posture_guide(scenario, q_start[: len(robot.q_seed)])
        self._plant, self._alpha_k = plant, scenario.policy.alpha_k
        tool_frame = plant.GetFrameByName(TOOL_FRAME)
        self._robot, self._tool = tool_frame.model_instance(), tool_frame.scoped_name().get_full()
        self._inputs = {
            name: self.DeclareVectorInputPort(name, size)
            for name, size in (
                ("desired_position", 3),
                ("desired_velocity", 3),
                ("desired_orientation", 4),
                ("desired_angular_velocity", 3),
                ("phase", 1),
                ("commanded_position", len(q_start)),
                ("plant_state", plant.num_multibody_states()),
            )
        }
        n = plant.num_positions()
        self.DeclareAbstractOutputPort(
            "desired_cartesian_poses", lambda: Value(BusValue()), self._calc_poses
        )
        self.DeclareVectorOutputPort("position", n, self._calc_position)
        self.DeclareVectorOutputPort("nominal_posture", n, self._calc_posture)

    def _calc_poses(self, context: Context, output: AbstractValue) -> None:
        p_WE, v_WE = (
            self._inputs[name].Eval(context) for name in ("desired_position", "desired_velocity")
        )
        R_WE = self._R_WE
        if self._inputs["desired_orientation"].HasValue(context):
            quaternion = self._inputs["desired_orientation"].Eval(context)
            turning = self._inputs["desired_angular_velocity"].Eval(context)
            ahead = Rotation.from_rotvec(self._look_ahead * turning)
            R_WE = (ahead * Rotation.from_quat(quaternion, scalar_first=True)).as_matrix()
        X_WE = RigidTransform(RotationMatrix(R_WE), p_WE + self._look_ahead * v_WE)
        poses = BusValue()
        poses.Set(self._tool, Value(X_WE))
        output.set_value(poses)

    def _calc_position(self, context: Context, output: BasicVector) -> None:
        q = self._inputs["plant_state"].Eval(context)[: self._plant.num_positions()].copy()
        q_robot = self._inputs["commanded_position"].Eval(context)
        self._plant.SetPositionsInArray(self._robot, q_robot, q)
        output.set_value(q)

    def _calc_posture(self, context: Context, output: BasicVector) -> None:
        # No posture is requested of the obstacles.
        posture, q_robot = np.zeros(self._plant.num_positions()), self._q_start.copy()
        if self._guide is not None:
            s = normalised_time(self._inputs["phase"].Eval(context)[0], self._alpha_k)
            (arm,) = self._guide(np.array([s]))
            q_robot[: len(arm)] = arm
        self._plant.SetPositionsInArray(self._robot, q_robot, posture)
        output.set_value(posture)


def build_differential_ik(
    scenario: Scenario, q_start: FloatArray, distances: KeptDistances
) -> Diagram:
    """Wires the peer on a scenario's station.

    Subsystems by name: plant, scene_graph, goal, dmp_integrator, inputs, differential_ik,
    mover_<model instance>, commanded_position, commanded_velocity, commanded_state, controller,
    actuation, effort_limits, log_<signal>; where the tool turns orientation_integrator.

    Args:
        scenario: with a robot; its perception is not used.
        q_start: (n,) all positions of the robot at the start, and its posture.
        distances: that are kept.

    Raises:
        ScenarioError: naming the field that does not fit.
    """
    robot, period, n = robot_of(scenario), scenario.policy.period, len(q_start)
    builder = DiagramBuilder()
    station = make_station(builder, scenario, render=False)
    plant = station.plant
    plant.SetDefaultPositions(station.robot, q_start)
    wires = Wires(builder)
    wires.offer("plant_state", plant.get_state_output_port())
    wires.offer("robot_state", plant.get_state_output_port(station.robot))
    wires.take("actuation", plant.get_actuation_input_port(station.robot))
    add_drivers(wires, scenario, station)

    # The pre-planned motion, and where the tool turns that of its orientation.
    wires.add("goal", make_goal(scenario), offers={"y0": "goal"})
    wires.add("dmp_integrator", make_dmp_integrator(scenario))
    orientation = make_orientation_integrator(scenario)
    if orientation is not None:
        add_orientation(wires, orientation)

    # From there to the commanded positions and velocities.
    checker = make_collision_checker(
        scenario,
        tool=distances.tool - distances.safety,
        links=distances.arm - distances.safety,
        world=distances.arm - distances.safety,
        own=SELF_DISTANCE - distances.safety,
    )
    wires.add("inputs", ProgramInputs(scenario, checker.plant(), q_start))
    wires.add(
        "differential_ik",
        make_differential_ik(scenario, checker, distances),
        offers={"commanded_velocity": "joint_velocity"},
    )
    for name, held in (
        ("commanded_position", DiscreteTimeIntegrator(n, period)),
        ("commanded_velocity", ZeroOrderHold(period, n)),
    ):
        wires.add(name, held, reads={"u": "joint_velocity"}, offers={"y": name})
    wires.add(
        "commanded_state",
        Multiplexer([n, n]),
        reads={"u0": "commanded_position", "u1": "commanded_velocity"},
        offers={"y0": "commanded_state"},
    )

    # From there to the plant. The arm's dynamics are its own: the controller need not know of
    # driven obstacles.
    model = make_robot_plant(robot).plant
    controller = InverseDynamicsController(
        model,
        kp=np.full(n, KP),
        ki=np.zeros(n),
        kd=np.full(n, KD),
        has_reference_acceleration=False,
    )
    wires.add(
        "controller",
        controller,
        reads={"estimated_state": "robot_state", "desired_state": "commanded_state"},
        offers={controller.get_output_port_control().get_name(): "torque"},
    )
    wires.add(
        "actuation",
        MatrixGain(model.MakeActuationMatrix().T),
        reads={"u0": "torque"},
        offers={"y0": "unlimited_actuation"},
    )
    effort = model.GetEffortUpperLimits()
    wires.add(
        "effort_limits",
        Saturation(-effort, effort),
        reads={"u0": "unlimited_actuation"},
        offers={"y0": "actuation"},
    )
    wires.log("goal", "desired_position", "desired_velocity", "desired_acceleration", "phase")
    wires.log("robot_state", "actuation")
    wires.connect()
    diagram = builder.Build()
    diagram.set_name(METHOD)
    return diagram


@contextlib.contextmanager
def _without_solver_messages() -> Iterator[None]:
    """Suppresses messages of Drake and OSQP on steps without solution or active constraint."""
    logger = logging.getLogger("drake")
    level, out = logger.level, os.dup(1)
    logger.setLevel(logging.ERROR)
    sys.stdout.flush()
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 1)
    try:
        yield
    finally:
        # What is printed from C waits in a buffer of its own.
        ctypes.CDLL(None).fflush(None)
        os.dup2(out, 1)
        os.close(out)
        logger.setLevel(level)


def simulate_differential_ik(
    scenario: Scenario,
    *,
    duration: float | None = None,
    distances: KeptDistances = _DISTANCES,
) -> MotionLog:
    """Runs one motion of the peer until it has ended as one of `simulate` does.

    Until the planned duration is over the tool is asked along the planned motion, and then to the
    goal. Where the program has no solution the robot is held.

    Args:
        scenario: with a robot; its perception and regulation are not used.
        duration: time limit [s]; None: `LONGEST_SCALING` demonstrated durations.
        distances: that are kept.

    Returns:
        The log; `regulation` is `METHOD`, and there are no observations.

    Raises:
        ScenarioError: if the scenario has no robot, or its start or goal is out of reach.
        MotionInterruptedError: if the simulation raised or was interrupted; it
            carries the log until then, and the cause.
    """
    q_start = start_positions(scenario)
    diagram = build_differential_ik(scenario, q_start, distances)
    simulator = Simulator(diagram)
    root = simulator.get_mutable_context()
    integral = diagram.GetSubsystemByName("commanded_position")
    integral.set_integral_value(integral.GetMyMutableContextFromRoot(root), q_start)
    with _without_solver_messages():
        watcher = MotionWatcher(diagram, scenario, duration)
        log = run_motion(scenario, simulator, watcher, modulated=True)
    saturated = (np.abs(log.torque) >= log.effort_limit).any(axis=1).astype(float)
    log = replace(log, regulation=METHOD, saturated=saturated)
    if not len(log.desired_orientation):
        return log
    poses = make_robot_plant(robot_of(scenario)).tool_poses(log.q)
    actual = Rotation.from_matrix([X_WE.rotation().matrix() for X_WE in poses])
    desired = Rotation.from_quat(log.desired_orientation, scalar_first=True)
    return replace(log, orientation_error=(desired * actual.inv()).as_rotvec())
