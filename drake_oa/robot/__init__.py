"""Robot arm: plant, kinematics as arrays, inverse kinematics, limits, and spheres that cover the
robot.

Input: the block `robot` of a scenario (`config.Robot`: model, base pose X_WB, tool and gains). The
defaults of the block describe the Panda; no other code of this package is specific to one arm. The
package has two outputs. One is a finalized `MultibodyPlant` of the robot alone
(`plant.RobotPlant`). Its base link is welded to the world at X_WB, and its tool frame E is at the
tool point. The other output is `arm.Chain`, the same arm as arrays for compiled kernels, with six
or more revolute joints in series. Configurations q [rad, m] are in the order of the plant, with the
arm's joints first. Poses X_WE are in the world. The package contains no LeafSystems.

- `plant`, `grasped_object`: parsing of the model, once per process; base pose, limits, grasped
  object, and corners of the tool. `formats`: conversion of models that Drake cannot read.
- `arm`: forward kinematics, geometric Jacobian, tracking of tool paths, and inverse kinematics
  within the joint limits.
- `spheres`: spheres that enclose the collision geometry of the robot and its grasped object, with
  the pairs of bodies that can collide. `sphere_cover`: spheres of one body by a greedy set cover
  with proven enclosure; the spheres of the Panda are shipped.
- `inertias`: replacement of the inertial parameters of a model by those of a file.

Read `plant.make_robot_plant` and `arm.make_chain` first.
"""
