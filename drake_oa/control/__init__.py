"""From the desired motion of the tool to torques: inverse dynamics in operational space.

In: robot_state [q, v], desired position, velocity and acceleration (3,) of E in the world [m, m/s,
m/s^2]; optionally orientation, angular velocity and acceleration, a posture and a null-space
acceleration. Out: actuation [N m], whether torques saturate, tracking error (3,) [m], orientation
error (3,) [rad], and whether the arm is being stopped.

Systems:

- `CartesianInverseDynamics`: stateless, evaluated with every step of the plant.
- `IntegralAction`: adds to the desired acceleration what a wrong model lacks, summed up at
  `policy.period`.

The law is tau = M (a_0 + J# (A_c - dJ/dt v - J a_0)) + h with the dynamically consistent inverse J#
(Khatib, IEEE J. Robotics and Automation 3(1), 1987), damped near singularities, and limited to
the joints' efforts, the task before the posture. What is not finite brakes the joints.

The configuration is `robot.gains` of a scenario (`drake_oa.robot.config.Gains`).

Begin with `operational_space`, then `operational_space_kernels.law`.
"""
