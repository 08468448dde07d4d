"""Posture layer: nominal joint motion that the null space of a redundant arm tracks.

In:  motion `PlannedMotion` with joint positions (T, n) [rad]; policy_state `PolicyState`, the state
     of the movement primitive that generates the motion of the tool.
Out: desired_posture (2n,), nominal joint positions [rad] and velocities [rad/s], for `MotionGuard`
     or `CartesianInverseDynamics`.

System
    NominalPostureSource  outputs the planned joint positions as a continuous trajectory over time,
                          and checks every 8 ms (step of the movement primitive) for a new plan

Method
    Monotone cubic interpolation of the samples (F. N. Fritsch and J. Butland, SIAM J. Sci. Stat.
    Comput. 5(2), 1984), and a critically damped transition to each new plan.

Modules: `posture_trajectory` (trajectory for one planned motion), `nominal_posture_source`.

Read first: `posture_trajectory`.
"""
