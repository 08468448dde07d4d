"""Control layer: inverse dynamics of the arm, in joint space or for the tool.

In: robot_state (positions q and velocities v), and desired position, velocity and acceleration,
either of the arm's joints [rad, rad/s, rad/s^2], or (3,) of the tool point E in the world
[m, m/s, m/s^2]. For the tool, desired orientation, angular velocity, angular acceleration and
posture are optional.
Out: actuation [N m], whether torques saturate, and whether the arm is being braked; for the tool
also tracking error (3,) [m] and orientation error (3,) [rad].

Systems:

- `JointInverseDynamics`: computed-torque control of the joint motion that MotionGuard, the system
  of the safety layer, outputs.
- `CartesianInverseDynamics`: operational-space control of the tool, in diagrams without
  MotionGuard, such as those of `inference: !Paper` (the method of Pairet et al., RA-L 2019, without
  checks of the motion by simulation).

Both derive from `InverseDynamics`. Integral action, updated each `policy.period`, removes the
steady-state error caused by model errors. Torques are limited to the joints' effort limits without
changing the direction of the acceleration. While an input is not finite, the joints are braked by
damping.

The configuration is `robot.gains` of a scenario (`drake_oa.robot.config.Gains`).

Read first: `joint_inverse_dynamics`.
"""
