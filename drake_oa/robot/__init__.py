"""The arm: its plant, its kinematics as arrays, inverse kinematics and limits.

In: the block `robot` of a scenario (`config.Robot`: model, tool, gains, posture). Out: a finalized
`MultibodyPlant` of the robot alone (`plant.RobotPlant`), welded to the world by its base link,
with the frame E at the tool point; and `arm.ArmModel`, the same arm as arrays for compiled
kernels. Positions q [rad, m] are the plant's, the arm's joints first; poses X_WE in the world.
There are no systems here: the layers above hold a plant each.

- `plant`, `grasped_object`: parsing, welding, what the hand holds, the tool's corners.
- `arm_kernels`: forward kinematics of revolute joints, the geometric Jacobian, Newton steps onto
  a pose with one joint fixed, distances of links to points, to a plane and to each other.
- `inverse_kinematics`: `solve_tool_pose` at set-up, by Drake's `InverseKinematics` and Newton
  steps within the joint limits; `solve_pose`, compiled, damped and weighted by the joints' ranges.
- `reachability`: where the tool can be held in one orientation, on a grid, with signed margins;
  and an annulus about the base that was fitted to the Panda held tool down.
- `reachable_turns`: which turns of the tool the arm can hold along a path.
- `limits`: joint names and limits. `panda_inertias`: measured inertias (Gaz et al. 2019), and a
  model with uniform density in place of them.

Begin with `plant.make_robot_plant` and `arm.make_arm_model`.
"""
