"""Motion verifier without the other layers: the joint motion of an arm past a ball."""

from dataclasses import replace

import numpy as np
from pydrake.geometry import Sphere
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator

from drake_oa.common.messages import PolicyState
from drake_oa.geometry.collision_scene import CollisionScene, geometry_of
from drake_oa.inference.config import Verified
from drake_oa.planning.motion_search import MotionSearch
from drake_oa.planning.motion_verifier import MotionVerifier
from drake_oa.policy.config import Policy
from drake_oa.policy.dmp import imitate, minimum_jerk
from drake_oa.robot.arm import make_chain
from drake_oa.robot.config import Robot
from drake_oa.robot.plant import home_positions, make_robot_plant
from drake_oa.robot.spheres import make_arm_spheres

CLEARANCE, RADIUS = 0.1, 0.05


def main() -> None:
    """Prints the distances of tool point and ball on the nominal and on the verified motion."""
    robot = Robot()  # The Panda. The arguments for another arm are the fields of a block `robot`.
    plant, q = make_robot_plant(robot), home_positions(robot)
    spheres = make_arm_spheres(plant, q, robot.tool_links, robot.spheres)
    chain = make_chain(plant.plant, plant.tool_frame, q, spheres.arrays)
    q_arm, X_WE = q[chain.q_index], plant.tool_poses(q[None])[0]
    start, goal = X_WE.translation(), X_WE.translation() + [0.0, 0.45, 0.0]
    dmp = imitate(*minimum_jerk(start, goal, duration=5.0))
    settings = {"orientation": lambda s: np.tile(X_WE.rotation().matrix(), (len(s), 1, 1))}
    settings |= {"posture": lambda s: np.tile(q_arm, (len(s), 1))}  # In the null space.
    settings |= {"parameters": Verified(), "policy": Policy(), "protrusion": spheres.protrusion}
    search = MotionSearch(dmp, CLEARANCE, chain, spheres.arrays, **settings)
    verifier = MotionVerifier(search, tuple(chain.q_index.tolist()), 2 * len(q))
    simulator = Simulator(verifier)
    context = simulator.get_mutable_context()

    X_WO = RigidTransform(start + [0.0, 0.22, -0.05])
    ball = replace(geometry_of(Sphere(RADIUS)), X_WO=X_WO.GetAsMatrix4())
    inputs = {"policy_state": PolicyState(p_WE=start, p_WS=start, p_WG=goal), "goal": goal}
    scene, x = CollisionScene.of(0.0, [ball]), np.append(q, np.zeros(len(q)))
    inputs |= {"collision_scene_W": scene, "robot_state": x}
    for name, value in inputs.items():
        verifier.GetInputPort(name).FixValue(context, value)
    simulator.AdvanceTo(0.5)  # The simulated latency of the decision has passed.
    motion = verifier.GetOutputPort("motion").Eval(context)
    q_motion = np.tile(q, (len(motion), 1))
    q_motion[:, chain.q_index] = motion.q
    verified = [pose.translation() for pose in plant.tool_poses(q_motion)]
    for name, path in {"nominal": np.linspace(start, goal, 100), "verified": verified}.items():
        distance = np.linalg.norm(path - X_WO.translation(), axis=1).min() - RADIUS
        print(f"{name} motion: minimum distance of ball and tool point {distance:.3f} m")


if __name__ == "__main__":
    main()
