"""From a desired motion to torques: inverse dynamics of the arm, in its joints or of its tool.

In: robot_state [q, v] and either the desired position, velocity and acceleration of the arm's
joints, or those (3,) of E in the world [m, m/s, m/s^2], optionally with orientation, angular
velocity and acceleration, and a posture. Out: actuation [N m], whether torques saturate, and
whether the arm is being stopped; of the tool also tracking error (3,) [m] and orientation error
(3,) [rad].

Systems:

- `JointInverseDynamics`: computed torque for the joints that MotionGuard commands.
- `CartesianInverseDynamics`: operational-space law for the tool, in diagrams without MotionGuard,
  as those of `!Paper`.

Both derive from `InverseDynamics`: an integral, updated at `policy.period`, removes the error that
a wrong model leaves; torques are limited to the joints' efforts with the direction of the
acceleration kept; an input that is not finite brakes the joints.

The configuration is `robot.gains` of a scenario (`drake_oa.robot.config.Gains`).

Begin with `joint_inverse_dynamics`.
"""
