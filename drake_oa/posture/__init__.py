"""Posture layer: nominal joint motion that the null space of a redundant arm tracks.

In:  motion `PlannedMotion` with joint positions (T, n) [rad]; policy_state `PolicyState`.
Out: desired_posture (2n,) [rad, rad/s] for `MotionGuard` or `CartesianInverseDynamics`.

System
    NominalPostureSource  outputs the planned joint positions as a continuous trajectory over time,
                          and checks at each step of the policy (8 ms) for a new plan

Method
    Monotone cubic interpolation of the samples (F. N. Fritsch and J. Butland, SIAM J. Sci. Stat.
    Comput. 5(2), 1984), and a critically damped transition to each new plan.

Modules: `posture_trajectory` (trajectory for one planned motion), `nominal_posture_source`.

Read first: `posture_trajectory`.
"""
