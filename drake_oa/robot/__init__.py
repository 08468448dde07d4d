"""The arm: its plant, its kinematics as arrays, inverse kinematics and limits.

In: the block `robot` of a scenario (`config.Robot`: model, base pose X_WB, tool and gains;
its defaults are the Panda's, and nothing else here knows of one arm). Out: a finalized
`MultibodyPlant` of the robot alone (`plant.RobotPlant`), its base link welded to the world at X_WB,
with the frame E at the tool point; and `arm.Chain`, the same arm as arrays for compiled
kernels: revolute joints in series, six or more. Positions q [rad, m] are the plant's, the arm's
joints first; poses X_WE in the world. There are no systems here: the layers above hold a plant
each.

- `plant`, `grasped_object`: parsing once a process, welding, limits, what the hand holds, the
  tool's corners. `formats`: a model with meshes that Drake does not read, without actuators, or in
  a package of Python, as Drake takes it.
- `arm`: forward kinematics, the geometric Jacobian, tracking of a path of the tool, and inverse
  kinematics within the joint limits.
- `spheres`: the robot, with what it holds, as spheres that enclose its collision geometry; pairs of
  bodies that may touch are found in random postures. `sphere_cover`: a body's spheres by a greedy
  set cover, proven; those of the Panda are shipped.
- `inertias`: a model with those of a file in place of its own.

Begin with `plant.make_robot_plant` and `arm.make_chain`.
"""
