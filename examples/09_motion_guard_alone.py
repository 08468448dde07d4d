"""Motion guard without the other layers: an arm at rest evades a ball that flies at its hand."""

from dataclasses import replace

import numpy as np
from pydrake.geometry import Sphere
from pydrake.systems.analysis import Simulator

from drake_oa.common.messages import PlannedMotion, PolicyState
from drake_oa.geometry.collision_scene import CollisionScene, geometry_of
from drake_oa.policy.config import Policy
from drake_oa.robot.arm import make_chain
from drake_oa.robot.config import Robot
from drake_oa.robot.plant import home_positions, make_robot_plant
from drake_oa.robot.spheres import make_arm_spheres
from drake_oa.safety.config import GuardParameters
from drake_oa.safety.maneuvers import ACTIONS
from drake_oa.safety.motion_guard import MotionGuard

STEP, RADIUS, VELOCITY = Policy().period, 0.05, np.array([-0.5, 0.0, 0.0])


def main() -> None:
    """Prints the changes of the guard's action, and the minimum distance of ball and tool point."""
    robot = Robot()  # The Panda. The arguments for another arm are the fields of a block `robot`.
    plant, q = make_robot_plant(robot), home_positions(robot)
    spheres = make_arm_spheres(plant, q, robot.tool_links, robot.spheres)
    chain = make_chain(plant.plant, plant.tool_frame, q, spheres.arrays)
    q_arm, settings = q[chain.q_index], {"config": Policy(), "parameters": GuardParameters()}
    guard = MotionGuard(plant, chain, spheres, 5.0, q_arm, **settings)  # 5 s: a motion's duration
    simulator = Simulator(guard)
    context = simulator.get_mutable_context()

    X_WE, x = plant.tool_poses(q[None])[0], np.append(q, np.zeros(len(q)))
    p_WE, at_rest = X_WE.translation(), np.append(q_arm, np.zeros(len(q_arm)))
    motion = PlannedMotion(np.array([0.0, 2.0]), np.tile(p_WE, (2, 1)), np.tile(q_arm, (2, 1)))
    inputs = {"policy_state": PolicyState(p_WE=p_WE, p_WS=p_WE, p_WG=p_WE), "motion": motion}
    inputs |= {"desired_position": p_WE, "desired_velocity": np.zeros(3)}
    inputs |= {"desired_orientation": X_WE.rotation().ToQuaternion().wxyz()}
    inputs |= {"desired_angular_velocity": np.zeros(3), "desired_posture": at_rest}
    action, distances = -1, []
    for time in np.arange(0.0, 3.5, STEP):
        X_WO = np.eye(4)
        X_WO[:3, 3] = p_WE + (time - 2.0) * VELOCITY  # At the tool point after 2 s.
        ball = replace(geometry_of(Sphere(RADIUS)), X_WO=X_WO, v_WO=VELOCITY, stamp=time)
        inputs |= {"robot_state": x, "collision_scene_W": CollisionScene.of(time, [ball])}
        for name, value in inputs.items():
            guard.GetInputPort(name).FixValue(context, value)
        simulator.AdvanceTo(time + STEP)
        command = guard.GetOutputPort("desired_joint_state").Eval(context)  # Followed exactly.
        x[chain.q_index], x[len(q) + chain.q_index] = np.split(command, 2)
        tool_W = plant.tool_poses(x[None, : len(q)])[0].translation()
        distances.append(np.linalg.norm(tool_W - X_WO[:3, 3]) - RADIUS)
        if action != (action := int(guard.GetOutputPort("guard_action").Eval(context)[0])):
            print(f"{time:.2f} s: {ACTIONS[action]}")
    print(f"minimum distance of ball and tool point: {min(distances):.3f} m")


if __name__ == "__main__":
    main()
