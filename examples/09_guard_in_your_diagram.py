"""Motion guard and controller in your own diagram: a resting arm evades a ball that flies at it."""

from dataclasses import replace

import numpy as np
from pydrake.geometry import Sphere
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drake_oa.common.messages import PlannedMotion, PolicyState
from drake_oa.control.joint_inverse_dynamics import JointInverseDynamics
from drake_oa.geometry.collision_scene import CollisionScene, geometry_of
from drake_oa.policy.config import Policy
from drake_oa.robot.arm import make_chain
from drake_oa.robot.config import Robot
from drake_oa.robot.plant import add_robot, home_positions, make_robot_plant
from drake_oa.robot.spheres import make_arm_spheres
from drake_oa.safety.config import GuardParameters
from drake_oa.safety.maneuvers import ACTIONS
from drake_oa.safety.motion_guard import MotionGuard

STEP, RADIUS, VELOCITY = Policy().period, 0.05, np.array([-0.5, 0.0, 0.0])


def main() -> None:
    """Prints the changes of the guard's action, and the minimum distance of ball and tool point."""
    robot = Robot()  # The Panda. The arguments for another arm are the fields of a block `robot`.
    model, q = make_robot_plant(robot), home_positions(robot)
    spheres = make_arm_spheres(model, q, robot.tool_links, robot.spheres)
    chain = make_chain(model.plant, model.tool_frame, q, spheres.arrays)
    q_arm, settings = q[chain.q_index], {"config": Policy(), "parameters": GuardParameters()}
    tool = {"tool_frame": model.tool_frame.name(), "finger_opening": robot.finger_opening}

    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.002)
    arm = add_robot(plant, robot)
    plant.Finalize()
    # The duration of the motion is 5 s.
    guard = builder.AddSystem(MotionGuard(model, chain, spheres, 5.0, q_arm, **settings))
    controller = builder.AddSystem(JointInverseDynamics(model.plant, **tool))
    for system in (guard, controller):
        state = plant.get_state_output_port(arm)
        builder.Connect(state, system.GetInputPort("robot_state"))
    for source, reader, names in (
        (guard, controller, ("desired_joint_state", "desired_joint_acceleration")),
        (controller, guard, ("torque_saturation", "stopping")),
    ):
        for name in names:
            builder.Connect(source.GetOutputPort(name), reader.GetInputPort(name))
    builder.Connect(controller.GetOutputPort("actuation"), plant.get_actuation_input_port(arm))
    simulator = Simulator(builder.Build())
    root = simulator.get_mutable_context()
    plant.SetPositions(plant.GetMyMutableContextFromRoot(root), arm, q)
    context = guard.GetMyMutableContextFromRoot(root)

    # The other inputs of the guard are fixed: the verified motion is rest at the present pose.
    X_WE, zeros = model.tool_poses(q[None])[0], np.zeros(len(q_arm))
    p_WE = X_WE.translation()
    motion = PlannedMotion(np.array([0.0, 2.0]), np.tile(p_WE, (2, 1)), np.tile(q_arm, (2, 1)))
    inputs = {"policy_state": PolicyState(p_WE=p_WE, p_WS=p_WE, p_WG=p_WE), "motion": motion}
    inputs |= {"desired_position": p_WE, "desired_velocity": np.zeros(3)}
    inputs |= {"desired_orientation": X_WE.rotation().ToQuaternion().wxyz()}
    inputs |= {"desired_angular_velocity": np.zeros(3), "desired_posture": np.append(q_arm, zeros)}
    action, distances = -1, []
    for time in np.arange(0.0, 3.5, STEP):
        X_WO = np.eye(4)
        X_WO[:3, 3] = p_WE + (time - 2.0) * VELOCITY  # At the tool point after 2 s.
        ball = replace(geometry_of(Sphere(RADIUS)), X_WO=X_WO, v_WO=VELOCITY, stamp=time)
        inputs |= {"collision_scene_W": CollisionScene.of(time, [ball])}
        for name, value in inputs.items():
            guard.GetInputPort(name).FixValue(context, value)
        simulator.AdvanceTo(time + STEP)
        x = plant.get_state_output_port(arm).Eval(plant.GetMyContextFromRoot(root))
        tool_W = model.tool_poses(x[None, : len(q)])[0].translation()
        distances.append(np.linalg.norm(tool_W - X_WO[:3, 3]) - RADIUS)
        if action != (action := int(guard.GetOutputPort("guard_action").Eval(context)[0])):
            print(f"{time:.2f} s: {ACTIONS[action]}")
    print(f"minimum distance of ball and tool point: {min(distances):.3f} m")


if __name__ == "__main__":
    main()
