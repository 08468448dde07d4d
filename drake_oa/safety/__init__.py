"""Safety: slows, holds or stops a motion, and gets the arm out of the way of what moves.

In:  robot_state (2n,) [rad, rad/s], policy_state `PolicyState`, obstacles_W `ObstacleClouds`
     (W, [m, m/s]), motion `PlannedMotion`, tracking_error (3,) [m], torque_saturation.
Out: speed_scale in [0, 1] and evasion (3,) [m/s] for `DmpIntegrator`; supervision `Supervision`;
     evading `Evasion` for `PostureFollower`.

Systems
    Supervisor       every step of the policy (8 ms); the least of what its monitors allow
    ObstacleEvasion  every observation (15 Hz), its velocity every step; leaves the motion alone,
                     holds it, turns the arm in its null space, or displaces the tool

Method
    A link is slowed so that it rests before it touches: share * c + c_obstacle <= (d - d_stop) /
    T_reaction for every pair of a link and a point that is near, which is speed and separation
    monitoring (ISO/TS 15066). With `solids_W` connected, distances are of the arm's spheres to
    the true shapes, and what rests beside a verified `motion` is approached as near as braking
    allows: see `supervision`. Evasion looks about a second ahead on some hundred ways of the arm,
    by the product of exponentials (Murray, Li and Sastry, 1994, section 3.2), among obstacles
    that go on at their velocities.

Parts: `supervision` (state and decision) with `monitors` (what each asks for) and
`approach_kernels` (distances); `evasion` (the choice) with `evasion_candidates`, `lookahead` and
`lookahead_kernels`.

Configuration: `config`, the blocks `supervisor` and `evasion` of a scenario.

Read first: `supervision`, then `evasion`.
"""
