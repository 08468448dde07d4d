"""Posture: where the rest of a redundant arm goes while its tool follows a path.

In:  motion `PlannedMotion` with the arm's joints (T, n) [rad]; policy_state; evading `Evasion`; for
     the coupling robot_state (2m,) [rad, rad/s] and obstacles_W `ObstacleClouds` (W, [m, m/s]).
Out: desired_posture (2n,) [rad, rad/s] and null_space_acceleration (n,) [rad/s^2] for
     `CartesianInverseDynamics`.

Systems
    PostureFollower    every step of the policy (8 ms); the joints of the motion as a smooth course
                       of time
    NullSpaceCoupling  every step; the coupling law on the links' points that are nearest to
                       obstacles (the paper's final remarks); off unless asked for

Method
    Monotone cubics through the samples (F. N. Fritsch and J. Butland, SIAM J. Sci. Stat. Comput.
    5(2), 1984), taken over critically damped; the coupling in an orthonormal basis of the null
    space, by a damped inverse.

Parts: `posture_course` (a plan over time), `posture_follower`, `null_space_coupling`.

Configuration: `robot.null_space_coupling` (`drake_oa.robot.config.NullSpaceCouplingParameters`).

Read first: `posture_course`.
"""
