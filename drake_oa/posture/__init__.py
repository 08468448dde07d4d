"""Posture: where the rest of a redundant arm goes while its tool follows a path.

In:  motion `PlannedMotion` with the arm's joints (T, n) [rad]; policy_state.
Out: desired_posture (2n,) [rad, rad/s] for `CartesianInverseDynamics`.

System
    NominalPostureSource    every step of the policy (8 ms); the joints of the motion as a smooth course
                       of time

Method
    Monotone cubics through the samples (F. N. Fritsch and J. Butland, SIAM J. Sci. Stat. Comput.
    5(2), 1984), taken over critically damped.

Parts: `posture_trajectory` (a plan over time), `nominal_posture_source`.

Read first: `posture_trajectory`.
"""
