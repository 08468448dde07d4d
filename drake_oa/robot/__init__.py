"""Robot arm: plant, kinematics as arrays, inverse kinematics, limits, and covering spheres.

In: the block `robot` of a scenario (`config.Robot`: model, base pose X_WB, tool and gains), whose
defaults are those of the Panda; no other code here is specific to one arm. Out: a finalized
`MultibodyPlant` of the robot alone (`plant.RobotPlant`), its base link welded to the world at X_WB,
with the frame E at the tool point; and `arm.Chain`, the same arm as arrays for compiled kernels,
with six or more revolute joints in series. Configurations q [rad, m] are in the order of the
plant, the arm's joints first; poses X_WE are in the world. The package has no systems.

- `plant`, `grasped_object`: model parsing, once per process, base pose, limits, grasped object, and
  corners of the tool. `formats`: conversion of models that Drake cannot read.
- `arm`: forward kinematics, geometric Jacobian, tracking of tool paths, and inverse kinematics
  within the joint limits.
- `spheres`: the robot and its grasped object as spheres that enclose the collision geometry, with
  the pairs of bodies that can collide. `sphere_cover`: spheres of a body by a greedy set cover with
  proven enclosure; those of the Panda are shipped.
- `inertias`: a model with the inertial parameters of a file.

Read `plant.make_robot_plant` and `arm.make_chain` first.
"""
